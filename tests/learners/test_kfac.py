from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import pytest
import torch
from helpers.references import PlainKFAC, copies_of, flat_of, random_network, tanh_mlp
from helpers.states import assert_equal_states, copied
from torch import Tensor

from ril.learners.exploration import sample_softmax
from ril.learners.kfac import KFAC, KFACConfig
from ril.vectorized.architectures import MLP
from ril.vectorized.networks import Network

#: With a trust region that nothing leaves, and no momentum.
CONFIG = KFACConfig(
    learning_rate=0.05,
    kl_clip=1e9,
    momentum=0.0,
    damping=0.01,
    stats_decay=0.99,
    eigen_interval=1,
)
SMALL = tanh_mlp(3, (5, 4), 2)
WIDE = tanh_mlp(2, (20,), 1)  # wider than 16 in one place, one output
SEEDS, BATCH = 3, 30


@pytest.fixture(autouse=True)
def double_precision() -> Iterator[None]:
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def config(**changes: float) -> KFACConfig:
    return dataclasses.replace(CONFIG, **changes)


def optimizer(architecture: MLP = SMALL, **changes: float) -> KFAC:
    return KFAC(random_network(architecture, SEEDS), config(**changes))


def normal(*shape: int, seed: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def batch(architecture: MLP, update: int) -> tuple[Tensor, Tensor, Tensor]:
    """Inputs, targets of a loss, and what makes a Fisher matrix, all of S seeds."""
    sizes = (architecture.inputs, architecture.outputs, architecture.outputs)
    x, targets, noise = (
        normal(SEEDS, BATCH, size, seed=3 * update + i) for i, size in enumerate(sizes)
    )
    return x, targets, noise


def train(kfac: KFAC, count: int = 1) -> Tensor:
    """(S, P) change by some updates, each on a batch of its own."""
    shape = kfac.network.architecture
    assert isinstance(shape, MLP)
    before = kfac.network.flat.clone()
    for update in range(kfac.steps, kfac.steps + count):
        x, targets, noise = batch(shape, update)
        outputs = kfac(x)
        losses = (outputs - targets).square().sum(dim=-1).mean(dim=1)
        kfac.step(losses, (outputs * noise).sum(dim=-1).tanh())
    return kfac.network.flat - before


def plain(architecture: MLP, count: int = 1, **changes: float) -> list[PlainKFAC]:
    """What has done the same, a seed at a time."""
    references = []
    for seed, module in enumerate(copies_of(random_network(architecture, SEEDS))):
        reference = PlainKFAC(module, config(**changes))
        for update in range(count):
            x, targets, noise = (part[seed] for part in batch(architecture, update))
            loss = (module(x) - targets).square().sum(dim=-1).mean()
            reference.step(x, loss, lambda out, i, noise=noise: (out * noise[i]).sum().tanh())
        references.append(reference)
    return references


def assert_same(kfac: KFAC, references: list[PlainKFAC]) -> None:
    expected = torch.stack([flat_of(reference.module) for reference in references])
    torch.testing.assert_close(kfac.network.flat, expected, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("architecture", [SMALL, WIDE])
def test_factors_are_means_over_samples(architecture: MLP) -> None:
    kfac, references = optimizer(architecture), plain(architecture)
    train(kfac)
    for index, layer in enumerate(kfac.layers.values()):
        for seed, reference in enumerate(references):
            for found, expected in zip(layer.factors, reference.factors[index], strict=True):
                size = len(expected)
                torch.testing.assert_close(found[seed, :size, :size], expected)
                assert not found[seed, size:].any()


def test_outputs_are_the_networks_own() -> None:
    kfac = optimizer()
    x = normal(SEEDS, BATCH, 3, seed=0)
    assert torch.equal(kfac(x), kfac.network(x))


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"stats_decay": 0.4},
        {"eigen_interval": 3},
        {"momentum": 0.7},
        {"kl_clip": 1e-3},
        {"kl_clip": 1e-3, "momentum": 0.9, "eigen_interval": 2, "damping": 1e-3},
    ],
)
@pytest.mark.parametrize("architecture", [SMALL, WIDE])
def test_updates_are_those_of_a_whole_matrix_per_layer(
    architecture: MLP, changes: dict[str, float]
) -> None:
    kfac = optimizer(architecture, **changes)
    train(kfac, 5)
    assert_same(kfac, plain(architecture, 5, **changes))


def per_sample_gradients(network: Network, x: Tensor, noise: Tensor) -> Tensor:
    """(S, B, P) gradients of each sample's log-probability."""
    found = []
    for index in range(x.shape[1]):
        log_prob = (network(x[:, index, None])[:, 0] * noise[:, index]).sum()
        gradients = torch.autograd.grad(log_prob, list(network.parameters.values()))
        found.append(torch.cat([g.flatten(1) for g in gradients], dim=1))
    return torch.stack(found, dim=1)


