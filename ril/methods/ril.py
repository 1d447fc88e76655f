"""Reinforced Imitation Learning: Algorithm 1, with its line numbers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from omegaconf import MISSING
from torch import Tensor

from ril.config.fields import part
from ril.io.errors import UserError
from ril.learners.cloning import Cloning
from ril.learners.exploration import Explorer
from ril.learners.goal_sampler import positive_limit
from ril.learners.imitation import ImitationConfig, SelfSupervisedImitation
from ril.learners.q_learning import QLearning, TargetNetworkConfig
from ril.learners.topology import initial_policy
from ril.methods.base import Metrics, Progress
from ril.methods.spec import EPSILON, INVERSE_DYNAMICS, TD_LOSS, MethodSpec
from ril.task import Task
from ril.vectorized.compiling import worth_compiling
from ril.vectorized.networks import Network
from ril.vectorized.replay import Replay
from ril.vectorized.rollout import Episodes
from ril.vectorized.state import Stateful
from ril.vectorized.streams import Streams


@dataclass
class QLearningConfig(TargetNetworkConfig):
    """Settings of RIL's reinforcement half (line 13)."""

    replay_trajectories: float = MISSING


@dataclass
class HalvesConfig(ImitationConfig):
    """Settings of methods that have both halves, either of which may be left out."""

    imitation: bool = MISSING
    reinforcement: bool = MISSING


@dataclass
class RILConfig(HalvesConfig):
    """Settings of RIL: `conf/method/ril.yaml`."""

    q_learning: QLearningConfig = part(QLearningConfig)


class Cloner(Protocol):
    """The interface of line 9: trains the policy on the pseudo-labels of the expert's states."""

    def train(self, observations: Tensor, labels: Tensor) -> Tensor:
        """Train on states (M, obs) with labels (S, M); return each seed's mean loss (S,)."""


class Correction(Protocol):
    """The interface of line 13: corrects the policy by the rewards of its own episodes."""

    def train(self, epoch: int, episodes: Episodes, labels: Tensor | None) -> Metrics:
        """Train on one episode of each seed.

        Args:
            epoch: number of this epoch, from 1.
            episodes: S episodes, in the order of the seeds.
            labels: (S, M) pseudo-labels of line 8; None without imitation.

        Returns:
            Diagnostics by name, each (S,).
        """


class Algorithm1(Stateful):
    """S agents that imitate one expert's states and correct themselves by rewards.

    Args:
        config: `method` of the configuration.
        task: environment, expert states, seeds.
        policy: π_φ.
        imitation: lines 3–5, 7, 8, 12 and 14.
        cloner: line 9; None leaves out lines 4–5, 7–9, 12 and 14.
        correction: line 13; None leaves it out.
    """

    STATE = ("epoch", "env_samples", "policy", "imitation", "explorer", "cloner", "correction")

    def __init__(
        self,
        config: ImitationConfig,
        task: Task,
        policy: Network,
        imitation: SelfSupervisedImitation,
        cloner: Cloner | None,
        correction: Correction | None,
    ) -> None:
        self.config = config
        self.task = task
        self.epochs = config.epochs
        self.policy = policy
        self.imitation = imitation
        self.cloner = cloner
        self.correction = correction
        # Without line 13 the policy does not change between an epoch's episodes, so they can be
        # played in parallel.
        self.rounds = 1 if correction is None else config.episodes
        side_by_side = config.episodes // self.rounds
        self.explorer = Explorer(config.exploration, task, policy, side_by_side)
        self.epoch = 0
        self.env_samples = np.zeros(len(task.seeds), dtype=np.int64)

    def train(self) -> Iterator[Progress]:
        """Run Algorithm 1 from line 4 on; yield after each epoch."""
        while self.epoch < self.epochs and not self.imitation.stopping.stopped.all():  # line 6
            yield self.train_epoch()

    def train_epoch(self) -> Progress:
        """Run one epoch, lines 7 to 14; before the first epoch, run lines 4 and 5."""
        imitation, labels = self.imitation, None
        metrics: Metrics = {}
        if self.cloner is not None:
            imitation.generate_pre()  # lines 4–5: I^pre, once
            dataset = imitation.sample_dataset(self._limit())  # line 14: I^s
            loss = imitation.train(dataset)  # line 7: M_θ
            metrics["inverse_dynamics_loss"] = _array(loss)
            labels = imitation.infer_actions()  # line 8: Â
            loss = self.cloner.train(imitation.expert_states, labels)  # line 9: π_φ
            metrics["cloning_loss"] = _array(loss)
        self.epoch += 1
        epsilon = metrics["epsilon"] = imitation.epsilon(metrics.get("cloning_loss"))
        metrics |= self._solve_environments(epsilon, labels)  # lines 10–13
        return Progress(
            self.epoch,
            self.env_samples,
            np.full_like(self.env_samples, self.expert_samples),
            0 if labels is None else imitation.pre.capacity,
            imitation.stopping.stopped.copy(),
            metrics,
            None if labels is None else labels.cpu().numpy(),
        )

    def _solve_environments(self, epsilon: NDArray[np.float64], labels: Tensor | None) -> Metrics:
        """Play an epoch's episodes, learn from each, and remember those that reach the goal.

        Args:
            epsilon: (S,) chance of a step to explore.
            labels: (S, M) of line 8; None without imitation.
        """
        played: list[Episodes] = []
        corrections: list[Metrics] = []
        for _ in range(self.rounds):  # line 10: E
            episodes = self.explorer.play(epsilon)  # line 11
            played.append(episodes)
            if self.correction is not None:
                corrections.append(self.correction.train(self.epoch, episodes, labels))  # line 13
        returns, lengths = (
            np.concatenate(
                [getattr(each, name).reshape(len(epsilon), -1) for each in played], axis=1
            )
            for name in ("returns", "lengths")
        )
        self.env_samples = self.env_samples + lengths.sum(axis=1)
        metrics = {"training_return": returns.mean(axis=1)}
        for name in corrections[0] if corrections else ():
            metrics[name] = np.mean([each[name] for each in corrections], axis=0)
        if labels is not None:
            metrics |= self.imitation.remember(played)  # line 12: I^pos
        return metrics

    def _limit(self) -> float:
        """Return the largest share of I^pos in I^s by equation 2; 1 without that limit."""
        if not self.config.goal_sampler.upper_limit:
            return 1.0
        return positive_limit(self.epoch, self.task.ablation.n, self.task.ablation.k)

    @property
    def expert_samples(self) -> int:
        """Expert transitions used so far, of each seed: T^e once per epoch (§5.2.2)."""
        return 0 if self.cloner is None else self.epoch * len(self.task.expert.observations)


