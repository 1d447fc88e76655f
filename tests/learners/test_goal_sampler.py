from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st

from ril.learners.goal_sampler import choose_per_action, positive_limit, select
from ril.vectorized.replay import Replay
from ril.vectorized.rollout import Episodes

pytestmark = pytest.mark.quick

epochs = st.integers(0, 400) | st.floats(0, 400)
lengths = st.integers(1, 300) | st.floats(1, 300)
slopes = st.floats(0.05, 500)


@given(epoch=epochs, n=lengths, k=slopes)
def test_limit_is_a_share(epoch: float, n: float, k: float) -> None:
    assert 0 <= positive_limit(epoch, n, k) <= 1


@given(epoch=epochs, later=st.floats(0, 100), n=lengths, k=slopes)
def test_limit_never_falls_with_the_epoch(epoch: float, later: float, n: float, k: float) -> None:
    assert positive_limit(epoch + later, n, k) >= positive_limit(epoch, n, k)


@given(n=lengths, k=slopes)
def test_limit_is_none_before_the_first_epoch(n: float, k: float) -> None:
    assert positive_limit(0, n, k) == 0


@given(n=lengths, k=slopes)
def test_limit_is_all_at_n(n: float, k: float) -> None:
    assert positive_limit(n, n, k) == 1


@given(n=lengths, beyond=st.floats(1e-6, 1e6), k=slopes)
def test_limit_stays_all_beyond_n(n: float, beyond: float, k: float) -> None:
    assert positive_limit(n + beyond, n, k) == 1


