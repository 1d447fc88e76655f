"""Generative Adversarial Imitation Learning (Ho & Ermon, 2016), with PPO as its policy step."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from omegaconf import MISSING

from ril.config.fields import part
from ril.config.schema import MethodConfig
from ril.demonstrations.trajectories import LabeledTransitions
from ril.learners.discriminator import Discriminator, DiscriminatorConfig, state_action_pairs
from ril.learners.normalization import Standardization
from ril.learners.ppo import PPOConfig, PPOLearner
from ril.learners.topology import tanh_mlp
from ril.methods.base import Progress
from ril.methods.spec import MethodSpec, Shown
from ril.task import Task
from ril.vectorized.networks import Network
from ril.vectorized.state import Stateful
from ril.vectorized.streams import Streams


@dataclass
class GAILConfig(MethodConfig):
    """Settings of GAIL: `conf/method/gail.yaml`."""

    total_timesteps: int = MISSING
    standardize_states: bool = MISSING
    discriminator: DiscriminatorConfig = part(DiscriminatorConfig)
    ppo: PPOConfig = part(PPOConfig)


class GAIL(Stateful):
    """S policies, each rewarded by a discriminator between its pairs (s, a) and the expert's.

    Args:
        config: `method` of the configuration.
        task: environment, the expert's states and actions, seeds.
    """

    STATE = ("epoch", "learner", "discriminator")

    def __init__(self, config: GAILConfig, task: Task) -> None:
        assert isinstance(task.expert, LabeledTransitions)
        environment, seeds = task.environment, task.seeds
        states = task.expert.observations
        standardize = Standardization(states) if config.standardize_states else None
        self.learner = PPOLearner(config.ppo, task, config.total_timesteps, standardize=standardize)
        self.policy = self.learner.policy
        self.epochs = self.learner.rollouts
        features = environment.observation_size + environment.action_count
        shape = tanh_mlp(features, config.discriminator.hidden, 1)
        self.discriminator = Discriminator(
            Network.initialize(shape, seeds, "discriminator", task.device),
            config.discriminator,
            Streams(seeds, "discriminator batches"),
            compiled=self.learner.compiled,
        )
        self._actions = environment.action_count
        seen = states if standardize is None else standardize(states)
        pairs = torch.from_numpy(seen), torch.from_numpy(task.expert.actions)
        self._expert = state_action_pairs(*pairs, self._actions).to(task.device)
        self.epoch = 0

    def train(self) -> Iterator[Progress]:
        """Train in rounds of one rollout (Algorithm 1 of Ho & Ermon, with its line numbers)."""
        seeds = len(self.policy.flat)
        while self.epoch < self.epochs:  # line 2
            self.epoch += 1
            observations, actions = self.learner.collect()  # line 3
            pairs = state_action_pairs(observations, actions, self._actions)
            metrics = self.discriminator.train(self._expert, pairs)  # line 4
            rewards = self.discriminator.rewards(pairs)
            self.learner.improve(rewards)  # line 5
            metrics["imitation_reward"] = rewards.mean(dim=1).double().cpu().numpy()
            yield Progress(
                self.epoch,
                env_samples=np.full(seeds, self.learner.steps),
                expert_samples=np.full(seeds, self.epoch * len(self._expert)),
                pre_samples=0,
                stopped=np.zeros(seeds, dtype=bool),
                metrics=metrics,
            )


SPEC = MethodSpec(
    "gail",
    GAILConfig,
    GAIL,
    expert="states and actions",
    budget="total_timesteps",
    compiles=True,
    shown=(Shown("discriminator", "discriminator_accuracy", ".0%"),),
)
