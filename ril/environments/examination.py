"""A short trial of a user's environment, before anything is trained in it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ril.environments.checked import CheckedEnvironment, check_finite
from ril.environments.environment import Environment, Floats

#: Environments that need no trial, if no `env.kwargs` change them.
_SHIPPED = ("CartPole-v1", "Acrobot-v1", "MountainCar-v0", "LunarLander-v3")
_STEPS = 100
_BEYOND = 10.0  # scaled observations are about 1 at most
_TOO_SMALL = 1e-3


class _Trial(NamedTuple):
    observations: Floats  # (resets and steps, obs), raw
    rewards: Floats
    over: NDArray[np.bool_]  # (steps, 2) terminated, truncated


def examine(environment: Environment) -> tuple[str, ...]:
    """Try an environment for a hundred random steps, three times in two copies.

    Args:
        environment: any environment; those that ril ships pass without a trial.

    Returns:
        A line for each doubt: training is possible, but may not mean what the user thinks.

    Raises:
        UserError: it cannot be trained in; the line names its method and what was expected.
    """
    config = environment.config
    if config.id in _SHIPPED and not config.kwargs:
        return ()
    actions = np.random.default_rng(0).integers(environment.action_count, size=_STEPS).tolist()
    copies = environment.make(), environment.make()
    try:
        first, of_other_copy, again = [
            _try(config.id, copies[which], actions) for which in (0, 1, 0)
        ]
    finally:
        for copy in copies:
            copy.close()
    doubts = _doubts_about_scale(environment, first.observations)
    if not (_are_equal(first, of_other_copy) and _are_equal(first, again)):
        doubts.append(
            f"env.id={config.id}: the same seed and actions give different episodes; results "
            "cannot be repeated, and a stopped run cannot be resumed exactly"
        )
    return tuple(doubts)


def _try(name: str, copy: CheckedEnvironment, actions: list[int]) -> _Trial:
    """Take actions, with a new episode whenever one is over."""
    observations, rewards, over = [_kept(copy.reset(seed=0)[0])], [], []
    for step, action in enumerate(actions):
        observation, reward, *ends, _ = copy.step(action)
        observations.append(_kept(observation))
        rewards.append(reward)
        over.append(ends)
        if any(ends):
            observations.append(_kept(copy.reset(seed=step)[0]))
    trial = _Trial(np.array(observations), _kept(rewards), np.array(over, dtype=bool))
    check_finite(name, "the observation", trial.observations)
    check_finite(name, "the reward", trial.rewards)
    return trial


def _kept(values: Any) -> Floats:
    """Copy values, which the environment may change in place; too large ones become infinite."""
    with np.errstate(over="ignore"):
        return np.array(values, dtype=np.float32)


def _are_equal(one: _Trial, other: _Trial) -> bool:
    return all(np.array_equal(*pair) for pair in zip(one, other, strict=True))


def _doubts_about_scale(environment: Environment, observations: Floats) -> list[str]:
    """Say which entries of observations the bounds do not fit."""
    if not environment.config.scale_observations:
        return []
    doubts = []
    scaled = environment.scale(observations)
    for entry, (raw, values) in enumerate(zip(observations.T, scaled.T, strict=True)):
        bounds = f"{environment.low[entry]:g} and {environment.high[entry]:g}"
        between = f"observation[{entry}] moves between {raw.min():g} and {raw.max():g}"
        advice = "give env.observation_low and env.observation_high"
        if np.abs(values).max() > _BEYOND:
            doubts.append(f"env.observation_high: {between}, far beyond {bounds}; {advice}")
        elif 0 < np.ptp(values) < _TOO_SMALL or (np.ptp(values) == 0 < np.ptp(raw)):
            doubts.append(
                f"env.observation_high: {between}; scaled by {bounds} it hardly moves; {advice}"
            )
    return doubts
