"""Consistent RIL: one loss for both halves, on one network (docs/methods/ril_consistent.md)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ril.config.fields import part
from ril.io.errors import UserError
from ril.learners.consistency import ConsistencyConfig, ConsistentLearning
from ril.learners.goal_sampler import positive_limit
from ril.learners.imitation import SelfSupervisedImitation
from ril.learners.topology import mlp
from ril.methods.base import Metrics
from ril.methods.ril import (
    Algorithm1,
    HalvesConfig,
    check_halves,
    cloning,
    empty_memory,
    transitions_in,
)
from ril.methods.spec import EPSILON, INVERSE_DYNAMICS, TD_LOSS, MethodSpec
from ril.task import Task
from ril.vectorized.architectures import Consistent
from ril.vectorized.compiling import worth_compiling
from ril.vectorized.losses import cross_entropy
from ril.vectorized.networks import Network
from ril.vectorized.rollout import Episodes
from ril.vectorized.state import Stateful


@dataclass
class RILConsistentConfig(HalvesConfig):
    """Settings of consistent RIL: `conf/method/ril_consistent.yaml`."""

    q_learning: ConsistencyConfig = part(ConsistencyConfig)


class BothHalves(Stateful):
    """Lines 9 and 13 as gradient steps on one loss, taken after each episode.

    Args:
        config: `method` of the configuration.
        task: environment, expert states, seeds.
        learning: the consistent networks and their loss.
        imitation: the imitation half, whose confidence in a label decides whether it is cloned.
    """

    STATE = ("learning",)

    def __init__(
        self,
        config: RILConsistentConfig,
        task: Task,
        learning: ConsistentLearning,
        imitation: SelfSupervisedImitation,
    ) -> None:
        self.config = config
        self.task = task
        self.learning = learning
        self.imitation = imitation

    def train(self, epoch: int, episodes: Episodes, labels: Tensor | None) -> Metrics:
        """Store one episode of each seed, then train on the memory and the labels (lines 9, 13)."""
        settings, ablation = self.config.q_learning, self.task.ablation
        self.learning.remember(episodes)
        rate, weight = settings.learning_rate, settings.imitation_weight
        if settings.anneal:
            rate *= 1 - (epoch - 1) / self.config.epochs
        if settings.fade:
            weight *= 1 - positive_limit(epoch - 1, ablation.n, ablation.k)
        weights = None
        if labels is not None:
            weights = weight * (self.imitation.confidence >= settings.min_confidence)
        td_loss, cloning_loss = self.learning.train(
            settings.updates, self.imitation.expert_states, labels, weights, rate
        )
        metrics = {"td_loss": td_loss.double().cpu().numpy()}
        if labels is not None:
            metrics["cloning_loss"] = cloning_loss.double().cpu().numpy()
        return metrics


class DeferredCloning(Stateful):
    """Line 9 if line 13 also clones the labels: it measures the loss and trains nothing.

    Args:
        policy: π_φ.
    """

    STATE = ()

    def __init__(self, policy: Network) -> None:
        self.policy = policy

    @torch.no_grad()
    def train(self, observations: Tensor, labels: Tensor) -> Tensor:
        """Return (S,) the loss at states (M, obs) with labels (S, M)."""
        states = observations.expand(*labels.shape, -1)
        return cross_entropy(self.policy(states), labels).mean(dim=1)


def build(config: RILConsistentConfig, task: Task) -> Algorithm1:
    """Make consistent RIL: Algorithm 1 with lines 9 and 13 merged into one loss.

    With `reinforcement=false`, line 9 is RIL's.

    Raises:
        UserError: `n_steps` is longer than an episode, or both halves are left out.
    """
    check_halves(config)
    learning = _learning(config, task)
    policy = learning.policy
    imitation = SelfSupervisedImitation(config, task, policy)
    correction, cloner = None, None
    if config.reinforcement:
        correction = BothHalves(config, task, learning, imitation)
    if config.imitation:
        cloner = DeferredCloning(policy) if correction else cloning(config, task, policy)
    return Algorithm1(config, task, policy, imitation, cloner, correction)


def _learning(config: RILConsistentConfig, task: Task) -> ConsistentLearning:
    """Make the networks and their loss."""
    settings = config.q_learning
    size, actions = task.environment.observation_size, task.environment.action_count
    steps = task.environment.max_episode_steps
    if settings.n_steps > steps:  # a truncated episode would yield no n-step transition
        raise UserError(
            f"method.q_learning.n_steps={settings.n_steps}: must be within 1..{steps}, "
            "the steps of an episode"
        )
    # V has no attention: over a single token it would add a product, but no information (D2).
    value = replace(
        mlp(config.network, size, 1), hidden=tuple(settings.value_hidden), attention=False
    )
    architecture = Consistent(
        value, mlp(config.network, size, actions), settings.temperature, settings.value_scale
    )
    recent = None
    if settings.replay_recent is not None:
        recent = transitions_in(settings.replay_recent, task)
    # An update costs as much as four of RIL's Q-learning, to which `worth_compiling` is adjusted.
    updates = 4 * config.epochs * config.episodes * settings.updates
    return ConsistentLearning(
        Network.initialize(architecture, task.seeds, "policy", task.device),
        empty_memory(settings.replay_trajectories, task),
        settings,
        task.seeds,
        recent=recent,
        compile_step=worth_compiling(task.compile, updates),
    )


SPEC = MethodSpec(
    "ril_consistent",
    RILConsistentConfig,
    build,
    expert="states",
    uses_equation_2=True,
    compiles=True,
    shown=(INVERSE_DYNAMICS, TD_LOSS, EPSILON),
)
