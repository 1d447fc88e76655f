"""Figures 5a and 5b: the limit of equation 2 on I^pos by epoch (§6.4)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ril.learners.goal_sampler import positive_limit
from ril.report.figures.style import SMALL, WIDTH, house_style, method_style

_EPOCHS = range(151)
_SLOPES = (1, 1.5, 2, 2.5, 3, 3.5, 4)
_LENGTHS = (37, 75, 112, 150)


@house_style()
def limits() -> Figure:
    """Draw equation 2 over 150 epochs: for each k at n = 150 (5a), for each n at k = 2 (5b)."""
    figure = Figure(
        (WIDTH, 2.6),
        layout="constrained",
        label="Equation 2's limit over 150 epochs, for k from 1 to 4 and for n from 37 to 150",
    )
    left, right = figure.subplots(1, 2, sharey=True)
    _draw(left, [(f"k = {k:g}", 150, k) for k in _SLOPES])
    left.set_title("a  by k, at n = 150", loc="left")
    left.set_ylabel("limit on the share of Iᵖᵒˢ")
    left.legend(loc="lower right", reverse=True, labelspacing=0.2, handlelength=1.5)
    _draw(right, [(f"n = {n}", n, 2) for n in _LENGTHS])
    for n in _LENGTHS:
        right.text(0.71 * n + 2, 0.83, f"n = {n}", fontsize=SMALL)
    right.set_title("b  by n, at k = 2", loc="left")
    return figure


def _draw(axes: Axes, settings: Sequence[tuple[str, float, float]]) -> None:
    """Draw a line per setting (name, n, k), the paper's choice in RIL's color."""
    for shade, (name, n, k) in zip(np.linspace(1, 0.5, len(settings)), settings, strict=True):
        chosen = (n, k) == (150, 2)
        axes.plot(
            _EPOCHS,
            [positive_limit(epoch, n, k) for epoch in _EPOCHS],
            color=method_style("RIL").color if chosen else method_style("DQN₂").color,
            alpha=1 if chosen else shade,
            lw=2 if chosen else 1.1,
            zorder=3 if chosen else 2,
            label=name,
        )
    axes.set(xlabel="epoch e", xlim=(0, 150), xticks=[0, *_LENGTHS], ylim=(0, 1.02))
    axes.grid()
