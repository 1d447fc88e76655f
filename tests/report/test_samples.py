from __future__ import annotations

import gymnasium as gym
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ril.environments.environment import Environment
from ril.report.samples import THRESHOLDS, samples_to_best, samples_to_threshold

EVALUATIONS = st.lists(
    st.tuples(st.integers(0, 2), st.integers(1, 50), st.sampled_from([-200.0, -110.0, -90.0])),
    unique_by=lambda each: each[:2],
    min_size=1,
)


def curve(evaluations: list[tuple[int, int, float]]) -> pd.DataFrame:
    """Evaluations (seed, epoch, aer) with 100 samples per epoch."""
    frame = pd.DataFrame(evaluations, columns=["seed", "epoch", "aer"])
    return frame.assign(run_id="a", samples=frame["epoch"] * 100)


@given(EVALUATIONS)
def test_samples_to_best_by_a_plain_loop(evaluations: list[tuple[int, int, float]]) -> None:
    best: dict[int, tuple[float, int]] = {}
    for seed, epoch, aer in sorted(evaluations, key=lambda each: each[1]):
        if seed not in best or aer > best[seed][0]:
            best[seed] = aer, epoch * 100
    found = samples_to_best(curve(evaluations)).to_dict()
    assert found == {seed: samples for seed, (_, samples) in best.items()}


@given(EVALUATIONS)
def test_samples_to_a_threshold_by_a_plain_loop(evaluations: list[tuple[int, int, float]]) -> None:
    solved: dict[int, int] = {}
    for seed, epoch, aer in sorted(evaluations, key=lambda each: each[1]):
        if aer >= -110:
            solved.setdefault(seed, epoch * 100)
    assert samples_to_threshold(curve(evaluations), -110).to_dict() == solved


@pytest.mark.parametrize("env", THRESHOLDS)
def test_thresholds_are_gymnasiums(environments: dict[str, Environment], env: str) -> None:
    assert gym.spec(environments[env].config.id).reward_threshold == THRESHOLDS[env]
