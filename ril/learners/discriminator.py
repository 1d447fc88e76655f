"""GAIL's discriminator, which tells the expert's state-action pairs from the policy's."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from omegaconf import MISSING
from torch import Tensor
from torch.nn import functional

from ril.config.fields import one_of
from ril.vectorized.compiling import LEAST_ROWS, compile_graph, with_fallback
from ril.vectorized.descent import descent, train_on_minibatches
from ril.vectorized.layers import Parameters
from ril.vectorized.networks import Network, by_name
from ril.vectorized.replay import gather_by_seed, random_indices
from ril.vectorized.state import Stateful
from ril.vectorized.streams import Streams
from ril.vectorized.updates import ClippedAdam


@dataclass
class DiscriminatorConfig:
    """GAIL's discriminator and the rewards that it gives."""

    hidden: list[int] = MISSING
    learning_rate: float = MISSING
    updates: int = MISSING
    batch_size: int = MISSING
    reward: str = one_of("positive", "negative", "logit")


def state_action_pairs(observations: Tensor, actions: Tensor, action_count: int) -> Tensor:
    """Join states (…, obs) and one-hot actions (…) into pairs (…, obs + |A|)."""
    one_hot = functional.one_hot(actions, action_count).to(observations)
    return torch.cat((observations, one_hot), dim=-1)


def discriminator_losses(expert_logits: Tensor, generated_logits: Tensor) -> Tensor:
    """Compute the discriminator's losses, with the mean −E_E[log D] − E_π[log(1 − D)].

    D = σ(logit) is the probability that a pair is the expert's; in GAIL's paper it is the policy's.

    Args:
        expert_logits: (S, B) for the expert's pairs.
        generated_logits: (S, B) for the policy's pairs.

    Returns:
        (S, B).
    """
    # logsigmoid, unlike softplus, rounds a seed's values alike whatever the number of seeds.
    return -functional.logsigmoid(expert_logits) - functional.logsigmoid(-generated_logits)


def imitation_reward(logits: Tensor, kind: str) -> Tensor:
    """Compute the policy's rewards from the discriminator's logits.

    Args:
        logits: (…) for state-action pairs.
        kind: "positive" is −log(1 − D) ≥ 0, which also rewards long episodes; "negative" is
            log D ≤ 0, which also rewards short ones, for tasks whose episodes end in success;
            "logit" is their sum, log D − log(1 − D), which has either sign.

    Returns:
        (…).
    """
    if kind == "positive":
        return -functional.logsigmoid(-logits)
    if kind == "negative":
        return functional.logsigmoid(logits)
    return logits


class Discriminator(Stateful):
    """S discriminators D(s, a).

    Args:
        network: from obs + |A| features to one logit.
        config: `method.discriminator`.
        streams: random streams that draw the minibatches.
        compiled: whether to compile updates and rewards, if minibatches are large enough.
    """

    STATE: ClassVar = ("network", "_optimizer", "_streams")

    def __init__(
        self, network: Network, config: DiscriminatorConfig, streams: Streams, *, compiled: bool
    ) -> None:
        self.network = network
        self.config = config
        self._streams = streams
        self._optimizer = ClippedAdam(network, config.learning_rate)
        compiled = compiled and 2 * config.batch_size >= LEAST_ROWS
        self._descend = descent(self._optimizer, self._loss, compile_step=compiled)
        self._reward = self._rewards
        if compiled:
            self._reward = with_fallback(compile_graph(self._rewards), self._rewards)

    def train(self, expert: Tensor, generated: Tensor) -> dict[str, NDArray[np.float64]]:
        """Take minibatch steps, each on equally many pairs of the expert and of the policy.

        Args:
            expert: (M, obs + |A|) pairs of the expert, the same for all seeds.
            generated: (S, N, obs + |A|) pairs of each seed's policy.

        Returns:
            Means over the steps by name, (S,) each: the loss, and the share of pairs that are
            classified correctly.
        """
        updates, batch_size = self.config.updates, self.config.batch_size
        seeds, device = len(generated), generated.device
        uniform = self._streams.uniform(updates, 2, batch_size)
        of_expert = random_indices(uniform[:, :, 0], np.full(seeds, len(expert))).to(device)
        of_policy = random_indices(uniform[:, :, 1], np.full(seeds, generated.shape[1])).to(device)

        def step(of_expert: Tensor, of_policy: Tensor) -> Tensor:
            pairs = expert[of_expert], gather_by_seed(generated, of_policy)
            losses, correct = self._descend(torch.cat(pairs, dim=1))
            return torch.stack((losses.mean(dim=1), correct.mean(dim=1)))

        means = train_on_minibatches(step, of_expert.unbind(dim=1), of_policy.unbind(dim=1))
        loss, accuracy = means.double().cpu().numpy()
        return {"discriminator_loss": loss, "discriminator_accuracy": accuracy}

    @torch.no_grad()
    def rewards(self, generated: Tensor) -> Tensor:
        """Compute rewards (S, N) for pairs (S, N, obs + |A|) of the policy."""
        rewards: Tensor = self._reward(self.network.flat, generated)
        return rewards

    def _loss(self, parameters: Parameters, pairs: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the losses of pairs (S, 2 · B, obs + |A|), the expert's before the policy's.

        Returns:
            (S, B) the losses, and (S, 2 · B) 1 for a pair that is classified correctly.
        """
        logits = self.network.architecture.forward(parameters, pairs).squeeze(-1)
        expert_logits, generated_logits = logits.chunk(2, dim=1)
        correct = torch.cat((expert_logits > 0, generated_logits <= 0), dim=1)
        return discriminator_losses(expert_logits, generated_logits), correct.float()

    def _rewards(self, flat: Tensor, generated: Tensor) -> Tensor:
        """Compute `rewards` with the parameters (S, P)."""
        architecture = self.network.architecture
        logits = architecture.forward(by_name(architecture, flat), generated)
        return imitation_reward(logits.squeeze(-1), self.config.reward)
