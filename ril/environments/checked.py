"""An environment whose every answer is checked; a wrong one ends the run in one line."""

from __future__ import annotations

import contextlib
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from ril.io.errors import NotFiniteError, UserError, one_line

_BOOLEANS = (bool, np.bool_)
_ANSWERS = {
    "reset": "observation, info",
    "step": "observation, reward, terminated, truncated, info",
}


class CheckedEnvironment(gym.Wrapper[Any, Any, Any, Any]):
    """An environment whose errors and wrong answers are `UserError`s that name its method.

    Finite numbers are not checked here but for many copies at once, in `ril.vectorized.copies`.

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
        if type(answer) is not tuple or len(answer) != 2:
            raise self._wrong("reset", _summary(answer), _ANSWERS["reset"])
        self._check_observation("reset", answer[0])
        return answer

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take an action.

        Raises:
            UserError: `step` fails, or does not return what Gymnasium's `step` does.
        """
        try:
            answer: Any = self.env.step(action)
        except Exception as error:
            raise self._failure("step", error) from error
        if type(answer) is not tuple or len(answer) != 5:
            raise self._wrong("step", _summary(answer), _ANSWERS["step"])
        observation, reward, terminated, truncated, _ = answer
        self._check_observation("step", observation)
        if type(reward) is not float and not _is_number(reward):
            raise self._wrong("step", f"the reward {_summary(reward)}", "one number")
        for flag, value in (("terminated", terminated), ("truncated", truncated)):
            if not isinstance(value, _BOOLEANS):
                raise self._wrong("step", f"{flag} = {_summary(value)}", "True or False")
        return answer

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
            except ValueError:  # of a ragged list
                raise self._wrong(method, "a ragged observation", self._expected) from None
        if observation.shape != self._shape or observation.dtype.kind not in "fiub":
            found = f"an observation of shape {observation.shape} and type {observation.dtype}"
            raise self._wrong(method, found, self._expected)

    @property
    def _expected(self) -> str:
        return f"numbers of shape {self._shape}, as observation_space says"

    def _failure(self, method: str, error: Exception) -> UserError:
        if "unpack" in str(error):  # in a wrapper of Gymnasium, of what the environment returned
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


def _is_number(value: Any) -> bool:
    return np.ndim(value) == 0 and np.asarray(value).dtype.kind in "fiub"


def _summary(value: Any) -> str:
    """Describe a value by its shape or its type."""
    if isinstance(value, tuple):
        return f"a tuple of {len(value)}"
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape}"
    return one_line(repr(value))[:60]
