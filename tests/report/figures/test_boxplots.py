from __future__ import annotations

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text

from ril.report.figures.boxplots import boxplots
from ril.report.figures.style import INK, Reference, method_style
from ril.report.paper.tables import ENVIRONMENTS

OURS = {
    "BC": {"acrobot": [-90.0, -110.0, -95.0], "lunarlander": [10.0, -900.0, -50.0]},
    "ILPO": {"lunarlander": [-700.0, -600.0, -650.0, -800.0]},
    "RIL": {"acrobot": (-80.0, -82.0, -84.0, -100.0), "lunarlander": ()},
}
PAPER = {"RIL": {"acrobot": (-79.5, 4.5)}, "ILPO": {"lunarlander": (-451.8, 247.5)}}
REFERENCES = {env: Reference(-500.0, -85.0) for env in ENVIRONMENTS} | {
    "lunarlander": Reference(-200.0, 200.0)
}


@pytest.fixture(scope="module")
def figure() -> Figure:
    return boxplots(OURS, PAPER, REFERENCES)


def panel(figure: Figure, title: str) -> Axes:
    [found] = [axes for axes in figure.axes if axes.get_title(loc="left") == title]
    return found


def texts(axes: Axes) -> list[str]:
    return [text.get_text() for text in axes.texts]


def test_a_panel_per_environment(figure: Figure) -> None:
    assert [axes.get_title(loc="left") for axes in figure.axes] == list(ENVIRONMENTS.values())


@pytest.mark.parametrize(("method", "median"), [("BC", -95.0), ("RIL", -83.0)])
def test_the_line_in_a_box_is_the_median(figure: Figure, method: str, median: float) -> None:
    row = list(OURS).index(method)
    [found] = [
        line
        for line in panel(figure, "Acrobot").lines
        if line.get_linewidth() == 2 and np.mean(line.get_ydata()) == row
    ]
    assert list(found.get_xdata()) == [median, median]
    assert found.get_color() == method_style(method).color


def test_a_box_spans_the_quartiles(figure: Figure) -> None:
    box = panel(figure, "Acrobot").patches[0].get_path().vertices[:-1]
    assert (box[:, 0].min(), box[:, 0].max()) == (-102.5, -92.5)


def test_every_seed_is_a_dot_in_its_row(figure: Figure) -> None:
    dots = np.asarray(panel(figure, "Acrobot").collections[0].get_offsets())
    np.testing.assert_array_equal(dots[:, 0], [-90, -110, -95, -80, -82, -84, -100])
    np.testing.assert_array_equal(np.round(dots[:, 1]), [0, 0, 0, 2, 2, 2, 2])


def test_the_papers_mean_and_std_are_in_its_row(figure: Figure) -> None:
    [(mean, bars)] = [
        (container.lines[0], container.lines[2][0])
        for container in panel(figure, "Acrobot").containers
    ]
    np.testing.assert_array_equal(mean.get_xdata(), [np.nan, np.nan, -79.5])
    assert mean.get_color() == INK
    np.testing.assert_array_equal(bars.get_segments()[-1][:, 0], [-84, -75])


def test_the_number_of_seeds_is_in_each_row(figure: Figure) -> None:
    assert texts(panel(figure, "Acrobot")) == ["3", "not run", "4", "seeds"]


def test_a_value_below_the_scale_is_named(figure: Figure) -> None:
    lander = panel(figure, "LunarLander")
    assert texts(lander) == [
        "◂ seeds to −900",
        "3",
        "◂ seeds to −800, paper −452",
        "4",
        "not run",
        "seeds",
    ]
    low, high = lander.get_xlim()
    assert -300 < low < -260 < 200 < high


def test_the_scale_fits_the_drawn_values(figure: Figure) -> None:
    low, high = panel(figure, "Acrobot").get_xlim()
    assert -112 < low < -110 < -75 < high < -73


def test_random_and_expert_are_lines(figure: Figure) -> None:
    lines = [list(line.get_xdata()) for line in panel(figure, "MountainCar").lines]
    assert [-500, -500] in lines
    assert [-85, -85] in lines


def test_rows_are_in_order_from_the_top(figure: Figure) -> None:
    axes = figure.axes[0]
    assert [label.get_text() for label in axes.get_yticklabels()] == list(OURS)
    assert axes.yaxis_inverted()


def test_nothing_run_is_a_whole_figure() -> None:
    empty = boxplots({method: {} for method in OURS}, {}, REFERENCES)
    assert texts(empty.axes[0]) == ["not run"] * 3 + ["seeds"]
    empty.draw_without_rendering()


def test_all_text_is_in_ink(figure: Figure) -> None:
    assert {text.get_color() for text in figure.findobj(Text)} == {INK}
