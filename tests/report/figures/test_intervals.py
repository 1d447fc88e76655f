from __future__ import annotations

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text

from ril.report.figures.statistics import aggregates, improvement
from ril.report.figures.style import INK, method_style
from ril.report.statistics import Aggregate

BY_METHOD = {
    "BC": Aggregate((0.9, 0.8, 1.0), (0.8, 0.7, 0.9), (0.7, 0.6, 0.8), (0.1, 0.05, 0.2)),
    "RIL": Aggregate((1.1, 1.0, 1.2), (1.0, 0.9, 1.1), (0.9, 0.8, 1.0), (0.0, 0.0, 0.0)),
}
AGGREGATES = aggregates(BY_METHOD)
BETTER = {"BC": (0.7, 0.6, 0.85), "ILPO": (1.0, 1.0, 1.0)}
IMPROVEMENT = improvement(BETTER)


def rows(axes: Axes) -> list[tuple[float, float, float]]:
    """Each row's marker and the ends of its bar, from the top."""
    marks = [line.get_xdata()[0] for line in axes.lines if line.get_marker() != "None"]
    bars = [(bar.get_x(), bar.get_x() + bar.get_width()) for bar in axes.patches]
    return [(marker, *bar) for marker, bar in zip(marks, bars, strict=True)]


@pytest.mark.parametrize(
    ("panel", "measure"), list(enumerate(("mean", "median", "iqm", "optimality_gap")))
)
def test_a_panel_shows_a_measure(panel: int, measure: str) -> None:
    expected = [getattr(aggregate, measure) for aggregate in BY_METHOD.values()]
    np.testing.assert_allclose(rows(AGGREGATES.axes[panel]), expected)


def test_a_probability_is_shown_per_method() -> None:
    np.testing.assert_allclose(rows(IMPROVEMENT.axes[0]), list(BETTER.values()))


def test_even_odds_are_a_line() -> None:
    lines = [list(line.get_xdata()) for line in IMPROVEMENT.axes[0].lines]
    assert [0.5, 0.5] in lines


def test_a_method_has_its_own_marker() -> None:
    marks = [line for line in IMPROVEMENT.axes[0].lines if line.get_marker() != "None"]
    assert [(marker.get_color(), marker.get_marker()) for marker in marks] == [
        (method_style(method).color, method_style(method).marker) for method in BETTER
    ]


def test_no_bar_touches_the_frame() -> None:
    for axes in AGGREGATES.axes:
        low, high = axes.get_xlim()
        assert all(
            low < bar.get_x() and bar.get_x() + bar.get_width() < high for bar in axes.patches
        )


def test_a_method_without_an_interval_is_a_marker_alone() -> None:
    sure = improvement({"BC": (0.7, np.nan, np.nan)})
    sure.draw_without_rendering()
    np.testing.assert_array_equal(rows(sure.axes[0]), [(0.7, np.nan, np.nan)])


@pytest.mark.parametrize("figure", [AGGREGATES, IMPROVEMENT])
def test_all_text_is_in_ink(figure: Figure) -> None:
    assert {text.get_color() for text in figure.findobj(Text)} == {INK}


def test_nothing_run_is_a_whole_figure() -> None:
    for figure in (aggregates({}), improvement({})):
        figure.draw_without_rendering()
        assert all(not rows(axes) for axes in figure.axes)
