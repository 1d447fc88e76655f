"""Reinforced Imitation Learning: Algorithm 1, with its line numbers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from omegaconf import MISSING
from torch import Tensor

from ril.config.fields import part
from ril.io.errors import UserError
from ril.learners.exploration import Explorer
from ril.learners.goal_sampler import positive_limit
from ril.learners.imitation import ImitationConfig, Metrics, SelfSupervisedImitation
from ril.learners.q_learning import QLearning, TargetNetworkConfig
from ril.learners.topology import initial_policy
from ril.methods.base import Progress
from ril.task import Task
from ril.vectorized.compiling import worth_compiling
from ril.vectorized.networks import Network
from ril.vectorized.replay import Replay
from ril.vectorized.rollout import Episodes
from ril.vectorized.streams import Streams


@dataclass
class QLearningConfig(TargetNetworkConfig):
    """π_φ's reinforcement half (Alg. 1, line 13)."""

    replay_trajectories: float = MISSING


@dataclass
class RILConfig(ImitationConfig):
    """`conf/method/ril.yaml`: Reinforced Imitation Learning."""

    imitation: bool = MISSING
    reinforcement: bool = MISSING
    q_learning: QLearningConfig = part(QLearningConfig)


class RIL:
    """S agents that imitate one expert's states and correct themselves by Q-learning.

    Args:
        config: `method` of the configuration.
        task: environment, expert states, seeds.
    """

    def __init__(self, config: HalvesConfig, task: Task) -> None:
        if not (config.imitation or config.reinforcement):
            raise UserError(
                "method.imitation=false method.reinforcement=false: nothing would learn"
            )
        self.config = config
        self.task = task
        self.epochs = config.epochs
        self.policy = self._policy()  # line 2: π_φ
        self.imitation = SelfSupervisedImitation(config, task, self.policy)  # lines 1 and 3
        self.explorer = Explorer(config.exploration, task, self.policy)
        self.epoch = 0
        self.env_samples = np.zeros(len(task.seeds), dtype=np.int64)

    def _policy(self) -> Network:
        """π_φ, with what corrects it by rewards."""
        config, task = self.config, self.task
        assert isinstance(config, RILConfig)
        policy, q_learning = initial_policy(config.network, task), config.q_learning
        self.q_learning = QLearning(
            policy,
            empty_memory(q_learning.replay_trajectories, task),
            q_learning,
            Streams(task.seeds, "replay batches"),
            fused=worth_compiling(
                task.compile, config.epochs * config.episodes * q_learning.updates
            ),
        )
        return policy

    def train(self) -> Iterator[Progress]:
        """Algorithm 1, from line 4 on; yields after each epoch."""
        imitation = self.imitation
        if self.config.imitation:
            imitation.generate_pre()  # lines 4–5
        while self.epoch < self.epochs and not imitation.stopping.stopped.all():  # line 6
            self.epoch += 1
            metrics: Metrics = {}
            labels = None
            if self.config.imitation:
                metrics, labels = imitation.infer_actions(self._limit())  # lines 14, 7 and 8
                metrics["cloning_loss"] = self._clone(labels)  # line 9
            epsilon = imitation.look_at_expert(metrics.get("cloning_loss"))
            metrics["epsilon"] = epsilon
            metrics |= self._solve_environments(epsilon, labels)  # lines 10–13
            yield Progress(
                self.epoch,
                self.env_samples.copy(),
                np.full_like(self.env_samples, self._expert_samples()),
                imitation.pre.capacity if self.config.imitation else 0,
                imitation.stopping.stopped.copy(),
                metrics,
                None if labels is None else labels.cpu().numpy(),
            )

    def _limit(self) -> float:
        """Equation 2, for line 14 of the epoch before."""
        if not self.config.goal_sampler.upper_limit:
            return 1.0
        return positive_limit(self.epoch - 1, self.task.ablation.n, self.task.ablation.k)

    def _clone(self, labels: Tensor) -> NDArray[np.float64]:
        """Line 9; returns (S,) the loss."""
        return self.imitation.clone(labels)

    def _solve_environments(self, epsilon: NDArray[np.float64], labels: Tensor | None) -> Metrics:
        """Lines 10–13: play |E| episodes, remember them, learn from each."""
        played: list[Episodes] = []
        corrections: list[Metrics] = []
        for _ in range(self.config.episodes):  # line 10
            episodes = self.explorer.play(epsilon)  # line 11
            played.append(episodes)
            self.env_samples += episodes.lengths
            if self.config.reinforcement:
                corrections.append(self._correct(episodes, labels))  # line 13
        metrics = {"training_return": np.mean([e.returns for e in played], axis=0)}
        for name in corrections[0] if corrections else ():
            metrics[name] = np.mean([each[name] for each in corrections], axis=0)
        if self.config.imitation:
            metrics |= self.imitation.remember(played)  # line 12
        return metrics

    def _correct(self, episodes: Episodes, labels: Tensor | None) -> Metrics:
        """Line 13, after one episode of each seed; `labels` (S, M) are line 8's."""
        self.q_learning.replay.append(episodes)
        loss = self.q_learning.train(self.q_learning.config.updates)
        return {"td_loss": loss.double().cpu().numpy()}

    def _expert_samples(self) -> int:
        """Expert transitions used so far: T^e once per epoch (§5.2.2)."""
        return self.epoch * len(self.task.expert.observations) if self.config.imitation else 0

    def _stateful(self) -> dict[str, Any]:
        """The parts that keep state of their own, by name."""
        return {
            "imitation": self.imitation,
            "q_learning": self.q_learning,
            "explorer": self.explorer,
        }

    def state_dict(self) -> dict[str, Any]:
        """All that the next epoch depends on; episodes are whole between epochs."""
        return {
            "epoch": self.epoch,
            "policy": self.policy.flat,
            "env_samples": self.env_samples.tolist(),
            "parts": {name: part.state_dict() for name, part in self._stateful().items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from where `state_dict` was taken."""
        self.epoch = state["epoch"]
        self.policy.flat.copy_(state["policy"])
        self.env_samples = np.array(state["env_samples"], dtype=np.int64)
        for name, part in self._stateful().items():
            part.load_state_dict(state["parts"][name])


def empty_memory(trajectories: float, task: Task) -> Replay:
    """A replay memory of as many mean expert trajectories (§3.4)."""
    size = task.environment.observation_size
    return Replay(len(task.seeds), steps_of(trajectories, task), size, task.device)


def steps_of(trajectories: float, task: Task) -> int:
    """How many transitions so many mean expert trajectories are."""
    return max(1, round(trajectories * task.expert.mean_length))
