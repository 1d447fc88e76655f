"""An environment whose every answer is checked; a wrong one ends the run in one line."""

from __future__ import annotations

import contextlib
import traceback
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from ril.io.errors import NotFiniteError, UserError, one_line

_ANSWERS = {
    "reset": "observation, info",
    "step": "observation, reward, terminated, truncated, info",
}


class CheckedEnvironment(gym.Wrapper[Any, Any, Any, Any]):
    """An environment whose errors and wrong answers are `UserError`s that name its method.

    `ril.vectorized.copies` checks that numbers are finite, for many copies at once.

    Args:
        env: the environment; its observations are a one-dimensional Box.
        name: its id, for messages.
        open_copies: holds this copy until it is closed.
    """

    def __init__(
        self, env: gym.Env[Any, Any], name: str, open_copies: set[CheckedEnvironment]
    ) -> None:
        super().__init__(env)
        self._name = name
        self._open_copies = open_copies
        open_copies.add(self)
        assert env.observation_space.shape is not None
        self._shape = env.observation_space.shape

    def reset(self, **arguments: Any) -> tuple[Any, dict[str, Any]]:
        """Begin an episode.

        Raises:
            UserError: `reset` fails, or does not return an observation and a dict.
        """
        try:
            answer: Any = self.env.reset(**arguments)
        except Exception as error:
            raise self._failure("reset", error) from error
        if not isinstance(answer, tuple | list) or len(answer) != 2:
            raise self._wrong("reset", _summary(answer), _ANSWERS["reset"])
        observation, info = answer
        self._check_observation("reset", observation)
        self._check_info("reset", info)
        return observation, info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take an action.

        Raises:
            UserError: `step` fails, or does not return what Gymnasium's `step` does.
        """
        try:
            answer: Any = self.env.step(action)
        except Exception as error:
            raise self._failure("step", error) from error
        if not isinstance(answer, tuple | list) or len(answer) != 5:
            raise self._wrong("step", _summary(answer), _ANSWERS["step"])
        observation, reward, terminated, truncated, info = answer
        self._check_observation("step", observation)
        if type(reward) is not float and not _is_number(reward, "fiub"):
            raise self._wrong("step", f"the reward {_summary(reward)}", "one number")
        for flag, value in (("terminated", terminated), ("truncated", truncated)):
            if type(value) is not bool and not _is_number(value, "biu"):
                raise self._wrong("step", f"{flag} = {_summary(value)}", "True or False")
        self._check_info("step", info)
        return observation, reward, terminated, truncated, info

    def close(self) -> None:
        """Close the environment once; errors are ignored, since its episodes are over."""
        if self in self._open_copies:
            self._open_copies.remove(self)
            with contextlib.suppress(Exception):
                self.env.close()

    def _check_observation(self, method: str, observation: Any) -> None:
        if type(observation) is not np.ndarray:
            try:
                observation = np.asarray(observation)
            except Exception as error:  # of a ragged list, or a tensor
                found = f"an observation that is no array ({one_line(error)})"
                raise self._wrong(method, found, self._expected) from error
        if observation.shape != self._shape or observation.dtype.kind not in "fiub":
            found = f"an observation of shape {observation.shape} and type {observation.dtype}"
            raise self._wrong(method, found, self._expected)

    def _check_info(self, method: str, info: Any) -> None:
        if not isinstance(info, dict):
            raise self._wrong(method, f"info = {_summary(info)}", "a dict")

    @property
    def _expected(self) -> str:
        return f"numbers of shape {self._shape}, as observation_space says"

    def _failure(self, method: str, error: Exception) -> UserError:
        # A wrapper of Gymnasium that could not unpack what the environment returned.
        *_, (frame, _) = traceback.walk_tb(error.__traceback__)
        if "unpack" in str(error) and frame.f_globals["__name__"].startswith("gymnasium.wrappers"):
            return self._wrong(method, f"another number of values ({error})", _ANSWERS[method])
        return failure(self._name, method, error)

    def _wrong(self, method: str, returned: str, expected: str) -> UserError:
        return UserError(f"env.id={self._name}: {method} returned {returned}, must be {expected}")


def failure(name: str, method: str, error: Exception) -> UserError:
    """Describe an exception of an environment in one line.

    Args:
        name: the environment's id.
        method: what was called.
        error: what it raised.
    """
    said = one_line(error)
    kind = type(error).__name__
    return UserError(f"env.id={name}: {method}: {kind}{': ' * bool(said)}{said}")


def check_finite(name: str, what: str, values: NDArray[Any]) -> None:
    """Refuse values that are not finite, such as those too large for single precision.

    Args:
        name: the environment's id.
        what: what the values are: "the observation" or "the reward".
        values: (…, obs) or (…).

    Raises:
        NotFiniteError: a value is infinite or NaN.
    """
    is_finite = np.isfinite(values)
    if not is_finite.all():
        at = tuple(np.argwhere(~is_finite)[0])
        entry = f"[{at[-1]}]" if what == "the observation" else ""
        raise NotFiniteError(f"env.id={name}: {what}{entry} is {values[at]}, must be finite")


def _is_number(value: Any, kinds: str) -> bool:
    """Return whether a value is one number, also as an array without axes.

    Args:
        value: any value.
        kinds: NumPy's letters of the allowed types.
    """
    try:
        array = np.asarray(value)
    except Exception:  # of a ragged list, or a tensor
        return False
    return array.ndim == 0 and array.dtype.kind in kinds


def _summary(value: Any) -> str:
    """Describe a value by its shape or its type."""
    if isinstance(value, tuple):
        return f"a tuple of {len(value)}"
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape}"
    return one_line(repr(value))[:60]
