"""Train an expert with Stable-Baselines3 until its greedy policy is as good as wanted, no better.

The paper's experts are known by their returns: 500, −85, −106 and 235.96 (Table 2), and lower
ones on purpose (§7, Table 9). So training is interrupted every few thousand steps, and ends once
the mean return lies within a tolerance of the target, above or below.
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
from ril.environments import Environment, Floats
from ril.experts.collection import Episode, play
from ril.io.errors import UserError

EVALUATION_EPISODES = 100  # as many as AER is a mean of (§4)
OnStep = Callable[[int, float | None], None]  # steps so far, and the mean return if just measured


@dataclass
class ExpertConfig:
    """What `conf/expert.yaml` and `conf/expert/*.yaml` say, where each key is explained."""

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
        """How far from `target_return` a mean may lie, in units of return."""
        return self.tolerance * max(1.0, abs(self.target_return))


def train(
    config: ExpertConfig, environment: Environment, on_step: OnStep
) -> tuple[list[Episode], int, float]:
    """Train until the greedy policy's mean return lies within the tolerance of the target.

    Two means have to: that of 100 episodes which only decide, and that of `config.episodes`
    other ones, which are handed on (returns can be so uneven that one mean says little).

    Returns:
        The episodes to hand on, the steps trained, and the mean return of the deciding ones.

    Raises:
        UserError: a hyperparameter is unknown or unfit, or the target is not reached.
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
        raise UserError(f"{config.algorithm}: not what {kind.__name__} takes: {error}") from None

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
        """Whether to go on training."""
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
        "allow more steps, a larger tolerance, a smaller check_every, more episodes or another seed"
    )


def _settings(config: ExpertConfig, kind: type) -> tuple[int, bool, dict[str, Any]]:
    """Copies of the environment, whether to normalise, and what `kind` is called with."""
    settings = dict(getattr(config, config.algorithm))
    for key, value in settings.items():
        known = inspect.signature(kind).parameters
        default = {"n_envs": 1, "normalize": False}.get(key)
        if default is None:
            if key not in known:
                fault = f"{kind.__name__} has no such setting"
                raise UserError(f"{config.algorithm}.{key}={value}: {fault}")
            default = known[key].default
        if isinstance(default, bool):
            fine, allowed = isinstance(value, bool), "true or false"
        elif isinstance(default, int | float):
            if key in ("learning_rate", "clip_range"):
                value = settings[key] = _schedule(value)
            fine, allowed = isinstance(value, int | float) or callable(value), "a number"
        else:
            continue
        if not fine:
            raise UserError(f"{config.algorithm}.{key}={value}: must be {allowed}")
    n_envs = settings.pop("n_envs", 1)
    if not isinstance(n_envs, int) or n_envs < 1:
        raise UserError(f"{config.algorithm}.n_envs={n_envs}: must be a whole number, 1 or more")
    return n_envs, settings.pop("normalize", False), settings


def _schedule(value: Any) -> Any:
    """`lin_0.001` as RL Zoo means it: falls linearly to 0 over the training; others as they are."""
    try:
        start = float(str(value).removeprefix("lin_"))
    except ValueError:
        return value
    return (lambda remaining: start * remaining) if str(value).startswith("lin_") else start


def _mean(episodes: Sequence[Episode]) -> float:
    return float(np.mean([episode.total_reward for episode in episodes]))
