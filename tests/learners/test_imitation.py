from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from ril.config.schema import Config
from ril.io.errors import UserError
from ril.learners import imitation as module
from ril.learners.imitation import SelfSupervisedImitation
from ril.learners.topology import mlp
from ril.task import Task
from ril.vectorized.networks import Network
from ril.vectorized.streams import Streams

Make = Callable[..., SelfSupervisedImitation]


@pytest.fixture
def make(quick: Any, make_task: Callable[[Config], Task]) -> Make:
    """IUPE's imitation with I^pre filled."""

    def made(*overrides: str) -> SelfSupervisedImitation:
        config = quick("method=iupe", *overrides)
        task = make_task(config)
        topology = mlp(config.method.network, 4, 2)
        policy = Network.initialize(topology, task.seeds, "policy", task.device)
        learner = SelfSupervisedImitation(config.method, task, policy)
        learner.generate_pre()
        return learner

    return made


def labels_of(learner: SelfSupervisedImitation) -> np.ndarray:
    """(S, M) pseudo-labels after lines 14, 7 and 8."""
    learner.train(learner.sample_dataset(1.0))
    return learner.infer_actions().numpy()


def probabilities(learner: SelfSupervisedImitation) -> np.ndarray:
    """(S, M, |A|) what M_θ makes of the expert's transitions."""
    count = len(learner.task.seeds)
    states = learner.expert_states.repeat(count, 1, 1)
    following = learner._expert_next.repeat(count, 1, 1)
    with torch.no_grad():
        return learner.inverse_dynamics(states, following).softmax(dim=-1).numpy()


def test_labels_are_the_likeliest_actions(make: Make) -> None:
    learner = make("method.inverse_dynamics.labels=argmax")
    labels = labels_of(learner)
    np.testing.assert_array_equal(labels, probabilities(learner).argmax(axis=-1))


def test_sampled_labels_invert_the_distribution_function(make: Make) -> None:
    learner = make("method.inverse_dynamics.labels=sample")
    draws = Streams(learner.task.seeds, "labels")
    for _ in range(2):  # new numbers each time
        labels = labels_of(learner)
        chances, uniform = probabilities(learner), draws.uniform(len(learner.expert_states))
        expected = uniform >= chances[:, :, 0]  # of two actions, the second
        assert not (np.abs(uniform - chances[:, :, 0]) < 1e-6).any()  # nothing for rounding
        np.testing.assert_array_equal(labels, expected)
        assert 0 < labels.mean() < 1


@pytest.fixture
def alike(make: Make) -> SelfSupervisedImitation:
    """An expert that was in the same place each time, so that all labels have the same chances."""
    learner = make("method.inverse_dynamics.labels=sample", "seeds=3")
    learner.expert_states = learner.expert_states[:1].repeat(20_000, 1)
    learner._expert_next = learner._expert_next[:1].repeat(20_000, 1)
    return learner


def test_sampled_labels_are_as_frequent_as_the_softmax_says(alike: Any) -> None:
    labels = labels_of(alike)
    expected = probabilities(alike)[:, 0, 1]
    assert ((expected > 0.1) & (expected < 0.9)).all()
    np.testing.assert_allclose(labels.mean(axis=1), expected, atol=0.015)  # 4 deviations


def test_each_transition_of_each_seed_has_a_draw_of_its_own(alike: Any) -> None:
    labels = labels_of(alike)
    share = labels.mean(axis=1)
    for seed in range(3):
        # Were draws shared, neighbors or seeds would agree more often than by chance.
        agree = (labels[seed, 1:] == labels[seed, :-1]).mean()
        assert agree == pytest.approx(share[seed] ** 2 + (1 - share[seed]) ** 2, abs=0.02)
        other = (seed + 1) % 3
        agree = (labels[seed] == labels[other]).mean()
        by_chance = share[seed] * share[other] + (1 - share[seed]) * (1 - share[other])
        assert agree == pytest.approx(by_chance, abs=0.02)


@pytest.mark.parametrize("kind", ["argmax", "sample"])
@pytest.mark.parametrize("chunk", [1, 7, 64])
def test_chunks_do_not_change_labels(
    make: Make, monkeypatch: pytest.MonkeyPatch, kind: str, chunk: int
) -> None:
    whole, parts = (make(f"method.inverse_dynamics.labels={kind}") for _ in range(2))
    assert len(whole.expert_states) > 3 * 7
    expected = labels_of(whole)
    monkeypatch.setattr(module, "_CHUNK", chunk)
    np.testing.assert_array_equal(labels_of(parts), expected)


def test_chunks_do_not_change_the_exploration_ratio(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, parts = (make("method.exploration.epsilon=null") for _ in range(2))
    expected = whole.epsilon(None)
    monkeypatch.setattr(module, "_CHUNK", 7)
    np.testing.assert_array_equal(parts.epsilon(None), expected)
    assert (expected > 0).all()


def test_no_chunk_is_larger_than_asked(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    learner = make()
    rows: list[int] = []
    forward = Network.__call__

    def counted(self: Network, x: torch.Tensor) -> torch.Tensor:
        rows.append(x.shape[1])
        return forward(self, x)

    monkeypatch.setattr(module, "_CHUNK", 17)  # one more than a minibatch has
    monkeypatch.setattr(Network, "__call__", counted)
    for work in (lambda: labels_of(learner), lambda: learner.epsilon(None)):
        rows.clear()
        work()
        assert max(rows) == 17


def test_an_environment_without_a_goal_is_refused(make: Make) -> None:
    with pytest.raises(UserError, match=r"^env\.goal is empty: .*minimum_return"):
        make("env.goal.minimum_return=null")


def test_states_alone_have_no_change_to_standardize(make: Make) -> None:
    with pytest.raises(
        UserError, match=r"^method\.inverse_dynamics\.standardize=change: .*inputs=states"
    ):
        make("method.inverse_dynamics.inputs=states")
