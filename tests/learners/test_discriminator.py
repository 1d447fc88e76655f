from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers.references import Adam, copies_of, flat_of, random_network
from helpers.states import copied
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.nn import functional

from ril.learners.discriminator import (
    Discriminator,
    DiscriminatorConfig,
    discriminator_losses,
    imitation_reward,
    state_action_pairs,
)
from ril.vectorized.architectures import MLP
from ril.vectorized.replay import random_indices
from ril.vectorized.streams import Streams

ARCHITECTURE = MLP(5, (8, 6), 1, attention=False, layer_norm=False, negative_slope=None)
SEEDS = (0, 1, 2)
EXPERT, GENERATED = 30, 20

LOGIT = st.floats(-15, 15, width=32)


def learner(
    purpose: str = "batches",
    *,
    compiled: bool = False,
    seeds: tuple[int, ...] = SEEDS,
    **changes: object,
) -> Discriminator:
    values = {
        "hidden": [8, 6],
        "learning_rate": 0.01,
        "updates": 6,
        "batch_size": 8,
        "reward": "positive",
    }
    network = random_network(ARCHITECTURE, len(seeds))
    config = DiscriminatorConfig(**(values | changes))
    return Discriminator(network, config, Streams(seeds, purpose), compiled=compiled)


def clouds(distance: float = 0.0) -> tuple[Tensor, Tensor]:
    """The expert's pairs, and pairs of each seed that lie at a distance from them."""
    generator = torch.Generator().manual_seed(0)
    expert = torch.randn(EXPERT, 5, generator=generator)
    return expert, torch.randn(len(SEEDS), GENERATED, 5, generator=generator) + distance


def test_pairs_are_states_beside_one_hot_actions() -> None:
    found = state_action_pairs(torch.tensor([[0.5, -1.0], [2.0, 3.0]]), torch.tensor([2, 0]), 3)
    assert found.tolist() == [[0.5, -1.0, 0.0, 0.0, 1.0], [2.0, 3.0, 1.0, 0.0, 0.0]]


@given(st.lists(st.tuples(LOGIT, LOGIT), min_size=2, max_size=6))
def test_the_loss_is_binary_cross_entropy_of_both(logits: list[tuple[float, float]]) -> None:
    expert, generated = torch.tensor(logits).T
    entropy = functional.binary_cross_entropy_with_logits
    expected = entropy(expert, torch.ones_like(expert))  # −log D
    expected = expected + entropy(generated, torch.zeros_like(generated))  # −log(1 − D)
    found = discriminator_losses(expert[None], generated[None])
    torch.testing.assert_close(found.mean(), expected)


GRID = torch.linspace(-12, 12, 49, dtype=torch.float64)
D = 1 / (1 + (-GRID).exp())


def test_a_positive_reward_is_the_log_of_what_is_left() -> None:
    torch.testing.assert_close(imitation_reward(GRID, "positive"), -(1 - D).log())


def test_a_logit_is_the_sum_of_both_rewards() -> None:
    expected = imitation_reward(GRID, "positive") + imitation_reward(GRID, "negative")
    torch.testing.assert_close(imitation_reward(GRID, "logit"), expected)


def test_a_negative_reward_is_the_log_of_the_chance() -> None:
    torch.testing.assert_close(imitation_reward(GRID, "negative"), D.log())


@pytest.mark.parametrize(("kind", "sign"), [("positive", 1), ("negative", -1)])
def test_a_reward_has_the_sign_of_its_name(kind: str, sign: int) -> None:
    assert (sign * imitation_reward(GRID, kind) > 0).all()


@pytest.mark.parametrize("kind", ["positive", "negative", "logit"])
def test_what_is_more_like_the_expert_is_paid_more(kind: str) -> None:
    assert (imitation_reward(GRID, kind).diff() > 0).all()


@pytest.mark.parametrize("compiled", [False, True])
def test_training_is_that_of_one_discriminator_per_seed(compiled: bool) -> None:
    discriminator = learner(compiled=compiled)
    modules = copies_of(discriminator.network)
    expert, generated = clouds()
    found = discriminator.train(expert, generated)

    optimizers = [Adam(module, 0.01, None) for module in modules]
    uniform = Streams(SEEDS, "batches").uniform(6, 2, 8)
    ours = random_indices(uniform[:, :, 0], np.full(3, EXPERT))
    theirs = random_indices(uniform[:, :, 1], np.full(3, GENERATED))
    losses = torch.zeros(3)
    right = torch.zeros(3)
    for update in range(6):
        for seed, module in enumerate(modules):
            real = module(expert[ours[seed, update]]).sigmoid()
            made = module(generated[seed, theirs[seed, update]]).sigmoid()
            loss = -real.log().mean() - (1 - made).log().mean()
            optimizers[seed].step(loss)
            losses[seed] += loss.detach() / 6
            right[seed] += ((real > 0.5).sum() + (made <= 0.5).sum()) / 16 / 6
    expected = torch.stack([flat_of(module) for module in modules])
    torch.testing.assert_close(discriminator.network.flat, expected, rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(found["discriminator_loss"], losses, rtol=1e-4)
    np.testing.assert_allclose(found["discriminator_accuracy"], right, rtol=1e-6)


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("kind", ["positive", "negative"])
def test_rewards_are_those_of_the_present_network(kind: str, compiled: bool) -> None:
    discriminator = learner(reward=kind, compiled=compiled)
    expert, generated = clouds()
    discriminator.train(expert, generated)
    found = discriminator.rewards(generated)
    for seed, module in enumerate(copies_of(discriminator.network)):
        d = module(generated[seed])[:, 0].sigmoid()
        expected = -(1 - d).log() if kind == "positive" else d.log()
        torch.testing.assert_close(found[seed], expected.detach(), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("compiled", "batch_size"), [(True, 16), *((False, size) for size in (5, 8, 16, 33))]
)
def test_a_seed_does_not_depend_on_its_neighbors(compiled: bool, batch_size: int) -> None:
    together = learner(compiled=compiled, batch_size=batch_size)
    alone = learner(compiled=compiled, batch_size=batch_size, seeds=SEEDS[1:2])
    alone.network.flat.copy_(together.network.flat[1:2])
    expert, generated = clouds()
    for discriminator, of_its_seeds in ((together, generated), (alone, generated[1:2])):
        discriminator.train(expert, of_its_seeds)
    assert torch.equal(alone.network.flat[0], together.network.flat[1])
    assert torch.equal(alone.rewards(generated[1:2])[0], together.rewards(generated)[1])


def test_two_clouds_are_told_apart() -> None:
    discriminator = learner(updates=200, batch_size=16)
    expert, generated = clouds(distance=3.0)
    discriminator.train(expert, generated)
    last = discriminator.train(expert, generated)
    assert last["discriminator_accuracy"].min() > 0.95
    assert discriminator.rewards(expert.expand(3, -1, -1)).mean() > 1  # D near 1
    assert discriminator.rewards(generated).mean() < 0.1  # D near 0


def test_a_loaded_state_resumes_bit_identically() -> None:
    discriminator, resumed = learner(), learner(purpose="other")
    discriminator.train(*clouds())
    resumed.load_state_dict(copied(discriminator.state_dict()))
    discriminator.train(*clouds())
    resumed.train(*clouds())
    assert torch.equal(resumed.network.flat, discriminator.network.flat)
