"""RIL*: the imitation half of Algorithm 1, and after it the reinforcement half (§6.2)."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from omegaconf import MISSING

from ril.config.fields import part
from ril.io.errors import UserError
from ril.learners.exploration import Explorer
from ril.learners.goal_sampler import positive_limit
from ril.learners.imitation import ImitationConfig, Metrics, SelfSupervisedImitation
from ril.learners.online_q_learning import EPOCHS, OnlineQLearning, OnlineQLearningConfig
from ril.learners.topology import initial_policy
from ril.methods.base import Progress
from ril.task import Task


@dataclass
class RILSequentialConfig(ImitationConfig):
    """`conf/method/ril_sequential.yaml`: RIL's halves one after the other."""

    total_timesteps: int = MISSING
    q_learning: OnlineQLearningConfig = part(OnlineQLearningConfig)


class SequentialRIL:
    """S agents that first imitate one expert's states, and then learn by rewards alone.

    Args:
        config: `method` of the configuration.
        task: environment, expert states, seeds.
    """

    def __init__(self, config: RILSequentialConfig, task: Task) -> None:
        if config.stopping.patience is not None:
            raise UserError(
                f"method.stopping.patience={config.stopping.patience}: must be null, since "
                "RIL* trains all of its epochs"
            )
        self.config = config
        self.task = task
        self.epochs = config.epochs + min(EPOCHS, config.total_timesteps)
        self.policy = initial_policy(config.network, task)  # line 2: π_φ
        self.imitation = SelfSupervisedImitation(config, task, self.policy)  # lines 1 and 3
        self.explorer = Explorer(config.exploration, task, self.policy, config.episodes)
        q_learning = copy.deepcopy(config.q_learning)
        if q_learning.replay.capacity is None:
            q_learning.replay.capacity = max(1, round(10 * task.expert.mean_length))  # §3.4
        self.q_learning = OnlineQLearning(
            q_learning,
            task,
            self.policy,
            config.exploration.kind,
            config.total_timesteps,
            purpose="exploration of the second half",
        )
        self.epoch = 0
        self.imitation_samples = np.zeros(len(task.seeds), dtype=np.int64)

    def train(self) -> Iterator[Progress]:
        """Both halves; yields after each epoch of the first, and each part of the second."""
        self.imitation.generate_pre()  # lines 4–5
        while self.epoch < self.epochs:
            self.epoch += 1
            if self.epoch <= self.config.epochs:
                metrics, labels = self._imitate()
            else:
                metrics, labels = self._reinforce(), None
            imitated = min(self.epoch, self.config.epochs)
            yield Progress(
                self.epoch,
                env_samples=self.imitation_samples + self.q_learning.steps,
                expert_samples=np.full_like(
                    self.imitation_samples, imitated * len(self.task.expert.observations)
                ),
                pre_samples=self.imitation.pre.capacity,
                stopped=np.zeros(len(self.task.seeds), dtype=bool),
                metrics=metrics,
                pseudo_labels=labels,
                can_be_best=labels is None,  # the clone is what the second half begins with
            )

    def _imitate(self) -> tuple[Metrics, NDArray[np.int64]]:
        """Lines 7–12 and 14 without line 13, as `method=ril method.reinforcement=false`."""
        limit = positive_limit(self.epoch - 1, self.task.ablation.n, self.task.ablation.k)
        metrics, labels = self.imitation.train(limit)  # lines 14 and 7–9
        metrics["epsilon"] = self.imitation.look_at_expert(metrics["cloning_loss"])
        played = self.explorer.play(metrics["epsilon"])  # lines 10–11
        by_seed = len(self.imitation_samples), self.config.episodes
        self.imitation_samples += played.lengths.reshape(by_seed).sum(axis=1)
        metrics["training_return"] = played.returns.reshape(by_seed).mean(axis=1)
        metrics |= self.imitation.remember([played])  # line 12
        return metrics, labels

    def _reinforce(self) -> Metrics:
        """Lines 11 and 13, for the next part of the budget; ε as in RIL (§3.4)."""
        part, parts = self.epoch - self.config.epochs, self.epochs - self.config.epochs
        until = part * self.config.total_timesteps // parts
        epsilon = self.imitation.look_at_expert(None)
        return self.q_learning.advance(until, np.tile(epsilon, (until - self.q_learning.steps, 1)))

    def _stateful(self) -> dict[str, Any]:
        """The parts that keep state of their own, by name."""
        return {
            "imitation": self.imitation,
            "explorer": self.explorer,
            "q_learning": self.q_learning,
        }

    def state_dict(self) -> dict[str, Any]:
        """All that the next epoch depends on."""
        return {
            "epoch": self.epoch,
            "policy": self.policy.flat,
            "imitation_samples": self.imitation_samples.tolist(),
            "parts": {name: part.state_dict() for name, part in self._stateful().items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from where `state_dict` was taken."""
        self.epoch = state["epoch"]
        self.policy.flat.copy_(state["policy"])
        self.imitation_samples = np.array(state["imitation_samples"], dtype=np.int64)
        for name, part in self._stateful().items():
            part.load_state_dict(state["parts"][name])
