"""One optimizer step for all seeds at once."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import ClassVar

import torch
from torch import Tensor

from ril.vectorized.networks import Network
from ril.vectorized.state import Stateful


class ClippedAdam(Stateful):
    """Adam with its default values (§4.1), after clipping the gradient.

    Args:
        network: the networks whose parameters are updated, in place.
        learning_rate: α of §4.1; it may change between steps and is not part of the state.
        gradient_clip: each entry of the gradient is clipped to [−clip, clip] (§3.4); None does not
            clip.
        beta1: decay rate of the running mean of the gradients.
        epsilon: ε of Adam.
        max_norm: the largest norm of each seed's gradient; a longer one is scaled down to it.
            None does not clip.

    Attributes:
        steps: number of steps so far.
        mean: (S, P) running mean of the gradients.
        square: (S, P) running mean of the squared gradients.
    """

    STATE: ClassVar = ("steps", "mean", "square")
    BETA2 = 0.999

    def __init__(
        self,
        network: Network,
        learning_rate: float,
        gradient_clip: float | None = None,
        beta1: float = 0.9,
        epsilon: float = 1e-8,
        max_norm: float | None = None,
    ) -> None:
        self.network = network
        self.learning_rate = learning_rate
        self.gradient_clip = gradient_clip
        self.beta1 = beta1
        self.epsilon = epsilon
        self.max_norm = max_norm
        self.steps = 0
        self.mean = torch.zeros_like(network.flat)
        self.square = torch.zeros_like(network.flat)

    def step(self, losses: Tensor) -> None:
        """Take one step down each seed's own loss.

        Args:
            losses: (S,), one per seed. The gradient of their sum holds each seed's own gradient,
                because the seeds share no parameters.
        """
        leaves = list(self.network.parameters.values())
        gradients = torch.autograd.grad(losses.sum(), leaves)
        mean_scale, square_scale = self.scales()
        denominator = self.change(self.mean, self.square, gradients, square_scale)
        rate = self.learning_rate / mean_scale
        self.network.flat.addcdiv_(self.mean, denominator, value=-rate)
        self.steps += 1

    def scales(self) -> tuple[float, float]:
        """Compute the next step's bias corrections.

        Returns:
            The divisors of `mean` and of the square root of `square`, which correct for their
            initial value of 0.
        """
        steps = self.steps + 1
        return 1 - self.beta1**steps, math.sqrt(1 - self.BETA2**steps)

    def change(
        self,
        mean: Tensor,
        square: Tensor,
        gradients: Iterable[Tensor],
        square_scale: float | Tensor,
    ) -> Tensor:
        """Update both running means, of which the first is the step's numerator.

        Args:
            mean: `mean`, (S, P), written in place.
            square: `square`, (S, P), written in place.
            gradients: of each parameter, (S, rows, columns).
            square_scale: the second of `scales`.

        Returns:
            (S, P) the step's denominator.
        """
        parts = [gradient.flatten(1) for gradient in gradients]
        if self.max_norm is not None:
            norms = [part.square().sum(dim=1, keepdim=True) for part in parts]
            norm = square_root(torch.cat(norms, dim=1).sum(dim=1, keepdim=True))
            scale = (self.max_norm / (norm + 1e-6)).clamp(max=1.0)
            parts = [part * scale for part in parts]
        gradient = torch.cat(parts, dim=1)
        if self.gradient_clip is not None:
            gradient = gradient.clamp(-self.gradient_clip, self.gradient_clip)
        mean.lerp_(gradient, 1 - self.beta1)
        square.mul_(self.BETA2).addcmul_(gradient, gradient, value=1 - self.BETA2)
        return square_root(square).div_(square_scale).add_(self.epsilon)


def square_root(x: Tensor) -> Tensor:
    """Compute √x, with the same digits on every make of processor.

    `torch.sqrt` is MKL's, which begins with an approximation that each make has its own of.
    """
    return x.rsqrt().reciprocal_()
