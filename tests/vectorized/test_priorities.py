from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise

import numpy as np
import pytest
import torch
from helpers.states import assert_equal_states, copied
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from ril.vectorized import priorities as module
from ril.vectorized.priorities import Priorities, importance

CPU = torch.device("cpu")
BELOW_ONE = float(np.nextafter(np.float32(1), np.float32(0)))


def draw_from(
    priorities: Priorities, uniform: NDArray[np.float32], sizes: NDArray[np.int64]
) -> torch.Tensor:
    return module.draw(priorities.levels, torch.from_numpy(uniform), torch.from_numpy(sizes))


def importance_of(
    priorities: Priorities, slots: torch.Tensor, sizes: NDArray[np.int64], beta: float
) -> torch.Tensor:
    return importance(
        priorities.levels, slots, torch.from_numpy(sizes), torch.tensor([beta], dtype=torch.float64)
    )


uniforms = st.floats(0, BELOW_ONE, width=32) | st.sampled_from([0.0, 0.5, BELOW_ONE])


def plain_draw(weights: NDArray[np.float64], uniform: NDArray[np.float32]) -> list[int]:
    """One seed's slots: one number in each of B equal shares of the weights laid end to end."""
    ends, count = weights.cumsum(), len(uniform)
    drawn = []
    for share, number in enumerate(uniform.astype(float)):
        sought = (share + number) / count * ends[-1]
        drawn.append(min(int(np.searchsorted(ends, sought, side="right")), len(weights) - 1))
    return drawn


@contextmanager
def bare_errors() -> Iterator[None]:
    """Nothing is added to the errors, so that whole numbers stay whole, and their sums exact."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "_EPSILON", 0.0)
        yield


@st.composite
def memories(draw: st.DrawFn) -> tuple[int, list[list[int]], list[list[float]]]:
    """A capacity, whole errors of each seed's filled slots, and numbers to draw by."""
    capacity = draw(st.integers(1, 40) | st.sampled_from([1, 2, 3, 4, 9, 16, 17, 100, 101]))
    seeds = draw(st.integers(1, 3))
    sizes = st.integers(1, capacity)
    errors = [
        draw(st.lists(st.integers(1, 1000), min_size=size, max_size=size))
        for size in (draw(sizes) for _ in range(seeds))
    ]
    count = draw(st.integers(1, 12))
    uniform = [draw(st.lists(uniforms, min_size=count, max_size=count)) for _ in range(seeds)]
    return capacity, errors, uniform


def filled(capacity: int, errors: Sequence[Sequence[float]], alpha: float = 1.0) -> Priorities:
    """Priorities of seeds whose memories are filled to different degrees."""
    priorities = Priorities(len(errors), capacity, alpha, CPU)
    for slot in range(max(len(row) for row in errors)):
        # A slot that a seed has not filled is given what its last one has.
        slots = torch.tensor([[min(slot, len(row) - 1)] for row in errors])
        values = torch.tensor([[float(row[min(slot, len(row) - 1)])] for row in errors])
        priorities.update(slots, values)
    return priorities


@given(memories())
def test_slots_are_those_of_a_plain_sampler(memory: tuple) -> None:
    capacity, errors, numbers = memory
    with bare_errors():
        priorities = filled(capacity, errors)
    uniform = np.array(numbers, dtype=np.float32)
    sizes = np.array([len(row) for row in errors])
    expected = [
        plain_draw(np.array(row, dtype=float), of_seed)
        for row, of_seed in zip(errors, uniform, strict=True)
    ]
    assert draw_from(priorities, uniform, sizes).tolist() == expected


@given(memories(), st.lists(st.floats(-20, 20), min_size=40, max_size=40))
def test_no_slot_lies_beyond_the_filled_ones(memory: tuple, exponents: list[float]) -> None:
    capacity, rows, numbers = memory
    errors = [[10.0 ** exponents[v % 40] for v in row] for row in rows]  # tiny and huge
    priorities = filled(capacity, errors)
    sizes = np.array([len(row) for row in errors])
    for uniform in (np.array(numbers, dtype=np.float32), np.full((len(rows), 7), BELOW_ONE)):
        drawn = draw_from(priorities, uniform.astype(np.float32), sizes).numpy()
        assert (drawn >= 0).all()
        assert (drawn < sizes[:, None]).all()


