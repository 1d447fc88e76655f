"""Architectures: the shapes of a network's parameters by name, and its forward pass."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor
from torch.nn import functional

from ril.vectorized.layers import (
    Parameters,
    affine,
    apply_linear,
    attended_linear,
    attention_of,
    layer_norm,
    linear,
    self_attention,
    tanh,
)


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
            attention = attention_of(p, f"linear{layer}.")
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
