"""Environments that are stepped without end: each begins its next episode by itself."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ril.environments import Environment, Floats, Integers
from ril.vectorized.copies import make_copies


@dataclass(frozen=True)
class Step:
    """One step of K environments.

    Attributes:
        next_observations: (K, obs) scaled s_{t+1}; of an episode that ended, its final state.
        rewards: (K,).
        terminated: (K,) whether the environment ended the episode.
        truncated: (K,) whether the step limit cut it.
    """

    next_observations: Floats
    rewards: Floats
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]


class SteppedEnvironments:
    """K copies of an environment per seed; what one meets depends on its seed and number only.

    Gymnasium's environments cannot be saved, but they can be repeated: the state of a copy is
    the number of its episode and the actions since that began.

    Args:
        environment: of which copies are made.
        seeds: S; copies of one seed lie side by side.
        copies: K per seed.
        purpose: names the episodes; the same purpose gives the same starts.

    Attributes:
        observations: (S·K, obs) scaled current states.
    """

    def __init__(
        self, environment: Environment, seeds: Sequence[int], copies: int, purpose: str
    ) -> None:
        self.environment = environment
        self._keys = [
            [seed, zlib.crc32(purpose.encode()), k] for seed in seeds for k in range(copies)
        ]
        count = len(self._keys)
        self._all = np.arange(count)
        self._copies = make_copies(environment, count)
        self._episodes = [0] * count
        self._actions = np.zeros((environment.max_episode_steps, count), dtype=np.int64)
        self._taken = np.zeros(count, dtype=np.int64)  # actions since the episode began
        for index in range(count):
            self._begin(index)
        self.observations = environment.scale(self._copies.observations)

    def _begin(self, index: int) -> None:
        """Reset a copy to the start of its current episode."""
        sequence = np.random.SeedSequence([*self._keys[index], self._episodes[index]])
        self._copies.reset(index, int(sequence.generate_state(1)[0] >> 1))
        self._taken[index] = 0

    def step(self, actions: Integers) -> Step:
        """Take (S·K,) actions; `observations` then are the states to act in next."""
        self._actions[self._taken, self._all] = actions
        self._taken += 1
        rewards, terminated, truncated = self._copies.step(self._all, actions)
        following = self.environment.scale(self._copies.observations)
        self.observations = following
        over = terminated | truncated
        if over.any():
            for index in np.flatnonzero(over).tolist():
                self._episodes[index] += 1
                self._begin(index)
            self.observations = self.environment.scale(self._copies.observations)
        return Step(following, rewards, terminated, truncated & ~terminated)

    def state_dict(self) -> dict[str, Any]:
        """Which episode each copy is in, and how it came to where it is."""
        taken = zip(self._actions.T, self._taken, strict=True)
        return {
            "episodes": list(self._episodes),
            "actions": [actions[:count].tolist() for actions, count in taken],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from where `state_dict` was taken, by playing the current episodes again."""
        self._episodes = list(state["episodes"])
        for index, actions in enumerate(state["actions"]):
            self._begin(index)
            self._actions[: len(actions), index] = actions
            self._taken[index] = len(actions)
        for step in range(self._taken.max()):
            going_on = np.flatnonzero(self._taken > step)
            self._copies.step(going_on, self._actions[step, going_on])
        self.observations = self.environment.scale(self._copies.observations)
