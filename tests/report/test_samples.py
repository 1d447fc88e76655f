from __future__ import annotations

import pandas as pd
from hypothesis import given
from hypothesis import strategies as st

from ril.report.samples import samples_to_best, samples_to_solved

LOOKS = st.lists(
    st.tuples(st.integers(0, 2), st.integers(1, 50), st.sampled_from([-200.0, -110.0, -90.0])),
    unique_by=lambda look: look[:2],
    min_size=1,
)


def curve(looks: list[tuple[int, int, float]]) -> pd.DataFrame:
    """Looks (seed, epoch, aer) with 100 samples an epoch."""
    frame = pd.DataFrame(looks, columns=["seed", "epoch", "aer"])
    return frame.assign(run_id="a", samples=frame["epoch"] * 100)


@given(LOOKS)
def test_samples_to_best_by_a_plain_loop(looks: list[tuple[int, int, float]]) -> None:
    best: dict[int, tuple[float, int]] = {}
    for seed, epoch, aer in sorted(looks, key=lambda look: look[1]):
        if seed not in best or aer > best[seed][0]:
            best[seed] = aer, epoch * 100
    found = samples_to_best(curve(looks)).to_dict()
    assert found == {seed: samples for seed, (_, samples) in best.items()}


@given(LOOKS)
def test_samples_to_solved_by_a_plain_loop(looks: list[tuple[int, int, float]]) -> None:
    solved: dict[int, int] = {}
    for seed, epoch, aer in sorted(looks, key=lambda look: look[1]):
        if aer >= -110:
            solved.setdefault(seed, epoch * 100)
    assert samples_to_solved(curve(looks), "mountaincar").to_dict() == solved
