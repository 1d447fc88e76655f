from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from helpers.references import Adam, copies_of, flat_of, random_network
from helpers.states import assert_equal_states, copied
from torch.nn import functional

from ril.learners.q_learning import QLearning
from ril.methods.ril import QLearningConfig
from ril.vectorized.architectures import MLP
from ril.vectorized.networks import Network
from ril.vectorized.priorities import Priorities
from ril.vectorized.replay import Replay, random_indices
from ril.vectorized.rollout import Episodes
from ril.vectorized.streams import Streams

ARCHITECTURE = MLP(inputs=2, hidden=(6,), outputs=3)
SEEDS = (0, 1)


def config(**changes: object) -> QLearningConfig:
    values = {
        "learning_rate": 0.01,
        "updates": 6,
        "batch_size": 8,
        "gradient_clip": 0.05,
        "discount": 0.9,
        "loss": "huber",
        "target_interval": 0,
        "replay_trajectories": 10.0,
    }
    return QLearningConfig(**(values | changes))


def memory(capacity: int = 40, lengths: tuple[int, int] = (30, 20)) -> Replay:
    """Two seeds' random transitions: 30 of the first and 20 of the second, if not said else."""
    numbers = np.random.default_rng(0)
    states = numbers.normal(size=(2, 30, 2)).astype(np.float32)
    replay = Replay(2, capacity, 2, torch.device("cpu"))
    replay.observations.fill_(torch.nan)  # empty slots must never be used
    replay.append(
        Episodes(
            states,
            numbers.integers(3, size=(2, 30)),
            numbers.normal(size=(2, 30)).astype(np.float32),
            states[:, ::-1].copy(),
            numbers.random((2, 30)) < 0.2,
            np.array(lengths),
        )
    )
    return replay


def learner(config: QLearningConfig, purpose: str = "replay batches") -> tuple[QLearning, Network]:
    policy = random_network(ARCHITECTURE, len(SEEDS))
    return QLearning(policy, memory(), config, Streams(SEEDS, purpose)), policy


@pytest.mark.parametrize("loss", ["huber", "mse"])
@pytest.mark.parametrize("target_interval", [0, 4])
def test_training_is_that_of_one_dqn_per_seed(loss: str, target_interval: int) -> None:
    settings = config(loss=loss, target_interval=target_interval)
    q_learning, policy = learner(settings)
    modules = copies_of(policy)
    q_learning.train(6)
    q_learning.train(5)

    replay, streams = memory(), Streams(SEEDS, "replay batches")
    targets = copies_of(random_network(ARCHITECTURE, len(SEEDS)))
    optimizers = [Adam(module, 0.01, 0.05) for module in modules]
    distance = {"huber": functional.huber_loss, "mse": functional.mse_loss}[loss]
    step = 0
    for updates in (6, 5):
        drawn = random_indices(streams.uniform(updates, 8), replay.sizes)
        for update in range(updates):
            for seed, module in enumerate(modules):
                if not target_interval or step % target_interval == 0:
                    targets[seed].load_state_dict(module.state_dict())
                at = drawn[seed, update]
                with torch.no_grad():
                    best = targets[seed](replay.next_observations[seed, at]).max(dim=1).values
                    not_terminal = 1 - replay.terminated[seed, at]
                    target = replay.rewards[seed, at] + 0.9 * not_terminal * best
                values = module(replay.observations[seed, at])
                chosen = values[torch.arange(8), replay.actions[seed, at]]
                optimizers[seed].step(distance(chosen, target))
            step += 1
    expected = torch.stack([flat_of(module) for module in modules])
    torch.testing.assert_close(policy.flat, expected, rtol=1e-3, atol=1e-5)


def test_training_gives_the_mean_loss_of_each_seed() -> None:
    found = learner(config(batch_size=500))[0].train(1)
    replay = memory()
    drawn = random_indices(Streams(SEEDS, "replay batches").uniform(1, 500), replay.sizes)[:, 0]
    expected = []
    for seed, module in enumerate(copies_of(random_network(ARCHITECTURE, len(SEEDS)))):
        at = drawn[seed]
        with torch.no_grad():
            best = module(replay.next_observations[seed, at]).max(dim=1).values
            target = replay.rewards[seed, at] + 0.9 * (1 - replay.terminated[seed, at]) * best
            values = module(replay.observations[seed, at])
            chosen = values[torch.arange(500), replay.actions[seed, at]]
            expected.append(functional.huber_loss(chosen, target))
    torch.testing.assert_close(found, torch.stack(expected))


STORED, ALPHA = 30, 0.6


