"""GAIL's discriminator: is a state and action the expert's, or the policy's?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from omegaconf import MISSING
from torch import Tensor
from torch.nn import functional

from ril.config.fields import one_of
from ril.vectorized.networks import Network
from ril.vectorized.replay import at, random_indices
from ril.vectorized.streams import Streams
from ril.vectorized.updates import ClippedAdam


@dataclass
class DiscriminatorConfig:
    """GAIL's discriminator, and what it pays."""

    hidden: list[int] = MISSING
    learning_rate: float = MISSING
    updates: int = MISSING
    batch_size: int = MISSING
    reward: str = one_of("positive", "negative")


def state_action_pairs(observations: Tensor, actions: Tensor, action_count: int) -> Tensor:
    """States (..., obs) and actions (...) to (..., obs + |A|), the actions one-hot."""
    one_hot = functional.one_hot(actions, action_count).to(observations)
    return torch.cat((observations, one_hot), dim=-1)


def discriminator_loss(expert_logits: Tensor, generated_logits: Tensor) -> Tensor:
    """What the discriminator minimises: −E_E[log D] − E_π[log(1 − D)], with D = σ(logit).

    D is the chance that a pair is the expert's; the paper of GAIL has it the other way round.

    Args:
        expert_logits: (S, B) of the expert's pairs.
        generated_logits: (S, C) of the policy's.

    Returns:
        (S,).
    """
    of_expert = functional.softplus(-expert_logits).mean(dim=1)
    return of_expert + functional.softplus(generated_logits).mean(dim=1)


def imitation_reward(logits: Tensor, kind: str) -> Tensor:
    """What the policy is paid for a pair.

    Args:
        logits: (...) of the discriminator.
        kind: "positive" is −log(1 − D) ≥ 0, which also pays for staying alive; "negative" is
            log D ≤ 0, which also charges for every step, as tasks that end in success need.
    """
    if kind == "positive":
        return functional.softplus(logits)
    return -functional.softplus(-logits)


class Discriminator:
    """S discriminators D(s, a).

    Args:
        network: from obs + |A| features to one logit.
        config: `method.discriminator`.
        streams: from which minibatches are drawn.
    """

    def __init__(self, network: Network, config: DiscriminatorConfig, streams: Streams) -> None:
        self.network = network
        self.config = config
        self._streams = streams
        self._optimizer = ClippedAdam(network, config.learning_rate)

    def train(self, expert: Tensor, generated: Tensor) -> dict[str, NDArray[np.float64]]:
        """Minibatch steps, each with as many of the expert's pairs as of the policy's.

        Args:
            expert: (M, obs + |A|) pairs of the expert, the same for all seeds.
            generated: (S, N, obs + |A|) pairs of each seed's policy.

        Returns:
            Diagnostics by name, each (S,): mean loss, and the share of pairs told rightly.
        """
        updates, batch_size = self.config.updates, self.config.batch_size
        seeds, device = len(generated), generated.device
        uniform = self._streams.uniform(updates, 2, batch_size)
        of_expert = random_indices(uniform[:, :, 0], np.full(seeds, len(expert))).to(device)
        of_policy = random_indices(uniform[:, :, 1], np.full(seeds, generated.shape[1])).to(device)
        total, right = torch.zeros(2, seeds, device=device)
        for update in range(updates):
            pairs = (expert[of_expert[:, update]], at(generated, of_policy[:, update]))
            logits = self.network(torch.cat(pairs, dim=1)).squeeze(-1)
            expert_logits, generated_logits = logits.chunk(2, dim=1)
            losses = discriminator_loss(expert_logits, generated_logits)
            self._optimizer.step(losses)
            total += losses.detach()
            told = torch.cat((expert_logits > 0, generated_logits <= 0), dim=1)
            right += told.float().mean(dim=1)
        metrics = {"discriminator_loss": total, "discriminator_accuracy": right}
        return {name: (sums / updates).double().cpu().numpy() for name, sums in metrics.items()}

    @torch.no_grad()
    def rewards(self, generated: Tensor) -> Tensor:
        """(S, N, obs + |A|) pairs to (S, N) rewards."""
        return imitation_reward(self.network(generated).squeeze(-1), self.config.reward)

    def state_dict(self) -> dict[str, Any]:
        """Parameters, optimiser and random streams."""
        return {
            "parameters": self.network.flat,
            "optimizer": self._optimizer.state_dict(),
            "streams": self._streams.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from where `state_dict` was taken."""
        self.network.flat.copy_(state["parameters"])
        self._optimizer.load_state_dict(state["optimizer"])
        self._streams.load_state_dict(state["streams"])
