"""One seed at a time, from torch.nn and torch.optim: what the vectorised parts are held against."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ril.vectorized.networks import Architecture, Network


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


def network_of(architecture: Architecture) -> nn.Sequential:
    """The topology of §4.1 as torch.nn modules, with random parameters of their own."""
    parts: list[nn.Module] = []
    fan_in = architecture.inputs
    for size in architecture.hidden:
        parts.append(nn.Linear(fan_in, size))
        if architecture.attention:
            parts.append(OneToken(size))
        if architecture.layer_norm:
            parts.append(nn.LayerNorm(size))
        parts.append(nn.LeakyReLU(architecture.negative_slope))
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
    flat = 0.5 * torch.randn(seeds, architecture.parameter_count, generator=generator)
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