def prioritized(
    settings: QLearningConfig, *, double: bool = False, purpose: str = "replay batches"
) -> tuple[QLearning, Network]:
    """A learner of two full memories with priorities."""
    policy, replay = random_network(ARCHITECTURE, len(SEEDS)), memory(lengths=(STORED, STORED))
    priorities = Priorities(len(SEEDS), 40, ALPHA, torch.device("cpu"))
    priorities.add(torch.arange(STORED).expand(len(SEEDS), STORED))
    streams = Streams(SEEDS, purpose)
    q_learning = QLearning(policy, replay, settings, streams, priorities=priorities, double=double)
    return q_learning, policy


@pytest.mark.parametrize("double", [False, True])
@pytest.mark.parametrize("target_interval", [0, 4])
def test_prioritized_training_is_that_of_one_agent_per_seed(
    target_interval: int, double: bool
) -> None:
    q_learning, policy = prioritized(config(target_interval=target_interval), double=double)
    modules = copies_of(policy)
    betas = {9: 0.4, 7: 0.8}  # by the number of updates that they hold for
    losses = [q_learning.train(updates, beta) for updates, beta in betas.items()]

    replay, streams = q_learning.replay, Streams(SEEDS, "replay batches")
    targets = copies_of(random_network(ARCHITECTURE, len(SEEDS)))
    optimizers = [Adam(module, 0.01, 0.05) for module in modules]
    priorities = np.ones((len(SEEDS), STORED))
    step = 0
    for (updates, beta), found in zip(betas.items(), losses, strict=True):
        uniform = streams.uniform(updates, 8)
        total = torch.zeros(len(SEEDS))
        for update in range(updates):
            for seed, module in enumerate(modules):
                if not target_interval or step % target_interval == 0:
                    targets[seed].load_state_dict(module.state_dict())
                weights = priorities[seed] ** ALPHA
                shares = (np.arange(8) + uniform[seed, update]) / 8
                at = np.searchsorted(weights.cumsum(), shares * weights.sum(), side="right")
                correction = (STORED * weights[at] / weights.sum()) ** -beta
                correction /= correction.max()
                with torch.no_grad():
                    following = replay.next_observations[seed, at]
                    aimed = targets[seed](following)
                    chosen = (module(following) if double else aimed).argmax(dim=1)
                    not_terminal = 1 - replay.terminated[seed, at]
                    best = aimed[torch.arange(8), chosen]
                    target = replay.rewards[seed, at] + 0.9 * not_terminal * best
                values = module(replay.observations[seed, at])
                chosen = values[torch.arange(8), replay.actions[seed, at]]
                each = functional.huber_loss(chosen, target, reduction="none")
                optimizers[seed].step((torch.from_numpy(correction).float() * each).mean())
                total[seed] += each.mean().item()
                priorities[seed, at] = (chosen - target).abs().detach().numpy() + 1e-6
            step += 1
        torch.testing.assert_close(found, total / updates, rtol=1e-3, atol=1e-5)
    expected = torch.stack([flat_of(module) for module in modules])
    torch.testing.assert_close(policy.flat, expected, rtol=1e-3, atol=1e-5)
    assert q_learning.priorities is not None
    found_weights = q_learning.priorities.weights[:, :STORED].numpy()
    np.testing.assert_allclose(found_weights, priorities**ALPHA, rtol=1e-3, atol=1e-4)


def after_training(beta: float) -> torch.Tensor:
    q_learning, policy = prioritized(config())
    q_learning.train(4)  # so that priorities differ
    q_learning.train(1, beta)
    return policy.flat


def test_beta_makes_a_difference() -> None:
    assert not torch.equal(after_training(1.0), after_training(0.0))


def test_a_double_target_makes_a_difference() -> None:
    flats = []
    for double in (False, True):
        q_learning, policy = prioritized(config(target_interval=20), double=double)
        q_learning.train(10)
        flats.append(policy.flat)
    assert not torch.equal(*flats)


@pytest.mark.parametrize("make", [learner, prioritized])
def test_a_loaded_state_resumes_bit_identically(
    make: Callable[..., tuple[QLearning, Network]],
) -> None:
    q_learning, policy = make(config(target_interval=4))
    q_learning.train(6)
    resumed, restored = make(config(target_interval=4), purpose="other")
    restored.flat.copy_(policy.flat)
    resumed.load_state_dict(copied(q_learning.state_dict()))
    q_learning.train(5)
    resumed.train(5)
    assert torch.equal(restored.flat, policy.flat)
    assert_equal_states(resumed.state_dict(), q_learning.state_dict())
