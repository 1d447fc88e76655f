"""Whole episodes in many copies of one environment, played side by side."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ril.environments import Environment, Floats, Integers
from ril.vectorized.copies import make_copies

#: From (K, obs) scaled observations and the number of the step to (K,) actions.
Act = Callable[[Floats, int], Integers]


@dataclass(frozen=True)
class Episodes:
    """K episodes, padded to the length T of the longest.

    Attributes:
        observations: (K, T, obs) scaled states s_t.
        actions: (K, T).
        rewards: (K, T), 0 after an episode's end.
        next_observations: (K, T, obs) scaled states s_{t+1}.
        terminated: (K, T), true at a last step at which the environment ended the episode.
        lengths: (K,) steps of each episode.
    """

    observations: Floats
    actions: Integers
    rewards: Floats
    next_observations: Floats
    terminated: NDArray[np.bool_]
    lengths: Integers

    @property
    def returns(self) -> NDArray[np.float64]:
        """(K,) undiscounted returns."""
        total: NDArray[np.float64] = self.rewards.sum(axis=1, dtype=np.float64)
        return total

    @property
    def ends(self) -> NDArray[np.bool_]:
        """(K,) whether the environment, not the step limit, ended the episode."""
        return self.terminated[np.arange(len(self.lengths)), self.lengths - 1]

    @property
    def final_rewards(self) -> Floats:
        """(K,) reward of each episode's last step."""
        return self.rewards[np.arange(len(self.lengths)), self.lengths - 1]


class Environments:
    """K copies of an environment, each stepped only while its own episode lasts.

    Args:
        environment: what to copy.
        copies: K.
    """

    def __init__(self, environment: Environment, copies: int) -> None:
        self.environment = environment
        self._count = copies
        self._copies = make_copies(environment, copies)

    def play(self, act: Act, reset_seeds: Integers, max_steps: int | None = None) -> Episodes:
        """Play one episode in each copy.

        Args:
            act: chooses the actions of all copies; those of copies whose episode is over are
                ignored.
            reset_seeds: (K,) seeds of the resets.
            max_steps: number of steps after which to stop every episode; the environment's own
                limit if None.
        """
        count = self._count
        limit = max_steps or self.environment.max_episode_steps
        size = self.environment.observation_size
        states = np.zeros((limit + 1, count, size), dtype=np.float32)
        actions = np.zeros((limit, count), dtype=np.int64)
        rewards = np.zeros((limit, count), dtype=np.float32)
        terminated = np.zeros((limit, count), dtype=bool)
        lengths = np.zeros(count, dtype=np.int64)

        for index, seed in enumerate(reset_seeds.tolist()):
            self._copies.reset(index, seed)
        states[0] = self.environment.scale(self._copies.observations)
        running = np.arange(count)
        step = 0
        while running.size and step < limit:
            actions[step] = act(states[step], step)
            outcome = self._copies.step(running, actions[step, running])
            rewards[step, running], ended, truncated = outcome
            terminated[step, running] = ended
            step += 1
            lengths[running] = step
            if ended.any() or truncated.any():
                running = running[~(ended | truncated)]
            states[step] = self.environment.scale(self._copies.observations)

        by_copy = np.ascontiguousarray(states[: step + 1].swapaxes(0, 1))
        return Episodes(
            by_copy[:, :-1],
            np.ascontiguousarray(actions[:step].T),
            np.ascontiguousarray(rewards[:step].T),
            by_copy[:, 1:],
            np.ascontiguousarray(terminated[:step].T),
            lengths,
        )