class EpisodicQLearning(Stateful):
    """Line 13 as Q-learning (eq. 1) on the policy's own outputs.

    Args:
        config: `method` of the configuration.
        task: environment, expert states, seeds.
        policy: π_φ, read as a Q-function.
    """

    STATE = ("q_learning",)

    def __init__(self, config: RILConfig, task: Task, policy: Network) -> None:
        self.updates = config.q_learning.updates
        self.q_learning = QLearning(
            policy,
            empty_memory(config.q_learning.replay_trajectories, task),
            config.q_learning,
            Streams(task.seeds, "replay batches"),
            compile_step=worth_compiling(
                task.compile, config.epochs * config.episodes * self.updates
            ),
        )

    def train(self, epoch: int, episodes: Episodes, labels: Tensor | None) -> Metrics:
        """Store one episode of each seed, then train on minibatches of the memory."""
        self.q_learning.replay.append(episodes)
        return {"td_loss": _array(self.q_learning.train(self.updates))}


def build(config: RILConfig, task: Task) -> Algorithm1:
    """Make RIL: Algorithm 1 with Q-learning, of which either half may be left out.

    Raises:
        UserError: both halves are left out.
    """
    check_halves(config)
    policy = initial_policy(config.network, task)  # line 2: π_φ
    return Algorithm1(
        config,
        task,
        policy,
        SelfSupervisedImitation(config, task, policy),  # lines 1 and 3
        cloning(config, task, policy) if config.imitation else None,
        EpisodicQLearning(config, task, policy) if config.reinforcement else None,
    )


SPEC = MethodSpec(
    "ril",
    RILConfig,
    build,
    expert="states",
    uses_equation_2=True,
    compiles=True,
    shown=(INVERSE_DYNAMICS, TD_LOSS, EPSILON),
)


def check_halves(config: HalvesConfig) -> None:
    """Refuse a configuration that leaves out both halves.

    Raises:
        UserError: both are false.
    """
    if not (config.imitation or config.reinforcement):
        raise UserError(
            "method.imitation=false method.reinforcement=false: at least one must be true, "
            "or nothing is trained"
        )


def cloning(config: ImitationConfig, task: Task, policy: Network) -> Cloning:
    """Make line 9, the cloning of pseudo-labels, for a policy."""
    return Cloning(
        policy,
        config.cloning,
        Streams(task.seeds, "cloning batches"),
        compile_step=worth_compiling(task.compile, config.epochs * config.cloning.updates),
    )


def empty_memory(trajectories: float, task: Task) -> Replay:
    """Make a replay memory for `trajectories` expert trajectories of mean length (§3.4)."""
    size = task.environment.observation_size
    return Replay(len(task.seeds), transitions_in(trajectories, task), size, task.device)


def transitions_in(trajectories: float, task: Task) -> int:
    """Return the number of transitions in `trajectories` expert trajectories of mean length."""
    return max(1, round(trajectories * task.expert.mean_length))


def _array(losses: Tensor) -> Any:
    """Return (S,) losses as an array of doubles."""
    return losses.double().cpu().numpy()
