"""Train an expert with Stable-Baselines3 until its greedy policy has a given mean return.

The paper describes its experts by their returns alone: 500, −85, −106 and 235.96 (Table 2), and
lower ones for its sub-optimal experts (§7, Table 9). So training is evaluated every few thousand
steps, and ends once the mean return lies within a tolerance of the target, above or below.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from omegaconf import MISSING

from ril.config.schema import EnvironmentConfig
from ril.environments.environment import Environment, Floats
from ril.experts.collection import Episode, play
from ril.io.errors import UserError, one_line

EVALUATION_EPISODES = 100  # as AER's (§4)
OnStep = Callable[[int, float | None], None]  # steps so far, and the mean return if just evaluated


@dataclass
class ExpertConfig:
    """The configuration of `ril-expert`; `conf/expert.yaml` explains each key."""

    env: EnvironmentConfig = field(default_factory=EnvironmentConfig)
    algorithm: str = MISSING
    ppo: dict[str, Any] = MISSING
    dqn: dict[str, Any] = MISSING
    target_return: float = MISSING
    tolerance: float = MISSING
    total_timesteps: int = MISSING
    check_every: int = MISSING
    episodes: int = MISSING
    first_length: int | None = None
    seed: int = MISSING
    output: str = MISSING
    device: str = MISSING

    @property
    def margin(self) -> float:
        """Return the allowed distance of a mean from `target_return`, in units of return."""
        return self.tolerance * max(1.0, abs(self.target_return))


def train(
    config: ExpertConfig, environment: Environment, on_step: OnStep
) -> tuple[list[Episode], int, float]:
    """Train until the greedy policy's mean return lies within the tolerance of the target.

    Two means must: that of 100 evaluation episodes, and that of `config.episodes` others, which
    are collected. Returns can vary so much between episodes that one mean says little.

    Args:
        config: of `ril-expert`.
        environment: the environment to train in.
        on_step: called after every step of the environments.

    Returns:
        The collected episodes, the steps trained, and the mean return of the evaluation episodes.

    Raises:
        UserError: a hyperparameter is unknown or not allowed, or the target is not reached.
    """
    from stable_baselines3 import DQN, PPO
    from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

    kind = {"ppo": PPO, "dqn": DQN}[config.algorithm]
    n_envs, normalize, settings = _settings(config, kind)
    vec_env: VecEnv = DummyVecEnv([environment.make] * n_envs)
    if normalize:
        vec_env = VecNormalize(vec_env, gamma=settings.get("gamma", 0.99))
    try:
        model = kind("MlpPolicy", vec_env, seed=config.seed, device=config.device, **settings)
    except (TypeError, ValueError, AssertionError) as error:
        refusal = f"{kind.__name__} refuses a value: {one_line(error)}"
        raise UserError(f"{config.algorithm}: {refusal}") from None

    def policy(observations: Floats) -> NDArray[np.integer]:
        if isinstance(vec_env, VecNormalize):
            observations = np.asarray(vec_env.normalize_obs(observations))
        return np.asarray(model.predict(observations, deterministic=True)[0])

    def distance(mean: float) -> float:
        return abs(mean - config.target_return)

    evaluation, collection = np.random.SeedSequence(config.seed).spawn(2)
    evaluation_seeds = evaluation.generate_state(EVALUATION_EPISODES).tolist()
    collection_seeds = collection.generate_state(config.episodes).tolist()
    means: list[tuple[int, float]] = []
    collected: list[Episode] = []

    def check(_locals: dict[str, Any], _globals: dict[str, Any]) -> bool:
        """Evaluate if it is time; return whether to continue training."""
        steps = model.num_timesteps
        on_step(steps, None)
        if steps < (means[-1][0] if means else 0) + config.check_every:
            return True
        means.append((steps, _mean(play(environment, policy, evaluation_seeds))))
        on_step(*means[-1])
        if distance(means[-1][1]) <= config.margin:
            episodes = play(environment, policy, collection_seeds)
            if distance(_mean(episodes)) <= config.margin:
                collected.extend(episodes)
            else:
                means[-1] = (steps, _mean(episodes))
        return not collected

    model.learn(config.total_timesteps, callback=check)
    vec_env.close()
    if collected:
        return collected, *means[-1]
    steps, nearest = min(means, key=lambda at: distance(at[1]), default=(0, math.nan))
    raise UserError(
        f"target_return={config.target_return:g}: not reached within ±{config.margin:.3g} in "
        f"total_timesteps={config.total_timesteps} (nearest mean {nearest:.2f}, at step {steps}); "
        "give more steps, a larger tolerance, a smaller check_every, more episodes or another seed"
    )


def _settings(config: ExpertConfig, kind: type) -> tuple[int, bool, dict[str, Any]]:
    """Check an algorithm's settings.

    Args:
        config: of `ril-expert`.
        kind: class of the algorithm.

    Returns:
        The number of environments, whether to normalize observations and rewards, and the keyword
        arguments of `kind`.

    Raises:
        UserError: a setting does not exist, or its value has a wrong type.
    """
    settings = dict(getattr(config, config.algorithm))
    for key, value in settings.items():
        known = inspect.signature(kind).parameters
        default = {"n_envs": 1, "normalize": False}.get(key)
        if default is None:
            if key not in known:
                raise UserError(f"{config.algorithm}.{key}={value}: no such key of {kind.__name__}")
            default = known[key].default
        if isinstance(default, bool):
            is_allowed, allowed = isinstance(value, bool), "true or false"
        elif isinstance(default, int | float):
            if key in ("learning_rate", "clip_range"):
                value = settings[key] = _schedule(value)
            is_allowed = isinstance(value, int | float) or callable(value)
            allowed = "a number"
        else:
            continue
        if not is_allowed:
            raise UserError(f"{config.algorithm}.{key}={value}: must be {allowed}")
    n_envs = settings.pop("n_envs", 1)
    if not isinstance(n_envs, int) or n_envs < 1:
        raise UserError(f"{config.algorithm}.n_envs={n_envs}: must be a whole number, 1 or more")
    return n_envs, settings.pop("normalize", False), settings


def _schedule(value: Any) -> Any:
    """Convert RL Zoo's `lin_0.001` to a schedule that falls linearly from 0.001 to 0.

    Numbers become floats; other values are returned unchanged, to be refused.
    """
    try:
        start = float(str(value).removeprefix("lin_"))
    except ValueError:
        return value
    return (lambda remaining: start * remaining) if str(value).startswith("lin_") else start


def _mean(episodes: Sequence[Episode]) -> float:
    """Return the mean return of some episodes."""
    return float(np.mean([episode.total_reward for episode in episodes]))
