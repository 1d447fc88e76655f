from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import same_color
from matplotlib.figure import Figure
from matplotlib.text import Text

from ril.report.figures.curves import learning_curves, stepwise
from ril.report.figures.style import INK, Reference, method_style
from ril.report.paper.tables import ENVIRONMENTS

REFERENCES = {env: Reference(-200.0, -100.0, -110.0) for env in ENVIRONMENTS}


def curve(evaluations: dict[int, list[tuple[int, float]]]) -> pd.DataFrame:
    """Evaluations of each seed: samples and return."""
    rows = [
        (seed, epoch, samples, aer)
        for seed, seen in evaluations.items()
        for epoch, (samples, aer) in enumerate(seen)
    ]
    return pd.DataFrame(rows, columns=["seed", "epoch", "samples", "aer"])


@pytest.fixture(scope="module")
def noisy() -> pd.DataFrame:
    """Three seeds with different numbers of evaluations, at different samples."""
    rng = np.random.default_rng(0)
    return curve(
        {
            seed: [(int(at), rng.normal()) for at in np.cumsum(rng.integers(1, 99, evaluations))]
            for seed, evaluations in enumerate((100, 60, 7))
        }
    )


@pytest.fixture(scope="module")
def figure() -> Figure:
    ril = curve({0: [(10, -190), (100, -120)], 1: [(20, -150), (50, -110), (90, -160)]})
    once = curve({0: [(50, -150)], 1: [(50, -170)]})
    bad = curve({0: [(30, -900), (60, -800)]})
    parts = {"RIL": ril, "IUPE": once, "ILPO": bad}
    frames = [part.assign(method=method, env="acrobot") for method, part in parts.items()]
    return learning_curves(pd.concat(frames), REFERENCES, {"acrobot": (16365, -79.52)})


def lines(figure: Figure, label: str) -> list[np.ndarray]:
    """Of all panels."""
    found = [line for axes in figure.axes for line in axes.lines if line.get_label() == label]
    return [np.asarray(line.get_xydata()) for line in found]


def test_a_grid_point_has_the_latest_evaluation(noisy: pd.DataFrame) -> None:
    for samples, row in stepwise(noisy).iterrows():
        for seed, value in row.items():
            seen = noisy[(noisy["seed"] == seed) & (noisy["samples"] <= samples)]
            assert value == seen["aer"].iloc[-1]


def test_the_grid_spans_from_where_all_seeds_are_evaluated_to_the_last_evaluation(
    noisy: pd.DataFrame,
) -> None:
    grid = stepwise(noisy).index
    firsts = noisy.groupby("seed")["samples"].min()
    assert firsts.max() <= grid[0] < 1.1 * firsts.max()
    assert grid[-1] == noisy["samples"].max()


def test_the_grid_is_even_on_a_log_axis(noisy: pd.DataFrame) -> None:
    steps = np.diff(np.log(stepwise(noisy).index))
    np.testing.assert_allclose(steps, steps[0])


def test_of_two_evaluations_at_one_number_of_samples_the_later_counts() -> None:
    assert stepwise(curve({0: [(5, -3.0), (9, -1.0), (9, -2.0)]}))[0].iloc[-1] == -2


def test_a_line_is_the_mean_over_seeds(figure: Figure) -> None:
    [line] = lines(figure, "RIL")
    np.testing.assert_array_equal(line[[0, -1], 1], [(-190 - 150) / 2, (-120 - 160) / 2])


def test_the_best_so_far_never_falls() -> None:
    falling = curve({0: [(10, -100), (100, -150), (200, -90)]}).assign(method="BC", env="acrobot")
    [line] = lines(learning_curves(falling, REFERENCES, {}, best_so_far=True), "BC")
    assert sorted(set(line[:, 1])) == [-100, -90]
    assert (np.diff(line[:, 1]) >= 0).all()


def test_a_band_holds_the_mean_and_no_more_than_the_seeds(figure: Figure) -> None:
    [line] = lines(figure, "RIL")
    color = method_style("RIL").color
    [band] = [
        band.get_paths()[0].vertices
        for band in figure.axes[1].collections
        if same_color(band.get_facecolor()[0][:3], color)
    ]
    at_end = band[band[:, 0] == line[-1, 0], 1]
    assert (at_end.min(), at_end.max()) == (-160, -120)  # of two seeds, these are the interval


def test_a_method_evaluated_once_is_a_marker(figure: Figure) -> None:
    [line] = lines(figure, "IUPE")
    np.testing.assert_array_equal(line, [[50, -160]])


def test_a_method_below_the_scale_is_named(figure: Figure) -> None:
    assert [text.get_text() for text in figure.axes[1].texts] == ["ILPO −800 ▾"]
    assert figure.axes[1].get_ylim()[0] == -215


@pytest.mark.parametrize("level", [-200, -100, -110])
def test_references_are_lines(figure: Figure, level: float) -> None:
    levels = [line.get_ydata() for line in figure.axes[1].lines if line.get_xdata()[0] == 0]
    assert [level, level] in [list(level) for level in levels]


def test_the_papers_point_is_a_star_in_its_panel(figure: Figure) -> None:
    stars = [
        (panel, line.get_xydata().tolist())
        for panel, axes in enumerate(figure.axes)
        for line in axes.lines
        if line.get_marker() == "*"
    ]
    assert stars == [(1, [[16365, -79.52]])]


def test_nothing_run_is_a_whole_figure() -> None:
    none = pd.DataFrame(columns=["method", "env", "seed", "epoch", "samples", "aer"])
    empty = learning_curves(none, REFERENCES, {"acrobot": (16365, -79.52)})
    empty.draw_without_rendering()
    assert len(empty.axes) == 4


def test_all_text_is_in_ink(figure: Figure) -> None:
    assert {text.get_color() for text in figure.findobj(Text)} == {INK}
