"""Aggregate performance over all environments, and the probability that RIL is better."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ril.report.figures.style import INK, WIDTH, house_style, method_style, name_rows
from ril.report.statistics import Aggregate, Estimate

_MEASURES = {
    "mean": "mean P",
    "median": "median P",
    "iqm": "interquartile mean P",
    "optimality_gap": "optimality gap",
}


@house_style()
def aggregates(by_method: Mapping[str, Aggregate]) -> Figure:
    """Draw mean, median, interquartile mean and optimality gap of performance P, per method.

    Args:
        by_method: method → its aggregates over environments and seeds, each with a 95 %
            interval; rows keep this order.
    """
    figure = Figure(
        (WIDTH, 0.19 * len(by_method) + 0.75),
        layout="constrained",
        label="Aggregate performance of each method, with 95 % intervals",
    )
    panels = figure.subplots(1, len(_MEASURES), sharey=True)
    for axes, (measure, title) in zip(panels, _MEASURES.items(), strict=True):
        estimates = [getattr(aggregate, measure) for aggregate in by_method.values()]
        _draw(axes, tuple(by_method), estimates)
        axes.axvline(0 if measure == "optimality_gap" else 1, color=INK, ls="--", lw=0.8)
        axes.set_xlabel(title)
    return figure


@house_style()
def improvement(by_method: Mapping[str, Estimate]) -> Figure:
    """Draw the probability that a seed of RIL is better than one of another method.

    Args:
        by_method: other method → the probability and its 95 % interval; rows keep this order.
    """
    figure = Figure(
        (WIDTH, 0.19 * len(by_method) + 0.75),
        layout="constrained",
        label="Probability that RIL improves on each method, with 95 % intervals",
    )
    axes = figure.subplots()
    _draw(axes, tuple(by_method), list(by_method.values()))
    axes.axvline(0.5, color=INK, ls="--", lw=0.8)
    axes.set(xlabel="probability that RIL is better than the method", xlim=(-0.02, 1.02))
    return figure


def _draw(axes: Axes, methods: Sequence[str], estimates: Sequence[Estimate]) -> None:
    """Draw a row per method: a bar over the interval, and a marker at the value."""
    at = np.arange(len(methods))
    colors = [method_style(method).color for method in methods]
    values, lows, highs = np.array(estimates, dtype=float).reshape(-1, 3).T
    axes.use_sticky_edges = False  # keeps bars off the frame
    axes.barh(at, highs - lows, left=lows, height=0.5, color=colors, alpha=0.45)
    for y, value, method in zip(at, values, methods, strict=True):
        axes.plot(
            value, y, color=method_style(method).color, marker=method_style(method).marker, ms=5
        )
    name_rows(axes, methods)
