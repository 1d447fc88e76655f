"""S independent networks as one: every tensor has a leading seed axis."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ril.environments.environment import Floats
from ril.vectorized.layers import Parameters, without_attention
from ril.vectorized.state import Stateful
from ril.vectorized.streams import Streams


class Architecture(Protocol):
    """A dataclass that describes a network: the shapes of its parameters and its forward pass."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    def shapes(self) -> dict[str, tuple[int, int]]:
        """Return (rows, columns) of every parameter of one seed, by name."""

    def forward(self, parameters: Parameters, x: Tensor) -> Tensor:
        """Map (S, B, inputs) to (S, B, outputs)."""


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
