"""A whole step of Q-learning, from gathering the batch to Adam, as one compiled graph."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ril.learners.td import td_errors, td_losses
from ril.schema import TemporalDifferenceConfig
from ril.vectorized.compiling import compiled
from ril.vectorized.networks import Network, by_name
from ril.vectorized.replay import Batch
from ril.vectorized.updates import ClippedAdam

#: Memories (S, N, …), slots (S, B) and weights (S, B) or None, to the temporal differences (S, B).
Step = Callable[[Batch, Tensor, Tensor | None], Tensor]


def fused_step(
    policy: Network,
    target: Network,
    adam: ClippedAdam,
    config: TemporalDifferenceConfig,
    *,
    double: bool,
) -> Step:
    """What `QLearning` does in eager mode, the same but for rounding.

    Args:
        policy: that is changed, in place.
        target: whose values are aimed at; may be the policy.
        adam: of the policy; its moments are changed, in place.
        config: discount and loss.
        double: as for `td_errors`.
    """
    architecture = policy.architecture

    @compiled
    def descend(
        parameters: Tensor,
        target_parameters: Tensor,
        scales: Tensor,
        memory: Batch,
        slots: Tensor,
        weights: Tensor | None,
    ) -> Tensor:
        batch = memory.at(slots)

        def loss(parameters: Tensor) -> tuple[Tensor, Tensor]:
            errors = td_errors(
                lambda x: architecture.forward(by_name(architecture, parameters), x),
                lambda x: architecture.forward(by_name(architecture, target_parameters), x),
                batch,
                config.discount,
                double=double,
            )
            losses = td_losses(errors, config.loss)
            return (losses if weights is None else weights * losses).mean(dim=1).sum(), errors

        errors: Tensor
        gradient, errors = torch.func.grad(loss, has_aux=True)(parameters)
        mean, denominator = adam.change(gradient, scales[1])
        parameters.sub_(adam.learning_rate / scales[0] * mean / denominator)
        return errors

    def step(memory: Batch, slots: Tensor, weights: Tensor | None) -> Tensor:
        # As a tensor, since a number that changes would be compiled anew.
        scales = torch.tensor(adam.count_step(), device=slots.device)
        errors: Tensor = descend(policy.flat, target.flat, scales, memory, slots, weights)
        return errors

    return step
