"""K-FAC: natural gradients with a Fisher matrix that is one Kronecker product per layer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from omegaconf import MISSING
from torch import Tensor
from torch.nn import functional

from ril.config.fields import within
from ril.io.errors import UserError
from ril.vectorized.architectures import MLP
from ril.vectorized.layers import apply_linear
from ril.vectorized.networks import Network
from ril.vectorized.state import Stateful
from ril.vectorized.updates import square_root


@dataclass
class KFACConfig:
    """K-FAC's steps within a trust region, for ACKTR's actor or its critic."""

    learning_rate: float = MISSING
    kl_clip: float = MISSING
    momentum: float = within(0, 0.9999)
    damping: float = MISSING
    stats_decay: float = within(0, 0.9999)
    eigen_interval: int = MISSING


def aligned(x: Tensor) -> Tensor:
    """Pad the last axis with zeros, up to a multiple of 16.

    Each seed's matrices then begin at a multiple of 64 bytes. Otherwise, the rounding of products
    and eigenvectors would depend on the number of seeds. Padding changes no parameter, since a
    padded input or output has no weights.
    """
    return functional.pad(x, (0, -x.shape[-1] % 16))


class FactoredLayer(Stateful):
    """One Linear layer's block of the Fisher matrix, F ≈ A ⊗ G, for each of S networks.

    Below, n counts the layer's inputs plus a constant 1 for the bias, and m its outputs, both
    `aligned`.

    Args:
        seeds: S.
        inputs: number of the layer's inputs, without the constant 1.
        outputs: number of the layer's outputs.
        device: device of the factors.

    Attributes:
        factors: A = E[a aᵀ] (S, n, n) of inputs a, and G = E[g gᵀ] (S, m, m) of the gradients
            g with respect to outputs; running means.
        eigenvalues: (S, n) and (S, m), those of both factors at the last `decompose`.
        bases: their eigenvectors, (S, n, n) and (S, m, m).
    """

    STATE: ClassVar = ("factors", "eigenvalues", "bases")

    def __init__(self, seeds: int, inputs: int, outputs: int, device: torch.device) -> None:
        self.shape = (inputs + 1, outputs)
        sizes = [size + -size % 16 for size in self.shape]
        self.factors = tuple(torch.zeros(seeds, size, size, device=device) for size in sizes)
        self.eigenvalues = tuple(torch.zeros(seeds, size, device=device) for size in sizes)
        self.bases = tuple(torch.zeros_like(factor) for factor in self.factors)

    def observe(self, inputs: Tensor, gradients: Tensor, weight: float) -> None:
        """Update the factors with those of a batch.

        Args:
            inputs: a, (S, B, n).
            gradients: g, (S, B, m).
            weight: weight of the batch in the running means.
        """
        for factor, batch in zip(self.factors, (inputs, gradients), strict=True):
            factor.lerp_(batch.mT @ batch / batch.shape[1], weight)

    def decompose(self) -> None:
        """Compute the eigenvalues and eigenvectors of the current factors.

        Raises:
            UserError: a factor is not finite.
        """
        for factor, eigenvalues, basis in zip(
            self.factors, self.eigenvalues, self.bases, strict=True
        ):
            try:
                values, vectors = torch.linalg.eigh(factor)
            except RuntimeError:  # torch's linear algebra error is one
                raise UserError(
                    "method.actor, method.critic: a network's parameters are no longer finite; "
                    "lower its learning_rate or kl_clip"
                ) from None
            eigenvalues.copy_(values.clamp_min(0))  # rounding may make them negative
            basis.copy_(vectors)

    def natural_gradient(self, gradient: Tensor, damping: float) -> Tensor:
        """Compute (A ⊗ G + damping·I)⁻¹ ∇ for a gradient ∇ (S, n, m) of the layer's weights."""
        of_inputs, of_outputs = self.bases
        eigenvalues = self.eigenvalues[0][:, :, None] * self.eigenvalues[1][:, None, :]
        rotated = of_inputs.mT @ gradient @ of_outputs
        return of_inputs @ (rotated / (eigenvalues + damping)) @ of_outputs.mT

    def flatten(self, matrix: Tensor) -> Tensor:
        """Order (S, n, m) as (S, parameters): weights, then bias, as in `Network.flat`."""
        rows, columns = self.shape
        return matrix[:, :rows, :columns].flatten(1)


