"""Deep Q-networks (Mnih et al., 2013): RIL's Q-learning alone, with optional extensions.

`method=dqn` is the paper's DQN₁. With prioritized replay (Schaul et al., 2015), double targets (van
Hasselt et al., 2016) and dueling streams (Wang et al., 2016) it is DQN₂, in `dqn_prioritized.py`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from omegaconf import MISSING

from ril.config.fields import part, within
from ril.config.schema import MethodConfig
from ril.learners.online_q_learning import EPOCHS, OnlineQLearning, OnlineQLearningConfig
from ril.learners.topology import NetworkConfig, mlp
from ril.methods.base import Progress
from ril.methods.spec import EPSILON, TD_LOSS, MethodSpec
from ril.task import Task
from ril.vectorized.architectures import Dueling
from ril.vectorized.networks import Architecture, Network
from ril.vectorized.state import Stateful


@dataclass
class LinearExplorationConfig:
    """The schedule of ε: linear from its initial to its final value, then constant."""

    initial_epsilon: float = within(0, 1)
    final_epsilon: float = within(0, 1)
    steps: int = MISSING


@dataclass
class DQNConfig(MethodConfig):
    """Settings of deep Q-networks: `conf/method/dqn.yaml` and `dqn_prioritized.yaml`."""

    total_timesteps: int = MISSING
    network: NetworkConfig = part(NetworkConfig)
    dueling: bool = MISSING
    q_learning: OnlineQLearningConfig = part(OnlineQLearningConfig)
    exploration: LinearExplorationConfig = part(LinearExplorationConfig)


def topology(config: DQNConfig, task: Task) -> Architecture:
    """Return the network from scaled observations to a value per action."""
    environment = task.environment
    values = mlp(config.network, environment.observation_size, environment.action_count)
    return Dueling(replace(values, outputs=1), values) if config.dueling else values


class DQN(Stateful):
    """S agents that learn the value of each action from rewards alone.

    Args:
        config: `method` of the configuration.
        task: environment and seeds; the expert's trajectories are not used.
    """

    STATE = ("epoch", "policy", "q_learning")

    def __init__(self, config: DQNConfig, task: Task) -> None:
        self.config = config
        self.epochs = min(EPOCHS, config.total_timesteps)
        self.policy = Network.initialize(topology(config, task), task.seeds, "policy", task.device)
        self.q_learning = OnlineQLearning(
            config.q_learning, task, self.policy, "uniform", config.total_timesteps
        )
        self.epoch = 0
        self._seeds = len(task.seeds)

    def train(self) -> Iterator[Progress]:
        """Act and train; yield after each thousandth of the budget."""
        while self.epoch < self.epochs:
            self.epoch += 1
            until = self.epoch * self.config.total_timesteps // self.epochs
            metrics = self.q_learning.advance(until, self._epsilon(until))
            yield Progress.of_rewards(self.epoch, self._seeds, until, metrics)

    def _epsilon(self, until: int) -> NDArray[np.float64]:
        """Return (T, S) the ε of each of the next T steps, up to step `until` of the run.

        Before `learning_starts`, ε is 1.
        """
        line = self.config.exploration
        steps = np.arange(self.q_learning.steps, until)
        fallen = np.minimum(1.0, steps / line.steps)
        epsilon = line.initial_epsilon + fallen * (line.final_epsilon - line.initial_epsilon)
        epsilon[steps < self.config.q_learning.learning_starts] = 1.0
        return np.tile(epsilon[:, None], self._seeds)


SPEC = MethodSpec(
    "dqn", DQNConfig, DQN, budget="total_timesteps", compiles=True, shown=(TD_LOSS, EPSILON)
)
