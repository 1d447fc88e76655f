"""How far policies are from an optimal one, π*, on MountainCar (§5.1, Table 1)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple, Protocol

import gymnasium as gym
import numpy as np
import pandas as pd
from gymnasium.envs.classic_control.mountain_car import MountainCarEnv
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.special import log_softmax, softmax

from ril.environments.environment import Floats
from ril.policy import load_policy

ACTIONS = ("left", "none", "right")
#: Start positions, at rest, evenly over the range of `reset`: each policy plays one episode each.
STARTS = np.linspace(-0.6, -0.4, 100)
#: Replaces the zeros of one-hot distributions. In an episode of 86 steps, the length of the paper's
#: π*, 15 and 7 different actions then give the paper's 1.7345 and 0.8094.
SMOOTHING = 4.792e-5

_CAR = MountainCarEnv()
_EPISODE_STEPS = gym.spec("MountainCar-v0").max_episode_steps or 0
_LOW = np.array([_CAR.min_position, -_CAR.max_speed])
_HIGH = np.array([_CAR.max_position, _CAR.max_speed])
_NODES = np.array([541, 421], dtype=np.int32)  # of position and velocity; the goal, 0.5, is one
_TOLERANCE = 1e-6  # steps, between two sweeps of value iteration
_TIE = 1e-2  # steps, by which equally good actions may differ on the grid

Array = NDArray[np.float64]


class DiscretePolicy(Protocol):
    """A policy over raw observations, such as `ril.policy.Policy`."""

    def values(self, observations: Floats, /) -> NDArray[np.floating]:
        """Return the (N, 3) outputs whose softmax is the policy, for raw observations (N, 2)."""

    def probabilities(self, observations: Floats, /) -> NDArray[np.floating]:
        """Return (N, 3) action probabilities for raw observations (N, 2)."""

    def predict(self, observations: Floats, /) -> NDArray[np.int64]:
        """Return (N,) greedy actions for raw observations (N, 2)."""


def step(
    states: NDArray[np.floating], actions: NDArray[np.int64]
) -> tuple[Array, NDArray[np.bool_]]:
    """Advance many cars of MountainCar-v0 by one step.

    Args:
        states: (..., 2) position and velocity.
        actions: (...) push to the left, none, or to the right.

    Returns:
        (..., 2) next states, and (...) whether each is at the goal.
    """
    position, velocity = np.moveaxis(np.asarray(states, dtype=np.float64), -1, 0)
    push = (actions - 1) * _CAR.force - np.cos(3 * position) * _CAR.gravity
    velocity = np.clip(velocity + push, -_CAR.max_speed, _CAR.max_speed)
    position = np.clip(position + velocity, _CAR.min_position, _CAR.max_position)
    velocity = np.where((position == _CAR.min_position) & (velocity < 0), 0, velocity)
    terminated = (position >= _CAR.goal_position) & (velocity >= _CAR.goal_velocity)
    return np.stack([position, velocity], axis=-1), terminated


def _lookahead(states: NDArray[np.floating]) -> csr_array:
    """Return (3N, nodes) weights that interpolate the next states of N states; 0 at the goal."""
    following, terminated = step(states, np.arange(len(ACTIONS))[:, None])
    scaled = (following.reshape(-1, 2) - _LOW) / (_HIGH - _LOW) * (_NODES - 1)
    corner = np.minimum(scaled.astype(np.int32), _NODES - 2)
    shares = np.stack([1 - (scaled - corner), scaled - corner])  # of lower and upper node, by axis
    weights = np.einsum("in,jn->nij", shares[..., 0], shares[..., 1])
    weights *= ~terminated.reshape(-1, 1, 1)
    first = corner[:, 0] * _NODES[1] + corner[:, 1]
    nodes = first[:, None] + np.array([0, 1, _NODES[1], _NODES[1] + 1], dtype=np.int32)
    rows = np.arange(0, weights.size + 1, 4, dtype=np.int32)
    return csr_array((weights.ravel(), nodes.ravel(), rows), shape=(len(corner), _NODES.prod()))


@dataclass(frozen=True)
class OptimalPolicy:
    """π*, which reaches the goal in the fewest steps.

    Attributes:
        node_values: (nodes,) minus the steps to the goal from each node of a grid of states.
    """

    node_values: Array

    def values(self, observations: Floats) -> Array:
        """Return (N, 3) Q*, minus the steps to the goal after each action."""
        after: Array = _lookahead(observations) @ self.node_values
        return after.reshape(len(ACTIONS), -1).T - 1

    def probabilities(self, observations: Floats) -> Array:
        """Return the (N, 3) softmax of Q*."""
        probabilities: Array = softmax(self.values(observations), axis=-1)
        return probabilities

    def predict(self, observations: Floats) -> NDArray[np.int64]:
        """Return (N,) best actions; among equally good ones, the one along the motion."""
        values = self.values(observations)
        best = values >= values.max(axis=-1, keepdims=True) - _TIE
        along = np.sign(observations[:, 1:]) * (np.arange(len(ACTIONS)) - 1)
        actions: NDArray[np.int64] = np.where(best, along, -2).argmax(axis=-1)
        return actions


@cache
def optimal_policy() -> OptimalPolicy:
    """Compute π* by undiscounted value iteration on a grid of 541 positions × 421 velocities."""
    axes = (np.linspace(*bounds) for bounds in zip(_LOW, _HIGH, _NODES, strict=True))
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    lookahead = _lookahead(grid.reshape(-1, 2))
    values, change = np.zeros(_NODES.prod()), np.inf
    while change > _TOLERANCE:
        updated = (lookahead @ values).reshape(len(ACTIONS), -1).max(axis=0) - 1
        change = np.abs(updated - values).max()
        values = updated
    return OptimalPolicy(values)


def play(policy: DiscretePolicy, positions: NDArray[np.floating]) -> tuple[Array, Floats]:
    """Play greedy episodes of at most 200 steps from some positions at rest, all at once.

    Args:
        policy: the policy that acts.
        positions: (N,) start positions.

    Returns:
        (N,) returns, and (M, 2) all states in which the policy acted, step by step.
    """
    states = np.stack([positions, np.zeros_like(positions)], axis=-1).astype(np.float64)
    returns = np.zeros(len(states))
    running = np.arange(len(states))
    visited = []
    for _ in range(_EPISODE_STEPS):
        visited.append(states.astype(np.float32))  # the precision of the environment's observations
        returns[running] -= 1
        states, terminated = step(states, policy.predict(visited[-1]))
        states, running = states[~terminated], running[~terminated]
        if not running.size:
            break
    return returns, np.concatenate(visited)


def cells(count: int = 20) -> Floats:
    """Return (count, count, 2) centers of a grid of states: positions up to the goal × velocities.

    Figure 3 has 20 × 20 cells.
    """
    middles = (np.arange(count) + 0.5) / count
    high = np.array([_CAR.goal_position, _CAR.max_speed])
    scaled = np.stack(np.meshgrid(middles, middles, indexing="ij"), axis=-1)
    states: Floats = (_LOW + scaled * (high - _LOW)).astype(np.float32)
    return states


def agreement(policy: DiscretePolicy, states: Floats) -> NDArray[np.bool_]:
    """Return (N,) whether a policy's greedy action is that of π* in states (N, 2)."""
    same: NDArray[np.bool_] = policy.predict(states) == optimal_policy().predict(states)
    return same


