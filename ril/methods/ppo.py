"""Proximal Policy Optimization (Schulman et al., 2017) by Stable-Baselines3."""

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
from ril.learners.ppo import PPOAgent, PPOConfig, actor_topology
from ril.methods.base import Progress
from ril.methods.spec import MethodSpec
from ril.task import Task
from ril.vectorized.networks import Network
from ril.vectorized.processes import WorkerPool


@dataclass
class ScheduledPPOConfig(PPOConfig):
    """Settings of PPO, including those that RL Baselines3 Zoo adds."""

    normalize: bool = MISSING
    linear_schedule: bool = MISSING


@dataclass
class PPOMethodConfig(MethodConfig):
    """Settings of `method=ppo`: `conf/method/ppo.yaml`."""

    total_timesteps: int = MISSING
    ppo: ScheduledPPOConfig = part(ScheduledPPOConfig)


class PPO:
    """S agents that learn from the environment's rewards alone; an epoch is a rollout.

    Args:
        config: `method` of the configuration.
        task: environment and seeds; the expert's trajectories are not used.
    """

    def __init__(self, config: PPOMethodConfig, task: Task) -> None:
        self.rollout_steps = config.ppo.n_envs * config.ppo.n_steps
        self.epochs = math.ceil(config.total_timesteps / self.rollout_steps)
        build = partial(
            PPOAgent,
            config.ppo,
            task.environment,
            normalize=config.ppo.normalize,
            schedule_steps=config.total_timesteps if config.ppo.linear_schedule else None,
        )
        self.agents = WorkerPool([partial(build, seed) for seed in task.seeds], task.processes)
        flat = torch.stack(self.agents.each(PPOAgent.actor)).to(task.device)
        self.policy = Network(actor_topology(config.ppo, task.environment), flat)
        self.epoch = 0

    def train(self) -> Iterator[Progress]:
        """Train by PPO's update on one rollout after another; yield after each."""
        seeds = len(self.policy.flat)
        while self.epoch < self.epochs:
            self.epoch += 1
            actors, diagnostics = zip(*self.agents.each(_rollout_and_update), strict=True)
            self.policy.flat.copy_(torch.stack(actors))
            metrics = {
                name: np.array([each[name] for each in diagnostics]) for name in diagnostics[0]
            }
            steps = self.epoch * self.rollout_steps
            yield Progress.of_rewards(self.epoch, seeds, steps, metrics)

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the next epoch depends on."""
        return {"epoch": self.epoch, "agents": self.agents.each(PPOAgent.state_dict)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume from a state that `state_dict` returned."""
        self.epoch = state["epoch"]
        self.agents.each(PPOAgent.load_state_dict, state["agents"])
        self.policy.flat.copy_(torch.stack(self.agents.each(PPOAgent.actor)))


def _rollout_and_update(agent: PPOAgent) -> tuple[Tensor, dict[str, float]]:
    """Train one agent for an epoch; return its actor's parameters (P,) and its diagnostics."""
    agent.collect()
    agent.improve()
    return agent.actor(), agent.diagnostics()


SPEC = MethodSpec("ppo", PPOMethodConfig, PPO, budget="total_timesteps")
