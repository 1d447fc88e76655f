"""Environments that reset themselves: each begins its next episode when one is over."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ril.environments.environment import Environment, Floats, Integers
from ril.vectorized.copies import make_copies

_ROOM = 256  # steps of an episode, at first


@dataclass(frozen=True)
class Step:
    """One step of K environments.

    Attributes:
        next_observations: (K, obs) scaled s_{t+1}; the final state where an episode is over.
        rewards: (K,).
        terminated: (K,) whether the environment ended the episode.
        truncated: (K,) whether the step limit truncated it.
    """

    next_observations: Floats
    rewards: Floats
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]


class SteppedEnvironments:
    """K copies of an environment per seed; a copy's episodes depend on its seed and number only.

    Gymnasium's environments cannot be saved, but their episodes can be replayed: the state of a
    copy is the number of its episode and the actions in it so far.

    Args:
        environment: what to copy.
        seeds: S; copies of one seed lie side by side.
        copies: K per seed.
        purpose: names the episodes; the same purpose gives the same initial states.

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
        self._actions = np.zeros((_ROOM, count), dtype=np.int64)  # grows with the episodes
        self._steps = np.zeros(count, dtype=np.int64)  # of the current episodes
        for index in range(count):
            self._begin(index)
        self.observations = environment.scale(self._copies.observations)

    def _begin(self, index: int) -> None:
        """Reset a copy to the start of its current episode."""
        sequence = np.random.SeedSequence([*self._keys[index], self._episodes[index]])
        self._copies.reset(index, int(sequence.generate_state(1)[0] >> 1))
        self._steps[index] = 0

    def step(self, actions: Integers) -> Step:
        """Take one action in each copy, and reset the copies whose episodes are over.

        `observations` then holds the states to act in next.

        Args:
            actions: (S·K,).
        """
        try:
            self._actions[self._steps, self._all] = actions
        except IndexError:  # an episode is longer than all before
            self._make_room(2 * len(self._actions))
            self._actions[self._steps, self._all] = actions
        self._steps += 1
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

    def _make_room(self, steps: int) -> None:
        """Make room for the actions of longer episodes."""
        missing = max(0, steps - len(self._actions))
        self._actions = np.pad(self._actions, ((0, missing), (0, 0)))

    def state_dict(self) -> dict[str, Any]:
        """Return the number of each copy's episode and the actions in it so far."""
        played = zip(self._actions.T, self._steps, strict=True)
        return {
            "episodes": list(self._episodes),
            "actions": [actions[:count].tolist() for actions, count in played],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume from a state that `state_dict` returned, by replaying the current episodes."""
        self._episodes = list(state["episodes"])
        self._make_room(max(map(len, state["actions"])))
        for index, actions in enumerate(state["actions"]):
            self._begin(index)
            self._actions[: len(actions), index] = actions
            self._steps[index] = len(actions)
        for step in range(self._steps.max()):
            running = np.flatnonzero(self._steps > step)
            self._copies.step(running, self._actions[step, running])
        self.observations = self.environment.scale(self._copies.observations)
