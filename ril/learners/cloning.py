"""Behavioural cloning: the policy learns to take the labelled actions (§3.2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from omegaconf import MISSING
from torch import Tensor

from ril.vectorized.descent import descent
from ril.vectorized.losses import cross_entropy
from ril.vectorized.networks import Network, Parameters
from ril.vectorized.replay import random_indices
from ril.vectorized.streams import Streams
from ril.vectorized.updates import ClippedAdam


@dataclass
class CloningConfig:
    """π_φ's imitation half (Alg. 1, line 9)."""

    learning_rate: float = MISSING
    updates: int = MISSING
    batch_size: int = MISSING
    gradient_clip: float | None = MISSING


class Cloning:
    """Cross-entropy of S policies on the expert's states T^e and the labels given for them.

    Args:
        policy: from obs features to |A| logits.
        config: `method.cloning`.
        streams: from which minibatches are drawn.
        fused: whether each step is one compiled graph; the same but for rounding.
    """

    def __init__(
        self, policy: Network, config: CloningConfig, streams: Streams, *, fused: bool = False
    ) -> None:
        self.policy = policy
        self.config = config
        self._streams = streams
        self._optimizer = ClippedAdam(policy, config.learning_rate, config.gradient_clip)
        self._descend = descent(self._optimizer, self._loss, fused=fused)

    def train(self, observations: Tensor, labels: Tensor) -> Tensor:
        """Algorithm 1, line 9: minibatch steps of cross-entropy on the expert's states.

        Args:
            observations: (M, obs) states of the expert, the same for all seeds.
            labels: (S, M) actions.

        Returns:
            (S,) mean loss over these steps.
        """
        updates, batch_size = self.config.updates, self.config.batch_size
        sizes = np.full(len(labels), len(observations))
        uniform = self._streams.uniform(updates, batch_size)
        indices = random_indices(uniform, sizes).to(labels.device)
        total = torch.zeros(len(labels), device=labels.device)
        for chosen in indices.unbind(dim=1):
            (losses,) = self._descend(observations[chosen], labels.gather(1, chosen))
            total += losses.mean(dim=1)
        return total / updates

    def _loss(self, parameters: Parameters, observations: Tensor, labels: Tensor) -> tuple[Tensor]:
        """(S, B) cross-entropies at observations (S, B, obs) with labels (S, B)."""
        logits = self.policy.architecture.forward(parameters, observations)
        return (cross_entropy(logits, labels),)

    def state_dict(self) -> dict[str, Any]:
        """Optimiser and random streams; the policy belongs to the method."""
        return {"optimizer": self._optimizer.state_dict(), "streams": self._streams.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from where `state_dict` was taken."""
        self._optimizer.load_state_dict(state["optimizer"])
        self._streams.load_state_dict(state["streams"])
