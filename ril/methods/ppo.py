"""Proximal Policy Optimization (Schulman et al., 2017): rewards alone, a rollout at a time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from omegaconf import MISSING

from ril.config.fields import part
from ril.config.schema import MethodConfig
from ril.learners.ppo import PPOConfig, PPOLearner
from ril.methods.base import Progress
from ril.methods.spec import MethodSpec
from ril.task import Task
from ril.vectorized.state import Stateful


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


class PPO(Stateful):
    """S agents that learn from the environment's rewards alone; an epoch is a rollout.

    Args:
        config: `method` of the configuration.
        task: environment and seeds; the expert's trajectories are not used.
    """

    STATE = ("epoch", "learner")

    def __init__(self, config: PPOMethodConfig, task: Task) -> None:
        self.learner = PPOLearner(
            config.ppo,
            task,
            config.total_timesteps,
            normalize=config.ppo.normalize,
            linear_schedule=config.ppo.linear_schedule,
        )
        self.policy = self.learner.policy
        self.epochs = self.learner.rollouts
        self.epoch = 0

    def train(self) -> Iterator[Progress]:
        """Train on one rollout after another; yield after each."""
        while self.epoch < self.epochs:
            self.epoch += 1
            self.learner.collect()
            metrics = self.learner.improve()
            yield Progress.of_rewards(
                self.epoch, len(self.policy.flat), self.learner.steps, metrics
            )


SPEC = MethodSpec("ppo", PPOMethodConfig, PPO, budget="total_timesteps", compiles=True)
