"""Environments that a user may write: each does one thing wrong, or only looks as if it did."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np

from ril.config.schema import EnvironmentConfig
from ril.environments.environment import Environment, load_environment

ID = "Strange-v0"
LIMIT = 15

#: What `step` returns, by what is wrong with it, from what it should return.
STEPS: dict[str, Any] = {
    "four values": lambda o, r, te, tr, i: (o, r, te or tr, i),
    "nothing": lambda *_: None,
    "one entry": lambda o, *rest: (o[:1], *rest),
    "a number as observation": lambda o, *rest: (float(o[0]), *rest),
    "a ragged observation": lambda o, *rest: ([[0.0], [1.0, 2.0]], *rest),
    "text": lambda o, *rest: (np.array(["a", "b"]), *rest),
    "reward of shape (1,)": lambda o, r, *rest: (o, np.array([r]), *rest),
    "a vector reward": lambda o, r, *rest: (o, np.array([r, r]), *rest),
    "a ragged reward": lambda o, r, *rest: (o, [1.0, [2.0, 3.0]], *rest),
    "no reward": lambda o, r, *rest: (o, None, *rest),
    "an end of shape (1,)": lambda o, r, te, *rest: (o, r, np.array([te]), *rest),
    "an end that is text": lambda o, r, te, *rest: (o, r, "no", *rest),
    "NaN observation": lambda o, *rest: (o * np.nan, *rest),
    "an infinite entry": lambda o, *rest: (np.array([o[0], np.inf]), *rest),
    "too large for single precision": lambda o, *rest: (np.array([1e300, 0.0]), *rest),
    "NaN reward": lambda o, r, *rest: (o, float("nan"), *rest),
    "info that is no dict": lambda *answer: (*answer[:-1], None),
}
#: Unusual, but allowed.
ALLOWED: dict[str, Any] = {
    "a list": lambda *answer: list(answer),
    "an observation that is a list": lambda o, *rest: (o.tolist(), *rest),
    "an observation of doubles": lambda o, *rest: (o.astype(float), *rest),
    "a whole reward": lambda o, r, *rest: (o, 1, *rest),
    "a reward of single precision": lambda o, r, *rest: (o, np.float32(r), *rest),
    "a reward without axes": lambda o, r, *rest: (o, np.array(r), *rest),
    "ends that are 0 or 1": lambda o, r, te, tr, i: (o, r, int(te), np.int8(tr), i),
    "ends without axes": lambda o, r, te, tr, i: (o, r, np.array(te), np.bool_(tr), i),
}
#: What `reset` returns.
RESETS: dict[str, Any] = {
    "reset: the observation alone": lambda o, _: o,
    "reset: three values": lambda o, i: (o, i, i),
    "reset: one entry": lambda o, i: (o[:1], i),
    "reset: info that is no dict": lambda o, _: (o, 5),
    "reset: NaN": lambda o, i: (o * np.nan, i),
}


class Strange(gym.Env[Any, Any]):
    """Push a point along a line: action 1 to the right, 0 to the left, with some wind.

    Args:
        how: what is wrong; "" if nothing is.
        after: number of steps, of all copies together, after which it is.
    """

    made: ClassVar[list[Strange]] = []
    closed: ClassVar[list[Strange]] = []
    steps: ClassVar[Iterator[int]] = itertools.count()

    def __init__(self, how: str = "", after: int = 0) -> None:
        if how == "one only" and len(self.made) > len(self.closed):
            raise RuntimeError("the port is\nin use")
        self.how, self.after = how, after
        self.made.append(self)
        high = np.array(
            {
                "unbounded": [np.inf, 1.0],
                "huge bounds": [3e38, 1.0],
                "wide bounds": [1e6, 1.0],
                "narrow bounds": [0.01, 1.0],
            }.get(how, [2.0, 1.0]),
            dtype=np.float32,
        )
        low = -high
        if how == "a constant entry":
            low[1] = high[1] = 1.0
        self.observation_space = gym.spaces.Box(low, high)
        self.action_space = gym.spaces.Discrete(2)
        self.episodes = 0
        self.buffer = np.zeros(2, dtype=np.float32)

    @property
    def wrong(self) -> str:
        return self.how if next(self.steps) >= self.after else ""

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        wrong = self.wrong
        if wrong == "reset raises":
            raise KeyError("level")
        self.random = np.random.default_rng() if wrong == "ignores its seed" else self.np_random
        self.episodes += 1
        kept = self.episodes if wrong == "keeps a state" else 0
        self.length = 0
        self.position = float(self.random.uniform(-0.5, 0.5)) + 0.01 * kept
        answer = self.observation(), {}
        return RESETS[wrong](*answer) if wrong in RESETS else answer

    def step(self, action: int) -> Any:
        wrong = self.wrong
        if wrong == "raises":
            raise RuntimeError("the simulator\nis gone")
        if wrong == "is out of memory":
            raise MemoryError
        self.position += 0.1 * (2 * int(action) - 1) + 0.02 * float(self.random.normal())
        self.position = min(2.0, max(-2.0, self.position))
        self.length += 1
        if wrong == "unpacks too much":
            _, _, _ = self.observation()
        answer = self.observation(), self.position, self.length >= LIMIT, False, {}
        changed = STEPS | ALLOWED
        return changed[wrong](*answer) if wrong in changed else answer

    def observation(self) -> Any:
        self.buffer[:] = self.position, 1.0
        if self.how == "NaN in a buffer that it keeps":
            self.buffer[1] = np.nan if self.length == 3 else 1.0
            return self.buffer
        return self.buffer.copy()

    def close(self) -> None:
        self.closed.append(self)
        if self.how == "close raises":
            raise OSError("the window is gone")


@contextmanager
def registered() -> Iterator[None]:
    """Register the environment; nothing has been made, closed or stepped."""
    Strange.made.clear()
    Strange.closed.clear()
    Strange.steps = itertools.count()
    gym.register(ID, Strange, max_episode_steps=50)
    try:
        yield
    finally:
        del gym.registry[ID]


def strange(how: str = "", after: int = 0, **changes: Any) -> Environment:
    """Load the environment."""
    values = {"name": "strange", "id": ID, "kwargs": {"how": how, "after": after}}
    return load_environment(EnvironmentConfig(**(values | changes)))
