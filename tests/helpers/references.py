"""One seed at a time, from torch.nn and torch.optim: references for the vectorized parts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from ril.learners.kfac import KFACConfig
from ril.vectorized.architectures import MLP
from ril.vectorized.networks import Architecture, Network, parameter_count


class SelfAttention(nn.Module):
    """Residual dot-product attention with query, key and value over tokens x (..., T, n)."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.query, self.key = nn.Linear(size, size), nn.Linear(size, size)
        self.value = nn.Linear(size, size)
        self.gamma = nn.Parameter(torch.zeros(1))

    def forward(self, x: Tensor) -> Tensor:
        scores = self.query(x) @ self.key(x).transpose(-1, -2) / x.shape[-1] ** 0.5
        return x + self.gamma * (scores.softmax(dim=-1) @ self.value(x))


class OneToken(nn.Module):
    """Attention over states (B, n), each of which is a sequence of one token."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.attention = SelfAttention(size)

    def forward(self, x: Tensor) -> Tensor:
        return self.attention(x[:, None]).squeeze(1)


def network_of(architecture: MLP) -> nn.Sequential:
    """The topology of §4.1 as torch.nn modules, with random parameters of their own."""
    parts: list[nn.Module] = []
    fan_in = architecture.inputs
    for size in architecture.hidden:
        parts.append(nn.Linear(fan_in, size))
        if architecture.attention:
            parts.append(OneToken(size))
        if architecture.layer_norm:
            parts.append(nn.LayerNorm(size))
        slope = architecture.negative_slope
        parts.append(nn.Tanh() if slope is None else nn.LeakyReLU(slope))
        fan_in = size
    return nn.Sequential(*parts, nn.Linear(fan_in, architecture.outputs))


def tensors_of(reference: nn.Sequential) -> list[nn.Parameter]:
    """The parameters that `Network` also has, in its order; there, Linear's are transposed."""
    found = []
    for part in reference:
        if isinstance(part, OneToken):
            value = part.attention.value
            found += [value.weight, value.bias, part.attention.gamma]
        elif isinstance(part, nn.Linear | nn.LayerNorm):
            found += [part.weight, part.bias]
    return found


def flat_of(reference: nn.Sequential, *, gradients: bool = False) -> Tensor:
    """(P,) parameters, or gradients, as a row of `Network.flat`."""
    tensors = [p.grad if gradients else p.detach() for p in tensors_of(reference)]
    return torch.cat([(t.T if t.ndim == 2 else t).reshape(-1) for t in tensors])


def copies_of(network: Network) -> list[nn.Sequential]:
    """Each seed's network as a module of torch.nn."""
    references = []
    for row in network.flat:
        reference = network_of(network.architecture)
        start = 0
        for tensor in tensors_of(reference):
            values = row[start : start + tensor.numel()]
            start += tensor.numel()
            shape = tensor.T.shape if tensor.ndim == 2 else tensor.shape
            values = values.reshape(shape)
            tensor.data.copy_(values.T if tensor.ndim == 2 else values)
        references.append(reference)
    return references


def random_network(architecture: Architecture, seeds: int = 3) -> Network:
    """Networks in which every parameter, γ too, differs from 0."""
    generator = torch.Generator().manual_seed(0)
    flat = 0.5 * torch.randn(seeds, parameter_count(architecture), generator=generator)
    return Network(architecture, flat)


class Adam:
    """torch.optim.Adam with its default values on one module, after clip_grad_value_."""

    def __init__(self, module: nn.Module, learning_rate: float, clip: float | None) -> None:
        self.module, self.clip = module, clip
        self.optimizer = torch.optim.Adam(module.parameters(), lr=learning_rate)

    def step(self, loss: Tensor) -> None:
        self.optimizer.zero_grad()
        loss.backward()
        if self.clip is not None:
            nn.utils.clip_grad_value_(self.module.parameters(), self.clip)
        self.optimizer.step()


def gradients_of(network: Network, losses: Tensor) -> Tensor:
    """(S, P) gradients of each seed's own loss."""
    leaves = list(network.parameters.values())
    gradients = torch.autograd.grad(losses.sum(), leaves)
    return torch.cat([g.reshape(len(g), -1) for g in gradients], dim=1)


