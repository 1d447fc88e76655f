"""Configurations for the scripts, and Stable-Baselines3's DQN with the values of `method=dqn`."""

from __future__ import annotations

import gymnasium as gym
import hydra
import numpy as np
from stable_baselines3 import DQN

from ril.cli.configuration import from_hydra, store_schemas
from ril.config.schema import Config
from ril.environments.environment import Environment
from ril.io.paths import config_folder
from ril.methods.dqn import DQNConfig


def composed(*overrides: str) -> Config:
    """Return the configuration of `ril-run` with these overrides."""
    store_schemas()
    with hydra.initialize_config_dir(str(config_folder()), version_base="1.3"):
        return from_hydra(hydra.compose("config", list(overrides)))


def make_scaled(environment: Environment) -> gym.Env:
    """Make a copy of an environment with scaled observations, as ril's methods see them."""
    space = gym.spaces.Box(-np.inf, np.inf, (environment.observation_size,), np.float32)
    return gym.wrappers.TransformObservation(environment.make(), environment.scale, space)


def stable_baselines_dqn(config: DQNConfig, environment: Environment, seed: int) -> DQN:
    """Make Stable-Baselines3's DQN for one seed.

    Gradients are not clipped, as with `method.q_learning.gradient_clip=null`. One difference
    remains: its target network is copied after environment steps, ril's after updates.

    Args:
        config: values of every key.
        environment: the environment to train in.
        seed: seed of the agent and its environment.
    """
    learning, exploration = config.q_learning, config.exploration
    return DQN(
        "MlpPolicy",
        make_scaled(environment),
        learning_rate=learning.learning_rate,
        buffer_size=learning.replay.capacity,
        learning_starts=learning.learning_starts,
        batch_size=learning.batch_size,
        gamma=learning.discount,
        train_freq=learning.train_freq,
        gradient_steps=learning.updates,
        target_update_interval=learning.target_interval * learning.train_freq // learning.updates,
        exploration_fraction=exploration.steps / config.total_timesteps,
        exploration_initial_eps=exploration.initial_epsilon,
        exploration_final_eps=exploration.final_epsilon,
        max_grad_norm=float("inf"),
        policy_kwargs={"net_arch": list(config.network.hidden)},
        seed=seed,
        device="cpu",
    )
