from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from helpers.references import LatentActions, Remapping, fill, linear_flat_of
from torch import Tensor
from torch.nn import functional

from ril.io.errors import UserError
from ril.methods.ilpo import ILPO
from ril.task import Task
from ril.vectorized import networks
from ril.vectorized.stepping import SteppedEnvironments
from ril.vectorized.streams import Streams

SMALL = (
    "method.latent_policy.encoder=[10,12]",
    "method.latent_policy.generator=7",
    "method.latent_policy.latents=3",
    "method.remapping.hidden=[8,6]",
)


@pytest.fixture
def make(make_method: Callable[..., Any]) -> Callable[..., ILPO]:
    return lambda *overrides: make_method("ilpo", *overrides)


def halves(method: ILPO) -> tuple[list[LatentActions], list[Remapping]]:
    """Each seed's networks as modules, of the sizes of SMALL."""
    latent, remapping = [], []
    for seed in range(len(method.task.seeds)):
        latent.append(LatentActions(4, 3, 10, 12, 7))
        fill(latent[-1], method.dynamics, seed)
        remapping.append(Remapping(4, 3, 2, (10, 12), (8, 6)))
        fill(remapping[-1], method.remapping, seed)
    return latent, remapping


UNITS = ("raw", "scaled", "standardized")


def factor_of(task: Task, unit: str) -> Tensor:
    """By what a change of scaled states is multiplied to be in a unit."""
    changes = task.expert.next_observations - task.expert.observations
    half_ranges = [2.4, 3.0, 0.21, 3.0]  # conf/env/cartpole.yaml
    factors = {"raw": half_ranges, "scaled": [1.0] * 4, "standardized": 1 / changes.std(0, ddof=1)}
    return torch.tensor(np.array(factors[unit], dtype=np.float32))


