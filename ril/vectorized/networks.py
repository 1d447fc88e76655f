"""S independent networks as one: every tensor has a leading seed axis."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from ril.environments import Floats
from ril.vectorized.compiling import is_tracing
from ril.vectorized.state import Stateful
from ril.vectorized.streams import Streams

Parameters = Mapping[str, Tensor]  # by name, each (S, rows, columns)


class Architecture(Protocol):
    """A dataclass that describes a network: the shapes of its parameters and its forward pass."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    def shapes(self) -> dict[str, tuple[int, int]]:
        """Return (rows, columns) of every parameter of one seed, by name."""

    def forward(self, parameters: Parameters, x: Tensor) -> Tensor:
        """Map (S, B, inputs) to (S, B, outputs)."""


@dataclass(frozen=True)
class MLP:
    """[Linear → self-attention → LayerNorm → activation] per hidden layer, then Linear (§4.1).

    Attributes:
        inputs: features of one sample.
        hidden: neurons of each hidden layer.
        outputs: one per action.
        attention: whether each hidden Linear is followed by self-attention.
        layer_norm: whether each hidden layer has a LayerNorm.
        negative_slope: of LeakyReLU; None makes the activation tanh.
    """

    inputs: int
    hidden: tuple[int, ...]
    outputs: int
    attention: bool = True
    layer_norm: bool = True
    negative_slope: float | None = 0.01

    def shapes(self) -> dict[str, tuple[int, int]]:
        """Return (rows, columns) of every parameter of one seed, by name."""
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
        """Map (S, B, inputs) to (S, B, outputs): logits, Q-values, or both at once."""
        p = parameters
        for layer in range(len(self.hidden)):
            weight, bias = p[f"linear{layer}.weight"], p[f"linear{layer}.bias"]
            attention = _attention_of(p, f"linear{layer}.")
            if attention and weight.shape[1] < x.shape[1]:  # fewer inputs than samples
                weight, bias = attended_linear(weight, bias, *attention)
                attention = None
            x = affine(x, weight, bias)
            if attention:
                x = self_attention(x, *attention)
            if self.layer_norm:
                x = layer_norm(x, p[f"norm{layer}.weight"], p[f"norm{layer}.bias"])
            if self.negative_slope is None:
                x = tanh(x)
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
        """Return (rows, columns) of every parameter of one seed, by name."""
        return _streams_shapes(value=self.value, advantage=self.advantage)

    def forward(self, parameters: Parameters, x: Tensor) -> Tensor:
        """Map (S, B, inputs) to (S, B, |A|) values."""
        value, advantage = _streams_forward(
            parameters, x, value=self.value, advantage=self.advantage
        )
        return value + advantage - advantage.mean(dim=-1, keepdim=True)


@dataclass(frozen=True)
class Consistent:
    """Q(s, a) = V(s) + τ·log π(a | s), from two streams (Nachum et al., 2017).

    The likeliest action has the largest value, and the softmax of Q / τ is π itself.

    Attributes:
        value: V, with one output.
        policy: π, with one logit per action.
        temperature: τ.
        value_scale: factor of the output of V's stream.
    """

    value: MLP
    policy: MLP
    temperature: float
    value_scale: float

    def shapes(self) -> dict[str, tuple[int, int]]:
        """Return (rows, columns) of every parameter of one seed, by name."""
        return _streams_shapes(value=self.value, policy=self.policy)

    def forward(self, parameters: Parameters, x: Tensor) -> Tensor:
        """Map (S, B, inputs) to (S, B, |A|) values."""
        value, logits = _streams_forward(parameters, x, value=self.value, policy=self.policy)
        return self.value_scale * value + self.temperature * logits.log_softmax(dim=-1)

    def logits(self, parameters: Parameters, x: Tensor) -> Tensor:
        """Map (S, B, inputs) to (S, B, |A|) logits of π alone."""
        return _streams_forward(parameters, x, policy=self.policy)[0]


@dataclass(frozen=True)
class ActorCritic:
    """A policy π(a | s) and a value function V(s), which share no parameters.

    Attributes:
        actor: π, with one logit per action; its parameters come first.
        critic: V, with one output.
    """

    actor: MLP
    critic: MLP

    def shapes(self) -> dict[str, tuple[int, int]]:
        """Return (rows, columns) of every parameter of one seed, by name."""
        return _streams_shapes(actor=self.actor, critic=self.critic)

    def forward(self, parameters: Parameters, x: Tensor) -> Tensor:
        """Map (S, B, inputs) to (S, B, |A|) logits."""
        return _streams_forward(parameters, x, actor=self.actor)[0]

    def values(self, parameters: Parameters, x: Tensor) -> Tensor:
        """Map (S, B, inputs) to (S, B) values."""
        return _streams_forward(parameters, x, critic=self.critic)[0].squeeze(-1)


@dataclass(frozen=True)
class Standardized:
    """A network whose inputs are standardized, and clipped to ±`clip` deviations.

    Attributes:
        network: the network; its parameters come last.
        clip: the largest standardized input.
    """

    network: MLP
    clip: float

    def shapes(self) -> dict[str, tuple[int, int]]:
        """Return (rows, columns) of every parameter of one seed, by name."""
        row = 1, self.network.inputs
        return {"standardize.mean": row, "standardize.deviation": row} | self.network.shapes()

    def forward(self, parameters: Parameters, x: Tensor) -> Tensor:
        """Map (S, B, inputs) to (S, B, outputs)."""
        mean, deviation = parameters["standardize.mean"], parameters["standardize.deviation"]
        standardized = ((x - mean) / deviation).clamp(-self.clip, self.clip)
        return self.network.forward(parameters, standardized)


