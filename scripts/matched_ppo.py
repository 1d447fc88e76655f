"""Stable-Baselines3's PPO with the values of `method=ppo` or of GAIL's policy step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from ril.learners.ppo import PPOConfig


def stable_baselines_ppo(config: PPOConfig, make: Callable[[], gym.Env], seed: int) -> PPO:
    """Make Stable-Baselines3's PPO for one seed.

    Args:
        config: `method.ppo`, with or without the keys that RL Baselines3 Zoo adds.
        make: makes a copy of the environment to train in.
        seed: seed of the agent and its environments.
    """
    given: dict[str, Any] = vars(config).copy()
    hidden, copies = list(given.pop("hidden")), given.pop("n_envs")
    environments: VecEnv = make_vec_env(make, copies, seed=seed)
    if given.pop("normalize", False):
        environments = VecNormalize(environments, gamma=config.gamma)
    if given.pop("linear_schedule", False):
        for name in ("learning_rate", "clip_range"):
            given[name] = _linear(given[name])
    return PPO(
        "MlpPolicy",
        environments,
        policy_kwargs={"net_arch": hidden},
        seed=seed,
        device="cpu",
        **given,
    )


def _linear(value: float) -> Callable[[float], float]:
    """Make a schedule that falls from `value` to 0 with the remaining share of the steps."""
    return lambda remaining: max(0.0, remaining) * value
