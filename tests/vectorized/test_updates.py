from __future__ import annotations

import io

import pytest
import torch
from helpers.references import Adam, copies_of, flat_of, gradients_of, random_network
from torch import Tensor

from ril.vectorized.architectures import MLP
from ril.vectorized.networks import Network
from ril.vectorized.updates import ClippedAdam

ARCHITECTURE = MLP(inputs=3, hidden=(6, 4), outputs=2)
S, STEPS = 3, 8


def inputs(step: int) -> Tensor:
    return torch.randn(S, 16, 3, generator=torch.Generator().manual_seed(step))


def losses(network: Network, step: int) -> Tensor:
    return network(inputs(step)).square().sum(dim=-1).mean(dim=-1)


def largest_gradient(network: Network) -> float:
    return gradients_of(network, losses(network, 0)).abs().max().item()


@pytest.mark.parametrize("clip", [None, 1.0, 0.05])
def test_steps_are_those_of_torch_adam_after_clip_grad_value(clip: float | None) -> None:
    network = random_network(ARCHITECTURE, S)
    assert largest_gradient(network) > 1.0  # so that every clip has an effect
    modules = copies_of(network)
    optimizer = ClippedAdam(network, 0.01, clip)
    references = [Adam(module, 0.01, clip) for module in modules]
    for step in range(STEPS):
        optimizer.step(losses(network, step))
        for module, reference, x in zip(modules, references, inputs(step), strict=True):
            reference.step(module(x).square().sum(dim=-1).mean())
    expected = torch.stack([flat_of(module) for module in modules])
    torch.testing.assert_close(network.flat, expected, rtol=1e-4, atol=1e-5)


def test_clipping_cuts_each_entry_by_itself() -> None:
    network = random_network(ARCHITECTURE, S)
    gradient = gradients_of(network, losses(network, 0))
    optimizer = ClippedAdam(network, 0.01, 0.1)
    optimizer.step(losses(network, 0))
    torch.testing.assert_close(optimizer.mean, 0.1 * gradient.clamp(-0.1, 0.1))


def test_steps_are_those_of_torch_adam_after_clip_grad_norm() -> None:
    """One seed's gradient is shorter than the limit, and stays as it is."""
    network = random_network(ARCHITECTURE, S)
    optimizer = ClippedAdam(network, 0.01, epsilon=1e-5, max_norm=0.5)
    factors = torch.tensor([1.0, 1e-3, 5.0])
    lengths = gradients_of(network, losses(network, 0) * factors).norm(dim=1)
    assert (lengths > 0.5).tolist() == [True, False, True]
    modules = copies_of(network)
    references = [torch.optim.Adam(m.parameters(), lr=0.01, eps=1e-5) for m in modules]
    for step in range(STEPS):
        optimizer.step(losses(network, step) * factors)
        for module, reference, x, factor in zip(
            modules, references, inputs(step), factors, strict=True
        ):
            reference.zero_grad()
            (factor * module(x).square().sum(dim=-1).mean()).backward()
            torch.nn.utils.clip_grad_norm_(module.parameters(), 0.5)
            reference.step()
    expected = torch.stack([flat_of(module) for module in modules])
    torch.testing.assert_close(network.flat, expected, rtol=1e-4, atol=1e-5)


def test_a_seed_without_a_gradient_stays() -> None:
    network = random_network(ARCHITECTURE, S)
    before = network.flat.clone()
    ClippedAdam(network, 0.01, None).step(losses(network, 0) * torch.tensor([1.0, 0.0, 1.0]))
    assert torch.equal(network.flat[1], before[1])
    assert (network.flat[[0, 2]] != before[[0, 2]]).any(dim=1).all()


def parameters_after(factors: list[float]) -> Tensor:
    """The parameters after steps on each seed's loss times a factor."""
    network = random_network(ARCHITECTURE, S)
    optimizer = ClippedAdam(network, 0.01, 1.0)
    for step in range(STEPS):
        optimizer.step(losses(network, step) * torch.tensor(factors))
    return network.flat


def test_a_seeds_steps_do_not_depend_on_other_seeds() -> None:
    one, other = parameters_after([1.0, 1.0, 1.0]), parameters_after([1.0, 0.1, -2.0])
    assert torch.equal(one[0], other[0])
    assert (one[1:] != other[1:]).any(dim=1).all()


def test_a_loaded_state_resumes_bit_identically() -> None:
    network = random_network(ARCHITECTURE, S)
    optimizer = ClippedAdam(network, 0.01, 1.0)
    for step in range(STEPS):
        optimizer.step(losses(network, step))
    buffer = io.BytesIO()
    torch.save(optimizer.state_dict(), buffer)
    restored = network.copy()
    resumed = ClippedAdam(restored, 0.01, 1.0)
    buffer.seek(0)
    resumed.load_state_dict(torch.load(buffer, weights_only=True))
    for step in range(STEPS, 2 * STEPS):
        optimizer.step(losses(network, step))
        resumed.step(losses(restored, step))
    assert torch.equal(restored.flat, network.flat)
