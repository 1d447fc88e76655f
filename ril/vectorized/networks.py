"""S independent multilayer perceptrons as one: every tensor has a leading seed axis."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from ril.vectorized.streams import Streams


@dataclass(frozen=True)
class Architecture:
    """[Linear → self-attention → LayerNorm → LeakyReLU] per hidden layer, then Linear (§4.1).

    Attributes:
        inputs: features of one sample.
        hidden: neurons of each hidden layer.
        outputs: one per action.
        attention: whether a self-attention follows each hidden Linear.
        layer_norm: whether a LayerNorm follows it.
        negative_slope: of LeakyReLU.
    """

    inputs: int
    hidden: tuple[int, ...]
    outputs: int
    attention: bool = True
    layer_norm: bool = True
    negative_slope: float = 0.01

    def shapes(self) -> dict[str, tuple[int, int]]:
        """(rows, columns) of every parameter, of one seed, by name."""
        shapes: dict[str, tuple[int, int]] = {}
        fan_in = self.inputs
        for layer, size in enumerate(self.hidden):
            shapes[f"linear{layer}.weight"] = (fan_in, size)
            shapes[f"linear{layer}.bias"] = (1, size)
            if self.attention:
                shapes[f"value{layer}.weight"] = (size, size)
                shapes[f"value{layer}.bias"] = (1, size)
                shapes[f"value{layer}.gamma"] = (1, 1)
            if self.layer_norm:
                shapes[f"norm{layer}.weight"] = (1, size)
                shapes[f"norm{layer}.bias"] = (1, size)
            fan_in = size
        shapes["output.weight"] = (fan_in, self.outputs)
        shapes["output.bias"] = (1, self.outputs)
        return shapes

    @property
    def parameter_count(self) -> int:
        """Numbers in one seed's network."""
        return sum(math.prod(shape) for shape in self.shapes().values())


def self_attention(x: Tensor, weight: Tensor, bias: Tensor, gamma: Tensor) -> Tensor:
    """Residual self-attention over the one token that a state is: x + γ·(xW + b).

    A softmax over one token is 1 whatever its query and key, which thus never receive a
    gradient; only the value projection is left (docs/deviations.md, D2).

    Args:
        x: (S, B, n).
        weight: (S, n, n) of the value projection.
        bias: (S, 1, n) of the value projection.
        gamma: (S, 1, 1) how much of it is added; starts at 0.
    """
    return torch.addcmul(x, gamma, torch.baddbmm(bias, x, weight))


def layer_norm(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """LayerNorm over the last axis of x (S, B, n); weight and bias (S, 1, n) are per seed."""
    return torch.addcmul(bias, functional.layer_norm(x, x.shape[-1:]), weight)


class Network:
    """S networks of one architecture, whose parameters lie in one (S, P) buffer.

    Attributes:
        architecture: the shape shared by all seeds.
        flat: (S, P) all parameters; written in place by the optimiser.
        parameters: views of `flat` by name, each (S, rows, columns), the leaves of autograd.
    """

    def __init__(self, architecture: Architecture, flat: Tensor) -> None:
        self.architecture = architecture
        self.flat = flat
        self.parameters: dict[str, Tensor] = {}
        start = 0
        for name, shape in architecture.shapes().items():
            stop = start + math.prod(shape)
            view = flat[:, start:stop].view(len(flat), *shape)
            self.parameters[name] = view.detach().requires_grad_()
            start = stop

    @classmethod
    def initialise(
        cls, architecture: Architecture, seeds: Sequence[int], purpose: str, device: torch.device
    ) -> Network:
        """Random networks: torch's own Linear and LayerNorm defaults, γ = 0.

        Args:
            architecture: the shape of each.
            seeds: S seeds; equal seeds and purpose give equal networks.
            purpose: the name of the stream that is drawn from.
            device: where the parameters live.
        """
        streams = Streams(seeds, purpose)
        flat = torch.zeros(len(seeds), architecture.parameter_count)
        network = cls(architecture, flat)
        fan_in = architecture.inputs
        with torch.no_grad():
            for name, parameter in network.parameters.items():
                if name.endswith("weight") and not name.startswith("norm"):
                    fan_in = parameter.shape[1]
                if name.startswith("norm"):
                    parameter.fill_(1.0 if name.endswith("weight") else 0.0)
                elif not name.endswith("gamma"):
                    uniform = torch.from_numpy(streams.uniform(*parameter.shape[1:]))
                    parameter.copy_((2 * uniform - 1) / math.sqrt(fan_in))
        return cls(architecture, flat.to(device))

    def __call__(self, x: Tensor) -> Tensor:
        """(S, B, inputs) to (S, B, outputs): logits, or Q-values, or both at once."""
        p, shape = self.parameters, self.architecture
        for layer in range(len(shape.hidden)):
            x = torch.baddbmm(p[f"linear{layer}.bias"], x, p[f"linear{layer}.weight"])
            if shape.attention:
                weight, bias = p[f"value{layer}.weight"], p[f"value{layer}.bias"]
                x = self_attention(x, weight, bias, p[f"value{layer}.gamma"])
            if shape.layer_norm:
                x = layer_norm(x, p[f"norm{layer}.weight"], p[f"norm{layer}.bias"])
            x = functional.leaky_relu(x, shape.negative_slope)
        return torch.baddbmm(p["output.bias"], x, p["output.weight"])

    def copy(self) -> Network:
        """The same networks in a buffer of their own."""
        return Network(self.architecture, self.flat.clone())
