"""RIL*: the imitation half of Algorithm 1, and after it the reinforcement half (§6.2)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from omegaconf import MISSING

from ril.config.fields import part
from ril.io.errors import UserError
from ril.learners.imitation import ImitationConfig, SelfSupervisedImitation
from ril.learners.online_q_learning import EPOCHS, OnlineQLearning, OnlineQLearningConfig
from ril.learners.topology import initial_policy
from ril.methods.base import Progress
from ril.methods.ril import Algorithm1, cloning, transitions_in
from ril.methods.spec import EPSILON, INVERSE_DYNAMICS, TD_LOSS, MethodSpec
from ril.task import Task
from ril.vectorized.state import Stateful


@dataclass
class RILSequentialConfig(ImitationConfig):
    """Settings of RIL*: `conf/method/ril_sequential.yaml`."""

    total_timesteps: int = MISSING
    q_learning: OnlineQLearningConfig = part(OnlineQLearningConfig)


class SequentialRIL(Stateful):
    """S agents that first imitate one expert's states, and then learn from rewards alone.

    Args:
        config: `method` of the configuration.
        task: environment, expert states, seeds.

    Raises:
        UserError: `method.stopping.patience` is set.
    """

    STATE = ("first_half", "q_learning", "epoch")

    def __init__(self, config: RILSequentialConfig, task: Task) -> None:
        if config.stopping.patience is not None:
            raise UserError(
                f"method.stopping.patience={config.stopping.patience}: must be null, since "
                "RIL* trains all of its epochs"
            )
        self.config = config
        self.epochs = config.epochs + min(EPOCHS, config.total_timesteps)
        self.policy = initial_policy(config.network, task)
        self.imitation = SelfSupervisedImitation(config, task, self.policy)
        cloner = cloning(config, task, self.policy)
        self.first_half = Algorithm1(config, task, self.policy, self.imitation, cloner, None)
        q_learning = config.q_learning
        if q_learning.replay.capacity is None:
            memory = replace(q_learning.replay, capacity=transitions_in(10, task))  # §3.4
            q_learning = replace(q_learning, replay=memory)
        self.q_learning = OnlineQLearning(
            q_learning,
            task,
            self.policy,
            config.exploration.kind,
            config.total_timesteps,
            purpose="exploration of the second half",
        )
        self.epoch = 0

    def train(self) -> Iterator[Progress]:
        """Train both halves; yield after each epoch of the first and each part of the second."""
        while self.epoch < self.epochs:
            self.epoch += 1
            if self.epoch <= self.config.epochs:
                # A policy of the first half is only the second's start, so none can be the best.
                yield replace(self.first_half.train_epoch(), can_be_best=False)
            else:
                yield self._reinforce()

    def _reinforce(self) -> Progress:
        """Run lines 11 and 13 for the next part of the budget, with RIL's ε (§3.4)."""
        part, parts = self.epoch - self.config.epochs, self.epochs - self.config.epochs
        until = part * self.config.total_timesteps // parts
        epsilon = self.imitation.epsilon(None)
        steps = until - self.q_learning.steps
        metrics = self.q_learning.advance(until, np.tile(epsilon, (steps, 1)))
        imitated = self.first_half.env_samples
        return Progress(
            self.epoch,
            env_samples=imitated + self.q_learning.steps,
            expert_samples=np.full_like(imitated, self.first_half.expert_samples),
            pre_samples=self.imitation.pre.capacity,
            stopped=np.zeros(len(imitated), dtype=bool),
            metrics=metrics,
        )


SPEC = MethodSpec(
    "ril_sequential",
    RILSequentialConfig,
    SequentialRIL,
    expert="states",
    budget="total_timesteps",
    uses_equation_2=True,
    compiles=True,
    shown=(INVERSE_DYNAMICS, TD_LOSS, EPSILON),
)
