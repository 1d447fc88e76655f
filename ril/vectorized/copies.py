"""K copies of one environment, which can be reset and stepped independently of each other."""

from __future__ import annotations

from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from ril.environments.checked import check_finite
from ril.environments.environment import Environment, Floats, Integers
from ril.vectorized.classic_control import STEPS

_FEWEST_IN_ARRAYS = 5  # fewer copies are faster one after another

#: Rewards, whether the environment ended the episode, whether the step limit truncated it; (C,).
Outcome = tuple[Floats, NDArray[np.bool_], NDArray[np.bool_]]


class EnvironmentCopies(Protocol):
    """K copies of one environment.

    Attributes:
        observations: (K, obs) raw states; the final state where an episode is over.
    """

    observations: Floats

    def reset(self, index: int, seed: int) -> None:
        """Begin an episode in one copy."""

    def step(self, indices: Integers, actions: Integers) -> Outcome:
        """Take actions (C,) in the copies at indices (C,).

        Args:
            indices: the copies, in ascending order; their episodes must not be over.
            actions: one for each of these copies.
        """


def make_copies(environment: Environment, count: int) -> EnvironmentCopies:
    """Make copies of an environment.

    Args:
        environment: what to copy.
        count: K.

    Returns:
        What is fastest: `ArrayCopies` for `classic_control`, `LanderCopies`, or `GymnasiumCopies`.
    """
    config = environment.config
    if config.vectorized and not config.kwargs:
        if config.id in STEPS and count >= _FEWEST_IN_ARRAYS:
            return ArrayCopies(environment, count)
        if config.id == "LunarLander-v3":
            # Imported here, because it imports Box2D.
            from ril.vectorized.lunar_lander import LanderCopies

            return LanderCopies(environment, count)
    return GymnasiumCopies(environment, count)


class GymnasiumCopies:
    """K of Gymnasium's own environments, stepped one after another.

    Args:
        environment: what to copy.
        count: K.
    """

    def __init__(self, environment: Environment, count: int) -> None:
        self._id = environment.config.id
        self._copies = [environment.make() for _ in range(count)]
        self.observations = np.zeros((count, environment.observation_size), dtype=np.float32)

    def reset(self, index: int, seed: int) -> None:
        """Begin an episode in one copy."""
        with np.errstate(over="ignore"):  # beyond single precision: infinite
            self.observations[index] = self._copies[index].reset(seed=seed)[0]
        check_finite(self._id, "the observation", self.observations[index])

    def step(self, indices: Integers, actions: Integers) -> Outcome:
        """Take actions (C,) in the copies at indices (C,)."""
        rewards, terminated, truncated = [], [], []
        with np.errstate(over="ignore"):  # beyond single precision: infinite
            for index, action in zip(indices.tolist(), actions.tolist(), strict=True):
                observation, reward, ended, at_limit, _ = self._copies[index].step(action)
                self.observations[index] = observation
                rewards.append(reward)
                terminated.append(ended)
                truncated.append(at_limit)
            earned = np.array(rewards, dtype=np.float32)
        check_finite(self._id, "the observation", self.observations[indices])
        check_finite(self._id, "the reward", earned)
        return earned, np.array(terminated, dtype=bool), np.array(truncated, dtype=bool)


class ArrayCopies:
    """K copies of an environment of `classic_control` in arrays; bit-identical to Gymnasium's.

    Args:
        environment: an environment of `classic_control`.
        count: K.
    """

    def __init__(self, environment: Environment, count: int) -> None:
        # Holds the constants, and resets every copy.
        self._one = cast(Any, environment.make().unwrapped)
        self._step = STEPS[environment.config.id]
        self._limit = environment.max_episode_steps
        self._one.reset(seed=0)
        self._states = np.zeros((len(self._one.state), count))
        self._steps = np.zeros(count, dtype=np.int64)
        self.observations = np.zeros((count, environment.observation_size), dtype=np.float32)

    def reset(self, index: int, seed: int) -> None:
        """Begin an episode in one copy."""
        self.observations[index] = self._one.reset(seed=seed)[0]
        self._states[:, index] = self._one.state
        self._steps[index] = 0

    def step(self, indices: Integers, actions: Integers) -> Outcome:
        """Take actions (C,) in the copies at indices (C,)."""
        everywhere = len(indices) == len(self._steps)
        at = slice(None) if everywhere else indices  # a slice needs no copy
        states, observations, rewards, terminated = self._step(
            self._one, self._states[:, at], actions
        )
        self._states[:, at] = states
        self.observations[at] = observations.T
        self._steps[at] += 1
        return rewards.astype(np.float32), terminated, self._steps[at] >= self._limit