def _streams_shapes(**streams: MLP) -> dict[str, tuple[int, int]]:
    """Return (rows, columns) of every parameter of several streams, by name."""
    return {
        _in_stream(name, stream): shape
        for stream, network in streams.items()
        for name, shape in network.shapes().items()
    }


def _streams_forward(parameters: Parameters, x: Tensor, **streams: MLP) -> list[Tensor]:
    """Return each stream's outputs for the same inputs (S, B, inputs)."""
    return [
        network.forward(_of_stream(parameters, stream), x) for stream, network in streams.items()
    ]


def _of_stream(parameters: Parameters, stream: str) -> Parameters:
    """Return the parameters of one of several streams, by their names in its own network."""
    own = {}
    for name, parameter in parameters.items():
        layer, of_stream, kind = name.split(".")
        if of_stream == stream:
            own[f"{layer}.{kind}"] = parameter
    return own


def _in_stream(name: str, stream: str) -> str:
    """Return a parameter's name in one of several streams."""
    # The layer stays first and the kind last, which `Network.initialize` goes by.
    layer, _, kind = name.rpartition(".")
    return f"{layer}.{stream}.{kind}"


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
            if attention := _attention_of(parameters, f"{layer}."):
                joined[weight], joined[bias] = attended_linear(
                    parameters[weight], parameters[bias], *attention
                )
    return joined


def _attention_of(parameters: Parameters, layer: str) -> tuple[Tensor, Tensor, Tensor] | None:
    """Return weight, bias and γ of the attention over a layer's outputs, if it has one."""
    name = layer.replace("linear", "value")
    if f"{name}gamma" not in parameters:
        return None
    return parameters[f"{name}weight"], parameters[f"{name}bias"], parameters[f"{name}gamma"]


def layer_norm(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Apply LayerNorm over the last axis of x (S, B, n), with weight and bias (S, 1, n)."""
    return torch.addcmul(bias, functional.layer_norm(x, x.shape[-1:]), weight)


def parameter_count(architecture: Architecture) -> int:
    """Count the parameters of one seed's network."""
    return sum(math.prod(shape) for shape in architecture.shapes().values())


def by_name(architecture: Architecture, flat: Tensor) -> dict[str, Tensor]:
    """Split a buffer of parameters (S, P) into views by name, each (S, rows, columns)."""
    views = {}
    start = 0
    for name, shape in architecture.shapes().items():
        stop = start + math.prod(shape)
        views[name] = flat[:, start:stop].view(len(flat), *shape)
        start = stop
    return views


def greedy(outputs: Tensor) -> NDArray[np.int64]:
    """Choose the actions of the largest outputs: (S, N, |A|) to (S·N,)."""
    return outputs.argmax(dim=-1).flatten().cpu().numpy()


class Network(Stateful):
    """S networks of one architecture, whose parameters lie in one (S, P) buffer.

    Attributes:
        architecture: shared by all seeds.
        flat: (S, P) all parameters; the optimizer writes to it in place.
        parameters: views of `flat` by name, each (S, rows, columns), the leaves of autograd.
    """

    STATE: ClassVar = ("flat",)

    def __init__(self, architecture: Architecture, flat: Tensor) -> None:
        self.architecture = architecture
        self.flat = flat
        self._views = by_name(architecture, flat)
        self.parameters = {
            name: view.detach().requires_grad_() for name, view in self._views.items()
        }

    @classmethod
    def initialize(
        cls, architecture: Architecture, seeds: Sequence[int], purpose: str, device: torch.device
    ) -> Network:
        """Make random networks, with torch's defaults for Linear and LayerNorm, and γ = 0.

        Args:
            architecture: the architecture of each network.
            seeds: S seeds; equal seeds and purpose give equal networks.
            purpose: names the stream of random numbers.
            device: device of the parameters.
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
        """Map (S, B, inputs) to (S, B, outputs), with gradients."""
        return self.architecture.forward(self.parameters, x)

    @torch.no_grad()
    def infer(self, observations: Floats) -> Tensor:
        """Compute outputs without gradients.

        Args:
            observations: (S·N, obs) scaled observations, the N of one seed side by side.

        Returns:
            (S, N, outputs).
        """
        return self.frozen()(observations)

    @torch.no_grad()
    def frozen(self) -> Callable[[Floats], Tensor]:
        """Return `infer` for the current parameters, for many calls until these change."""
        parameters = without_attention(self._views)  # views are faster than autograd's leaves
        device, seeds = self.flat.device, len(self.flat)

        @torch.no_grad()
        def infer(observations: Floats) -> Tensor:
            by_seed = torch.from_numpy(observations).to(device)
            by_seed = by_seed.view(seeds, -1, observations.shape[-1])
            return self.architecture.forward(parameters, by_seed)

        return infer

    def copy(self) -> Network:
        """Copy the networks into a new buffer."""
        return Network(self.architecture, self.flat.clone())
