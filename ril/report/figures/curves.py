"""Learning curves, which the paper lacks: return against samples, by environment."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, NullFormatter
from scipy.stats import bootstrap

from ril.report.figures.style import INK, SMALL, WIDTH, Reference, house_style, method_style
from ril.report.paper.tables import ENVIRONMENTS

_POINTS = 100  # per line; more would be invisible


def stepwise(curve: pd.DataFrame) -> pd.DataFrame:
    """Align a method's seeds on one grid of samples, each at its latest evaluation.

    A seed that stopped early keeps its last evaluation. The grid begins where every seed has one.

    Args:
        curve: a row per evaluation: seed, epoch, samples, aer.

    Returns:
        A row per number of samples, equidistant on a log axis, and a column per seed.
    """
    ordered = curve.sort_values("epoch")
    evaluations = ordered.pivot_table(index="samples", columns="seed", values="aer", aggfunc="last")
    grid = np.unique(np.geomspace(evaluations.index.min(), evaluations.index.max(), _POINTS))
    return evaluations.ffill().reindex(grid, method="ffill").dropna()


@house_style()
def learning_curves(
    curves: pd.DataFrame,
    references: Mapping[str, Reference],
    paper: Mapping[str, tuple[float, float]],
    *,
    best_so_far: bool = False,
) -> Figure:
    """Draw the mean return over seeds against samples, with its 95 % bootstrap interval.

    Args:
        curves: a row per evaluation: method, env, seed, epoch, samples, aer.
        references: environment → returns that are drawn as lines.
        paper: environment → the paper's samples (Table 3) and AER (Table 2) of RIL, as a star.
        best_so_far: draw the best of a seed's evaluations so far instead of the latest.
    """
    figure = Figure(
        (WIDTH, 6.2),
        layout="constrained",
        label="Learning curves: return against samples, for each environment",
    )
    for axes, (env, title) in zip(figure.subplots(2, 2).flat, ENVIRONMENTS.items(), strict=True):
        for method, curve in curves[curves["env"] == env].groupby("method"):
            seeds = stepwise(curve)
            drawn = seeds.cummax() if best_so_far else seeds
            _draw(axes, str(method), drawn, references[env].floor)
        _measure(axes, references[env])
        if env in paper:
            axes.plot(*paper[env], zorder=6, **_PAPER)
        axes.set_title(title, loc="left")
    figure.supxlabel("samples", fontsize=8)
    which = "best evaluation so far" if best_so_far else "latest evaluation"
    figure.supylabel(f"return, {which}: mean over seeds, 95 % interval", fontsize=8)
    lines = {"random": _RANDOM, "expert": _EXPERT, "solved": _SOLVED, "RIL in the paper": _PAPER}
    ours = {method: _line(method) for method in dict.fromkeys(curves["method"])}
    figure.legend(
        handles=[Line2D([], [], label=name, **style) for name, style in (ours | lines).items()],
        loc="outside upper center",
        ncols=7,
    )
    return figure


_RANDOM: dict[str, Any] = {"color": INK, "lw": 0.8, "ls": method_style("Random").line}
_EXPERT = _RANDOM | {"ls": method_style("Expert").line}
_SOLVED = _RANDOM | {"ls": ":"}
_PAPER: dict[str, Any] = {
    "color": INK,
    "marker": "*",
    "ms": 9,
    "mfc": method_style("RIL").color,
    "ls": "",
}


def _line(method: str) -> dict[str, Any]:
    color, marker, line = method_style(method)
    width = 2.0 if method == "RIL" else 1.0
    return {"color": color, "marker": marker, "ls": line, "lw": width, "ms": 4.5}


def _draw(axes: Axes, method: str, seeds: pd.DataFrame, floor: float) -> None:
    mean, top = seeds.mean(axis=1), 4 if method == "RIL" else 3
    marked = [len(mean) // 3, 2 * len(mean) // 3, -1]  # markers distinguish lines in grayscale
    axes.plot(mean, markevery=marked, zorder=top, label=method, **_line(method))
    if seeds.shape[1] > 1:
        drawn = bootstrap((seeds,), np.mean, axis=1, method="percentile", n_resamples=999, rng=0)
        low, high = drawn.confidence_interval
        # A method with one evaluation has a band without width, so its edge must show.
        edge = 0.3 if len(seeds) > 1 else 2.0
        band: dict[str, Any] = {
            "color": method_style(method).color,
            "alpha": 0.12 if top == 3 else 0.25,
            "lw": edge,
        }
        axes.fill_between(seeds.index, low, high, zorder=top - 2, **band)
    if mean.iloc[-1] < floor:
        text = f"{method} {mean.iloc[-1]:.0f} ▾".replace("-", "−")
        place = (mean.index[-1], 0.01)
        axes.text(*place, text, transform=axes.get_xaxis_transform(), fontsize=SMALL, ha="center")


def _measure(axes: Axes, reference: Reference) -> None:
    axes.axhline(reference.random, **_RANDOM)
    axes.axhline(reference.expert, **_EXPERT)
    if reference.solved is not None:
        axes.axhline(reference.solved, **_SOLVED)
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.xaxis.set_minor_formatter(NullFormatter())
    low, high = axes.get_ylim()
    axes.set_ylim(max(low, reference.floor), high)
    axes.grid()
