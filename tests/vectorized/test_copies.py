from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ril.environments.environment import Environment
from ril.vectorized.copies import ArrayCopies, GymnasiumCopies, make_copies
from ril.vectorized.lunar_lander import LanderCopies

CLASSIC = ("cartpole", "mountaincar", "acrobot")
SHIPPED = (*CLASSIC, "lunarlander")
COUNT = 20


def plan(environment: Environment, steps: int) -> np.ndarray:
    """(steps, copies) actions: each kept for as long as it takes to gain speed, or not at all."""
    numbers = np.random.default_rng(0)
    once = numbers.integers(environment.action_count, size=(steps // 12 + 1, COUNT))
    kept = np.repeat(once, 12, axis=0)[:steps]
    at_random = numbers.integers(environment.action_count, size=(steps, COUNT))
    return np.where(np.arange(COUNT) % 2, kept, at_random)


@pytest.mark.parametrize("name", SHIPPED)
def test_copies_are_bit_identical_to_gymnasium(
    environments: dict[str, Environment], name: str
) -> None:
    """20,000 transitions, with starts, ends and truncations; some copies pause now and then."""
    environment = environments[name]
    own, reference = make_copies(environment, COUNT), GymnasiumCopies(environment, COUNT)
    assert type(own) is (ArrayCopies if name in CLASSIC else LanderCopies)
    both = own, reference
    for index in range(COUNT):
        for copies in both:
            copies.reset(index, seed=index)
    ended = truncated = 0
    for step, actions in enumerate(plan(environment, 1000)):
        going = np.flatnonzero((np.arange(COUNT) + step) % 50)
        found, expected = (copies.step(going, actions[going]) for copies in both)
        for one, other in zip(found, expected, strict=True):
            np.testing.assert_array_equal(one, other)
            assert one.dtype == other.dtype
        np.testing.assert_array_equal(own.observations, reference.observations)
        _, by_environment, by_limit = expected
        ended, truncated = ended + by_environment.sum(), truncated + by_limit.sum()
        for index in going[by_environment | by_limit].tolist():
            for copies in both:
                copies.reset(index, seed=1000 * step + index)
    assert ended > 0
    # Random actions keep neither a pole up for 500 steps nor a lander for 1000.
    assert truncated > 0 or name in ("cartpole", "lunarlander")


@pytest.mark.parametrize(
    ("name", "kind"), [("cartpole", ArrayCopies), ("lunarlander", LanderCopies)]
)
def test_an_episode_is_truncated_at_its_limit(
    environments: dict[str, Environment], name: str, kind: type[ArrayCopies | LanderCopies]
) -> None:
    copies = kind(replace(environments[name], max_episode_steps=3), 1)
    copies.reset(0, seed=0)
    only = np.zeros(1, dtype=np.int64)
    assert [copies.step(only, only)[2].item() for _ in range(3)] == [False, False, True]


@pytest.mark.parametrize(
    ("name", "changes", "count"),
    [
        ("mountaincar", {"vectorized": False}, COUNT),
        ("mountaincar", {"kwargs": {"goal_velocity": 0.04}}, COUNT),
        ("mountaincar", {}, 2),
        ("lunarlander", {"vectorized": False}, COUNT),
        ("lunarlander", {"kwargs": {"enable_wind": True}}, COUNT),
    ],
)
def test_others_are_gymnasiums_own(
    environments: dict[str, Environment], name: str, changes: dict[str, object], count: int
) -> None:
    environment = environments[name]
    changed = replace(environment, config=replace(environment.config, **changes))
    assert isinstance(make_copies(changed, count), GymnasiumCopies)
