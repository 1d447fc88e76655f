from __future__ import annotations

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text

from ril.report.figures.sensitivity import Point, sensitivity
from ril.report.figures.style import INK
from ril.report.statistics import mean_interval

SEEDS = [-100.0, -104.0, -99.0]


@pytest.fixture(scope="module")
def figure() -> Figure:
    points = [
        Point("mountaincar", 3, [-120.0], -109.2),
        Point("mountaincar", 1, SEEDS, -150.3),
        Point("mountaincar", 2, [], -100.29),
        Point("mountaincar", 4, (-130.0, -131.0), None),
        Point("acrobot", 1, [], -81.84),
    ]
    return sensitivity(points, "k of equation 2")


def test_a_panel_per_environment_that_has_points(figure: Figure) -> None:
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["Acrobot", "MountainCar"]


def test_our_line_is_of_means_with_a_gap_where_nothing_was_run(figure: Figure) -> None:
    [bars] = figure.axes[1].containers
    np.testing.assert_array_equal(bars.lines[0].get_xdata(), [1, 2, 3, 4])
    np.testing.assert_array_equal(bars.lines[0].get_ydata(), [-101, np.nan, -120, -130.5])


def test_a_bar_is_the_95_percent_interval(figure: Figure) -> None:
    [bars] = figure.axes[1].containers
    low, high = bars.lines[2][0].get_segments()[0][:, 1]
    assert (low, high) == pytest.approx(mean_interval(np.array(SEEDS)))


def test_every_seed_is_a_dot(figure: Figure) -> None:
    [dots] = [line for line in figure.axes[1].lines if line.get_linestyle() == "None"][:1]
    np.testing.assert_array_equal(dots.get_xdata(), [1, 1, 1, 3, 4, 4])
    np.testing.assert_array_equal(dots.get_ydata(), [*SEEDS, -120, -130, -131])


def test_the_papers_line_has_a_gap_where_it_reports_nothing(figure: Figure) -> None:
    [paper] = [line for line in figure.axes[1].lines if line.get_color() == INK]
    np.testing.assert_array_equal(paper.get_ydata(), [-150.3, -100.29, -109.2, np.nan])


def test_all_text_is_in_ink(figure: Figure) -> None:
    assert {text.get_color() for text in figure.findobj(Text)} == {INK}
