from __future__ import annotations

import pytest
import torch
from helpers.references import (
    LatentActions,
    Remapping,
    fill,
    gradients_of,
    linear_flat_of,
    random_network,
)
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from ril.learners.latent_policy import latent_loss, nearest_latents
from ril.vectorized.latent_networks import (
    ActionRemapping,
    LatentDynamics,
    LatentPolicy,
    Predictions,
)
from ril.vectorized.networks import Network
from ril.vectorized.updates import ClippedAdam

OBS, Z, A = 4, 3, 2
PAPER = LatentDynamics(OBS, Z, (128, 256), 128, 0.2)
DYNAMICS = LatentDynamics(OBS, Z, encoder=(10, 12), generator=7, negative_slope=0.2)
REMAPPING = ActionRemapping(OBS, Z, A, encoder=(10, 12), hidden=(8, 6), negative_slope=0.2)
S, B = 3, 9


def states(rows: int = B, size: int = OBS, start: int = 1) -> Tensor:
    return torch.randn(S, rows, size, generator=torch.Generator().manual_seed(start))


def latent_actions(network: Network) -> list[LatentActions]:
    """Each seed's latent policy and generator as a module."""
    shape = network.architecture
    assert isinstance(shape, LatentDynamics)
    modules = []
    for seed in range(len(network.flat)):
        module = LatentActions(shape.observations, shape.latents, *shape.encoder, shape.generator)
        fill(module, network, seed)
        modules.append(module)
    return modules


def remappings(network: Network) -> list[Remapping]:
    """Each seed's remapping as a module."""
    shape = network.architecture
    assert isinstance(shape, ActionRemapping)
    modules = []
    for seed in range(len(network.flat)):
        module = Remapping(OBS, shape.latents, shape.actions, shape.encoder, shape.hidden)
        fill(module, network, seed)
        modules.append(module)
    return modules


def predict(network: Network, x: Tensor) -> Predictions:
    assert isinstance(network.architecture, LatentDynamics)
    return network.architecture.predict(network.parameters, x)


def test_sizes_are_the_papers() -> None:
    assert PAPER.shapes()["encoder0.weight"] == (OBS, 128)
    assert PAPER.shapes()["joint.weight"] == (512, 256)
    assert PAPER.shapes()["generator0.weight"] == (256, 128)
    remapping = ActionRemapping(OBS, Z, A, (128, 256), (64, 32), 0.2).shapes()
    assert remapping["remap_joint0.weight"] == (512, 64)
    assert remapping["remap_output.weight"] == (32, A)


@pytest.mark.parametrize("architecture", [DYNAMICS, PAPER])
def test_parameters_are_those_of_the_modules(architecture: LatentDynamics) -> None:
    network = random_network(architecture, S)
    found = torch.stack([linear_flat_of(module) for module in latent_actions(network)])
    assert torch.equal(found, network.flat)


def test_latent_logits_are_those_of_each_seeds_module() -> None:
    network, x = random_network(DYNAMICS, S), states()
    modules = latent_actions(network)
    expected = torch.stack([m.probabilities(rows) for m, rows in zip(modules, x, strict=True)])
    torch.testing.assert_close(network(x).softmax(dim=-1), expected)
    torch.testing.assert_close(predict(network, x).logits, network(x))


def test_predicted_changes_are_those_of_each_seeds_module() -> None:
    network, x = random_network(DYNAMICS, S), states()
    found = predict(network, x).changes
    for seed, module in enumerate(latent_actions(network)):
        for latent in range(Z):
            expected = module.change(x[seed], latent)
            torch.testing.assert_close(found[seed, :, latent], expected)


def test_changes_differ_between_latent_actions() -> None:
    changes = predict(random_network(DYNAMICS, S), states()).changes
    assert (changes[:, :, 0] - changes[:, :, 1]).abs().min() > 0


def test_the_loss_is_that_of_each_seeds_module() -> None:
    network, x, changes = random_network(DYNAMICS, S), states(), states(start=2)
    found = latent_loss(predict(network, x), changes)
    modules = latent_actions(network)
    expected = [m.loss(*pair) for m, *pair in zip(modules, x, changes, strict=True)]
    torch.testing.assert_close(found, torch.stack(expected))


def test_gradients_are_those_of_each_seeds_module() -> None:
    network, x, changes = random_network(DYNAMICS, S), states(), states(start=2)
    found = gradients_of(network, latent_loss(predict(network, x), changes))
    for seed, module in enumerate(latent_actions(network)):
        module.loss(x[seed], changes[seed]).backward()
        expected = linear_flat_of(module, gradients=True)
        torch.testing.assert_close(found[seed], expected, rtol=1e-4, atol=1e-4)


def second_term(predictions: Predictions, changes: Tensor) -> Tensor:
    """The part of the loss that is of the latent policy: all but the error of the best z."""
    errors = (changes[:, :, None] - predictions.changes).square().sum(dim=-1)
    return latent_loss(predictions, changes) - errors.amin(dim=-1).mean(dim=1)


def test_the_second_term_does_not_reach_the_generator() -> None:
    network = random_network(DYNAMICS, S)
    loss = second_term(predict(network, states()), states(start=2)).sum()
    gradients = torch.autograd.grad(loss, list(network.parameters.values()))
    largest = {
        name: gradient.abs().max().item() / network.parameters[name].abs().max().item()
        for name, gradient in zip(network.parameters, gradients, strict=True)
    }
    generator = ("embedding", "joint", "generator0", "generator1")
    # Rounding is all that is left of the first term, which is added and subtracted again.
    assert all(v < 1e-4 for name, v in largest.items() if name.startswith(generator))
    assert all(v > 1e-2 for name, v in largest.items() if not name.startswith(generator))


