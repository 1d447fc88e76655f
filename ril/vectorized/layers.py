"""Layers of S networks: functions of tensors with a leading seed axis."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from ril.vectorized.compiling import is_tracing

Parameters = Mapping[str, Tensor]  # by name, each (S, rows, columns)


def linear(name: str, inputs: int, outputs: int) -> dict[str, tuple[int, int]]:
    """Return the shapes of one Linear layer's weight and bias, by name."""
    return {f"{name}.weight": (inputs, outputs), f"{name}.bias": (1, outputs)}


def apply_linear(parameters: Parameters, name: str, x: Tensor) -> Tensor:
    """Apply the Linear layer `name`: (S, B, inputs) to (S, B, outputs)."""
    return affine(x, parameters[f"{name}.weight"], parameters[f"{name}.bias"])


def affine(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Compute each seed's xW + b.

    Where n or m is 1, x or W is padded with zeros: torch would multiply by a vector, whose
    rounding depends on the number of seeds. In a compiled graph m is padded to 16, which costs
    little there and makes such a product more than twice as fast.

    Args:
        x: (S, B, n).
        weight: W, (S, n, m).
        bias: b, (S, 1, m).

    Returns:
        (S, B, m).
    """
    inputs, outputs = weight.shape[1:]
    if inputs == 1:
        x, weight = functional.pad(x, (0, 1)), functional.pad(weight, (0, 0, 0, 1))
    least = 16 if is_tracing() else 2
    if outputs < least:
        padding = 0, least - outputs
        weight, bias = functional.pad(weight, padding), functional.pad(bias, padding)
    if is_tracing():
        product: Tensor = _Product.apply(x.contiguous(), weight.contiguous())  # type: ignore[no-untyped-call]
        return (product + bias)[..., :outputs]
    return torch.baddbmm(bias, x, weight)[..., :outputs]


class _Product(torch.autograd.Function):
    """Each seed's XW, as `compiling` needs it: the gradients' factors are contiguous too."""

    @staticmethod
    def forward(x: Tensor, weight: Tensor) -> Tensor:
        """Compute XW, (S, B, m)."""
        return torch.bmm(x, weight)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: Tensor) -> None:
        """Keep X and W for the gradients."""
        ctx.save_for_backward(*inputs)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the gradients of X and W from that of XW."""
        x, weight = ctx.saved_tensors
        of_x = torch.bmm(gradient, weight.mT.contiguous())
        return of_x, torch.bmm(x.mT.contiguous(), gradient)


def tanh(x: Tensor) -> Tensor:
    """Compute tanh; in a compiled graph as 2σ(2x) − 1, three times as fast, within 2e-7."""
    return 2 * torch.sigmoid(2 * x) - 1 if is_tracing() else x.tanh()


def self_attention(x: Tensor, weight: Tensor, bias: Tensor, gamma: Tensor) -> Tensor:
    """Apply residual self-attention to states of one token each: x + γ·(xW + b).

    A softmax over one token is 1 for every query and key, so these never receive a gradient and
    only the value projection is computed (docs/deviations.md, D2).

    Args:
        x: (S, B, n).
        weight: (S, n, n) weights of the value projection.
        bias: (S, 1, n) bias of the value projection.
        gamma: γ, (S, 1, 1), the weight of the attention; 0 at initialization.

    Returns:
        (S, B, n).
    """
    return torch.addcmul(x, gamma, affine(x, weight, bias))


def attended_linear(
    weight: Tensor, bias: Tensor, value_weight: Tensor, value_bias: Tensor, gamma: Tensor
) -> tuple[Tensor, Tensor]:
    """Join a Linear layer and the self-attention over its outputs into one Linear layer.

    Over one token self-attention is linear, so it can be applied to the rows of W and b instead of
    the outputs of every sample.

    Args:
        weight: W of the Linear layer, (S, n, m).
        bias: its b, (S, 1, m).
        value_weight: (S, m, m), as for `self_attention`.
        value_bias: (S, 1, m), likewise.
        gamma: (S, 1, 1), likewise.

    Returns:
        Weight (S, n, m) and bias (S, 1, m) of the one layer.
    """
    inputs = weight.shape[1]
    rows = torch.cat((weight, bias), dim=1)
    row_bias = functional.pad(value_bias, (0, 0, inputs, 0))  # b's row only
    attended = self_attention(rows, value_weight, row_bias, gamma)
    return attended[:, :inputs], attended[:, inputs:]


def without_attention(parameters: Parameters) -> Parameters:
    """Join every attention of a network with the Linear layer before it.

    Args:
        parameters: by name, of any architecture.

    Returns:
        Parameters of which `forward` computes the same function in fewer operations.
    """
    joined = {name: p for name, p in parameters.items() if not name.startswith("value")}
    for name in parameters:
        layer, _, kind = name.rpartition(".")
        if name.startswith("linear") and kind == "weight":
            weight, bias = f"{layer}.weight", f"{layer}.bias"
            if attention := attention_of(parameters, f"{layer}."):
                joined[weight], joined[bias] = attended_linear(
                    parameters[weight], parameters[bias], *attention
                )
    return joined


def attention_of(parameters: Parameters, layer: str) -> tuple[Tensor, Tensor, Tensor] | None:
    """Return weight, bias and γ of the attention over a layer's outputs, if it has one."""
    name = layer.replace("linear", "value")
    if f"{name}gamma" not in parameters:
        return None
    return parameters[f"{name}weight"], parameters[f"{name}bias"], parameters[f"{name}gamma"]


def layer_norm(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Apply LayerNorm over the last axis of x (S, B, n), with weight and bias (S, 1, n)."""
    return torch.addcmul(bias, functional.layer_norm(x, x.shape[-1:]), weight)
