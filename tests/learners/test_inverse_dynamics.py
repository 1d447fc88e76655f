from __future__ import annotations

import io

import numpy as np
import pytest
import torch
from helpers.references import Adam, copies_of, flat_of, random_network
from torch import Tensor
from torch.nn import functional

from ril.learners.goal_sampler import Selection
from ril.learners.inverse_dynamics import InverseDynamics, InverseDynamicsConfig
from ril.vectorized.architectures import MLP
from ril.vectorized.losses import cross_entropy
from ril.vectorized.replay import Batch, random_indices
from ril.vectorized.streams import Streams

ARCHITECTURE = MLP(inputs=4, hidden=(8,), outputs=3)
SEEDS = (0, 1)


def model(purpose: str = "batches", **changes: object) -> InverseDynamics:
    values = {
        "inputs": "states",
        "standardize": False,
        "learning_rate": 0.01,
        "updates": 6,
        "batch_size": 8,
        "gradient_clip": 0.1,
    }
    config = InverseDynamicsConfig(**(values | changes))
    return InverseDynamics(
        random_network(ARCHITECTURE, len(SEEDS)), config, Streams(SEEDS, purpose)
    )


def random_transitions(count: int = 30) -> Batch:
    """Transitions in which each action moves the state in a direction of its own."""
    generator = torch.Generator().manual_seed(0)
    observations = torch.randn(2, count, 2, generator=generator)
    actions = torch.randint(3, (2, count), generator=generator)
    moves = torch.tensor([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0]])
    zeros = torch.zeros(2, count)
    return Batch(observations, actions, zeros, observations + moves[actions], zeros)


def selection(count: int = 30, sizes: tuple[int, int] = (30, 12)) -> Selection:
    """I^s of 30 and 12 transitions; what lies beyond a seed's own is NaN."""
    transitions = random_transitions(count)
    beyond = torch.arange(count) >= torch.tensor(sizes)[:, None]
    transitions.observations[beyond] = torch.nan
    return Selection(transitions, np.array(sizes))


def states() -> tuple[Tensor, Tensor]:
    batch = random_transitions()
    return batch.observations, batch.next_observations


def test_cross_entropy_is_that_of_each_sample() -> None:
    logits = torch.randn(2, 5, 3, generator=torch.Generator().manual_seed(1))
    labels = torch.tensor([[0, 1, 2, 0, 1], [2, 2, 2, 0, 0]])
    each = zip(logits, labels, strict=True)
    expected = [functional.cross_entropy(*pair, reduction="none") for pair in each]
    torch.testing.assert_close(cross_entropy(logits, labels), torch.stack(expected))


def test_states_inputs_are_both_states() -> None:
    dynamics, (before, after) = model(inputs="states"), states()
    expected = dynamics.network(torch.cat((before, after), dim=-1))
    assert torch.equal(dynamics(before, after), expected)


def test_change_inputs_are_the_state_and_its_change() -> None:
    dynamics, (before, after) = model(inputs="change"), states()
    expected = dynamics.network(torch.cat((before, after - before), dim=-1))
    assert torch.equal(dynamics(before, after), expected)


def test_standardized_inputs_have_mean_zero_and_deviation_one() -> None:
    dynamics, batch = model(), random_transitions()
    dynamics.standardize(batch)
    features = torch.cat((batch.observations, batch.next_observations), dim=-1)
    z = (features - features.mean(dim=1, keepdim=True)) / features.std(dim=1, keepdim=True)
    expected = dynamics.network(z)
    found = dynamics(batch.observations, batch.next_observations)
    torch.testing.assert_close(found, expected)


def test_the_change_alone_can_be_standardized() -> None:
    dynamics, batch = model(inputs="change", standardize="change"), random_transitions()
    dynamics.standardize(batch)
    change = batch.next_observations - batch.observations
    z = (change - change.mean(dim=1, keepdim=True)) / change.std(dim=1, keepdim=True)
    expected = dynamics.network(torch.cat((batch.observations, z), dim=-1))
    found = dynamics(batch.observations, batch.next_observations)
    torch.testing.assert_close(found, expected)


def test_a_constant_input_is_not_divided_by_zero() -> None:
    dynamics, batch = model(), random_transitions()
    batch.observations[..., 0] = 0.25
    dynamics.standardize(batch)
    assert dynamics(batch.observations, batch.next_observations).isfinite().all()


def test_labels_are_the_likeliest_actions() -> None:
    dynamics, (before, after) = model(), states()
    assert torch.equal(dynamics.label(before, after), dynamics(before, after).argmax(dim=-1))


def test_training_is_that_of_one_model_per_seed() -> None:
    dynamics, dataset = model(), selection()
    modules = copies_of(dynamics.network)
    dynamics.train(dataset)
    dynamics.train(dataset)

    optimizers = [Adam(module, 0.01, 0.1) for module in modules]
    streams, batch = Streams(SEEDS, "batches"), dataset.transitions
    for _ in range(2):
        drawn = random_indices(streams.uniform(6, 8), dataset.sizes)
        for update in range(6):
            for seed, module in enumerate(modules):
                at = drawn[seed, update]
                pair = batch.observations[seed, at], batch.next_observations[seed, at]
                logits = module(torch.cat(pair, dim=-1))
                optimizers[seed].step(functional.cross_entropy(logits, batch.actions[seed, at]))
    expected = torch.stack([flat_of(module) for module in modules])
    torch.testing.assert_close(dynamics.network.flat, expected, rtol=1e-3, atol=1e-5)


def test_training_gives_the_mean_loss_of_each_seed() -> None:
    dynamics, dataset = model(updates=1), selection()
    drawn = random_indices(Streams(SEEDS, "batches").uniform(1, 8), dataset.sizes)[:, 0]
    batch = dataset.transitions.at(drawn)
    expected = cross_entropy(
        dynamics(batch.observations, batch.next_observations), batch.actions
    ).mean(1)
    torch.testing.assert_close(dynamics.train(dataset), expected.detach())


@pytest.mark.parametrize("inputs", ["states", "change"])
def test_training_finds_which_action_leads_where(inputs: str) -> None:
    dynamics = model(inputs=inputs, updates=300, batch_size=32, learning_rate=0.02)
    dynamics.train(selection(sizes=(30, 30)))
    batch = random_transitions()
    labels = dynamics.label(batch.observations, batch.next_observations)
    assert torch.equal(labels, batch.actions)


def test_a_loaded_state_resumes_bit_identically() -> None:
    dynamics, resumed = model(), model(purpose="other")
    dynamics.standardize(random_transitions())
    dynamics.train(selection())
    buffer = io.BytesIO()
    torch.save(dynamics.state_dict(), buffer)
    buffer.seek(0)
    resumed.load_state_dict(torch.load(buffer, weights_only=True))
    dynamics.train(selection())
    resumed.train(selection())
    assert torch.equal(resumed(*states()), dynamics(*states()))