def test_the_loss_of_numbers_that_can_be_worked_out() -> None:
    # One state, one entry, two latents: g = 1 and 4 with p = ¼ and ¾, and Δ = 2.
    logits = torch.tensor([[[0.25, 0.75]]]).log()
    predictions = Predictions(logits, torch.tensor([[[[1.0], [4.0]]]]))
    expected = (2 - 1) ** 2 + (2 - 3.25) ** 2
    assert latent_loss(predictions, torch.tensor([[[2.0]]])).tolist() == pytest.approx([expected])


def test_errors_are_summed_over_a_states_entries_and_averaged_over_states() -> None:
    zeros = Predictions(torch.zeros(1, 2, 1), torch.zeros(1, 2, 1, 3))
    changes = torch.tensor([[[1.0, 2.0, 2.0], [0.0, 0.0, 1.0]]])
    assert latent_loss(zeros, changes).tolist() == [2 * (9 + 1) / 2]


@given(st.integers(0, 2**31 - 1))
def test_the_nearest_latent_has_the_least_distance(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    before, after = torch.randn(2, S, B, OBS, generator=generator)
    changes = torch.randn(S, B, Z, OBS, generator=generator)
    found = nearest_latents(Predictions(torch.zeros(S, B, Z), changes), after - before)
    for s in range(S):
        for b in range(B):
            # ‖s' − (s + g)‖
            distances = [(after[s, b] - (before[s, b] + g)).norm() for g in changes[s, b]]
            assert distances[found[s, b]] <= min(distances) + 1e-5


def with_one_hot(x: Tensor, latents: Tensor) -> Tensor:
    return torch.cat((x, torch.eye(Z)[latents]), dim=-1)


def test_remapping_is_that_of_each_seeds_module() -> None:
    network, x = random_network(REMAPPING, S), states()
    latents = torch.randint(Z, (S, B), generator=torch.Generator().manual_seed(3))
    found = network(with_one_hot(x, latents))
    modules = remappings(network)
    for seed, module in enumerate(modules):
        torch.testing.assert_close(found[seed], module(x[seed], latents[seed]))


def test_gradients_of_the_remapping_are_those_of_each_seeds_module() -> None:
    network, x = random_network(REMAPPING, S), states()
    latents = torch.randint(Z, (S, B), generator=torch.Generator().manual_seed(3))
    found = gradients_of(network, network(with_one_hot(x, latents)).square().sum(dim=(1, 2)))
    for seed, module in enumerate(remappings(network)):
        module(x[seed], latents[seed]).square().sum().backward()
        expected = linear_flat_of(module, gradients=True)
        torch.testing.assert_close(found[seed], expected, rtol=1e-4, atol=1e-3)


def whole() -> tuple[Network, Network, Network]:
    """A policy, and its two halves."""
    policy = random_network(LatentPolicy(DYNAMICS, REMAPPING), S)
    border = linear_flat_of(LatentActions(OBS, Z, 10, 12, 7)).numel()
    halves = policy.flat[:, :border], policy.flat[:, border:]
    return policy, Network(DYNAMICS, halves[0]), Network(REMAPPING, halves[1])


def test_the_policy_remaps_its_likeliest_latent_action() -> None:
    policy, dynamics, remapping = whole()
    x = states(rows=40)
    found, seen = policy(x), set()
    modules = zip(latent_actions(dynamics), remappings(remapping), strict=True)
    for seed, (latent, remap) in enumerate(modules):
        likeliest = latent.probabilities(x[seed]).argmax(dim=1)
        seen |= set(likeliest.tolist())
        torch.testing.assert_close(found[seed], remap(x[seed], likeliest))
    assert seen == set(range(Z))


def test_the_policys_parameters_are_its_halves() -> None:
    policy, dynamics, remapping = whole()
    halves = {**dynamics.parameters, **remapping.parameters}
    assert list(policy.parameters) == list(halves)
    for name, parameter in policy.parameters.items():
        assert parameter.data_ptr() == halves[name].data_ptr(), name


MOVES = torch.tensor([[0.5, 0.0, 0.0, 0.0], [0.0, -0.5, 0.0, 0.0], [0.0, 0.0, 0.5, 0.5]])


def test_a_world_of_separable_moves_is_told_apart() -> None:
    # Which of three moves the expert makes is seen from its state.
    small = LatentDynamics(OBS, Z, encoder=(64, 128), generator=64, negative_slope=0.2)
    network = Network.initialize(small, range(S), "tests", torch.device("cpu"))
    x = states(rows=150)
    moves = x[..., :3].argmax(dim=-1)
    optimizer = ClippedAdam(network, 1e-3, beta1=0.5)
    for _ in range(400):
        optimizer.step(latent_loss(predict(network, x), MOVES[moves]))
    predictions = predict(network, x)
    nearest = nearest_latents(predictions, MOVES[moves])
    for seed in range(S):
        pairs = set(zip(moves[seed].tolist(), nearest[seed].tolist(), strict=True))
        assert len(pairs) == Z  # each move has a latent action of its own …
        likeliest = predictions.logits[seed].argmax(dim=-1)
        assert (likeliest == nearest[seed]).float().mean() > 0.95  # … which the policy takes