def fill(module: nn.Module, network: Network, seed: int) -> None:
    """Give a module's Linear layers the parameters of the same names of one seed's network."""
    for name, layer in module.named_children():
        assert isinstance(layer, nn.Linear)
        layer.weight.data.copy_(network.parameters[f"{name}.weight"][seed].T)
        layer.bias.data.copy_(network.parameters[f"{name}.bias"][seed, 0])


def linear_flat_of(module: nn.Module, *, gradients: bool = False) -> Tensor:
    """(P,) parameters, or gradients, of a module's Linear layers, as a row of `Network.flat`."""
    parts = []
    for layer in module.children():
        assert isinstance(layer, nn.Linear)
        for parameter in (layer.weight, layer.bias):
            values = parameter.detach()
            if gradients:
                # What is not part of a loss has no gradient.
                values = torch.zeros_like(values) if parameter.grad is None else parameter.grad
            parts.append(values.T.reshape(-1) if values.ndim == 2 else values)
    return torch.cat(parts)


def leaky(x: Tensor) -> Tensor:
    return torch.where(x > 0, x, 0.2 * x)


class LatentActions(nn.Module):
    """ILPO's latent policy and generator (Edwards et al., 2019), one latent action at a time."""

    def __init__(self, observations: int, latents: int, first: int, code: int, last: int) -> None:
        super().__init__()
        self.latents = latents
        self.encoder0, self.encoder1 = nn.Linear(observations, first), nn.Linear(first, code)
        self.latent = nn.Linear(code, latents)
        self.embedding = nn.Linear(latents, code)
        self.joint = nn.Linear(2 * code, code)
        self.generator0, self.generator1 = nn.Linear(code, last), nn.Linear(last, observations)

    def encode(self, states: Tensor) -> Tensor:
        return self.encoder1(leaky(self.encoder0(states)))

    def probabilities(self, states: Tensor) -> Tensor:
        """(B, |Z|) of the latent policy."""
        return self.latent(leaky(self.encode(states))).softmax(dim=1)

    def change(self, states: Tensor, latent: int) -> Tensor:
        """(B, obs) predicted s' − s."""
        one_hot = torch.zeros(len(states), self.latents)
        one_hot[:, latent] = 1
        both = torch.cat((leaky(self.encode(states)), leaky(self.embedding(one_hot))), dim=1)
        return self.generator1(leaky(self.generator0(leaky(self.joint(both)))))

    def loss(self, states: Tensor, changes: Tensor) -> Tensor:
        """Mean over b of min over z of ‖Δ − g‖², and of ‖Δ − Σ_z p(z|s)·g‖² with g held."""
        probabilities = self.probabilities(states)
        found = [self.change(states, latent) for latent in range(self.latents)]
        total = torch.zeros(())
        for b, change in enumerate(changes):
            total = total + min((change - g[b]).pow(2).sum() for g in found)
            mean = sum(p * g[b].detach() for p, g in zip(probabilities[b], found, strict=True))
            total = total + (change - mean).pow(2).sum()
        return total / len(states)


class Remapping(nn.Module):
    """ILPO's π(a | s, z), with an encoder of its own."""

    def __init__(
        self, observations: int, latents: int, actions: int, code: tuple[int, int], hidden: Any
    ) -> None:
        super().__init__()
        self.latents = latents
        self.remap_encoder0 = nn.Linear(observations, code[0])
        self.remap_encoder1 = nn.Linear(code[0], code[1])
        self.remap_embedding = nn.Linear(latents, code[1])
        self.remap_joint0 = nn.Linear(2 * code[1], hidden[0])
        self.remap_joint1 = nn.Linear(hidden[0], hidden[1])
        self.remap_output = nn.Linear(hidden[1], actions)

    def forward(self, states: Tensor, latents: Tensor) -> Tensor:
        """(B, obs) states and (B,) latent actions to (B, |A|) logits."""
        encoded = leaky(self.remap_encoder1(leaky(self.remap_encoder0(states))))
        embedded = leaky(self.remap_embedding(torch.eye(self.latents)[latents]))
        joint = leaky(self.remap_joint0(torch.cat((encoded, embedded), dim=1)))
        return self.remap_output(leaky(self.remap_joint1(joint)))


