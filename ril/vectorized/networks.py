"""S independent networks as one: every tensor has a leading seed axis."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from ril.environments import Floats
from ril.vectorized.state import Stateful
from ril.vectorized.streams import Streams

Parameters = Mapping[str, Tensor]  # by name, each (S, rows, columns)


class Architecture(Protocol):
    """The shape of a network, and what it computes with given parameters; a dataclass."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    def shapes(self) -> dict[str, tuple[int, int]]:
        """(rows, columns) of every parameter, of one seed, by name."""

    def forward(self, parameters: Parameters, x: Tensor) -> Tensor:
        """(S, B, inputs) to (S, B, outputs)."""


@dataclass(frozen=True)
class MLP:
    """[Linear → self-attention → LayerNorm → activation] per hidden layer, then Linear (§4.1).

    Attributes:
        inputs: features of one sample.
        hidden: neurons of each hidden layer.
        outputs: one per action.
        attention: whether a self-attention follows each hidden Linear.
        layer_norm: whether a LayerNorm follows it.
        negative_slope: of LeakyReLU; None makes the activation tanh.
    """

    inputs: int
    hidden: tuple[int, ...]
    outputs: int
    attention: bool = True
    layer_norm: bool = True
    negative_slope: float | None = 0.01

    def shapes(self) -> dict[str, tuple[int, int]]:
        """(rows, columns) of every parameter, of one seed, by name."""
        shapes: dict[str, tuple[int, int]] = {}
        fan_in = self.inputs
        for layer, size in enumerate(self.hidden):
            shapes |= linear(f"linear{layer}", fan_in, size)
            if self.attention:
                shapes |= linear(f"value{layer}", size, size)
                shapes[f"value{layer}.gamma"] = (1, 1)
            if self.layer_norm:
                shapes[f"norm{layer}.weight"] = (1, size)
                shapes[f"norm{layer}.bias"] = (1, size)
            fan_in = size
        return shapes | linear("output", fan_in, self.outputs)

    def forward(self, parameters: Parameters, x: Tensor) -> Tensor:
        """(S, B, inputs) to (S, B, outputs): logits, or Q-values, or both at once."""
        p = parameters
        for layer in range(len(self.hidden)):
            x = apply_linear(p, f"linear{layer}", x)
            if self.attention:
                weight, bias = p[f"value{layer}.weight"], p[f"value{layer}.bias"]
                x = self_attention(x, weight, bias, p[f"value{layer}.gamma"])
            if self.layer_norm:
                x = layer_norm(x, p[f"norm{layer}.weight"], p[f"norm{layer}.bias"])
            if self.negative_slope is None:
                x = x.tanh()
            else:
                x = functional.leaky_relu(x, self.negative_slope)
        return apply_linear(p, "output", x)


@dataclass(frozen=True)
class Dueling:
    """Q(s, a) = V(s) + A(s, a) − mean_a A(s, a), from two streams (Wang et al., 2016, eq. 9).

    Attributes:
        value: V, with one output.
        advantage: A, with one output per action.
    """

    value: MLP
    advantage: MLP

    def shapes(self) -> dict[str, tuple[int, int]]:
        """(rows, columns) of every parameter, of one seed, by name."""
        return _streams_shapes(value=self.value, advantage=self.advantage)

    def forward(self, parameters: Parameters, x: Tensor) -> Tensor:
        """(S, B, inputs) to (S, B, |A|) values."""
        value, advantage = _streams_forward(
            parameters, x, value=self.value, advantage=self.advantage
        )
        return value + advantage - advantage.mean(dim=-1, keepdim=True)


@dataclass(frozen=True)
class Consistent:
    """Q(s, a) = V(s) + τ·log π(a | s), from two streams (Nachum et al., 2017).

    Its largest value is that of its likeliest action, and the softmax of Q / τ is π itself.

    Attributes:
        value: V, with one output.
        policy: π, with a logit per action.
        temperature: τ.
        value_scale: what the output of V's stream is multiplied by.
    """

    value: MLP
    policy: MLP
    temperature: float
    value_scale: float

    def shapes(self) -> dict[str, tuple[int, int]]:
        """(rows, columns) of every parameter, of one seed, by name."""
        return _streams_shapes(value=self.value, policy=self.policy)

    def forward(self, parameters: Parameters, x: Tensor) -> Tensor:
        """(S, B, inputs) to (S, B, |A|) values."""
        value, logits = _streams_forward(parameters, x, value=self.value, policy=self.policy)
        return self.value_scale * value + self.temperature * logits.log_softmax(dim=-1)

    def logits(self, parameters: Parameters, x: Tensor) -> Tensor:
        """(S, B, inputs) to (S, B, |A|) logits of π alone."""
        return _streams_forward(parameters, x, policy=self.policy)[0]


