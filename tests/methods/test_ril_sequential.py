from __future__ import annotations

from collections.abc import Callable
from itertools import islice
from typing import Any

import numpy as np
import pytest
import torch
from helpers.states import assert_equal_states, copied

from ril.config.schema import Config
from ril.io.errors import UserError
from ril.learners.exploration import exploration_ratio
from ril.learners.online_q_learning import OnlineQLearning
from ril.methods.base import Progress
from ril.methods.ril_sequential import SequentialRIL
from ril.task import Task
from ril.vectorized.networks import Network
from ril.vectorized.streams import Streams

SECOND = "exploration of the second half"
Make = Callable[..., SequentialRIL]
EPOCHS = 6  # of the first half; the second has one for each of its 60 steps


@pytest.fixture(scope="module")
def make(make_method: Callable[..., Any]) -> Make:
    return lambda *overrides: make_method("ril_sequential", f"method.epochs={EPOCHS}", *overrides)


@pytest.fixture(scope="module")
def halves(make: Make) -> Any:
    """A trained method, its progress, and what it was after the first half."""
    method = make()
    epochs = method.train()
    first = list(islice(epochs, EPOCHS))
    middle = copied(method.state_dict())
    return method, first, list(epochs), middle


@pytest.mark.parametrize("episodes", [1, 3])
def test_its_first_half_is_rils_imitation_bit_for_bit(
    make: Make, make_method: Callable[..., Any], episodes: int
) -> None:
    changes = (f"method.epochs={EPOCHS}", f"method.episodes={episodes}")
    ril = make_method("ril", "method.reinforcement=false", *changes)
    sequential = make(*changes)
    expected = list(ril.train())
    found = list(islice(sequential.train(), EPOCHS))
    assert torch.equal(sequential.policy.flat, ril.policy.flat)
    for one, other in zip(found, expected, strict=True):
        assert one.metrics.keys() == other.metrics.keys()
        for name, values in other.metrics.items():
            np.testing.assert_array_equal(one.metrics[name], values, err_msg=name)
        for name in ("env_samples", "expert_samples", "pseudo_labels"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
        assert one.pre_samples == other.pre_samples
    goals = np.array([each.metrics["goals"] for each in found])
    assert (goals > 0).any()
    assert (goals < 1).any()


def test_its_first_half_does_no_q_learning(halves: Any, make: Make) -> None:
    found, expected = copied(halves[3]), copied(make().state_dict())
    assert_equal_states(found["q_learning"], expected["q_learning"])


def test_its_second_half_does_no_imitation(halves: Any) -> None:
    method, _, _, middle = halves
    after, before = copied(method.state_dict())["first_half"], copied(middle)["first_half"]
    assert not torch.equal(after.pop("policy")["flat"], before.pop("policy")["flat"])
    for half in (after, before):
        del half["imitation"]["_streams"]["exploration ratio"]
    assert_equal_states(after, before)


def test_its_second_half_changes_the_policy(halves: Any) -> None:
    method, _, _, middle = halves
    assert (method.policy.flat != middle["first_half"]["policy"]["flat"]).any(dim=1).all()


def second_half(
    method: SequentialRIL, middle: Any, config: Config, task: Task, epochs: int
) -> Network:
    """Q-learning alone from the policy of the first half, with its own exploration ratio."""
    policy = method.policy.copy()
    policy.load_state_dict(middle["first_half"]["policy"])
    settings: Any = config.method
    settings.q_learning.replay.capacity = round(10 * len(task.expert.observations))
    kind = settings.exploration.kind
    q_learning = OnlineQLearning(settings.q_learning, task, policy, kind, 60, SECOND)
    ratio = Streams(task.seeds, "exploration ratio")
    ratio.load_state_dict(middle["first_half"]["imitation"]["_streams"]["exploration ratio"])
    states = torch.from_numpy(task.expert.observations).expand(2, -1, -1)
    for step in range(1, epochs + 1):
        with torch.no_grad():
            epsilon = exploration_ratio(policy(states), ratio.uniform(states.shape[1]))
        q_learning.advance(step, epsilon[None])
    return policy


def test_its_second_half_is_q_learning_alone(
    halves: Any, quick: Any, make_task: Callable[[Config], Task]
) -> None:
    method, _, rest, middle = halves
    config = quick("method=ril_sequential")
    expected = second_half(method, middle, config, make_task(config), len(rest))
    assert torch.equal(method.policy.flat, expected.flat)


def test_the_halves_have_metrics_and_labels_of_their_own(halves: Any) -> None:
    _, first, rest, _ = halves
    assert {"cloning_loss", "inverse_dynamics_loss", "goals"} <= first[-1].metrics.keys()
    assert all(each.pseudo_labels is not None for each in first)
    for each in rest:
        assert each.metrics.keys() == {"td_loss", "training_return", "epsilon"}
        assert each.pseudo_labels is None


def test_epsilon_is_the_policys_own_in_both_halves(halves: Any) -> None:
    _, first, rest, _ = halves
    found = np.array([each.metrics["epsilon"] for each in (*first, *rest)])
    assert ((found > 0) & (found < 1)).all()
    assert len(np.unique(found[EPOCHS:])) > 5


def test_a_fixed_epsilon_is_kept_in_both_halves(make: Make) -> None:
    progress = list(make("method.exploration.epsilon=0.25").train())
    assert all(each.metrics["epsilon"].tolist() == [0.25, 0.25] for each in progress)


def test_the_experts_samples_count_once_per_epoch_of_imitation(halves: Any) -> None:
    method, first, rest, _ = halves
    once = len(method.imitation.task.expert.observations)
    found = [each.expert_samples.tolist() for each in (*first, *rest)]
    assert found == [[once * min(epoch, EPOCHS)] * 2 for epoch in range(1, EPOCHS + 61)]


def test_the_environments_samples_go_on_from_those_of_the_first_half(halves: Any) -> None:
    _, first, rest, _ = halves
    expected = [first[-1].env_samples + step for step in range(1, 61)]
    np.testing.assert_array_equal([each.env_samples for each in rest], expected)


def test_samples_of_the_first_half_are_the_steps_of_its_episodes(make: Make) -> None:
    progress = list(islice(make("method.episodes=3").train(), EPOCHS))
    samples = np.array([np.zeros(2), *(each.env_samples for each in progress)])
    returns = np.array([each.metrics["training_return"] for each in progress])
    # CartPole pays 1 for each step.
    np.testing.assert_allclose(np.diff(samples, axis=0), 3 * returns)


def test_the_random_transitions_are_as_many_as_asked(halves: Any) -> None:
    progress: list[Progress] = [*halves[1], *halves[2]]
    assert {each.pre_samples for each in progress} == {2 * 60}  # |A| · pre_steps_per_action


@pytest.mark.parametrize(("budget", "parts"), [(60, 60), (1000, 1000), (5000, 1000)])
def test_the_second_half_has_a_thousand_epochs_at_most(make: Make, budget: int, parts: int) -> None:
    assert make(f"method.total_timesteps={budget}").epochs == EPOCHS + parts


def test_all_of_the_second_halfs_budget_is_used_in_epochs_alike(make: Make) -> None:
    learns_never = "method.q_learning.learning_starts=9999"
    *progress, last = make("method.total_timesteps=1500", learns_never).train()
    steps = np.diff([each.env_samples for each in (*progress, last)][EPOCHS - 1 :], axis=0)
    assert steps.sum(axis=0).tolist() == [1500, 1500]
    assert set(steps.ravel()) == {1, 2}


def test_the_memory_holds_ten_mean_expert_trajectories(make: Make) -> None:
    method = make("ablation.trajectories=3")
    lengths = len(method.imitation.task.expert.observations) / 3
    assert method.q_learning.learner.replay.capacity == round(10 * lengths)


def test_the_memory_is_as_large_as_asked(make: Make) -> None:
    method = make("method.q_learning.replay.capacity=77")
    assert method.q_learning.learner.replay.capacity == 77


def test_the_configuration_stays_as_it_was(quick: Any, make_task: Callable[[Config], Task]) -> None:
    config = quick("method=ril_sequential")
    SequentialRIL(config.method, make_task(config))
    assert config == quick("method=ril_sequential")


def test_a_stopping_rule_is_refused(make: Any) -> None:
    with pytest.raises(UserError, match=r"^method\.stopping\.patience=1: "):
        make("method.stopping.patience=1")


def test_only_policies_of_the_second_half_may_be_the_best(halves: Any) -> None:
    _, first, second, _ = halves
    assert not any(progress.can_be_best for progress in first)
    assert all(progress.can_be_best for progress in second)