def test_where_inputs_and_gradients_are_independent_it_is_the_whole_fisher_matrix() -> None:
    kfac = optimizer(tanh_mlp(3, (), 2))
    # Every input meets every gradient as often: E[a aᵀ ⊗ g gᵀ] = E[a aᵀ] ⊗ E[g gᵀ].
    inputs, gradients = normal(SEEDS, 5, 3, seed=0), normal(SEEDS, 6, 2, seed=1)
    x = inputs.repeat_interleave(6, dim=1)
    noise = gradients.repeat(1, 5, 1)
    rows = per_sample_gradients(kfac.network, x, noise)
    fisher = rows.mT @ rows / x.shape[1]
    before = kfac.network.flat.clone()
    targets = normal(SEEDS, 30, 2, seed=2)

    outputs = kfac(x)
    losses = (outputs - targets).square().sum(dim=-1).mean(dim=1)
    parameters = list(kfac.network.parameters.values())
    parts = torch.autograd.grad(losses.sum(), parameters, retain_graph=True)
    gradient = torch.cat([g.flatten(1) for g in parts], dim=1)
    kfac.step(losses, (outputs * noise).sum(dim=-1))

    damped = fisher + CONFIG.damping * torch.eye(fisher.shape[1])
    expected = -CONFIG.learning_rate * torch.linalg.solve(damped, gradient)
    torch.testing.assert_close(kfac.network.flat - before, expected)


def quadratic(change: Tensor) -> Tensor:
    """(S,) ΔᵀFΔ with the damped Fisher matrix of a first update of `SMALL`."""
    found = []
    for row, reference in zip(change, plain(SMALL), strict=True):
        blocks = torch.block_diag(*reference.fisher)
        found.append(row @ (blocks + CONFIG.damping * torch.eye(len(blocks))) @ row)
    return torch.stack(found)


@pytest.mark.parametrize("clip", [1e-5, 1e-3])
def test_a_clipped_step_ends_on_the_edge_of_the_trust_region(clip: float) -> None:
    change = train(optimizer(kl_clip=clip))
    torch.testing.assert_close(quadratic(change) / 2, torch.full((SEEDS,), clip))


def test_a_step_within_the_trust_region_is_whole() -> None:
    whole = train(optimizer(kl_clip=1e9))
    size = quadratic(whole) / 2
    assert torch.equal(train(optimizer(kl_clip=1.01 * float(size.max()))), whole)
    clipped = train(optimizer(kl_clip=0.99 * float(size.min())))
    assert (clipped.norm(dim=1) < whole.norm(dim=1)).all()


def test_each_seed_has_a_trust_region_of_its_own() -> None:
    sizes = quadratic(train(optimizer(kl_clip=1e9))) / 2
    assert sizes.min() < sizes.median() < sizes.max()
    found = quadratic(train(optimizer(kl_clip=float(sizes.median())))) / 2
    torch.testing.assert_close(found, sizes.clamp(max=sizes.median()))


@pytest.mark.parametrize("clip", [1e-4, 1e-3])
def test_the_policy_moves_by_about_the_clip(clip: float) -> None:
    kfac = optimizer(tanh_mlp(3, (8,), 3), kl_clip=clip, learning_rate=1e9)
    x = normal(SEEDS, 2000, 3, seed=0)
    uniform = torch.rand(SEEDS, 2000, generator=torch.Generator().manual_seed(1))
    before = kfac(x).log_softmax(dim=-1)
    chosen = before.gather(-1, sample_softmax(before, uniform)[..., None]).squeeze(-1)
    advantages = normal(SEEDS, 2000, seed=2) + x[..., 0]
    kfac.step(-(chosen * advantages).mean(dim=1), -chosen)
    after = kfac.network(x).log_softmax(dim=-1)
    divergence = (before.exp() * (before - after)).sum(dim=-1).mean(dim=1)
    assert (divergence > clip / 3).all()
    assert (divergence < clip * 3).all()


def test_without_a_gradient_nothing_moves() -> None:
    kfac = optimizer()
    outputs = kfac(normal(SEEDS, BATCH, 3, seed=0))
    kfac.step(0 * outputs.sum(dim=(1, 2)), outputs.sum(dim=-1))
    assert torch.equal(kfac.network.flat, random_network(SMALL, SEEDS).flat)


def test_a_loaded_state_resumes_bit_identically() -> None:
    changes = {"eigen_interval": 4, "momentum": 0.9, "kl_clip": 1e-3}
    kfac, resumed = optimizer(**changes), optimizer(**changes)
    train(kfac, 3)
    resumed.load_state_dict(copied(kfac.state_dict()))
    resumed.network.flat.copy_(kfac.network.flat)
    train(kfac, 3)
    train(resumed, 3)
    assert torch.equal(resumed.network.flat, kfac.network.flat)
    assert_equal_states(resumed.state_dict(), kfac.state_dict())


@pytest.mark.parametrize("inputs", [2, 4, 6, 8])
@pytest.mark.parametrize("outputs", [1, 2, 3, 4])
def test_a_seed_alone_is_as_among_others(inputs: int, outputs: int) -> None:
    torch.set_default_dtype(torch.float32)
    shape = tanh_mlp(inputs, (64, 64), outputs)
    among = KFAC(random_network(shape, SEEDS), config(kl_clip=1e-3, eigen_interval=2))
    flat = random_network(shape, SEEDS).flat
    alone = KFAC(Network(shape, flat[1:2].clone()), among.config)
    for update in range(4):
        x, targets = (normal(SEEDS, 320, n, seed=update) for n in (inputs, outputs))
        for kfac, seeds in ((among, slice(None)), (alone, slice(1, 2))):
            found = kfac(x[seeds].clone())
            losses = (found - targets[seeds].clone()).square().sum(dim=-1).mean(dim=1)
            kfac.step(losses, found.sum(dim=-1).tanh())
        assert torch.equal(among.network.flat[1], alone.network.flat[0])
