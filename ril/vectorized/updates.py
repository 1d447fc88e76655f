"""One optimiser step for all seeds at once."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from ril.vectorized.networks import Network


class ClippedAdam:
    """Adam with its default values (§4.1) after clipping each gradient entry (§3.4).

    Args:
        network: whose parameters it changes, in place.
        learning_rate: α of §4.1; may be changed between steps, and is not part of the state.
        gradient_clip: every entry of the gradient is cut to [−clip, clip]; None cuts nothing.
        beta1: how slowly the mean of the gradients moves.
    """

    BETA2, EPSILON = 0.999, 1e-8

    def __init__(
        self,
        network: Network,
        learning_rate: float,
        gradient_clip: float | None = None,
        beta1: float = 0.9,
    ) -> None:
        self.network = network
        self.learning_rate = learning_rate
        self.gradient_clip = gradient_clip
        self.beta1 = beta1
        self.steps = 0
        self.mean = torch.zeros_like(network.flat)
        self.square = torch.zeros_like(network.flat)

    def step(self, losses: Tensor) -> None:
        """Descend each seed's own loss.

        Args:
            losses: (S,), one per seed. Their sum has each seed's own gradient, since no
                parameter is shared.
        """
        leaves = list(self.network.parameters.values())
        gradients = torch.autograd.grad(losses.sum(), leaves)
        gradient = torch.cat([g.reshape(len(g), -1) for g in gradients], dim=1)
        mean_scale, square_scale = self.scales()
        change = self.change(gradient, square_scale)
        self.network.flat.addcdiv_(*change, value=-self.learning_rate / mean_scale)
        self.steps += 1

    def scales(self) -> tuple[float, float]:
        """What the next step divides its means by while they still remember their zeros."""
        steps = self.steps + 1
        return 1 - self.beta1**steps, math.sqrt(1 - self.BETA2**steps)

    def change(self, gradient: Tensor, square_scale: float | Tensor) -> tuple[Tensor, Tensor]:
        """Numerator and denominator, (S, P) each, of a step along a gradient (S, P)."""
        if self.gradient_clip is not None:
            gradient = gradient.clamp(-self.gradient_clip, self.gradient_clip)
        self.mean.lerp_(gradient, 1 - self.beta1)
        self.square.mul_(self.BETA2).addcmul_(gradient, gradient, value=1 - self.BETA2)
        return self.mean, self.square.sqrt().div_(square_scale).add_(self.EPSILON)

    def state_dict(self) -> dict[str, Any]:
        """Moments and step count."""
        return {"steps": self.steps, "mean": self.mean, "square": self.square}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from where `state_dict` was taken."""
        self.steps = state["steps"]
        self.mean.copy_(state["mean"])
        self.square.copy_(state["square"])