@pytest.mark.parametrize("unit", UNITS)
def test_the_latent_policy_is_trained_as_by_one_network_per_seed(make: Any, unit: str) -> None:
    method = make(*SMALL, f"method.latent_policy.changes={unit}")
    modules, _ = halves(method)
    epochs = method.train()
    losses = [next(epochs).metrics["latent_loss"] for _ in range(2)]

    states = torch.from_numpy(method.task.expert.observations)
    changes = torch.from_numpy(method.task.expert.next_observations) - states
    changes = changes * factor_of(method.task, unit)
    streams = Streams(method.task.seeds, "latent batches")
    optimizers = [torch.optim.Adam(m.parameters(), lr=2e-4, betas=(0.5, 0.999)) for m in modules]
    expected = np.zeros((2, 2))
    for epoch in range(2):
        drawn = (streams.uniform(4, 16) * len(states)).astype(int)
        for update in range(4):
            for seed, module in enumerate(modules):
                at = drawn[seed, update]
                loss = module.loss(states[at], changes[at])
                expected[epoch, seed] += loss.item() / 4
                optimizers[seed].zero_grad()
                loss.backward()
                optimizers[seed].step()
    found = torch.stack([linear_flat_of(module) for module in modules])
    torch.testing.assert_close(method.dynamics.flat, found, rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(losses, expected, rtol=1e-4)


@pytest.mark.parametrize("unit", UNITS)
def test_the_remapping_is_trained_as_by_one_agent_per_seed(make: Any, unit: str) -> None:
    # Enough of the latent policy that more than one latent action explains what happens.
    method = make(
        *SMALL,
        "method.latent_policy.updates=200",
        "method.latent_policy.learning_rate=3e-3",
        f"method.latent_policy.changes={unit}",
    )
    factor = factor_of(method.task, unit)
    epochs = method.train()
    next(epochs), next(epochs)
    latent, remapping = halves(method)
    losses = [next(epochs).metrics["remapping_loss"] for _ in range(2)]
    assert next(epochs, None) is None

    seeds, environment = method.task.seeds, method.task.environment
    exploration = Streams(seeds, "remapping exploration")
    batches = Streams(seeds, "remapping batches")
    explained: set[int] = set()
    acted: set[int] = set()
    drawn = [(exploration.uniform(10, 2, 1), batches.uniform(10, 16)) for _ in range(2)]
    for seed, (knows, remap) in enumerate(zip(latent, remapping, strict=True)):
        stepped = SteppedEnvironments(environment, [seeds[seed]], 1, "remapping")
        optimizer = torch.optim.Adam(remap.parameters(), lr=2e-3)
        states, labels, actions = [], [], []
        for epoch, (uniform, chosen) in enumerate(drawn):
            total = 0.0
            for step in range(10):
                whether, what = uniform[seed, step, :, 0]
                state = torch.from_numpy(stepped.observations)
                action = int(what * 2)
                if whether >= np.float32(0.2):
                    likeliest = knows.probabilities(state).argmax(dim=1)
                    action = int(remap(state, likeliest).argmax())
                following = torch.from_numpy(stepped.step(np.array([action])).next_observations)
                # z* = argmin over z of ‖s' − (s + g)‖, in the unit of g
                change = (following - state) * factor
                distances = [(change - knows.change(state, z)).norm() for z in range(3)]
                states.append(state[0])
                labels.append(int(torch.stack(distances).argmin()))
                actions.append(action)
                at = (chosen[seed, step] * len(states)).astype(int)
                logits = remap(torch.stack(states)[at], torch.tensor(labels)[at])
                loss = functional.cross_entropy(logits, torch.tensor(actions)[at])
                total += loss.item() / 10
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
            assert losses[epoch][seed] == pytest.approx(total, rel=1e-3)
        explained |= set(labels)
        acted |= set(actions)
        found = method.remapping.flat[seed]
        torch.testing.assert_close(found, linear_flat_of(remap), rtol=1e-3, atol=1e-4)
    assert len(explained) > 1
    assert acted == {0, 1}


def test_both_halves_are_views_of_the_policy(make: Any) -> None:
    method = make()
    border = method.dynamics.flat.shape[1]
    epochs = method.train()
    for imitating in (True, True, False, False):
        before = method.policy.flat.clone()
        next(epochs)
        changed = method.policy.flat != before
        learned, other = changed[:, :border], changed[:, border:]
        if not imitating:
            learned, other = other, learned
        assert learned.any(dim=1).all()
        assert not other.any()
    assert torch.equal(
        method.policy.flat, torch.cat((method.dynamics.flat, method.remapping.flat), 1)
    )


def test_epochs_are_the_latent_policys_and_then_the_remappings(make: Any) -> None:
    method = make("method.epochs=3", "method.remapping.steps=40")
    progress = list(method.train())
    assert method.epochs == 3 + 40 // 10
    assert [each.epoch for each in progress] == [1, 2, 3, 4, 5, 6, 7]
    assert [list(each.metrics) for each in progress] == [["latent_loss"]] * 3 + [
        ["latent_loss", "remapping_loss"]
    ] * 4


def test_the_policy_can_act_once_it_has_begun_to_remap(make: Any) -> None:
    assert [each.can_act for each in make().train()] == [False, False, True, True]


def test_environment_samples_are_the_remappings_steps(make: Any) -> None:
    found = [each.env_samples.tolist() for each in make().train()]
    assert found == [[0, 0], [0, 0], [10, 10], [20, 20]]


def test_expert_samples_count_the_expert_once_per_latent_epoch(make: Any) -> None:
    method = make()
    count = len(method.task.expert.observations)
    found = [each.expert_samples.tolist() for each in method.train()]
    assert found == [[count] * 2, [2 * count] * 2, [2 * count] * 2, [2 * count] * 2]


def test_there_are_as_many_latent_actions_as_actions(make: Any) -> None:
    assert make().dynamics.architecture.latents == 2


def test_there_may_be_more_latent_actions(make: Any) -> None:
    method = make("method.latent_policy.latents=5")
    list(method.train())
    assert networks.greedy(method.policy.infer(np.zeros((2, 4), dtype=np.float32))).shape == (2,)


def test_sizes_and_rates_are_the_papers(compose: Any) -> None:
    method = compose("env=cartpole", "method=ilpo").method
    latent, remapping = method.latent_policy, method.remapping
    assert (latent.encoder, latent.generator, remapping.hidden) == ([128, 256], 128, [64, 32])
    assert (latent.learning_rate, latent.beta1, latent.negative_slope) == (2e-4, 0.5, 0.2)
    assert (remapping.learning_rate, remapping.epsilon) == (2e-3, 0.2)


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("method.latent_policy.encoder=[8]", r"method\.latent_policy\.encoder"),
        ("method.remapping.hidden=[8,8,8]", r"method\.remapping\.hidden"),
        ("method.remapping.steps=25", r"method\.remapping\.steps=25: .*10"),
    ],
)
def test_what_cannot_be_built_is_refused(make: Any, override: str, says: str) -> None:
    with pytest.raises(UserError, match=says):
        make(override)
