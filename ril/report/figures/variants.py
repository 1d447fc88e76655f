"""Effect of overridden keys on performance: a row per variant, a panel per environment."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.figure import Figure

from ril.report.figures.style import INK, WIDTH, house_style, method_style, name_rows
from ril.report.paper.tables import ENVIRONMENTS
from ril.report.variants import Variant


@house_style()
def changes(found: Sequence[Variant]) -> Figure:
    """Draw the change in P against the method's default configuration.

    Args:
        found: variants, from the top; blank in environments where not run.
    """
    several = len({variant.method for variant in found}) > 1
    names = [f"{v.method}: {_short(v.keys)}" if several else _short(v.keys) for v in found]
    panels = [env for env in ENVIRONMENTS if any(env in variant.gains for variant in found)]
    figure = Figure(
        (WIDTH, 0.17 * len(found) + 0.75),
        layout="constrained",
        label="Change in performance P by variant and environment, with 95 % intervals",
    )
    shared = figure.subplots(1, len(panels), sharey=True, squeeze=False)
    for axes, env in zip(shared.flat, panels, strict=True):
        axes.use_sticky_edges = False  # keeps bars off the frame
        for y, variant in enumerate(found):
            if env not in variant.gains:
                continue
            value, low, high = variant.gain(env)
            color, marker, _ = method_style(variant.method)
            axes.barh(y, high - low, left=low, height=0.5, color=color, alpha=0.45)
            axes.plot(value, y, color=color, marker=marker, ms=4)
        axes.axvline(0, color=INK, ls="--", lw=0.8)
        axes.set_title(ENVIRONMENTS[env], loc="left")
        name_rows(axes, names)
        axes.locator_params(axis="x", nbins=4)  # keeps long numbers apart
    figure.supxlabel("change in performance P", fontsize=8)
    return figure


def _short(keys: str) -> str:
    """Drop the group that almost all keys have."""
    return " ".join(key.removeprefix("method.") for key in keys.split(" "))
