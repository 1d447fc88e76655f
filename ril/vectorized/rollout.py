"""Whole episodes in many copies of one environment, played side by side."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ril.environments.environment import Environment, Floats, Integers
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
        count, limit = self._count, max_steps or self.environment.max_episode_steps
        for index, seed in enumerate(reset_seeds.tolist()):
            self._copies.reset(index, seed)
        # Lists, since the limit may be far above the length of any episode.
        states = [self.environment.scale(self._copies.observations)]
        actions: list[Integers] = []
        rewards: list[Floats] = []
        terminated: list[NDArray[np.bool_]] = []
        lengths = np.zeros(count, dtype=np.int64)
        running = np.arange(count)
        while running.size and len(actions) < limit:
            chosen = act(states[-1], len(actions))
            outcome = self._copies.step(running, chosen[running])
            earned, ends = np.zeros(count, dtype=np.float32), np.zeros(count, dtype=bool)
            earned[running], ends[running], truncated = outcome
            actions.append(chosen)
            rewards.append(earned)
            terminated.append(ends)
            lengths[running] += 1
            over = outcome[1] | truncated
            if over.any():
                running = running[~over]
            states.append(self.environment.scale(self._copies.observations))

        by_copy = np.stack(states, axis=1)
        return Episodes(
            by_copy[:, :-1],
            np.stack(actions, axis=1),
            np.stack(rewards, axis=1),
            by_copy[:, 1:],
            np.stack(terminated, axis=1),
            lengths,
        )
