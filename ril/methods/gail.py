"""Generative Adversarial Imitation Learning (Ho & Ermon, 2016), with PPO as its policy step."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from omegaconf import MISSING
from torch import Tensor

from ril.config.fields import part
from ril.config.schema import MethodConfig
from ril.demonstrations.trajectories import LabeledTransitions
from ril.environments import Floats
from ril.learners.discriminator import Discriminator, DiscriminatorConfig, state_action_pairs
from ril.learners.ppo import PPOAgent, PPOConfig, actor_topology
from ril.learners.topology import tanh_mlp
from ril.methods.base import Progress
from ril.methods.spec import MethodSpec, Shown
from ril.task import Task
from ril.vectorized.networks import Network
from ril.vectorized.processes import WorkerPool
from ril.vectorized.streams import Streams


@dataclass
class GAILConfig(MethodConfig):
    """Settings of GAIL: `conf/method/gail.yaml`."""

    total_timesteps: int = MISSING
    discriminator: DiscriminatorConfig = part(DiscriminatorConfig)
    ppo: PPOConfig = part(PPOConfig)


class GAIL:
    """S policies, each rewarded by a discriminator between its pairs (s, a) and the expert's.

    Args:
        config: `method` of the configuration.
        task: environment, the expert's states and actions, seeds.
    """

    def __init__(self, config: GAILConfig, task: Task) -> None:
        assert isinstance(task.expert, LabeledTransitions)
        environment, seeds = task.environment, task.seeds
        self.round_steps = config.ppo.n_envs * config.ppo.n_steps
        self.epochs = math.ceil(config.total_timesteps / self.round_steps)
        self.agents = WorkerPool(
            [partial(PPOAgent, config.ppo, environment, seed) for seed in seeds], task.processes
        )
        topology = actor_topology(config.ppo, environment)
        flat = torch.stack(self.agents.each(PPOAgent.actor)).to(task.device)
        self.policy = Network(topology, flat)
        features = environment.observation_size + environment.action_count
        shape = tanh_mlp(features, config.discriminator.hidden, 1)
        self.discriminator = Discriminator(
            Network.initialize(shape, seeds, "discriminator", task.device),
            config.discriminator,
            Streams(seeds, "discriminator batches"),
        )
        self._actions = environment.action_count
        self._device = task.device
        states, actions = map(torch.from_numpy, (task.expert.observations, task.expert.actions))
        self._expert = state_action_pairs(states, actions, self._actions).to(task.device)
        self.epoch = 0

    def train(self) -> Iterator[Progress]:
        """Train in rounds of one rollout (Algorithm 1 of Ho & Ermon, with its line numbers)."""
        seeds = len(self.policy.flat)
        while self.epoch < self.epochs:  # line 2
            self.epoch += 1
            rollouts = self.agents.each(PPOAgent.collect)  # line 3
            observations, actions = (
                torch.from_numpy(np.stack(part)).to(self._device)
                for part in zip(*rollouts, strict=True)
            )
            pairs = state_action_pairs(observations, actions, self._actions)
            metrics = self.discriminator.train(self._expert, pairs)  # line 4
            rewards = self.discriminator.rewards(pairs).cpu().numpy()
            self.policy.flat.copy_(
                torch.stack(self.agents.each(_improved, list(rewards)))
            )  # line 5
            metrics["imitation_reward"] = rewards.mean(axis=1, dtype=np.float64)
            yield Progress(
                self.epoch,
                env_samples=np.full(seeds, self.epoch * self.round_steps),
                expert_samples=np.full(seeds, self.epoch * len(self._expert)),
                pre_samples=0,
                stopped=np.zeros(seeds, dtype=bool),
                metrics=metrics,
            )

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the next round depends on."""
        return {
            "epoch": self.epoch,
            "discriminator": self.discriminator.state_dict(),
            "agents": self.agents.each(PPOAgent.state_dict),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume from a state that `state_dict` returned."""
        self.epoch = state["epoch"]
        self.discriminator.load_state_dict(state["discriminator"])
        self.agents.each(PPOAgent.load_state_dict, state["agents"])
        self.policy.flat.copy_(torch.stack(self.agents.each(PPOAgent.actor)))


def _improved(agent: PPOAgent, rewards: Floats) -> Tensor:
    """Improve the policy by PPO on the rewards (N,) of its rollout; return its parameters (P,)."""
    agent.improve(rewards)
    return agent.actor()


SPEC = MethodSpec(
    "gail",
    GAILConfig,
    GAIL,
    expert="states and actions",
    budget="total_timesteps",
    shown=(Shown("discriminator", "discriminator_accuracy", ".0%"),),
)