def _streams_shapes(**streams: MLP) -> dict[str, tuple[int, int]]:
    """(rows, columns) of every parameter of networks side by side."""
    return {
        _in_stream(name, stream): shape
        for stream, network in streams.items()
        for name, shape in network.shapes().items()
    }


def _streams_forward(parameters: Parameters, x: Tensor, **streams: MLP) -> list[Tensor]:
    """What each of the networks side by side makes of the same inputs."""
    return [
        network.forward({n: parameters[_in_stream(n, stream)] for n in network.shapes()}, x)
        for stream, network in streams.items()
    ]


def _in_stream(name: str, stream: str) -> str:
    """A parameter's name in one of several streams; it begins and ends as before."""
    layer, _, kind = name.rpartition(".")
    return f"{layer}.{stream}.{kind}"


def linear(name: str, inputs: int, outputs: int) -> dict[str, tuple[int, int]]:
    """The shapes of one Linear layer's weight and bias."""
    return {f"{name}.weight": (inputs, outputs), f"{name}.bias": (1, outputs)}


def apply_linear(parameters: Parameters, name: str, x: Tensor) -> Tensor:
    """One Linear layer: (S, B, inputs) to (S, B, outputs)."""
    return affine(x, parameters[f"{name}.weight"], parameters[f"{name}.bias"])


def affine(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Each seed's xW + b: (S, B, n), (S, n, m) and (S, 1, m) to (S, B, m).

    Where n or m is 1, a zero is put beside it: torch would multiply by a vector, and then it
    rounds otherwise for one seed alone than for several. Within a compiled graph, where it costs
    next to nothing, m is filled up to 16, which makes such a product more than twice as fast.
    """
    inputs, outputs = weight.shape[1:]
    if inputs == 1:
        x, weight = functional.pad(x, (0, 1)), functional.pad(weight, (0, 0, 0, 1))
    least = 16 if torch.compiler.is_compiling() else 2
    if outputs < least:
        beside = 0, least - outputs
        weight, bias = functional.pad(weight, beside), functional.pad(bias, beside)
        return torch.baddbmm(bias, x, weight)[..., :outputs]
    return torch.baddbmm(bias, x, weight)


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
    return torch.addcmul(x, gamma, affine(x, weight, bias))


def layer_norm(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """LayerNorm over the last axis of x (S, B, n); weight and bias (S, 1, n) are per seed."""
    return torch.addcmul(bias, functional.layer_norm(x, x.shape[-1:]), weight)


def parameter_count(architecture: Architecture) -> int:
    """Numbers in one seed's network."""
    return sum(math.prod(shape) for shape in architecture.shapes().values())


def by_name(architecture: Architecture, flat: Tensor) -> dict[str, Tensor]:
    """Parameters (S, P) that lie side by side as views by name, each (S, rows, columns)."""
    views = {}
    start = 0
    for name, shape in architecture.shapes().items():
        stop = start + math.prod(shape)
        views[name] = flat[:, start:stop].view(len(flat), *shape)
        start = stop
    return views


class Network(Stateful):
    """S networks of one architecture, whose parameters lie in one (S, P) buffer.

    Attributes:
        architecture: the shape shared by all seeds.
        flat: (S, P) all parameters; written in place by the optimiser.
        parameters: views of `flat` by name, each (S, rows, columns), the leaves of autograd.
    """

    STATE = ("flat",)

    def __init__(self, architecture: Architecture, flat: Tensor) -> None:
        self.architecture = architecture
        self.flat = flat
        self._views = by_name(architecture, flat)
        self.parameters = {
            name: view.detach().requires_grad_() for name, view in self._views.items()
        }

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
        flat = torch.zeros(len(seeds), parameter_count(architecture))
        network = cls(architecture, flat)
        fan_in = 1
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
        """(S, B, inputs) to (S, B, outputs)."""
        return self.architecture.forward(self.parameters, x)

    @torch.no_grad()
    def infer(self, observations: Floats) -> Tensor:
        """(S·N, obs) scaled observations, one seed's side by side, to (S, N, outputs)."""
        by_seed = torch.from_numpy(observations).to(self.flat.device)
        by_seed = by_seed.view(len(self.flat), -1, observations.shape[-1])
        return self.architecture.forward(self._views, by_seed)  # no leaves of autograd, so cheaper

    def greedy(self, observations: Floats) -> NDArray[np.int64]:
        """Actions of the largest outputs: (S·N, obs) as for `infer`, to (S·N,)."""
        return self.infer(observations).argmax(dim=-1).flatten().cpu().numpy()

    def copy(self) -> Network:
        """The same networks in a buffer of their own."""
        return Network(self.architecture, self.flat.clone())
