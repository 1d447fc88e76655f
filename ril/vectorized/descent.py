"""Gradient descent of S networks: one step, eager or compiled, and the loop over minibatches."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor

from ril.vectorized.compiling import compile_graph, with_fallback
from ril.vectorized.networks import by_name
from ril.vectorized.updates import ClippedAdam

#: From the networks' parameters by name and some tensors to losses (S, B) and any other results.
Loss = Callable[..., tuple[Tensor, ...]]


def descent(
    optimizer: ClippedAdam, loss: Loss, *, compile_step: bool
) -> Callable[..., tuple[Tensor, ...]]:
    """Make the function that takes one optimizer step for all seeds.

    Args:
        optimizer: updates its network and its running means, in place.
        loss: a pure function; the step descends its mean over each seed's B samples.
        compile_step: whether forward pass, gradient and step are one compiled graph, for the
            shapes of the first call. Results differ from the eager ones in the last bits.

    Returns:
        A function from the tensors that `loss` takes to the values that `loss` returned for them
        before the step, detached.
    """
    network = optimizer.network

    def eager(*tensors: Tensor) -> tuple[Tensor, ...]:
        values = loss(network.parameters, *tensors)
        optimizer.step(values[0].mean(dim=1))
        return tuple(value.detach() for value in values)

    if not compile_step:
        return eager

    @compile_graph
    def graph(
        parameters: Tensor, mean: Tensor, square: Tensor, scales: Tensor, *tensors: Tensor
    ) -> tuple[Tensor, ...]:
        def total(named: dict[str, Tensor]) -> tuple[Tensor, tuple[Tensor, ...]]:
            values = loss(named, *tensors)
            # The mean is not returned: its rounding depends on the number of seeds.
            return values[0].mean(dim=1).sum(), values

        views = by_name(network.architecture, parameters)
        gradients, values = torch.func.grad(total, has_aux=True)(views)
        denominator = optimizer.change(mean, square, gradients.values(), scales[1])
        parameters.sub_(scales[2] / scales[0] * mean / denominator)
        descended: tuple[Tensor, ...] = values
        return descended

    def step(*tensors: Tensor) -> tuple[Tensor, ...]:
        # A tensor, because the graph would hold plain numbers as constants.
        numbers = (*optimizer.scales(), optimizer.learning_rate)
        scales = torch.tensor(numbers, device=network.flat.device)
        state = network.flat, optimizer.mean, optimizer.square
        values: tuple[Tensor, ...] = graph(*state, scales, *tensors)
        optimizer.steps += 1
        return values

    return with_fallback(step, eager)


def train_on_minibatches(step: Callable[..., Tensor], *minibatches: Iterable[Any]) -> Tensor:
    """Take one optimizer step per minibatch.

    Args:
        step: takes one entry of each of `minibatches`, updates the networks, and returns losses
            (…, S).
        *minibatches: the data of the steps, one entry per step; at least one.

    Returns:
        (…, S) mean loss over the steps.
    """
    first, *others = [step(*minibatch) for minibatch in zip(*minibatches, strict=True)]
    return sum(others, first) / (1 + len(others))
