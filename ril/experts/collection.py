"""Play episodes of one policy, put them in order, and save them as demonstrations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ril.environments.environment import Environment, Floats

Policy = Callable[[Floats], NDArray[np.integer]]  # (N, obs) raw observations -> (N,) actions


@dataclass(frozen=True, eq=False)
class Episode:
    """One episode of T steps.

    Attributes:
        seed: seed of the environment's reset.
        observations: (T + 1, obs) raw states.
        actions: (T,) actions.
        rewards: (T,) rewards.
        terminated: whether the environment ended the episode, not the step limit.
    """

    seed: int
    observations: Floats
    actions: NDArray[np.int64]
    rewards: Floats
    terminated: bool

    @property
    def length(self) -> int:
        """Return T, the number of steps."""
        return len(self.actions)

    @property
    def total_reward(self) -> float:
        """Return the undiscounted return."""
        return float(self.rewards.sum(dtype=np.float64))


def play(environment: Environment, policy: Policy, seeds: Sequence[int]) -> list[Episode]:
    """Play one episode per reset seed, all of them at the same time.

    Args:
        environment: the environment, of which each episode has a copy.
        policy: raw observations (N, obs) of the N running episodes to actions (N,).
        seeds: reset seeds.

    Returns:
        The episodes, in the order of their seeds.
    """
    copies = [environment.make() for _ in seeds]
    starts = [env.reset(seed=seed)[0] for env, seed in zip(copies, seeds, strict=True)]
    # Copied, since an environment may change its observation in place.
    observations = [[np.array(start, dtype=np.float32)] for start in starts]
    actions: list[list[int]] = [[] for _ in seeds]
    rewards: list[list[float]] = [[] for _ in seeds]
    terminated = [False] * len(seeds)
    running = list(range(len(seeds)))
    while running:
        chosen = policy(np.array([observations[i][-1] for i in running], dtype=np.float32))
        still = []
        for i, action in zip(running, chosen.tolist(), strict=True):
            observation, reward, terminated[i], truncated, _ = copies[i].step(action)
            observations[i].append(np.array(observation, dtype=np.float32))
            actions[i].append(action)
            rewards[i].append(float(reward))
            if not (terminated[i] or truncated):
                still.append(i)
        running = still
    for env in copies:
        env.close()
    return [
        Episode(
            seed,
            np.array(observations[i], dtype=np.float32),
            np.array(actions[i], dtype=np.int64),
            np.array(rewards[i], dtype=np.float32),
            bool(terminated[i]),
        )
        for i, seed in enumerate(seeds)
    ]


def put_first(
    episodes: Sequence[Episode], first_length: int | None, target_return: float, margin: float
) -> list[Episode]:
    """Move the episode that single-trajectory runs will see to the front (Table 6).

    The candidates are the typical episodes: those that return at most `margin` less than
    `target_return`, and at most the larger of `margin` and one standard deviation of the returns
    more. The upper limit keeps the best episode of a sub-optimal expert from representing it. If
    no episode is typical, all are candidates. The candidate with the length nearest `first_length`
    is chosen; ties go to the highest return, then to the earliest.

    Args:
        episodes: the episodes in the order in which they were collected.
        first_length: steps; None leaves the order as it is.
        target_return: mean return that the expert was trained to.
        margin: tolerance of that return.

    Returns:
        All episodes; those that were not chosen keep their order.
    """
    if first_length is None:
        return list(episodes)
    above = max(margin, float(np.std([e.total_reward for e in episodes])))
    typical = [e for e in episodes if -margin <= e.total_reward - target_return <= above]
    first = min(typical or episodes, key=lambda e: (abs(e.length - first_length), -e.total_reward))
    return [first, *(episode for episode in episodes if episode is not first)]


def pack(episodes: Sequence[Episode]) -> dict[str, NDArray[Any]]:
    """Concatenate episodes into the arrays of ril's own layout (docs/demonstrations.md)."""
    return {
        "observations": np.concatenate([e.observations for e in episodes]),
        "actions": np.concatenate([e.actions for e in episodes]),
        "rewards": np.concatenate([e.rewards for e in episodes]),
        "lengths": np.array([e.length for e in episodes], dtype=np.int64),
        "terminated": np.array([e.terminated for e in episodes]),
    }


def save(path: Path, episodes: Sequence[Episode]) -> None:
    """Write episodes as a compressed npz file of demonstrations."""
    arrays: dict[str, Any] = pack(episodes)
    np.savez_compressed(path, allow_pickle=False, **arrays)
