from __future__ import annotations

from collections.abc import Callable
from itertools import islice
from typing import Any

import numpy as np
import pytest
import torch

from ril.environments.environment import Environment
from ril.methods.base import Progress
from ril.methods.dqn import DQN
from ril.vectorized.architectures import MLP, Dueling
from ril.vectorized.evaluation import Evaluation

Make = Callable[..., DQN]
NEVER_LEARNS = "method.q_learning.learning_starts=9999"


@pytest.fixture(scope="module")
def make(make_method: Callable[..., Any]) -> Make:
    return lambda *overrides: make_method("dqn", *overrides)


def epsilons(progress: list[Progress]) -> np.ndarray:
    return np.array([each.metrics["epsilon"] for each in progress])


def test_epsilon_is_one_until_learning_starts_and_then_on_its_line(make: Make) -> None:
    line = ("initial_epsilon=0.9", "final_epsilon=0.1", "steps=40")
    found = epsilons(list(make(*(f"method.exploration.{each}" for each in line)).train()))
    # One step in each epoch: no step comes before the first.
    expected = [1.0] * 10 + [0.9 - 0.8 * min(1, step / 40) for step in range(10, 60)]
    np.testing.assert_allclose(found, np.array([expected, expected]).T)


def test_the_line_is_as_steep_whatever_the_budget(make: Make) -> None:
    short = make("method.exploration.initial_epsilon=0.9")
    long = make("method.exploration.initial_epsilon=0.9", "method.total_timesteps=3000")
    of_short = epsilons(list(short.train()))
    of_long = epsilons(list(islice(long.train(), 20)))  # three steps in each epoch
    np.testing.assert_array_equal(of_long, of_short[2::3])


@pytest.mark.parametrize(("budget", "epochs"), [(1, 1), (60, 60), (1000, 1000), (1001, 1000)])
def test_a_budget_has_a_thousand_epochs_at_most(make: Make, budget: int, epochs: int) -> None:
    assert make(f"method.total_timesteps={budget}").epochs == epochs


def test_all_of_the_budget_is_used_in_epochs_alike(make: Make) -> None:
    method = make("method.total_timesteps=1500", NEVER_LEARNS)
    samples = np.array([each.env_samples for each in method.train()])
    assert samples.shape == (1000, 2)
    assert samples[-1].tolist() == [1500, 1500]
    assert set(np.diff(samples, axis=0).ravel()) == {1, 2}


def test_samples_are_the_steps_taken(make: Make) -> None:
    method = make("method.q_learning.replay.capacity=100")
    for progress in method.train():
        np.testing.assert_array_equal(progress.env_samples, method.q_learning.learner.replay.sizes)


def test_no_other_samples_are_used(make: Make) -> None:
    *_, last = make().train()
    assert (last.expert_samples.tolist(), last.pre_samples) == ([0, 0], 0)


def test_a_shorter_budget_is_the_beginning_of_a_longer_one(make: Make) -> None:
    short, long = make(), make("method.total_timesteps=2000")
    *_, of_short = short.train()
    *_, of_long = islice(long.train(), 30)  # two steps in each epoch
    assert of_long.env_samples.tolist() == of_short.env_samples.tolist() == [60, 60]
    assert torch.equal(long.policy.flat, short.policy.flat)
    name = "training_return"
    np.testing.assert_array_equal(of_long.metrics[name], of_short.metrics[name])


def test_its_network_has_the_topology_asked_for(make: Make) -> None:
    architecture = make("method.network.hidden=[7,5]").policy.architecture
    assert architecture == MLP(4, (7, 5), 2, attention=False, layer_norm=False, negative_slope=0.0)


def test_a_dueling_network_has_two_streams_of_that_topology(make: Make) -> None:
    architecture = make("method.network.hidden=[7,5]", "method.dueling=true").policy.architecture
    value, advantage = (MLP(4, (7, 5), outputs, False, False, 0.0) for outputs in (1, 2))
    assert architecture == Dueling(value, advantage)


@pytest.mark.parametrize(
    "option",
    [
        "method.q_learning.double=true",
        "method.dueling=true",
        "method.q_learning.replay.alpha=0.6",
        "method.q_learning.target_interval=0",
        "method.q_learning.loss=mse",
        "method.q_learning.discount=0.5",
        "method.q_learning.train_freq=3",
        "method.q_learning.learning_starts=20",
        "method.q_learning.replay.capacity=20",
        "method.exploration.final_epsilon=0.9",
    ],
)
def test_each_option_makes_a_difference(make: Make, option: str) -> None:
    # A target that is old, so that policy and target choose other actions.
    plain, changed = (
        make("method.q_learning.learning_rate=0.03", "method.q_learning.updates=6", *options)
        for options in ((), (option,))
    )
    for method in (plain, changed):
        list(method.train())
    same = plain.policy.flat.shape == changed.policy.flat.shape
    assert not (same and torch.equal(plain.policy.flat, changed.policy.flat))


def test_its_second_kind_is_the_first_with_three_options(
    make: Make, make_method: Callable[..., Any]
) -> None:
    options = (
        "method.dueling=true",
        "method.q_learning.double=true",
        "method.q_learning.replay.alpha=0.6",
    )
    first = make(*options)
    second = make_method("dqn_prioritized")
    for method in (first, second):
        list(method.train())
    assert torch.equal(second.policy.flat, first.policy.flat)


def test_it_learns_to_balance_the_pole(make: Make, cartpole: Environment) -> None:
    dqn = make(
        "method.total_timesteps=3000",
        "method.q_learning.learning_rate=3e-3",
        "method.q_learning.learning_starts=200",
        "method.q_learning.updates=2",
        "method.q_learning.batch_size=32",
        "method.q_learning.target_interval=50",
        "method.q_learning.replay.capacity=3000",
        "method.exploration.steps=1000",
    )
    evaluation = Evaluation(cartpole, (0, 1))
    assert evaluation.returns(dqn.policy, 10, "before").mean() < 50
    best = np.zeros(2)
    for progress in dqn.train():
        if progress.epoch % 50 == 0 and progress.epoch > 500:
            returns = evaluation.returns(dqn.policy, 5, f"after {progress.epoch}")
            best = np.maximum(best, returns.mean(axis=1))
    assert best.min() > 90
