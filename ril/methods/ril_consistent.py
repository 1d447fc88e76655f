"""RIL whose two halves are one loss of one consistent network: docs/ril_consistent.md."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from omegaconf import MISSING
from torch import Tensor

from ril.config.fields import part
from ril.io.errors import UserError
from ril.learners.consistency import ConsistencyConfig, ConsistentLearning
from ril.learners.goal_sampler import positive_limit
from ril.learners.imitation import ImitationConfig, Metrics
from ril.learners.topology import mlp
from ril.methods.ril import RIL, empty_memory, steps_of
from ril.vectorized.compiling import worth_compiling
from ril.vectorized.losses import cross_entropy
from ril.vectorized.networks import Consistent, Network
from ril.vectorized.rollout import Episodes


@dataclass
class RILConsistentConfig(ImitationConfig):
    """`conf/method/ril_consistent.yaml`: its halves in one consistent loss."""

    imitation: bool = MISSING
    reinforcement: bool = MISSING
    q_learning: ConsistencyConfig = part(ConsistencyConfig)


class ConsistentRIL(RIL):
    """Algorithm 1 with lines 9 and 13 as one descent; without rewards line 9 is as in RIL.

    Args:
        config: `method` of the configuration.
        task: environment, expert states, seeds.
    """

    def _policy(self) -> Network:
        config, task = self.config, self.task
        assert isinstance(config, RILConsistentConfig)
        settings = config.q_learning
        size, actions = task.environment.observation_size, task.environment.action_count
        steps = task.environment.max_episode_steps
        if settings.n_steps > steps:  # nothing of an episode that is cut would be left
            raise UserError(
                f"method.q_learning.n_steps={settings.n_steps}: must be within 1..{steps}, "
                "the steps of an episode"
            )
        architecture = Consistent(
            replace(
                mlp(config.network, size, 1),
                hidden=tuple(settings.value_hidden),
                attention=False,  # of one token, which adds a product and no information (D2)
            ),
            mlp(config.network, size, actions),
            settings.temperature,
            settings.value_scale,
        )
        recent = None
        if settings.replay_recent is not None:
            recent = steps_of(settings.replay_recent, task)
        self.learning = ConsistentLearning(
            Network.initialise(architecture, task.seeds, "policy", task.device),
            empty_memory(settings.replay_trajectories, task),
            settings,
            task.seeds,
            recent=recent,
            # One of its updates is worth four of Q-learning's, whose networks it evaluates once.
            fused=worth_compiling(
                task.compile, 4 * config.epochs * config.episodes * settings.updates
            ),
        )
        return self.learning.policy

    def _clone(self, labels: Tensor) -> NDArray[np.float64]:
        """Line 9, which is left to line 13 where there is one; returns (S,) the loss so far."""
        if not self.config.reinforcement:
            return super()._clone(labels)
        states = self.imitation.expert_states.expand(*labels.shape, -1)
        with torch.no_grad():
            losses = cross_entropy(self.policy(states), labels)
        return losses.mean(dim=1).double().cpu().numpy()

    def _correct(self, episodes: Episodes, labels: Tensor | None) -> Metrics:
        """Lines 9 and 13, after one episode of each seed."""
        settings, ablation = self.learning.config, self.task.ablation
        self.learning.remember(episodes)
        rate, weight = settings.learning_rate, settings.imitation_weight
        if settings.anneal:
            rate *= 1 - (self.epoch - 1) / self.epochs
        if settings.fade:
            weight *= 1 - positive_limit(self.epoch - 1, ablation.n, ablation.k)
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

    def _stateful(self) -> dict[str, Any]:
        return {
            "imitation": self.imitation,
            "learning": self.learning,
            "explorer": self.explorer,
        }
