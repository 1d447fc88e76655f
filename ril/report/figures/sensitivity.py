"""RIL's return by one of its settings: Tables 6 to 9 as plots (§6.3, §6.4, §7)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike

from ril.report.figures.style import INK, WIDTH, house_style, method_style
from ril.report.paper.tables import ENVIRONMENTS
from ril.report.statistics import mean_interval


class Point(NamedTuple):
    """RIL in one environment at one value of the setting.

    Attributes:
        env: the value of `env=`.
        x: the setting's value.
        ours: (S,) AER of each seed; empty where not run.
        paper: the paper's AER; None where it reports none.
    """

    env: str
    x: float
    ours: ArrayLike
    paper: float | None


@house_style()
def sensitivity(points: Iterable[Point], setting: str) -> Figure:
    """Draw RIL's AER against a setting, ours and the paper's, in a panel per environment.

    Points that are not run, or not in the paper, are gaps in the lines.

    Args:
        points: the points in any order; an environment without points gets no panel.
        setting: the label of x.
    """
    given = sorted(points, key=lambda point: point.x)
    panels = [env for env in ENVIRONMENTS if any(point.env == env for point in given)]
    figure = Figure(
        (WIDTH, 2.1), layout="constrained", label=f"Average episodic reward of RIL by {setting}"
    )
    for axes, env in zip(figure.subplots(1, len(panels), squeeze=False).flat, panels, strict=True):
        _draw(axes, [point for point in given if point.env == env])
        axes.set_title(ENVIRONMENTS[env], loc="left")
    figure.supxlabel(setting, fontsize=8)
    figure.supylabel("AER", fontsize=8)
    color, marker, line = method_style("RIL")
    figure.legend(
        handles=[
            Line2D(
                [], [], color=color, marker=marker, ls=line, label="ours, mean and 95 % interval"
            ),
            Line2D(
                [],
                [],
                color=color,
                marker="o",
                ms=2.5,
                mew=0,
                ls="",
                alpha=0.45,
                label="our seeds",
            ),
            Line2D([], [], label="paper", **_PAPER),
        ],
        loc="outside upper center",
        ncols=3,
    )
    return figure


_PAPER: dict[str, Any] = {
    "color": INK,
    "marker": "d",
    "mfc": "none",
    "mew": 0.7,
    "lw": 0.8,
    "ls": "--",
}


def _draw(axes: Axes, points: list[Point]) -> None:
    color, marker, line = method_style("RIL")
    x = np.array([point.x for point in points])
    ours = [np.asarray(point.ours, dtype=float) for point in points]
    means = np.array([seeds.mean() if seeds.size else np.nan for seeds in ours])
    bounds = np.array([mean_interval(seeds) or (np.nan, np.nan) for seeds in ours])
    axes.plot(x, [np.nan if p.paper is None else p.paper for p in points], zorder=5, **_PAPER)
    axes.plot(
        np.repeat(x, [seeds.size for seeds in ours]),
        np.concatenate(ours),
        color=color,
        alpha=0.45,
        marker="o",
        ms=2.5,
        mew=0,
        ls="",
        zorder=3,
    )
    axes.errorbar(
        x,
        means,
        np.abs(bounds.T - means),
        color=color,
        marker=marker,
        ls=line,
        elinewidth=0.9,
        capsize=2.5,
        zorder=4,
    )
    axes.grid()
