"""Behavioral cloning: the policy learns to choose the labeled actions (§3.2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from omegaconf import MISSING
from torch import Tensor

from ril.vectorized.descent import descent, train_on_minibatches
from ril.vectorized.layers import Parameters
from ril.vectorized.losses import cross_entropy
from ril.vectorized.networks import Network
from ril.vectorized.replay import random_indices
from ril.vectorized.state import Stateful
from ril.vectorized.streams import Streams
from ril.vectorized.updates import ClippedAdam


@dataclass
class CloningConfig:
    """π_φ's imitation half (Alg. 1, line 9)."""

    learning_rate: float = MISSING
    updates: int = MISSING
    batch_size: int = MISSING
    gradient_clip: float | None = MISSING


class Cloning(Stateful):
    """Trains S policies by cross-entropy on the expert's states T^e and labels for them.

    The policy is not part of its state, since the methods save it.

    Args:
        policy: π_φ, from obs features to |A| logits.
        config: `method.cloning`.
        streams: random streams that draw the minibatches.
        compile_step: whether each step is one compiled graph, which differs in the last bits.
    """

    STATE: ClassVar = ("_optimizer", "_streams")

    def __init__(
        self,
        policy: Network,
        config: CloningConfig,
        streams: Streams,
        *,
        compile_step: bool = False,
    ) -> None:
        self.policy = policy
        self.config = config
        self._streams = streams
        self._optimizer = ClippedAdam(policy, config.learning_rate, config.gradient_clip)
        self._descend = descent(self._optimizer, self._loss, compile_step=compile_step)

    def train(self, observations: Tensor, labels: Tensor) -> Tensor:
        """Take minibatch steps of cross-entropy on the expert's states (Algorithm 1, line 9).

        Args:
            observations: T^e, (M, obs) states of the expert, the same for all seeds.
            labels: (S, M) actions.

        Returns:
            (S,) mean loss over the steps.
        """
        updates, batch_size = self.config.updates, self.config.batch_size
        sizes = np.full(len(labels), len(observations))
        uniform = self._streams.uniform(updates, batch_size)
        indices = random_indices(uniform, sizes).to(labels.device)

        def step(chosen: Tensor) -> Tensor:
            (losses,) = self._descend(observations[chosen], labels.gather(1, chosen))
            return losses.mean(dim=1)

        return train_on_minibatches(step, indices.unbind(dim=1))

    def _loss(self, parameters: Parameters, observations: Tensor, labels: Tensor) -> tuple[Tensor]:
        """Compute (S, B) cross-entropies of observations (S, B, obs) with labels (S, B)."""
        logits = self.policy.architecture.forward(parameters, observations)
        return (cross_entropy(logits, labels),)
