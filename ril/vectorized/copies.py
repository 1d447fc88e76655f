"""K copies of one environment, which are reset and stepped one by one or several at once."""

from __future__ import annotations

from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from ril.environments import Environment, Floats, Integers
from ril.vectorized.classic_control import STEPS

_WORTHWHILE = 5  # copies; fewer are stepped faster one after another

#: Rewards, whether the environment ended the episode, whether the step limit cut it; each (C,).
Outcome = tuple[Floats, NDArray[np.bool_], NDArray[np.bool_]]


class Copies(Protocol):
    """K copies of one environment.

    Attributes:
        observations: (K, obs) raw states of all; of an episode that is over, its last.
    """

    observations: Floats

    def reset(self, index: int, seed: int) -> None:
        """Begin an episode in one copy."""

    def step(self, indices: Integers, actions: Integers) -> Outcome:
        """Take actions (C,) in copies (C,), in order, whose episodes must not be over."""


def make_copies(environment: Environment, count: int) -> Copies:
    """Arrays where the environment is known to be the same with them, Gymnasium's own elsewhere."""
    config = environment.config
    known = config.vectorized and config.id in STEPS and not config.kwargs
    return (ArrayCopies if known and count >= _WORTHWHILE else GymnasiumCopies)(environment, count)


class GymnasiumCopies:
    """Gymnasium's own environments, one after another.

    Args:
        environment: of which copies are made.
        count: K.
    """

    def __init__(self, environment: Environment, count: int) -> None:
        self._copies = [environment.make() for _ in range(count)]
        self.observations = np.zeros((count, environment.observation_size), dtype=np.float32)

    def reset(self, index: int, seed: int) -> None:
        """Begin an episode in one copy."""
        self.observations[index] = self._copies[index].reset(seed=seed)[0]

    def step(self, indices: Integers, actions: Integers) -> Outcome:
        """Take actions (C,) in the copies at indices (C,)."""
        rewards, ends, cuts = [], [], []
        for index, action in zip(indices.tolist(), actions.tolist(), strict=True):
            self.observations[index], reward, ended, cut, _ = self._copies[index].step(action)
            rewards.append(reward)
            ends.append(ended)
            cuts.append(cut)
        return (
            np.array(rewards, dtype=np.float32),
            np.array(ends, dtype=bool),
            np.array(cuts, dtype=bool),
        )


class ArrayCopies:
    """The same in arrays, for the environments of `classic_control`; the same bit for bit.

    Args:
        environment: one of these.
        count: K.
    """

    def __init__(self, environment: Environment, count: int) -> None:
        # Has the constants, and begins all episodes.
        self._one = cast(Any, environment.make().unwrapped)
        self._step = STEPS[environment.config.id]
        self._limit = environment.max_episode_steps
        self._one.reset(seed=0)
        self._states = np.zeros((len(self._one.state), count))
        self._taken = np.zeros(count, dtype=np.int64)
        self.observations = np.zeros((count, environment.observation_size), dtype=np.float32)

    def reset(self, index: int, seed: int) -> None:
        """Begin an episode in one copy."""
        self.observations[index] = self._one.reset(seed=seed)[0]
        self._states[:, index] = self._one.state
        self._taken[index] = 0

    def step(self, indices: Integers, actions: Integers) -> Outcome:
        """Take actions (C,) in the copies at indices (C,)."""
        everywhere = len(indices) == len(self._taken)
        at = slice(None) if everywhere else indices  # without copying
        states, observations, rewards, ends = self._step(self._one, self._states[:, at], actions)
        self._states[:, at] = states
        self.observations[at] = observations.T
        self._taken[at] += 1
        return rewards.astype(np.float32), ends, self._taken[at] >= self._limit
