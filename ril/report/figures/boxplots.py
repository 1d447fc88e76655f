"""Figure 4: how a method's returns spread over seeds, in each environment (§5.3)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import ArrayLike, NDArray

from ril.report.figures.style import INK, SMALL, WIDTH, Reference, house_style, look, name_rows
from ril.report.paper.tables import ENVIRONMENTS

Reported = tuple[float, float | None]  # the paper's mean and ±


@house_style()
def boxplots(
    ours: Mapping[str, Mapping[str, ArrayLike]],
    paper: Mapping[str, Mapping[str, Reported]],
    references: Mapping[str, Reference],
) -> Figure:
    """Draw AER of each method and environment over seeds, beside the paper's mean ± (Figure 4).

    A method without values in an environment is a row that says so. Values below an
    environment's `Reference.floor` are off the scale, and named at its edge.

    Args:
        ours: method → environment → (S,) AER of each seed; rows stand in this order.
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
            Line2D([], [], color=INK, ls=look("Random").line, lw=0.8, label="random"),
            Line2D([], [], color=INK, ls=look("Expert").line, lw=0.8, label="expert"),
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
    colours = [look(method).colour for method in methods]
    boxes = axes.boxplot(
        values,
        positions=at,
        orientation="horizontal",
        widths=0.42,
        patch_artist=True,
        showfliers=False,  # every seed is drawn as a dot anyway
        manage_ticks=False,
    )
    for part, per_box in (("boxes", 1), ("medians", 1), ("whiskers", 2), ("caps", 2)):
        for artist, colour in zip(boxes[part], np.repeat(colours, per_box), strict=True):
            artist.set_color(colour)
    for box, colour in zip(boxes["boxes"], colours, strict=True):
        box.set_facecolor((colour, 0.25))
    for median in boxes["medians"]:
        median.set_linewidth(2)
    sizes = [len(seeds) for seeds in values]
    row = np.repeat(at, sizes)
    spread = np.concatenate([np.linspace(-0.15, 0.15, size) for size in sizes])
    axes.scatter(
        np.concatenate(values), row + spread, s=5, c=np.repeat(colours, sizes), lw=0, zorder=3
    )
    means, spreads = np.array([(mean, spread or 0) for mean, spread in reported], dtype=float).T
    axes.errorbar(
        means,
        at + 0.36,
        xerr=spreads,
        fmt="d",
        color=INK,
        mfc="none",
        ms=3.5,
        mew=0.7,
        elinewidth=0.7,
    )
    axes.axvline(reference.random, color=INK, ls=look("Random").line, lw=0.8)
    axes.axvline(reference.expert, color=INK, ls=look("Expert").line, lw=0.8)

    drawn = np.array(
        [*np.concatenate(values), *means - spreads, *means + spreads, reference.expert]
    )
    low, high = max(np.nanmin(drawn), reference.floor), np.nanmax(drawn)
    margin = 0.04 * (high - low) or 1.0
    axes.set_xlim(low - margin, high + margin)
    edge = axes.get_yaxis_transform()  # x from 0 to 1, y in rows
    for y, (seeds, mean) in enumerate(zip(values, means, strict=True)):
        beyond = [f"seeds to {min(seeds):.0f}"] if seeds.size and min(seeds) < low else []
        beyond += [f"paper {mean:.0f}"] if mean < low else []
        if beyond:
            says = "◂ " + ", ".join(beyond).replace("-", "−")
            axes.text(0.01, y - 0.39, says, transform=edge, fontsize=SMALL, va="center")
        count = f"{seeds.size}" if seeds.size else "not run"
        axes.text(1.02, y, count, transform=edge, fontsize=SMALL, va="center")
    axes.text(1.02, -0.8, "seeds", transform=edge, fontsize=SMALL, va="center")
    name_rows(axes, methods)