@pytest.mark.parametrize("capacity", [1, 2, 5, 9, 1000])
def test_the_last_number_draws_a_filled_slot(capacity: int) -> None:
    for size in {1, capacity // 2 + 1, capacity}:
        priorities = filled(capacity, [[3] * size], alpha=0.6)
        drawn = draw_from(priorities, np.full((1, 4), BELOW_ONE, np.float32), np.array([size]))
        assert drawn.max() == size - 1


@pytest.mark.parametrize("error", [0.0, torch.inf, torch.nan])
@pytest.mark.parametrize("number", [0.0, 0.5, BELOW_ONE])
def test_a_filled_slot_is_drawn_though_priorities_vanish_or_are_no_numbers(
    error: float, number: float
) -> None:
    priorities = filled(12, [[error] * 7], alpha=100.0)  # to this power, 1e-6 is 0
    drawn = draw_from(priorities, np.full((1, 5), number, np.float32), np.array([7]))
    assert ((drawn >= 0) & (drawn < 7)).all()


def test_slots_are_drawn_as_often_as_their_priorities_say() -> None:
    errors = np.random.default_rng(0).exponential(size=23) + 0.05
    priorities = Priorities(1, 30, 0.6, CPU)
    priorities.update(torch.arange(23)[None], torch.from_numpy(errors)[None])
    draws, numbers = 6000, np.random.default_rng(1)
    # One number at a time: draws of one batch, each from a share of its own, are not independent.
    uniform = numbers.random((draws, 1, 1)).astype(np.float32)
    drawn = [int(draw_from(priorities, each, np.array([23]))) for each in uniform]
    expected = draws * (errors + 1e-6) ** 0.6 / ((errors + 1e-6) ** 0.6).sum()
    statistic = ((np.bincount(drawn, minlength=23) - expected) ** 2 / expected).sum()
    assert statistic < 48.3  # of 22 degrees of freedom, 999 of 1000 lie below


def test_each_share_of_a_batch_is_drawn_from_once() -> None:
    with bare_errors():
        priorities = filled(16, [[2] * 16])
    for number in (0.0, 0.3, BELOW_ONE):
        drawn = draw_from(priorities, np.full((1, 16), number, np.float32), np.array([16]))
        assert drawn.tolist() == [list(range(16))]


@pytest.mark.parametrize("beta", [0.0, 0.4, 1.0])
def test_importance_undoes_the_bias_up_to_a_factor(beta: float) -> None:
    numbers = np.random.default_rng(0)
    errors = numbers.exponential(size=(2, 12))
    priorities = Priorities(2, 20, 0.6, CPU)
    priorities.update(torch.arange(12).expand(2, 12), torch.from_numpy(errors))
    slots = numbers.integers(12, size=(2, 9))
    found = importance_of(priorities, torch.from_numpy(slots), np.array([12, 12]), beta)
    for seed in (0, 1):
        weights = (errors[seed] + 1e-6) ** 0.6
        expected = (12 * weights[slots[seed]] / weights.sum()) ** -beta
        np.testing.assert_allclose(found[seed].numpy(), expected / expected.max(), rtol=1e-5)


def test_the_largest_importance_of_each_seeds_batch_is_one() -> None:
    priorities = filled(9, [[1, 5, 9], [100, 2, 2]], alpha=0.6)
    slots = torch.tensor([[1, 2, 2], [0, 0, 0]])  # the least of neither is drawn
    found = importance_of(priorities, slots, np.array([3, 3]), 0.7)
    assert found.amax(dim=1).tolist() == [1.0, 1.0]
    assert found.dtype == torch.float32


def test_all_weights_are_one_without_alpha() -> None:
    priorities = filled(9, [[1, 500, 9]], alpha=0.0)
    found = importance_of(priorities, torch.tensor([[0, 1, 2]]), np.array([3]), 1.0)
    assert found.tolist() == [[1.0, 1.0, 1.0]]


def test_without_alpha_slots_are_equally_likely() -> None:
    priorities = filled(9, [[1, 500, 9, 70, 3, 2]], alpha=0.0)
    grid = ((np.arange(60) + 0.5) / 60).astype(np.float32)
    drawn = [int(draw_from(priorities, np.full((1, 1), n), np.array([6]))) for n in grid]
    assert np.bincount(drawn).tolist() == [10] * 6


def test_the_first_transitions_have_priority_one() -> None:
    priorities = Priorities(2, 5, 0.6, CPU)
    priorities.add(torch.tensor([[0, 1], [0, 1]]))
    assert priorities.weights[:, :5].tolist() == [[1.0, 1.0, 0.0, 0.0, 0.0]] * 2


def test_new_transitions_have_the_highest_priority_so_far_of_their_seed() -> None:
    priorities = Priorities(3, 6, 0.5, CPU)
    priorities.add(torch.tensor([[0, 1]] * 3))
    priorities.update(
        torch.tensor([[0, 1]] * 3), torch.tensor([[4.0, -9.0], [16.0, 2.0], [0.1, 0]])
    )
    # What was the highest counts on when its slot has another.
    priorities.update(torch.tensor([[1]] * 3), torch.tensor([[0.5]] * 3))
    priorities.add(torch.tensor([[2]] * 3))
    expected = np.sqrt([9 + 1e-6, 16 + 1e-6, 1])
    np.testing.assert_allclose(priorities.weights[:, 2].numpy(), expected, rtol=1e-7)


@pytest.mark.parametrize("error", [-2.0, 2.0])
def test_a_priority_is_the_size_of_the_error_and_a_little_to_the_power_of_alpha(
    error: float,
) -> None:
    priorities = Priorities(1, 5, 0.6, CPU)
    priorities.update(torch.tensor([[3, 4]]), torch.tensor([[error, 0.0]]))
    found = priorities.weights[0, [3, 4]].numpy()
    np.testing.assert_allclose(found, [(2 + 1e-6) ** 0.6, 1e-6**0.6], rtol=1e-12)


@given(
    capacity=st.integers(1, 60),
    number=st.integers(0, 2**31),
    alpha=st.sampled_from([0.0, 0.6, 1.0]),
)
def test_sums_are_those_of_the_slots_after_any_updates(
    capacity: int, number: int, alpha: float
) -> None:
    generator = np.random.default_rng(number)
    priorities, model = Priorities(2, capacity, alpha, CPU), np.zeros((2, capacity))
    for _ in range(30):
        slots = generator.integers(capacity, size=(2, 8))  # with repetitions
        errors = generator.normal(size=(2, capacity)).astype(np.float32)
        of_slots = np.take_along_axis(errors, slots, axis=1)
        priorities.update(torch.from_numpy(slots), torch.from_numpy(of_slots))
        values = (np.abs(of_slots.astype(float)) + 1e-6) ** alpha
        np.put_along_axis(model, slots, values, axis=1)
    np.testing.assert_allclose(priorities.weights[:, :capacity].numpy(), model, rtol=1e-12)
    assert not priorities.weights[:, capacity:].any()
    levels = [level.numpy() for level in priorities.state_dict()["levels"]]
    for above, below in pairwise(levels):
        sums = below.reshape(*above.shape, -1).sum(axis=-1)
        np.testing.assert_allclose(above, sums, rtol=1e-12)


def worked(priorities: Priorities, rows: slice, rounds: int, start: int = 0) -> list[torch.Tensor]:
    """Draw from and update the priorities of some of three seeds; returns what was drawn."""
    drawn = []
    for number in range(start, start + rounds):
        generator = np.random.default_rng(number)
        uniform = generator.random((3, 32)).astype(np.float32)[rows]
        errors = generator.normal(size=(3, 32)).astype(np.float32)[rows]
        priorities.add(torch.full((len(uniform), 1), number))
        slots = draw_from(priorities, uniform, np.full(len(uniform), number + 1))
        weights = importance_of(priorities, slots, np.full(len(uniform), number + 1), 0.5)
        priorities.update(slots, torch.from_numpy(errors) * weights)
        drawn.append(slots)
    return drawn


@pytest.mark.parametrize("capacity", [400, 50_000])
def test_a_seeds_draws_do_not_depend_on_other_seeds(capacity: int) -> None:
    among, alone = Priorities(3, capacity, 0.6, CPU), Priorities(1, capacity, 0.6, CPU)
    several, one = worked(among, slice(0, 3), 300), worked(alone, slice(1, 2), 300)
    for of_several, drawn in zip(several, one, strict=True):
        assert torch.equal(of_several[1], drawn[0])
    state, of_alone = among.state_dict(), alone.state_dict()
    for found, expected in zip(state["levels"], of_alone["levels"], strict=True):
        assert torch.equal(found[1], expected[0])
    assert torch.equal(state["_highest"][1], of_alone["_highest"][0])


def test_loaded_priorities_resume_bit_identically() -> None:
    priorities, resumed = (Priorities(3, 90, 0.6, CPU) for _ in range(2))
    worked(priorities, slice(0, 3), 40)
    worked(resumed, slice(0, 3), 7, start=50)  # what was done before leaves no trace
    resumed.load_state_dict(copied(priorities.state_dict()))
    found = worked(resumed, slice(0, 3), 30, start=40)
    expected = worked(priorities, slice(0, 3), 30, start=40)
    assert torch.equal(torch.stack(found), torch.stack(expected))
    assert_equal_states(resumed.state_dict(), priorities.state_dict())
