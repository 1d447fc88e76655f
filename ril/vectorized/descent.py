"""A step down a loss of S networks, from the forward pass to Adam; one compiled graph if wanted."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor

from ril.vectorized.compiling import compiled, unless_broken
from ril.vectorized.networks import by_name
from ril.vectorized.updates import ClippedAdam

#: Of the networks' parameters by name and some tensors: losses (S, B), then what else is wanted.
Loss = Callable[..., tuple[Tensor, ...]]


def descent(adam: ClippedAdam, loss: Loss, *, fused: bool) -> Callable[..., tuple[Tensor, ...]]:
    """A function that takes one step for all seeds.

    Args:
        adam: whose network and moments are changed, in place.
        loss: what is descended, on average over each seed's B samples; a pure function.
        fused: whether the step is one graph, compiled for the shapes of the first; the same but
            for rounding.

    Returns:
        Of the tensors that the loss takes, to what it returns for them before the step, detached.
    """
    network = adam.network

    def eager(*tensors: Tensor) -> tuple[Tensor, ...]:
        values = loss(network.parameters, *tensors)
        adam.step(values[0].mean(dim=1))
        return tuple(value.detach() for value in values)

    if not fused:
        return eager

    @compiled
    def whole(parameters: Tensor, scales: Tensor, *tensors: Tensor) -> tuple[Tensor, ...]:
        def total(named: dict[str, Tensor]) -> tuple[Tensor, tuple[Tensor, ...]]:
            values = loss(named, *tensors)
            # That average is no output: how it is rounded depends on the number of seeds.
            return values[0].mean(dim=1).sum(), values

        views = by_name(network.architecture, parameters)
        gradients, values = torch.func.grad(total, has_aux=True)(views)
        gradient = torch.cat([each.flatten(1) for each in gradients.values()], dim=1)
        mean, denominator = adam.change(gradient, scales[1])
        parameters.sub_(scales[2] / scales[0] * mean / denominator)
        descended: tuple[Tensor, ...] = values
        return descended

    def step(*tensors: Tensor) -> tuple[Tensor, ...]:
        # As a tensor, since a number that changes would be compiled anew.
        scales = torch.tensor((*adam.scales(), adam.learning_rate), device=network.flat.device)
        values: tuple[Tensor, ...] = whole(network.flat, scales, *tensors)
        adam.steps += 1
        return values

    return unless_broken(step, eager)


def train_on_minibatches(step: Callable[..., Tensor], *minibatches: Iterable[Any]) -> Tensor:
    """Take one optimizer step per minibatch.

    Args:
        step: takes one entry of each of `minibatches`, descends, and returns losses (…, S).
        *minibatches: what the steps use, an entry per step; at least one.

    Returns:
        (…, S) mean loss over the steps.
    """
    total, steps = None, 0
    for minibatch in zip(*minibatches, strict=True):
        losses = step(*minibatch)
        total = losses if total is None else total + losses
        steps += 1
    assert total is not None
    return total / steps
