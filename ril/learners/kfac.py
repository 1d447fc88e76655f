"""K-FAC: natural gradient steps with a Fisher matrix that is a Kronecker product per layer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from omegaconf import MISSING
from torch import Tensor
from torch.nn import functional

from ril.config.fields import within
from ril.io.errors import UserError
from ril.vectorized.networks import MLP, Network, apply_linear


@dataclass
class KFACConfig:
    """Steps of K-FAC within a trust region; of ACKTR's actor or its critic."""

    learning_rate: float = MISSING
    kl_clip: float = MISSING
    momentum: float = within(0, 0.9999)
    damping: float = MISSING
    stats_decay: float = within(0, 0.9999)
    eigen_interval: int = MISSING


def aligned(x: Tensor) -> Tensor:
    """Zeros beside the last axis, up to a multiple of 16.

    Every seed's matrices then begin at a multiple of 64 bytes, without which products and
    eigenvectors are rounded otherwise for one seed alone than for several. A zero feature, or
    the zero gradient of an output, has no weight of its own that could change.
    """
    return functional.pad(x, (0, -x.shape[-1] % 16))


class FactoredLayer:
    """One Linear layer's block of the Fisher matrix, F ≈ A ⊗ G, in each of S networks.

    Below, n and m are the layer's inputs with a 1 beside them for the bias, and its outputs,
    both `aligned`.

    Args:
        seeds: S.
        inputs: of the layer, without the 1.
        outputs: of the layer.
        device: where the factors live.

    Attributes:
        factors: A = E[a aᵀ] (S, n, n) of inputs a, and G = E[g gᵀ] (S, m, m) of the gradients
            g with respect to outputs; running means.
        eigenvalues: of both factors as of the last `decompose`, (S, n) and (S, m).
        bases: their eigenvectors, (S, n, n) and (S, m, m).
    """

    def __init__(self, seeds: int, inputs: int, outputs: int, device: torch.device) -> None:
        self.shape = (inputs + 1, outputs)
        sizes = [size + -size % 16 for size in self.shape]
        self.factors = [torch.zeros(seeds, size, size, device=device) for size in sizes]
        self.eigenvalues = [torch.zeros(seeds, size, device=device) for size in sizes]
        self.bases = [torch.zeros_like(factor) for factor in self.factors]

    def observe(self, inputs: Tensor, gradients: Tensor, weight: float) -> None:
        """Move the factors towards those of a batch: inputs (S, B, n), gradients (S, B, m)."""
        for factor, batch in zip(self.factors, (inputs, gradients), strict=True):
            factor.lerp_(batch.mT @ batch / batch.shape[1], weight)

    def decompose(self) -> None:
        """Work out the eigenvalues and bases of the factors as they now are."""
        for factor, eigenvalues, basis in zip(
            self.factors, self.eigenvalues, self.bases, strict=True
        ):
            try:
                values, vectors = torch.linalg.eigh(factor)
            except RuntimeError:  # of linear algebra
                raise UserError(
                    "method.actor, method.critic: a network is no longer finite; lower its "
                    "learning_rate or kl_clip"
                ) from None
            eigenvalues.copy_(values.clamp_min(0))  # which rounding may leave below
            basis.copy_(vectors)

    def natural(self, gradient: Tensor, damping: float) -> Tensor:
        """(A ⊗ G + damping·I)⁻¹ times a gradient (S, n, m) by the layer's weights."""
        of_inputs, of_outputs = self.bases
        eigenvalues = self.eigenvalues[0][:, :, None] * self.eigenvalues[1][:, None, :]
        rotated = of_inputs.mT @ gradient @ of_outputs
        return of_inputs @ (rotated / (eigenvalues + damping)) @ of_outputs.mT

    def flat(self, matrix: Tensor) -> Tensor:
        """(S, n, m) to (S, parameters), as a network's buffer has the weights and the bias."""
        rows, columns = self.shape
        return matrix[:, :rows, :columns].flatten(1)

    def state_dict(self) -> dict[str, Any]:
        """Factors, and what was made of them."""
        return {"factors": self.factors, "eigenvalues": self.eigenvalues, "bases": self.bases}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from where `state_dict` was taken."""
        for name, tensors in self.state_dict().items():
            for tensor, saved in zip(tensors, state[name], strict=True):
                tensor.copy_(saved)


class KFAC:
    """Natural gradient descent within a trust region (Wu et al., 2017, §3), by K-FAC.

    The network has to be a plain one: Linear layers with tanh between them.

    Args:
        network: whose parameters it changes, in place.
        config: `method.actor` or `method.critic`.
    """

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
        """The network's outputs at x (S, B, inputs), of which the next `step`'s losses are made."""
        self._inputs, self._outputs = [], []
        for name in self.layers:
            x = self._outputs[-1].tanh() if self._outputs else x
            self._inputs.append(x)
            self._outputs.append(apply_linear(self.network.parameters, name, x))
        return self._outputs[-1]

    def step(self, losses: Tensor, surprise: Tensor) -> None:
        """Descend each seed's own loss.

        Args:
            losses: (S,), one per seed.
            surprise: (S, B) −log p of each output's sample, drawn from the network's own
                distribution; the Fisher matrix is the covariance of its gradients.
        """
        config = self.config
        by_outputs = torch.autograd.grad(losses.sum(), self._outputs, retain_graph=True)
        fisher = torch.autograd.grad(surprise.sum(), self._outputs)
        self.steps += 1
        weight = max(1 - config.stats_decay, 1 / self.steps)  # at first a plain mean
        gradients, steps = [], []
        for layer, x, loss_gradient, fisher_gradient in zip(
            self.layers.values(), self._inputs, by_outputs, fisher, strict=True
        ):
            inputs = aligned(functional.pad(x.detach(), (0, 1), value=1.0))
            layer.observe(inputs, aligned(fisher_gradient), weight)
            if (self.steps - 1) % config.eigen_interval == 0:
                layer.decompose()
            gradient = inputs.mT @ aligned(loss_gradient)
            gradients.append(layer.flat(gradient))
            steps.append(layer.flat(layer.natural(gradient, config.damping)))
        gradient, delta = torch.cat(gradients, dim=1), torch.cat(steps, dim=1)
        # F̂Δ = ∇, so that ∇ᵀΔ is the quadratic form of the trust region: η²·ΔᵀF̂Δ / 2 ≤ δ.
        quadratic = (gradient * delta).sum(dim=1, keepdim=True).clamp_min(1e-12)
        rate = (2 * config.kl_clip / quadratic).sqrt().clamp(max=config.learning_rate)
        self.velocity.lerp_(rate * delta, 1 - config.momentum)
        self.network.flat.sub_(self.velocity)

    def state_dict(self) -> dict[str, Any]:
        """Factors, bases, velocity and step count."""
        layers = {name: layer.state_dict() for name, layer in self.layers.items()}
        return {"steps": self.steps, "velocity": self.velocity, "layers": layers}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from where `state_dict` was taken."""
        self.steps = state["steps"]
        self.velocity.copy_(state["velocity"])
        for name, layer in self.layers.items():
            layer.load_state_dict(state["layers"][name])
