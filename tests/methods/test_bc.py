from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from helpers.references import Adam, copies_of, flat_of
from torch.nn import functional

from ril.config.schema import Config
from ril.methods.bc import BC
from ril.task import Task
from ril.vectorized import networks
from ril.vectorized.architectures import MLP
from ril.vectorized.networks import Network
from ril.vectorized.replay import random_indices
from ril.vectorized.streams import Streams


@pytest.fixture
def make(quick: Any, make_task: Callable[[Config], Task]) -> Callable[..., tuple[BC, Task]]:
    def made(*overrides: str) -> tuple[BC, Task]:
        config = quick("method=bc", *overrides)
        task = make_task(config)
        return BC(config.method, task), task

    return made


def test_it_is_supervised_learning_of_the_experts_actions(make: Any) -> None:
    method, task = make()
    # §4.1 (i): CartPole's topology and learning rate.
    start = Network.initialize(MLP(4, (8, 8), 2), task.seeds, "policy", task.device)
    modules = copies_of(start)
    losses = [progress.metrics["cloning_loss"] for progress in method.train()]

    states, actions = map(torch.from_numpy, (task.expert.observations, task.expert.actions))
    optimizers = [Adam(module, 5e-4, 1.0) for module in modules]
    streams = Streams(task.seeds, "cloning batches")
    expected = np.zeros((3, 2))
    for epoch in range(3):
        drawn = random_indices(streams.uniform(4, 16), np.full(2, len(states)))
        for update in range(4):
            for seed, module in enumerate(modules):
                at = drawn[seed, update]
                loss = functional.cross_entropy(module(states[at]), actions[at])
                expected[epoch, seed] += loss.item() / 4
                optimizers[seed].step(loss)
    found = torch.stack([flat_of(module) for module in modules])
    torch.testing.assert_close(method.policy.flat, found, rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(losses, expected, rtol=1e-4)


def test_it_learns_what_the_expert_does(make: Any) -> None:
    method, task = make("method.epochs=20", "method.cloning.updates=50", "ablation.trajectories=3")
    for _ in method.train():
        pass
    both = np.concatenate([task.expert.observations] * 2)
    greedy = networks.greedy(method.policy.infer(both)).reshape(2, -1)
    assert (greedy == task.expert.actions).mean(axis=1).min() > 0.95


def test_it_never_steps_in_the_environment(make: Any) -> None:
    method, _ = make()
    assert all(progress.env_samples.tolist() == [0, 0] for progress in method.train())


def test_expert_samples_count_the_expert_once_per_epoch(make: Any) -> None:
    method, task = make()
    found = [progress.expert_samples.tolist() for progress in method.train()]
    count = len(task.expert.observations)
    assert found == [[count] * 2, [2 * count] * 2, [3 * count] * 2]
