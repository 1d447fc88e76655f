from __future__ import annotations

import io

import numpy as np
import pytest
import torch
from references import Adam, copies_of, flat_of, random_network
from torch.nn import functional

from ril.learners.q_learning import QLearning, td_loss, td_targets
from ril.schema import QLearningConfig
from ril.vectorized.networks import MLP, Network
from ril.vectorized.replay import Batch, Replay, random_indices
from ril.vectorized.rollout import Episodes
from ril.vectorized.streams import Streams

ARCHITECTURE = MLP(inputs=2, hidden=(6,), outputs=3)
SEEDS = (0, 1)


def batch_of(rewards: list[float], terminated: list[float], actions: list[int]) -> Batch:
    """One seed's transitions; the states do not matter."""
    states = torch.zeros(1, len(rewards), 2)
    columns = torch.tensor([rewards]), states, torch.tensor([terminated])
    return Batch(states, torch.tensor([actions]), *columns)


def test_target_is_reward_and_the_discounted_best_next_value() -> None:
    batch = batch_of([-1.0, 2.0], [0.0, 0.0], [0, 1])
    next_values = torch.tensor([[[1.0, 5.0, 3.0], [-4.0, -2.0, -9.0]]])
    targets = td_targets(batch, next_values, discount=0.9)
    torch.testing.assert_close(targets, torch.tensor([[-1 + 0.9 * 5, 2 + 0.9 * -2]]))


def test_target_of_a_terminal_step_is_its_reward() -> None:
    batch = batch_of([-1.0, 7.0], [0.0, 1.0], [0, 1])
    targets = td_targets(batch, torch.full((1, 2, 3), 10.0), discount=0.5)
    assert targets.tolist() == [[4.0, 7.0]]


VALUES = torch.tensor([[[1.0, 9.0, 9.0], [9.0, 9.0, 4.0]]])  # taken: 1.0 and 4.0
TARGETS = torch.tensor([[1.5, 1.0]])  # 0.5 and 3.0 away


@pytest.mark.parametrize(
    ("loss", "expected"),
    [("mse", (0.5**2 + 3.0**2) / 2), ("huber", (0.5 * 0.5**2 + (3.0 - 0.5)) / 2)],
)
def test_loss_is_the_mean_over_the_actions_taken(loss: str, expected: float) -> None:
    batch = batch_of([0.0, 0.0], [0.0, 0.0], [0, 2])
    assert td_loss(VALUES, batch, TARGETS, loss).tolist() == pytest.approx([expected])


def test_loss_is_of_each_seed() -> None:
    batch = Batch(
        *(field.repeat(2, *[1] * (field.ndim - 1)) for field in batch_of([0.0], [0.0], [0]))
    )
    values = torch.tensor([[[1.0, 0.0]], [[3.0, 0.0]]])
    assert td_loss(values, batch, torch.zeros(2, 1), "mse").tolist() == [1.0, 9.0]


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


def memory(capacity: int = 40) -> Replay:
    """Two seeds' random transitions: 30 of the first and 20 of the second."""
    numbers = np.random.default_rng(0)
    states = numbers.normal(size=(2, 30, 2)).astype(np.float32)
    replay = Replay(2, capacity, 2, torch.device("cpu"))
    replay.observations.fill_(torch.nan)  # empty slots must never be learnt from
    replay.append(
        Episodes(
            states,
            numbers.integers(3, size=(2, 30)),
            numbers.normal(size=(2, 30)).astype(np.float32),
            states[:, ::-1].copy(),
            numbers.random((2, 30)) < 0.2,
            np.array([30, 20]),
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
                    goes_on = 1 - replay.terminated[seed, at]
                    target = replay.rewards[seed, at] + 0.9 * goes_on * best
                values = module(replay.observations[seed, at])
                taken = values[torch.arange(8), replay.actions[seed, at]]
                optimizers[seed].step(distance(taken, target))
            step += 1
    expected = torch.stack([flat_of(module) for module in modules])
    torch.testing.assert_close(policy.flat, expected, rtol=1e-3, atol=1e-5)


def test_training_gives_the_mean_loss_of_each_seed() -> None:
    found = learner(config(batch_size=500))[0].train(1)
    replay = memory()
    drawn = random_indices(Streams(SEEDS, "replay batches").uniform(1, 500), replay.sizes)[:, 0]
    batch = replay.everything().at(drawn)
    before = random_network(ARCHITECTURE, len(SEEDS))
    with torch.no_grad():
        targets = td_targets(batch, before(batch.next_observations), 0.9)
        expected = td_loss(before(batch.observations), batch, targets, "huber")
    torch.testing.assert_close(found, expected)


def test_no_updates_change_nothing() -> None:
    q_learning, policy = learner(config())
    before = policy.flat.clone()
    assert q_learning.train(0).tolist() == [0.0, 0.0]
    assert torch.equal(policy.flat, before)


def test_a_saved_state_goes_on_alike() -> None:
    q_learning, policy = learner(config(target_interval=4))
    q_learning.train(6)
    buffer = io.BytesIO()
    torch.save(q_learning.state_dict(), buffer)
    buffer.seek(0)
    resumed, restored = learner(config(target_interval=4), purpose="other")
    restored.flat.copy_(policy.flat)
    resumed.load_state_dict(torch.load(buffer, weights_only=True))
    q_learning.train(5)
    resumed.train(5)
    assert torch.equal(restored.flat, policy.flat)