@given(fraction=st.floats(0.001, 0.999), n=lengths, k=st.floats(0.1, 10))
def test_limit_is_equation_2_inside(fraction: float, n: float, k: float) -> None:
    epoch = fraction * n
    assume(0 < epoch < n)
    paper = 1 - 1 / (1 + (n / epoch - 1) ** (-k))
    assert positive_limit(epoch, n, k) == pytest.approx(paper, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize(("epoch", "k"), [(50, 1), (50, 1.5), (50, 2), (120, 2.5), (30, 3.5)])
def test_limit_by_hand(epoch: int, k: float) -> None:
    # With o = e / (n − e), eq. 2 is o^k / (1 + o^k).
    odds = epoch / (150 - epoch)
    assert positive_limit(epoch, 150, k) == pytest.approx(odds**k / (1 + odds**k))


@pytest.mark.parametrize("epoch", [1, 149])
def test_limit_of_a_very_steep_slope_is_a_step(epoch: int) -> None:
    assert positive_limit(epoch, 150, 1000) == round(epoch / 150)


ACTIONS = 3
#: The actions stored in the filled slots of one seed's memory.
filled = st.lists(st.integers(0, ACTIONS - 1), max_size=12)
shares = st.floats(0, 1) | st.sampled_from([0.0, 0.5, 1.0])


def memory_of(actions_by_seed: list[list[int]], *, capacity: int = 15, first: int = 0) -> Replay:
    """A memory whose rewards number its transitions: first, first + 1, … in each seed."""
    replay = Replay(len(actions_by_seed), capacity, 1, torch.device("cpu"))
    replay.rewards.fill_(-1)
    for seed, actions in enumerate(actions_by_seed):
        if not actions:
            continue
        count = len(actions)
        numbers = np.arange(first, first + count, dtype=np.float32)
        keep = np.arange(len(actions_by_seed)) == seed
        shape = (len(actions_by_seed), count)
        states = np.broadcast_to(numbers[:, None], (*shape, 1))
        replay.append(
            Episodes(
                states,
                np.broadcast_to(np.array(actions), shape),
                np.broadcast_to(numbers, shape),
                states,
                np.zeros(shape, dtype=bool),
                np.full(shape[0], count),
            ),
            keep=keep,
        )
    return replay


def random_numbers(seeds: int, slots: int, state: int = 0) -> np.ndarray:
    return np.random.default_rng(state).random((seeds, slots), dtype=np.float32)


def quotas(actions: list[int], share: float) -> Counter[int]:
    """How many of each action a share of them is, rounded up."""
    return Counter({a: math.ceil(share * count) for a, count in Counter(actions).items()})


@given(first=filled, second=filled, shares=st.tuples(shares, shares), state=st.integers(0, 99))
def test_each_actions_share_is_chosen(
    first: list[int], second: list[int], shares: tuple[float, float], state: int
) -> None:
    memory = memory_of([first, second])
    chosen = choose_per_action(memory, np.array(shares), ACTIONS, random_numbers(2, 15, state))
    for seed, (actions, share) in enumerate(zip((first, second), shares, strict=True)):
        slots = np.flatnonzero(chosen[seed])
        assert (slots < len(actions)).all()  # nothing from empty slots
        assert Counter(actions[slot] for slot in slots) == +quotas(actions, share)


def test_all_slots_are_equally_likely_to_be_chosen() -> None:
    memory = memory_of([[0, 1, 0, 0, 1, 0, 0]] * 2000)
    share = np.full(2000, 0.4)  # two of the five 0s
    chosen = choose_per_action(memory, share, ACTIONS, random_numbers(2000, 15))
    np.testing.assert_allclose(chosen[:, [0, 2, 3, 5, 6]].mean(axis=0), 0.4, atol=0.04)


def selected(
    pre: list[list[int]],
    pos: list[list[int]],
    shares: list[float],
    state: int = 0,
    *,
    keep_pre: bool = False,
) -> list[list[tuple[int, int]]]:
    """(number, action) of each transition of I^s, by seed; those of I^pos count from 100."""
    seeds = len(pre)
    dataset = select(
        memory_of(pre),
        memory_of(pos, capacity=10, first=100),
        np.array(shares),
        ACTIONS,
        random_numbers(seeds, 25, state),
        keep_pre=keep_pre,
    )
    return [
        [
            (int(dataset.transitions.rewards[seed, i]), int(dataset.transitions.actions[seed, i]))
            for i in range(dataset.sizes[seed])
        ]
        for seed in range(seeds)
    ]


@given(
    pre=st.tuples(filled, filled),
    pos=st.tuples(filled.map(lambda a: a[:10]), filled.map(lambda a: a[:10])),
    shares=st.tuples(shares, shares),
    state=st.integers(0, 99),
    keep_pre=st.booleans(),
)
def test_a_share_of_pos_and_all_or_the_rest_of_pre_per_action(
    pre: tuple[list[int], ...],
    pos: tuple[list[int], ...],
    shares: tuple[float, float],
    state: int,
    keep_pre: bool,
) -> None:
    datasets = selected(list(pre), list(pos), list(shares), state, keep_pre=keep_pre)
    for of_pre, of_pos, given_share, dataset in zip(pre, pos, shares, datasets, strict=True):
        share = given_share if of_pos else 0
        assert len({number for number, _ in dataset}) == len(dataset)  # none twice
        for number, action in dataset:
            source, slot = (of_pos, number - 100) if number >= 100 else (of_pre, number)
            assert source[slot] == action
        share_of_pre = 1 if keep_pre else 1 - share
        expected = +quotas(of_pre, share_of_pre), +quotas(of_pos, share)
        found = (
            Counter(action for number, action in dataset if number < 100),
            Counter(action for number, action in dataset if number >= 100),
        )
        assert found == expected


def test_without_successes_all_of_pre_is_chosen() -> None:
    [dataset] = selected([[0, 1, 2, 0]], [[]], [0.9])
    assert sorted(number for number, _ in dataset) == [0, 1, 2, 3]


def test_the_whole_share_leaves_nothing_of_pre() -> None:
    [dataset] = selected([[0, 1, 2, 0]], [[1, 1]], [1.0])
    assert sorted(number for number, _ in dataset) == [100, 101]


def test_or_all_of_it() -> None:
    [dataset] = selected([[0, 1, 2, 0]], [[1, 1]], [1.0], keep_pre=True)
    assert sorted(number for number, _ in dataset) == [0, 1, 2, 3, 100, 101]


def test_what_is_selected_does_not_depend_on_other_seeds() -> None:
    pre, pos, uniform = [[0, 1, 1, 0, 2, 2]], [[0, 2, 1]], random_numbers(2, 25)
    share = np.array([0.5, 0.1])

    def first_seed(datasets_pre: list[list[int]], datasets_pos: list[list[int]]) -> list[float]:
        seeds = len(datasets_pre)
        memories = memory_of(datasets_pre), memory_of(datasets_pos, capacity=10, first=100)
        numbers = uniform[:seeds]
        dataset = select(*memories, share[:seeds], ACTIONS, numbers, keep_pre=False)
        return dataset.transitions.rewards[0, : dataset.sizes[0]].tolist()

    assert first_seed(pre, pos) == first_seed([*pre, [2] * 15], [*pos, [1] * 9])
