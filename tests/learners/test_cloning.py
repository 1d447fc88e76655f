from __future__ import annotations

import io

import numpy as np
import torch
from helpers.references import Adam, copies_of, flat_of, random_network
from torch import Tensor
from torch.nn import functional

from ril.learners.cloning import Cloning, CloningConfig
from ril.vectorized.architectures import MLP
from ril.vectorized.networks import Network
from ril.vectorized.replay import random_indices
from ril.vectorized.streams import Streams

ARCHITECTURE = MLP(inputs=2, hidden=(8,), outputs=3)
SEEDS = (0, 1)
SAMPLES = 30


def learner(purpose: str = "batches", **changes: object) -> tuple[Cloning, Network]:
    values = {"learning_rate": 0.01, "updates": 6, "batch_size": 8, "gradient_clip": 0.1}
    policy = random_network(ARCHITECTURE, len(SEEDS))
    return Cloning(policy, CloningConfig(**(values | changes)), Streams(SEEDS, purpose)), policy


def expert() -> tuple[Tensor, Tensor]:
    """The expert's states, and labels of which each seed has its own."""
    observations = torch.randn(SAMPLES, 2, generator=torch.Generator().manual_seed(0))
    first = (observations[:, 0] > 0).long()
    return observations, torch.stack((first, 2 - first))


def test_training_is_that_of_one_policy_per_seed() -> None:
    cloning, policy = learner()
    modules = copies_of(policy)
    observations, labels = expert()
    cloning.train(observations, labels)
    cloning.train(observations, labels)

    optimizers = [Adam(module, 0.01, 0.1) for module in modules]
    streams = Streams(SEEDS, "batches")
    for _ in range(2):
        drawn = random_indices(streams.uniform(6, 8), np.array([SAMPLES, SAMPLES]))
        for update in range(6):
            for seed, module in enumerate(modules):
                at = drawn[seed, update]
                loss = functional.cross_entropy(module(observations[at]), labels[seed, at])
                optimizers[seed].step(loss)
    expected = torch.stack([flat_of(module) for module in modules])
    torch.testing.assert_close(policy.flat, expected, rtol=1e-3, atol=1e-5)


def test_training_gives_the_mean_loss_of_each_seed() -> None:
    cloning, policy = learner(updates=1)
    observations, labels = expert()
    drawn = random_indices(Streams(SEEDS, "batches").uniform(1, 8), np.array([SAMPLES] * 2))[:, 0]
    expected = [
        functional.cross_entropy(module(observations[at]), of_seed[at])
        for module, of_seed, at in zip(copies_of(policy), labels, drawn, strict=True)
    ]
    torch.testing.assert_close(cloning.train(observations, labels), torch.stack(expected).detach())


def test_each_seed_learns_its_own_labels() -> None:
    cloning, policy = learner(updates=300, learning_rate=0.02, gradient_clip=1.0)
    observations, labels = expert()
    cloning.train(observations, labels)
    assert torch.equal(policy(observations.expand(2, -1, -1)).argmax(dim=-1), labels)


def test_a_loaded_state_resumes_bit_identically() -> None:
    (cloning, policy), (resumed, restored) = learner(), learner(purpose="other")
    cloning.train(*expert())
    buffer = io.BytesIO()
    torch.save(cloning.state_dict(), buffer)
    buffer.seek(0)
    restored.flat.copy_(policy.flat)
    resumed.load_state_dict(torch.load(buffer, weights_only=True))
    cloning.train(*expert())
    resumed.train(*expert())
    assert torch.equal(restored.flat, policy.flat)
