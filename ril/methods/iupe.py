"""Imitating Unknown Policies via Exploration (Gavenski et al., 2020): RIL's imitation half."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from ril.learners.exploration import Explorer
from ril.learners.imitation import ImitationConfig, SelfSupervisedImitation
from ril.learners.topology import initial_policy
from ril.methods.base import Progress
from ril.task import Task


class IUPE:
    """S agents that imitate one expert's states; the numbers are Algorithm 1's lines.

    Args:
        config: `method` of the configuration.
        task: environment, expert states, seeds.
    """

    def __init__(self, config: ImitationConfig, task: Task) -> None:
        self.config = config
        self.task = task
        self.epochs = config.epochs
        self.policy = initial_policy(config.network, task)  # line 2: π_φ
        self.imitation = SelfSupervisedImitation(config, task, self.policy)  # lines 1 and 3
        self.explorer = Explorer(config.exploration, task, self.policy, config.episodes)
        self.epoch = 0
        self.env_samples = np.zeros(len(task.seeds), dtype=np.int64)

    def train(self) -> Iterator[Progress]:
        """Label, clone, explore, sample; yields after each epoch."""
        imitation = self.imitation
        imitation.generate_pre()  # lines 4–5
        while self.epoch < self.epochs and not imitation.stopping.stopped.all():  # line 6
            self.epoch += 1
            # I^pos's share of I^s is the success ratio alone: no eq. 2 limits it.
            metrics, labels = imitation.train(limit=1.0)  # lines 14 and 7–9
            epsilon = imitation.look_at_expert(metrics["cloning_loss"])
            played = self.explorer.play(epsilon)  # lines 10–11
            metrics |= imitation.remember([played])  # line 12
            by_seed = (len(self.env_samples), self.config.episodes)
            self.env_samples += played.lengths.reshape(by_seed).sum(axis=1)
            metrics["epsilon"] = epsilon
            metrics["training_return"] = played.returns.reshape(by_seed).mean(axis=1)
            expert_samples = self.epoch * len(self.task.expert.observations)
            yield Progress(
                self.epoch,
                self.env_samples.copy(),
                np.full_like(self.env_samples, expert_samples),
                imitation.pre.capacity,
                imitation.stopping.stopped.copy(),
                metrics,
                labels,
            )

    def state_dict(self) -> dict[str, Any]:
        """All that the next epoch depends on; episodes are whole between epochs."""
        return {
            "epoch": self.epoch,
            "policy": self.policy.flat,
            "env_samples": self.env_samples.tolist(),
            "imitation": self.imitation.state_dict(),
            "explorer": self.explorer.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from where `state_dict` was taken."""
        self.epoch = state["epoch"]
        self.policy.flat.copy_(state["policy"])
        self.env_samples = np.array(state["env_samples"], dtype=np.int64)
        self.imitation.load_state_dict(state["imitation"])
        self.explorer.load_state_dict(state["explorer"])