def tanh_mlp(inputs: int, hidden: tuple[int, ...], outputs: int) -> MLP:
    return MLP(inputs, hidden, outputs, attention=False, layer_norm=False, negative_slope=None)


class PlainKFAC:
    """K-FAC of one module in double precision, with a whole Fisher matrix per Linear layer."""

    def __init__(self, module: nn.Sequential, config: KFACConfig) -> None:
        self.module, self.config = module.double(), config
        self.linears = [part for part in module if isinstance(part, nn.Linear)]
        self.factors: list[tuple[Tensor, Tensor]] = []
        self.fisher: list[Tensor] = []
        self.velocity = torch.zeros(sum(p.numel() for p in module.parameters()))
        self.steps = 0

    def batch_factors(
        self, x: Tensor, log_prob: Callable[[Tensor, int], Tensor]
    ) -> list[tuple[Tensor, Tensor]]:
        """E[a aᵀ] and E[g gᵀ] of each layer, from one sample after the other."""
        sums: list[tuple[Tensor, Tensor]] = []
        for index, sample in enumerate(x.double()):
            value, inputs, outputs = sample, [], []
            for part in self.module:
                if isinstance(part, nn.Linear):
                    inputs.append(torch.cat((value.detach(), torch.ones(1))))
                value = part(value)
                if isinstance(part, nn.Linear):
                    outputs.append(value)
            gradients = torch.autograd.grad(log_prob(value, index), outputs)
            pairs = [
                (torch.outer(a, a) / len(x), torch.outer(g, g) / len(x))
                for a, g in zip(inputs, gradients, strict=True)
            ]
            zeros = [(torch.zeros_like(a), torch.zeros_like(g)) for a, g in pairs]
            before = sums or zeros
            sums = [(A + a, G + g) for (A, G), (a, g) in zip(before, pairs, strict=True)]
        return sums

    def gradient(self, loss: Tensor) -> list[Tensor]:
        """Each layer's, in the order of a row of `Network.flat`."""
        self.module.zero_grad()
        loss.backward()
        found = []
        for layer in self.linears:
            assert layer.weight.grad is not None
            assert layer.bias.grad is not None
            found.append(torch.cat((layer.weight.grad.T.flatten(), layer.bias.grad)))
        return found

    def step(self, x: Tensor, loss: Tensor, log_prob: Callable[[Tensor, int], Tensor]) -> None:
        """Take one step down a loss; the Fisher matrix is that of log_prob."""
        config = self.config
        self.steps += 1
        batch = self.batch_factors(x, log_prob)
        decay = min(config.stats_decay, 1 - 1 / self.steps)
        before = self.factors or batch
        self.factors = [
            (decay * A + (1 - decay) * a, decay * G + (1 - decay) * g)
            for (A, G), (a, g) in zip(before, batch, strict=True)
        ]
        if (self.steps - 1) % config.eigen_interval == 0:
            self.fisher = [torch.kron(A, G) for A, G in self.factors]
        gradients = self.gradient(loss)
        steps = [
            torch.linalg.solve(F + config.damping * torch.eye(len(F)), g)
            for F, g in zip(self.fisher, gradients, strict=True)
        ]
        delta = torch.cat(steps)
        form = sum(
            d @ F @ d + config.damping * d @ d for d, F in zip(steps, self.fisher, strict=True)
        )
        rate = min(config.learning_rate, float((2 * config.kl_clip / form) ** 0.5))
        self.velocity = config.momentum * self.velocity + (1 - config.momentum) * rate * delta
        start = 0
        with torch.no_grad():
            for layer in self.linears:
                for parameter in (layer.weight.T, layer.bias):
                    change = self.velocity[start : start + parameter.numel()]
                    parameter.sub_(change.view(parameter.shape))
                    start += parameter.numel()