class KFAC(Stateful):
    """Natural gradient descent within a trust region, by K-FAC (Wu et al., 2017, §3).

    Args:
        network: Linear layers with tanh between them; its parameters are updated in place.
        config: `method.actor` or `method.critic`.

    Attributes:
        steps: number of steps so far.
        velocity: (S, P) running mean of the steps.
        layers: each layer's block of the Fisher matrix, by name.
    """

    STATE: ClassVar = ("steps", "velocity", "layers")

    def __init__(self, network: Network, config: KFACConfig) -> None:
        shape = network.architecture
        assert isinstance(shape, MLP)
        assert not shape.attention
        assert not shape.layer_norm
        assert shape.negative_slope is None
        self.network = network
        self.config = config
        self.steps = 0
        self.velocity = torch.zeros_like(network.flat)
        seeds, device = len(network.flat), network.flat.device
        self.layers = {
            name.removesuffix(".weight"): FactoredLayer(seeds, *size, device)
            for name, size in shape.shapes().items()
            if name.endswith(".weight")
        }
        self._inputs: list[Tensor] = []
        self._outputs: list[Tensor] = []

    def __call__(self, x: Tensor) -> Tensor:
        """Compute the outputs (S, B, outputs) for inputs (S, B, inputs).

        The losses of the next `step` must be computed from them.
        """
        self._inputs, self._outputs = [], []
        for name in self.layers:
            x = self._outputs[-1].tanh() if self._outputs else x
            self._inputs.append(x)
            self._outputs.append(apply_linear(self.network.parameters, name, x))
        return self._outputs[-1]

    def step(self, losses: Tensor, log_prob: Tensor) -> None:
        """Take one step down each seed's own loss.

        Args:
            losses: (S,), one per seed.
            log_prob: (S, B) log p of a sample from the network's own distribution at each output.
                The Fisher matrix is the covariance of its gradients, so its sign does not matter.
        """
        config = self.config
        by_outputs = torch.autograd.grad(losses.sum(), self._outputs, retain_graph=True)
        fisher = torch.autograd.grad(log_prob.sum(), self._outputs)
        self.steps += 1
        weight = max(
            1 - config.stats_decay, 1 / self.steps
        )  # at first the plain mean of all batches
        gradients, steps = [], []
        for layer, x, loss_gradient, fisher_gradient in zip(
            self.layers.values(), self._inputs, by_outputs, fisher, strict=True
        ):
            inputs = aligned(functional.pad(x.detach(), (0, 1), value=1.0))
            layer.observe(inputs, aligned(fisher_gradient), weight)
            if (self.steps - 1) % config.eigen_interval == 0:
                layer.decompose()
            gradient = inputs.mT @ aligned(loss_gradient)
            gradients.append(layer.flatten(gradient))
            steps.append(layer.flatten(layer.natural_gradient(gradient, config.damping)))
        gradient, delta = torch.cat(gradients, dim=1), torch.cat(steps, dim=1)
        # F̂Δ = ∇, so ∇ᵀΔ = ΔᵀF̂Δ, and the trust region η²·ΔᵀF̂Δ / 2 ≤ δ limits the rate η.
        quadratic = (gradient * delta).sum(dim=1, keepdim=True).clamp_min(1e-12)
        rate = square_root(2 * config.kl_clip / quadratic).clamp(max=config.learning_rate)
        self.velocity.lerp_(rate * delta, 1 - config.momentum)
        self.network.flat.sub_(self.velocity)
