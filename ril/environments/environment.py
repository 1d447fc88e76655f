"""A Gymnasium environment with its goal and the scale of its observations."""

from __future__ import annotations

import contextlib
import warnings
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from ril.config.schema import EnvironmentConfig
from ril.environments.checked import CheckedEnvironment, failure
from ril.io.errors import UserError, one_line

Floats = NDArray[np.float32]
Integers = NDArray[np.int64]
#: A bound from here on is none: the space between two of them cannot be computed.
_UNBOUNDED = 1e30


@dataclass(frozen=True)
class Environment:
    """An environment, and what the methods need to know about it.

    Attributes:
        config: of `conf/env/*.yaml`.
        observation_size: number of entries of one observation.
        action_count: |A|, the number of discrete actions.
        low: (observation_size,) raw values that are scaled to −1.
        high: (observation_size,) raw values that are scaled to 1.
        max_episode_steps: steps after which an episode is truncated.
    """

    config: EnvironmentConfig
    observation_size: int
    action_count: int
    low: Floats
    high: Floats
    max_episode_steps: int
    _open_copies: set[CheckedEnvironment] = field(default_factory=set, repr=False, compare=False)

    def make(self) -> CheckedEnvironment:
        """Make one copy of the environment.

        Raises:
            UserError: the environment raised an exception.
        """
        return CheckedEnvironment(_make(self.config), self.config.id, self._open_copies)

    def close(self) -> None:
        """Close all copies that are still open."""
        for copy in list(self._open_copies):
            copy.close()

    def scale(self, observations: NDArray[np.floating]) -> Floats:
        """Scale raw observations (..., observation_size) to about [−1, 1] (D5)."""
        center, half = self._center_and_half
        scaled: Floats = ((observations - center) / half).astype(np.float32, copy=False)
        return scaled

    @cached_property
    def _center_and_half(self) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Return the values scaled to 0, and their distance from those scaled to 1."""
        # Cached, since `scale` is called at every step.
        return (self.high + self.low) / 2, (self.high - self.low) / 2


def _make(config: EnvironmentConfig) -> gym.Env[Any, Any]:
    """Make an environment, without Gymnasium's passive checker and its warnings.

    Raises:
        UserError: that failed.
    """
    try:
        with warnings.catch_warnings():  # Gymnasium repeats its errors as warnings
            warnings.simplefilter("ignore")
            return gym.make(config.id, disable_env_checker=True, **config.kwargs)
    except Exception as error:  # an environment's constructor may raise any type
        message = one_line(error) or type(error).__name__
        if isinstance(error, ModuleNotFoundError):  # scripts do not search the current folder
            message += "; PYTHONPATH=. finds modules in the current folder"
        raise UserError(f"env.id={config.id}: {message}") from error


def load_environment(config: EnvironmentConfig) -> Environment:
    """Find an environment and check that ril supports it.

    Args:
        config: of `conf/env/*.yaml`.

    Raises:
        UserError: Gymnasium cannot make the environment, its spaces are not a one-dimensional Box
            and a Discrete that starts at 0, it has no step limit, or a bound of its observations
            is infinite and none is given.
    """
    probe = _make(config)
    try:
        observations, actions = probe.observation_space, probe.action_space
        spec = probe.spec
    except Exception as error:
        raise failure(config.id, "its spaces", error) from error
    finally:
        with contextlib.suppress(Exception):
            probe.close()
    if not isinstance(observations, gym.spaces.Box) or len(observations.shape) != 1:
        raise UserError(
            f"env.id={config.id}: observations are {observations}, must be a one-dimensional Box"
        )
    if not isinstance(actions, gym.spaces.Discrete) or actions.start != 0:
        raise UserError(f"env.id={config.id}: actions are {actions}, must be Discrete(n)")
    if spec is None or spec.max_episode_steps is None:
        raise UserError(
            f"env.id={config.id}: has no max_episode_steps, so its episodes may never end; "
            "give +env.kwargs.max_episode_steps=N"
        )

    size = observations.shape[0]
    bounds = []
    for name, given, of_space in (
        ("observation_low", config.observation_low, observations.low),
        ("observation_high", config.observation_high, observations.high),
    ):
        if not config.scale_observations:
            given = [1.0 if name == "observation_high" else -1.0] * size
        bound = np.asarray(of_space if given is None else given, dtype=np.float32)
        if bound.shape != (size,):
            raise UserError(f"env.{name}: has {bound.size} entries, {config.id} needs {size}")
        if not (np.abs(bound) < _UNBOUNDED).all():
            raise UserError(
                f"env.{name}: the observations of {config.id} are unbounded; give {size} finite "
                "numbers, or env.scale_observations=false"
            )
        bounds.append(bound)
    low, high = bounds
    if config.observation_low is None and config.observation_high is None:
        constant = low == high  # scaled to 0
        low, high = low - constant, high + constant
    if (low >= high).any():
        raise UserError("env.observation_low: every entry must be below that of observation_high")
    return Environment(config, size, int(actions.n), low, high, spec.max_episode_steps)
