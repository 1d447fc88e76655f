"""Environments that are stepped without end: each begins its next episode by itself."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ril.environments import Environment, Floats
from ril.vectorized.rollout import Integers


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
        self._copies = [environment.make() for _ in range(len(seeds) * copies)]
        self._keys = [
            [seed, zlib.crc32(purpose.encode()), k] for seed in seeds for k in range(copies)
        ]
        self._raw = np.zeros((len(self._copies), environment.observation_size), dtype=np.float32)
        self._episodes = [0] * len(self._copies)
        self._actions: list[list[int]] = [[] for _ in self._copies]
        for index in range(len(self._copies)):
            self._begin(index)
        self.observations = environment.scale(self._raw)

    def _begin(self, index: int) -> None:
        """Reset a copy to the start of its current episode."""
        sequence = np.random.SeedSequence([*self._keys[index], self._episodes[index]])
        start = int(sequence.generate_state(1)[0] >> 1)
        self._raw[index] = self._copies[index].reset(seed=start)[0]
        self._actions[index] = []

    def step(self, actions: Integers) -> Step:
        """Take (S·K,) actions; `observations` then are the states to act in next."""
        rewards, ends, cuts = [], [], []
        for index, action in enumerate(actions.tolist()):
            self._raw[index], reward, ended, cut, _ = self._copies[index].step(action)
            rewards.append(reward)
            ends.append(ended)
            cuts.append(cut)
            self._actions[index].append(action)
        terminated, truncated = np.array(ends, dtype=bool), np.array(cuts, dtype=bool)
        following = self.environment.scale(self._raw)
        self.observations = following
        if any(ends) or any(cuts):
            for index in np.flatnonzero(terminated | truncated).tolist():
                self._episodes[index] += 1
                self._begin(index)
            self.observations = self.environment.scale(self._raw)
        return Step(
            following,
            np.array(rewards, dtype=np.float32),
            terminated,
            truncated & ~terminated,
        )

    def state_dict(self) -> dict[str, Any]:
        """Which episode each copy is in, and how it came to where it is."""
        return {
            "episodes": list(self._episodes),
            "actions": [list(actions) for actions in self._actions],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from where `state_dict` was taken, by playing the current episodes again."""
        self._episodes = list(state["episodes"])
        for index, actions in enumerate(state["actions"]):
            self._begin(index)
            for action in actions:
                self._raw[index] = self._copies[index].step(action)[0]
            self._actions[index] = list(actions)
        self.observations = self.environment.scale(self._raw)