def divergence(policy: DiscretePolicy, states: Floats) -> Array:
    """Compute (N,) KL(π* ‖ π) of the action probabilities in states (N, 2), in nats."""
    return _kl(_log_probabilities(optimal_policy(), states), _log_probabilities(policy, states))


def greedy_divergence(policy: DiscretePolicy, states: Floats) -> Array:
    """Compute (N,) KL(π* ‖ π) of greedy actions, as smoothed one-hots, in states (N, 2)."""
    smoothed = np.where(np.eye(len(ACTIONS)), 1 - 2 * SMOOTHING, SMOOTHING)
    one_hots = np.log(smoothed)
    return _kl(one_hots[optimal_policy().predict(states)], one_hots[policy.predict(states)])


def _log_probabilities(policy: DiscretePolicy, states: Floats) -> Array:
    """Return (N, 3) from the outputs, since a probability may round to 0."""
    logs: Array = log_softmax(policy.values(states).astype(np.float64), axis=-1)
    return logs


def _kl(log_p: Array, log_q: Array) -> Array:
    total: Array = (np.exp(log_p) * (log_p - log_q)).sum(axis=-1)
    return total


@cache
def _optimal_episodes() -> tuple[Array, Floats]:
    return play(optimal_policy(), STARTS)


def optimal_reward() -> float:
    """Return the mean return of π* from all starts (Table 1)."""
    return float(_optimal_episodes()[0].mean())


class Measures(NamedTuple):
    """Table 1's measures of a policy, and the shares of states in which it acts as π* does.

    Attributes:
        reward: mean return from all starts.
        divergence: mean KL(π* ‖ π) over the states of π*'s episodes from there, in nats.
        greedy_divergence: the same of the greedy actions.
        agreement: share of these states.
        agreement_of_cells: share of Figure 3's 20 × 20 states.
    """

    reward: float
    divergence: float
    greedy_divergence: float
    agreement: float
    agreement_of_cells: float


def measures(policy: DiscretePolicy) -> Measures:
    """Measure how far a policy is from π* (Table 1)."""
    _, visited = _optimal_episodes()
    return Measures(
        reward=float(play(policy, STARTS)[0].mean()),
        divergence=float(divergence(policy, visited).mean()),
        greedy_divergence=float(greedy_divergence(policy, visited).mean()),
        agreement=float(agreement(policy, visited).mean()),
        agreement_of_cells=float(agreement(policy, cells().reshape(-1, 2)).mean()),
    )


def divergences(rows: pd.DataFrame, which: str = "best") -> pd.DataFrame:
    """Measure the saved policies of some runs' seeds (Table 1).

    Args:
        rows: each a `seed` of the run whose `policy.pt` is in `folder`.
        which: "best" or "last" policy of each.

    Returns:
        The fields of `Measures` as columns, for each row.

    Raises:
        UserError: a policy cannot be read, or a seed is not in its file.
    """
    places = zip(rows["folder"], rows["seed"], strict=True)
    found = [_saved(folder / "policy.pt", seed, which) for folder, seed in places]
    return pd.DataFrame(found, rows.index, Measures._fields)


@cache
def _saved(file: Path, seed: int, which: str) -> Measures:
    return measures(load_policy(file, seed, which))
