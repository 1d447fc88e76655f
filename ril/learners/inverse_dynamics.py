"""The inverse dynamics model M_θ, which infers the action between two states (§3.2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from omegaconf import MISSING
from torch import Tensor

from ril.config.fields import one_of
from ril.learners.goal_sampler import Selection
from ril.vectorized.descent import descent, train_on_minibatches
from ril.vectorized.layers import Parameters
from ril.vectorized.losses import cross_entropy
from ril.vectorized.networks import Network
from ril.vectorized.replay import Batch, random_indices
from ril.vectorized.state import Stateful
from ril.vectorized.streams import Streams
from ril.vectorized.updates import ClippedAdam


@dataclass
class InverseDynamicsConfig:
    """M_θ, its training (Alg. 1, line 7) and its labels (line 8)."""

    inputs: str = one_of("states", "change")
    standardize: Any = one_of("change", True, False)  # change, or all inputs: true or false
    learning_rate: float = MISSING
    updates: int = MISSING
    batch_size: int = MISSING
    gradient_clip: float | None = MISSING
    labels: str = one_of("argmax", "sample")


class InverseDynamics(Stateful):
    """S models M_θ(a | s_t, s_{t+1}), trained on I^s.

    Args:
        network: from 2·obs features to |A| logits.
        config: `method.inverse_dynamics`.
        streams: random streams that draw the minibatches.
        compile_step: whether each step is one compiled graph, which differs in the last bits.
    """

    STATE: ClassVar = ("network", "_mean", "_deviation", "_optimizer", "_streams")

    def __init__(
        self,
        network: Network,
        config: InverseDynamicsConfig,
        streams: Streams,
        *,
        compile_step: bool = False,
    ) -> None:
        self.network = network
        self.config = config
        self._streams = streams
        self._optimizer = ClippedAdam(network, config.learning_rate, config.gradient_clip)
        self._descend = descent(self._optimizer, self._loss, compile_step=compile_step)
        features = network.parameters["linear0.weight"].shape[1]
        self._mean = torch.zeros(len(network.flat), 1, features, device=network.flat.device)
        self._deviation = torch.ones_like(self._mean)

    def standardize(self, transitions: Batch) -> None:
        """Standardize each seed's inputs by mean and standard deviation of some transitions.

        `standardize=change` standardizes the change only: the states are scaled already, and an
        expert may visit states far outside of those that random actions reach.

        Args:
            transitions: (S, B, …), of I^pre.
        """
        features = self._features(transitions.observations, transitions.next_observations)
        self._mean = features.mean(dim=1, keepdim=True)
        deviation = features.std(dim=1, keepdim=True)
        self._deviation = torch.where(deviation > 0, deviation, torch.ones_like(deviation))
        if self.config.standardize == "change":
            size = transitions.observations.shape[-1]
            self._mean[..., :size], self._deviation[..., :size] = 0.0, 1.0

    def train(self, selection: Selection) -> Tensor:
        """Take minibatch steps of cross-entropy on I^s (Algorithm 1, line 7).

        Args:
            selection: I^s.

        Returns:
            (S,) mean loss over the steps.
        """
        updates, batch_size = self.config.updates, self.config.batch_size
        device = self.network.flat.device
        uniform = self._streams.uniform(updates, batch_size)
        indices = random_indices(uniform, selection.sizes).to(device)

        def step(chosen: Tensor) -> Tensor:
            batch = selection.transitions.at(chosen)
            transitions = batch.observations, batch.next_observations, batch.actions
            (losses,) = self._descend(*transitions, self._mean, self._deviation)
            return losses.mean(dim=1)

        return train_on_minibatches(step, indices.unbind(dim=1))

    def __call__(self, observations: Tensor, next_observations: Tensor) -> Tensor:
        """Map states and next states (S, B, obs) to (S, B, |A|) logits."""
        features = self._features(observations, next_observations)
        return self.network((features - self._mean) / self._deviation)

    def _features(self, observations: Tensor, next_observations: Tensor) -> Tensor:
        """Compute the features (S, B, 2·obs) of transitions, before they are standardized."""
        if self.config.inputs == "change":
            next_observations = next_observations - observations
        return torch.cat((observations, next_observations), dim=-1)

    def _loss(
        self,
        parameters: Parameters,
        observations: Tensor,
        next_observations: Tensor,
        actions: Tensor,
        mean: Tensor,
        deviation: Tensor,
    ) -> tuple[Tensor]:
        """Compute (S, B) cross-entropies with actions (S, B); mean and deviation are (S, 1, n)."""
        features = self._features(observations, next_observations)
        standard = (features - mean) / deviation
        logits = self.network.architecture.forward(parameters, standard)
        return (cross_entropy(logits, actions),)

    @torch.no_grad()
    def label(self, observations: Tensor, next_observations: Tensor) -> Tensor:
        """Infer the likeliest action of each transition.

        Args:
            observations: (S, B, obs) states s_t.
            next_observations: (S, B, obs) states s_{t+1}.

        Returns:
            (S, B) actions.
        """
        return self(observations, next_observations).argmax(dim=-1)
