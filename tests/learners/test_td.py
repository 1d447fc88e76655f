from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers.references import copies_of, random_network
from hypothesis import given
from hypothesis import strategies as st
from torch.nn import functional

from ril.learners.td import action_values, n_step, td_errors, td_losses, td_targets
from ril.vectorized.architectures import MLP
from ril.vectorized.replay import Batch
from ril.vectorized.rollout import Episodes

pytestmark = pytest.mark.quick

ARCHITECTURE = MLP(inputs=2, hidden=(6,), outputs=3)
S, B = 2, 5


def batch_of(rewards: list[float], terminated: list[float]) -> Batch:
    """One seed's transitions; states and actions do not matter."""
    states = torch.zeros(1, len(rewards), 2)
    actions = torch.zeros(1, len(rewards), dtype=torch.int64)
    return Batch(states, actions, torch.tensor([rewards]), states, torch.tensor([terminated]))


def random_batch() -> Batch:
    generator = torch.Generator().manual_seed(3)
    return Batch(
        torch.randn(S, B, 2, generator=generator),
        torch.randint(3, (S, B), generator=generator),
        torch.randn(S, B, generator=generator),
        torch.randn(S, B, 2, generator=generator),
        torch.tensor([[0.0, 1.0, 0.0, 0.0, 1.0], [1.0, 0.0, 0.0, 0.0, 0.0]]),
    )


def test_target_is_reward_and_the_discounted_best_next_value() -> None:
    batch = batch_of([-1.0, 2.0], [0.0, 0.0])
    next_values = torch.tensor([[[1.0, 5.0, 3.0], [-4.0, -2.0, -9.0]]])
    targets = td_targets(batch, next_values, discount=0.9)
    torch.testing.assert_close(targets, torch.tensor([[-1 + 0.9 * 5, 2 + 0.9 * -2]]))


@pytest.mark.parametrize("selection_values", [None, torch.zeros(1, 2, 3)], ids=["max", "double"])
def test_target_of_a_terminal_step_is_its_reward(selection_values: torch.Tensor | None) -> None:
    batch = batch_of([-1.0, 7.0], [0.0, 1.0])
    targets = td_targets(batch, torch.full((1, 2, 3), 10.0), 0.5, selection_values)
    assert targets.tolist() == [[4.0, 7.0]]


def test_a_double_target_is_the_value_of_the_action_that_another_would_choose() -> None:
    batch = batch_of([-1.0, 2.0], [0.0, 0.0])
    next_values = torch.tensor([[[1.0, 5.0, 3.0], [-4.0, -2.0, -9.0]]])
    selection_values = torch.tensor(
        [[[0.0, 1.0, 2.0], [8.0, 7.0, 6.0]]]
    )  # the third, and the first
    targets = td_targets(batch, next_values, 0.9, selection_values)
    torch.testing.assert_close(targets, torch.tensor([[-1 + 0.9 * 3, 2 + 0.9 * -4]]))


def test_action_values_are_those_of_the_actions_of_each_seed() -> None:
    values = torch.tensor([[[1.0, 2.0], [3.0, 4.0]], [[5.0, 6.0], [7.0, 8.0]]])
    assert action_values(values, torch.tensor([[1, 0], [0, 1]])).tolist() == [
        [2.0, 3.0],
        [5.0, 8.0],
    ]


@pytest.mark.parametrize(
    ("loss", "expected"),
    [("mse", [0.25, 9.0, 0.0]), ("huber", [0.5 * 0.5**2, 3.0 - 0.5, 0.0])],
)
def test_losses_are_those_of_each_difference(loss: str, expected: list[float]) -> None:
    assert td_losses(torch.tensor([[-0.5, 3.0, 0.0]]), loss).tolist() == [expected]


@pytest.mark.parametrize(
    ("loss", "distance"), [("mse", functional.mse_loss), ("huber", functional.huber_loss)]
)
def test_losses_have_the_slopes_of_torchs_own(loss: str, distance: object) -> None:
    assert callable(distance)
    errors = torch.linspace(-3, 3, 41, requires_grad=True)
    [found] = torch.autograd.grad(td_losses(errors, loss).sum(), errors)
    reference = distance(errors, torch.zeros(41), reduction="sum")
    [expected] = torch.autograd.grad(reference, errors)
    torch.testing.assert_close(found, expected)


