"""Behavioral cloning (Pomerleau, 1988): the policy learns the expert's true actions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from omegaconf import MISSING

from ril.config.fields import part
from ril.config.schema import MethodConfig
from ril.demonstrations.trajectories import LabeledTransitions
from ril.learners.cloning import Cloning, CloningConfig
from ril.learners.topology import NetworkConfig, initial_policy
from ril.methods.base import Progress
from ril.methods.spec import MethodSpec
from ril.task import Task
from ril.vectorized.compiling import worth_compiling
from ril.vectorized.state import Stateful
from ril.vectorized.streams import Streams


@dataclass
class BCConfig(MethodConfig):
    """Settings of behavioral cloning: `conf/method/bc.yaml`."""

    epochs: int = MISSING
    network: NetworkConfig = part(NetworkConfig)
    cloning: CloningConfig = part(CloningConfig)


class BC(Stateful):
    """S policies cloned from one expert: RIL's line 9 alone, with true labels.

    Args:
        config: `method` of the configuration.
        task: environment, the expert's states and actions, seeds.
    """

    STATE = ("epoch", "policy", "cloning")

    def __init__(self, config: BCConfig, task: Task) -> None:
        assert isinstance(task.expert, LabeledTransitions)
        self.epochs = config.epochs
        seeds = task.seeds
        self.policy = initial_policy(config.network, task)
        self.cloning = Cloning(
            self.policy,
            config.cloning,
            Streams(seeds, "cloning batches"),
            compile_step=worth_compiling(task.compile, config.epochs * config.cloning.updates),
        )
        self._states = torch.from_numpy(task.expert.observations).to(task.device)
        actions = torch.from_numpy(task.expert.actions).to(task.device)
        self._actions = actions.expand(len(seeds), -1)
        self.epoch = 0

    def train(self) -> Iterator[Progress]:
        """Train on minibatches by cross-entropy; yield after each epoch."""
        seeds = len(self._actions)
        while self.epoch < self.epochs:
            self.epoch += 1
            loss = self.cloning.train(self._states, self._actions)
            yield Progress(
                self.epoch,
                env_samples=np.zeros(seeds, dtype=np.int64),
                expert_samples=np.full(seeds, self.epoch * len(self._states)),
                pre_samples=0,
                stopped=np.zeros(seeds, dtype=bool),
                metrics={"cloning_loss": loss.double().cpu().numpy()},
            )


SPEC = MethodSpec("bc", BCConfig, BC, expert="states and actions", compiles=True)
