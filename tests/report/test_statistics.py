from __future__ import annotations

import itertools
import math
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from ril.report.statistics import (
    aggregate,
    average_interval,
    mean_interval,
    probability_of_improvement,
)

RUNS = st.lists(st.integers(-1000, 1000), min_size=2, max_size=6)
ENVIRONMENTS = st.lists(RUNS, min_size=1, max_size=4)
NUMBERS = np.random.default_rng(7).normal(size=(4, 10))


def by_env(runs: list[list[int]]) -> dict[str, list[int]]:
    return dict(zip("abcd", runs, strict=False))


def enumerated(values: list[float]) -> tuple[float, float]:
    """The interval from every possible resample, each once."""
    means = [sum(taken) / len(values) for taken in itertools.product(values, repeat=len(values))]
    low, high = np.percentile(means, [2.5, 97.5], method="inverted_cdf")
    return float(low), float(high)


def plain_mean(values: list[float]) -> float:
    total = 0.0
    for value in values:
        total += value
    return total / len(values)


def plain_aggregates(runs: dict[str, list[float]]) -> tuple[float, float, float, float]:
    """Mean, median, IQM and optimality gap by their definitions."""
    means = sorted(plain_mean(values) for values in runs.values())
    half = len(means) // 2
    median = means[half] if len(means) % 2 else (means[half - 1] + means[half]) / 2
    every = math.lcm(*map(len, runs.values()))  # each environment counts the same
    pooled = sorted(v for vs in runs.values() for v in vs for _ in range(every // len(vs)))
    cut = len(pooled) // 4
    middle = pooled[cut : len(pooled) - cut]
    gap = plain_mean([1 - value if value < 1 else 0.0 for value in pooled])
    return plain_mean(means), median, plain_mean(middle), gap


def plain_improvement(x: dict[str, list[int]], y: dict[str, list[int]]) -> float:
    wins = []
    for env in x:
        scores = [1.0 if a > b else 0.5 if a == b else 0.0 for a in x[env] for b in y[env]]
        wins.append(plain_mean(scores))
    return plain_mean(wins)


@pytest.mark.parametrize("values", [[1.0, 4.0], [1.0, 2.0, 4.0]])
def test_of_few_values_the_interval_is_that_of_all_resamples(values: list[float]) -> None:
    assert mean_interval(values) == pytest.approx(enumerated(values))


def test_of_more_values_the_interval_is_near_that_of_all_resamples() -> None:
    values = [0.0, 1.0, 3.5, 7.25, 10.0, 11.0]
    assert mean_interval(values) == pytest.approx(enumerated(values), abs=0.2)


def test_the_interval_is_that_of_scipy() -> None:
    found = stats.bootstrap(
        (NUMBERS[0],), np.mean, method="percentile", rng=np.random.default_rng(1)
    ).confidence_interval
    assert mean_interval(NUMBERS[0]) == pytest.approx(tuple(found), abs=0.03)


def test_the_average_interval_is_that_of_scipys_independent_samples() -> None:
    found = stats.bootstrap(
        tuple(NUMBERS),
        lambda *samples, axis: np.mean([sample.mean(axis=axis) for sample in samples], axis=0),
        method="percentile",
        rng=np.random.default_rng(1),
    ).confidence_interval
    assert average_interval(NUMBERS) == pytest.approx(tuple(found), abs=0.02)


@pytest.mark.parametrize("values", [[], [3.0]])
def test_fewer_than_two_values_have_no_interval(values: list[float]) -> None:
    assert mean_interval(values) is None


def test_an_environment_with_one_value_leaves_no_average_interval() -> None:
    assert average_interval([[1.0, 2.0], [3.0]]) is None


def test_no_environment_has_no_average_interval() -> None:
    assert average_interval([]) is None


@given(st.floats(-1e6, 1e6), st.integers(2, 12))
def test_equal_values_are_their_own_interval(value: float, count: int) -> None:
    assert mean_interval([value] * count) == (value, value)


def test_a_value_that_is_not_there_leaves_no_interval() -> None:
    assert np.isnan(mean_interval([1.0, math.nan, 2.0])).all()


@given(RUNS)
def test_an_interval_is_ordered_and_within_the_values(values: list[int]) -> None:
    low, high = mean_interval(values)
    assert min(values) - 1e-9 <= low <= high <= max(values) + 1e-9


@given(RUNS, st.integers(-1000, 1000))
def test_an_interval_moves_with_the_values(values: list[int], by: int) -> None:
    low, high = mean_interval(values)
    assert mean_interval([v + by for v in values]) == pytest.approx((low + by, high + by))


@given(RUNS)
def test_an_interval_of_values_in_another_order_is_nearly_the_same(values: list[int]) -> None:
    width = max(values) - min(values)
    found = mean_interval(values[::-1])
    assert found == pytest.approx(mean_interval(values), abs=0.05 * width + 1e-9)


def test_an_interval_of_the_same_values_is_always_the_same() -> None:
    assert mean_interval(NUMBERS[1]) == mean_interval(NUMBERS[1].copy())


def test_one_environments_average_interval_is_its_mean_interval() -> None:
    assert average_interval([NUMBERS[0]]) == mean_interval(NUMBERS[0])


def test_environments_are_resampled_apart() -> None:
    """The same runs four times over are as many independent samples: half as wide."""
    low, high = mean_interval(NUMBERS[0])
    four_low, four_high = average_interval([NUMBERS[0]] * 4)
    assert four_high - four_low == pytest.approx((high - low) / 2, rel=0.05)


def test_seeds_stay_within_their_environment() -> None:
    assert average_interval([[0.0] * 5, [100.0] * 5]) == (50.0, 50.0)


@given(ENVIRONMENTS)
def test_aggregates_are_by_their_definitions(runs: list[list[int]]) -> None:
    found = aggregate(by_env(runs))
    values = [found.mean[0], found.median[0], found.iqm[0], found.optimality_gap[0]]
    assert values == pytest.approx(list(plain_aggregates(by_env(runs))), abs=1e-9)


@pytest.mark.parametrize("field", ["mean", "median", "iqm", "optimality_gap"])
def test_an_aggregates_interval_is_near_that_of_plain_resampling(field: str) -> None:
    random = np.random.default_rng(3)
    number = ["mean", "median", "iqm", "optimality_gap"].index(field)
    resampled = [
        plain_aggregates({env: random.choice(v, 10).tolist() for env, v in enumerate(NUMBERS)})
        for _ in range(2000)
    ]
    expected = np.percentile(np.array(resampled)[:, number], [2.5, 97.5])
    found = getattr(aggregate(by_env(NUMBERS)), field)
    assert found[1:] == pytest.approx(tuple(expected), abs=0.05)


@given(ENVIRONMENTS)
def test_aggregates_intervals_are_ordered_and_within_the_values(runs: list[list[int]]) -> None:
    found = aggregate(by_env(runs))
    lowest, highest = min(map(min, runs)), max(map(max, runs))
    for value, low, high in (found.mean, found.median, found.iqm):
        assert lowest - 1e-9 <= low <= high <= highest + 1e-9
        assert lowest - 1e-9 <= value <= highest + 1e-9


def test_an_aggregate_of_one_seed_has_no_interval() -> None:
    value, low, high = aggregate({"a": [0.5, 0.7], "b": [0.25]}).mean
    assert (value, math.isnan(low), math.isnan(high)) == (pytest.approx(0.425), True, True)


@pytest.mark.parametrize("runs", [{}, {"a": [], "b": [1.0]}])
def test_an_aggregate_needs_runs(runs: dict[str, list[float]]) -> None:
    with pytest.raises(ValueError, match="needs a run"):
        aggregate(runs)


def test_an_environment_with_fewer_seeds_counts_as_much() -> None:
    found = aggregate({"a": [1.0] * 10, "b": [0.0] * 2})
    assert found.optimality_gap[0] == pytest.approx(1 - found.mean[0])
    assert found.iqm[0] == pytest.approx(0.5)


def test_the_expert_has_no_optimality_gap() -> None:
    assert aggregate({"a": [1.0, 1.5], "b": [2.0, 1.0]}).optimality_gap == (0.0, 0.0, 0.0)


@given(ENVIRONMENTS, st.data())
def test_an_improvement_is_by_its_definition(runs: list[list[int]], data: st.DataObject) -> None:
    others = data.draw(st.lists(RUNS, min_size=len(runs), max_size=len(runs)))
    x, y = by_env(runs), by_env(others)
    value, low, high = probability_of_improvement(x, y)
    assert value == pytest.approx(plain_improvement(x, y))
    assert -1e-9 <= low <= high <= 1 + 1e-9


@given(ENVIRONMENTS)
def test_a_method_is_no_improvement_over_itself(runs: list[list[int]]) -> None:
    assert probability_of_improvement(by_env(runs), by_env(runs))[0] == pytest.approx(0.5)


@given(ENVIRONMENTS)
def test_improvements_of_two_methods_add_up(runs: list[list[int]]) -> None:
    x, y = by_env(runs), by_env([values[::-1][:2] for values in runs])
    there, back = probability_of_improvement(x, y)[0], probability_of_improvement(y, x)[0]
    assert there + back == pytest.approx(1)


def test_a_method_that_always_wins_is_sure_to() -> None:
    found = probability_of_improvement({"a": [2, 3], "b": [5, 9]}, {"a": [0, 1], "b": [3, 4]})
    assert found == pytest.approx((1, 1, 1))


def test_an_improvements_interval_is_that_of_scipy() -> None:
    x, y = NUMBERS[0], NUMBERS[1] - 0.3
    found = stats.bootstrap(
        (x, y),
        lambda a, b, axis: (a[..., None] > b[..., None, :]).mean(axis=(-2, -1)),
        method="percentile",
        n_resamples=4000,
        rng=np.random.default_rng(1),
    ).confidence_interval
    assert probability_of_improvement({"a": x}, {"a": y})[1:] == pytest.approx(found, abs=0.02)


def test_only_environments_that_both_have_are_compared() -> None:
    x = {"a": [1.0, 2.0], "b": [0.0, 0.0]}
    assert probability_of_improvement(x, {"a": [0.0, 0.0]})[0] == 1


def test_methods_without_a_common_environment_cannot_be_compared() -> None:
    assert np.isnan(probability_of_improvement({"a": [1.0, 2.0]}, {"b": [1.0, 2.0]})).all()


def test_three_hundred_intervals_take_a_moment() -> None:
    cells = np.random.default_rng(0).normal(size=(300, 10))
    started = time.process_time()
    assert len([mean_interval(cell) for cell in cells]) == 300
    assert time.process_time() - started < 3