@pytest.mark.parametrize("double", [False, True])
def test_errors_are_those_of_a_loop(double: bool) -> None:
    policy, batch = random_network(ARCHITECTURE, S), random_batch()
    target = policy.copy()
    target.flat.neg_()
    found = td_errors(policy, target, batch, 0.9, double=double)
    expected = torch.zeros(S, B)
    disagreements = 0
    for seed, (acting, aiming) in enumerate(zip(copies_of(policy), copies_of(target), strict=True)):
        for b in range(B):
            state = batch.observations[seed, b : b + 1]
            following = batch.next_observations[seed, b : b + 1]
            action, aimed = int(batch.actions[seed, b]), aiming(following)[0].tolist()
            chosen = acting(following)[0].tolist()
            disagreements += chosen.index(max(chosen)) != aimed.index(max(aimed))
            best = aimed[chosen.index(max(chosen))] if double else max(aimed)
            goal = float(batch.rewards[seed, b])
            if not batch.terminated[seed, b]:
                goal += 0.9 * best
            expected[seed, b] = acting(state)[0, action].item() - goal
    assert disagreements > 2  # so that double makes a difference
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("double", [False, True])
def test_no_gradient_reaches_the_policy_through_what_is_aimed_at(double: bool) -> None:
    policy, batch = random_network(ARCHITECTURE, S), random_batch()
    leaves = list(policy.parameters.values())
    errors = td_errors(policy, policy, batch, 0.9, double=double)
    found = torch.autograd.grad(errors.sum(), leaves)
    expected = torch.autograd.grad(
        action_values(policy(batch.observations), batch.actions).sum(), leaves
    )
    torch.testing.assert_close(found, expected)


def random_episodes(ends: list[tuple[int, bool]]) -> Episodes:
    """One of each length, which the environment ended or a cut did, and noise beyond its end."""
    numbers, count = np.random.default_rng(0), len(ends)
    lengths = np.array([length for length, _ in ends])
    longest = lengths.max() + 2
    states = numbers.normal(size=(2, count, longest, 3)).astype(np.float32)
    rewards = numbers.normal(size=(count, longest)).astype(np.float32)
    rewards[np.arange(longest) >= lengths[:, None]] = 0.0
    terminated = np.zeros((count, longest), dtype=bool)
    terminated[np.arange(count), lengths - 1] = [ended for _, ended in ends]
    actions = numbers.integers(3, size=(count, longest))
    return Episodes(states[0], actions, rewards, states[1], terminated, lengths)


several_ends = st.lists(st.tuples(st.integers(1, 12), st.booleans()), min_size=1, max_size=4)


@given(
    ends=several_ends,
    steps=st.integers(1, 15),
    discount=st.sampled_from([0.0, 0.5, 0.98, 1.0]),
    in_units=st.booleans(),
)
def test_transitions_over_n_steps_are_those_of_a_loop(
    ends: list[tuple[int, bool]], steps: int, discount: float, in_units: bool
) -> None:
    episodes = random_episodes(ends)
    unit = np.linspace(0.5, 3, len(ends)) if in_units else None
    found = n_step(episodes, steps, discount, unit)
    for k, (length, ended) in enumerate(ends):
        rows = []
        for t in range(length):
            ahead = min(steps, length - t)
            if ahead < steps and not ended:
                continue  # nobody knows what would have followed
            reward = sum(discount**i * float(episodes.rewards[k, t + i]) for i in range(ahead))
            reward /= 1.0 if unit is None else unit[k]
            rows.append((t, reward, t + ahead - 1, ended and t + ahead == length))
        assert found.lengths[k] == len(rows)
        for row, (t, reward, last, terminal) in enumerate(rows):
            np.testing.assert_array_equal(found.observations[k, row], episodes.observations[k, t])
            assert found.actions[k, row] == episodes.actions[k, t]
            assert found.rewards[k, row] == pytest.approx(reward, rel=1e-4, abs=1e-5)
            following = episodes.next_observations[k, last]
            np.testing.assert_array_equal(found.next_observations[k, row], following)
            assert found.terminated[k, row] == terminal


@given(several_ends)
def test_transitions_over_one_step_are_the_episodes_own(ends: list[tuple[int, bool]]) -> None:
    episodes = random_episodes(ends)
    found = n_step(episodes, 1, 0.9)
    np.testing.assert_array_equal(found.lengths, episodes.lengths)
    for name in ("observations", "actions", "rewards", "next_observations", "terminated"):
        one, other = getattr(found, name), getattr(episodes, name)
        assert one.dtype == other.dtype
        for k, (length, _) in enumerate(ends):
            np.testing.assert_array_equal(one[k, :length], other[k, :length], err_msg=name)


def test_transitions_over_n_steps_leave_the_episodes_as_they_were() -> None:
    ends = [(5, True), (7, False)]
    episodes, before = random_episodes(ends), random_episodes(ends)
    n_step(episodes, 3, 0.9, np.array([2.0, 3.0]))
    for name, values in vars(before).items():
        np.testing.assert_array_equal(getattr(episodes, name), values, err_msg=name)


def test_an_episode_truncated_before_n_steps_leaves_no_transition() -> None:
    assert n_step(random_episodes([(3, False), (4, False)]), 4, 0.9).lengths.tolist() == [0, 1]
