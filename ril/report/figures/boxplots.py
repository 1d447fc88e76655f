"""Figure 4: the distribution of returns over seeds, by method and environment (§5.3)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import ArrayLike, NDArray

from ril.report.figures.style import (
    INK,
    SMALL,
    WIDTH,
    Reference,
    house_style,
    method_style,
    name_rows,
)
from ril.report.paper.tables import ENVIRONMENTS

Reported = tuple[float, float | None]  # the paper's mean and ±


@house_style()
def boxplots(
    ours: Mapping[str, Mapping[str, ArrayLike]],
    paper: Mapping[str, Mapping[str, Reported]],
    references: Mapping[str, Reference],
) -> Figure:
    """Draw box plots of AER over seeds, and the paper's mean and ± (Figure 4).

    A method without values in an environment is marked as not run. Values below
    `Reference.floor` are written at the edge.

    Args:
        ours: method → environment → (S,) AER of each seed; rows keep this order.
        paper: method → environment → the paper's mean and ±.
        references: environment → returns that are drawn as lines.
    """
    rows = 0.24 * len(ours) + 0.45
    figure = Figure(
        (WIDTH, 2 * rows + 0.5),
        layout="constrained",
        label="Box plots of the average episodic reward of each method in each environment",
    )
    panels = figure.subplots(2, 2, sharey=True).flat
    for axes, (env, title) in zip(panels, ENVIRONMENTS.items(), strict=True):
        values = [np.asarray(by_env.get(env, []), dtype=float) for by_env in ours.values()]
        reported = [paper.get(method, {}).get(env, (np.nan, None)) for method in ours]
        _draw(axes, tuple(ours), values, reported, references[env])
        axes.set_title(title, loc="left")
    figure.supxlabel("average episodic reward (AER)", fontsize=8)
    figure.legend(
        handles=[
            Patch(facecolor="#8888", edgecolor="#888", label="our quartiles"),
            Line2D([], [], color="#888", marker="o", markersize=2.5, ls="", label="our seeds"),
            Line2D([], [], color=INK, marker="d", mfc="none", lw=0.8, label="paper, mean ±"),
            Line2D([], [], color=INK, ls=method_style("Random").line, lw=0.8, label="random"),
            Line2D([], [], color=INK, ls=method_style("Expert").line, lw=0.8, label="expert"),
        ],
        loc="outside upper center",
        ncols=5,
    )
    return figure


def _draw(
    axes: Axes,
    methods: Sequence[str],
    values: Sequence[NDArray[np.float64]],
    reported: Sequence[Reported],
    reference: Reference,
) -> None:
    at = np.arange(len(methods))
    colors = [method_style(method).color for method in methods]
    boxes = axes.boxplot(
        values,
        positions=at,
        orientation="horizontal",
        widths=0.42,
        patch_artist=True,
        showfliers=False,  # dots show every seed
        manage_ticks=False,
    )
    for part, per_box in (("boxes", 1), ("medians", 1), ("whiskers", 2), ("caps", 2)):
        for artist, color in zip(boxes[part], np.repeat(colors, per_box), strict=True):
            artist.set_color(color)
    for box, color in zip(boxes["boxes"], colors, strict=True):
        box.set_facecolor((color, 0.25))
    for median in boxes["medians"]:
        median.set_linewidth(2)
    sizes = [len(seeds) for seeds in values]
    row = np.repeat(at, sizes)
    offset = np.concatenate([np.linspace(-0.15, 0.15, size) for size in sizes])
    axes.scatter(
        np.concatenate(values), row + offset, s=5, c=np.repeat(colors, sizes), lw=0, zorder=3
    )
    means, stds = np.array([(mean, std or 0) for mean, std in reported], dtype=float).T
    axes.errorbar(
        means,
        at + 0.36,
        xerr=stds,
        fmt="d",
        color=INK,
        mfc="none",
        ms=3.5,
        mew=0.7,
        elinewidth=0.7,
    )
    axes.axvline(reference.random, color=INK, ls=method_style("Random").line, lw=0.8)
    axes.axvline(reference.expert, color=INK, ls=method_style("Expert").line, lw=0.8)

    drawn = np.array([*np.concatenate(values), *means - stds, *means + stds, reference.expert])
    low, high = max(np.nanmin(drawn), reference.floor), np.nanmax(drawn)
    margin = 0.04 * (high - low) or 1.0
    axes.set_xlim(low - margin, high + margin)
    edge = axes.get_yaxis_transform()  # x from 0 to 1, y in rows
    for y, (seeds, mean) in enumerate(zip(values, means, strict=True)):
        beyond = [f"seeds to {min(seeds):.0f}"] if seeds.size and min(seeds) < low else []
        beyond += [f"paper {mean:.0f}"] if mean < low else []
        if beyond:
            text = "◂ " + ", ".join(beyond).replace("-", "−")
            axes.text(0.01, y - 0.39, text, transform=edge, fontsize=SMALL, va="center")
        count = f"{seeds.size}" if seeds.size else "not run"
        axes.text(1.02, y, count, transform=edge, fontsize=SMALL, va="center")
    axes.text(1.02, -0.8, "seeds", transform=edge, fontsize=SMALL, va="center")
    name_rows(axes, methods)
