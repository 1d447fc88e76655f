"""Policies in the states of MountainCar, compared with an optimal one (Figures 2, 3 and 5c)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from textwrap import fill
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import rc_context
from matplotlib.artist import Artist
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from ril.report.figures.style import INK, SMALL, WIDTH, house_style
from ril.report.mountaincar import (
    ACTIONS,
    STARTS,
    DiscretePolicy,
    agreement,
    cells,
    optimal_policy,
    play,
)

#: By action; they also differ in lightness.
COLORS = ("#0067a5", "#c46aa3", "#f4b63a")
_EPISODE: dict[str, Any] = {"color": INK, "linewidth": 0.8, "alpha": 0.7}
_MIDDLE = STARTS.mean(keepdims=True)

Policies = Mapping[str, DiscretePolicy | None]
Commands = Mapping[str, str]


def representative_seed(rows: pd.DataFrame) -> int:
    """Return the seed with the median AER; of an even number, the lower of the middle two."""
    return int(rows.sort_values("aer")["seed"].iloc[(len(rows) - 1) // 2])


@house_style()
@rc_context(
    {
        "axes.labelpad": 1.5,
        "axes3d.xaxis.panecolor": "none",
        "axes3d.yaxis.panecolor": "none",
        "axes3d.zaxis.panecolor": "none",
        "grid.color": f"{INK}30",  # grid.alpha has no effect on 3-D axes
    }
)
def probability_meshes(policies: Policies, commands: Commands) -> Figure:
    """Draw the probability of the most likely action over all states as 3-D meshes (Figure 2).

    Args:
        policies: by title; None where not run.
        commands: by title, to show where not run.
    """
    figure = _figure(
        "Probability of each policy's most likely action, by state of MountainCar", 5.8
    )
    axes = {
        "projection": "3d", "elev": 32, "azim": -125,
        "xlabel": "position", "xlim": (-1.2, 0.5), "xticks": (-1, -0.5, 0, 0.5),
        "ylabel": "velocity", "ylim": (-0.07, 0.07), "yticks": (-0.05, 0, 0.05),
        "zlabel": "probability", "zlim": (1 / 3, 1), "zticks": (0.4, 0.6, 0.8, 1),
    }  # fmt: skip
    states = cells(30)
    for ax, _, policy in _panels(figure.subplots(2, 2, subplot_kw=axes), policies, commands):
        probabilities = policy.probabilities(states.reshape(-1, 2)).reshape(30, 30, 3)
        ax.plot_surface(
            *np.moveaxis(states, -1, 0),
            probabilities.max(axis=-1),
            facecolors=np.array(COLORS)[probabilities.argmax(axis=-1)],
            rstride=1,
            cstride=1,
            edgecolor=INK,
            linewidth=0.15,
            shade=False,
        )
    return figure


@house_style()
def action_maps(policies: Policies, commands: Commands) -> Figure:
    """Draw greedy actions in 20 × 20 states, colored where they are those of π* (Figure 3).

    Args:
        policies: by title; None where not run.
        commands: by title, to show where not run.
    """
    label = "Greedy actions by state of MountainCar, colored where they are those of π*"
    other = Line2D(
        [], [], color=INK, marker=">", markersize=3, linestyle="", label="differs from π*"
    )
    episode = Line2D([], [], **_EPISODE, label="episode of π*")
    figure = _figure(label, 6.2, other, episode)
    axes = {"xlabel": "position", "ylabel": "velocity"}
    panels = figure.subplots(2, 2, sharex=True, sharey=True, subplot_kw=axes)
    states = cells()
    flat = states.reshape(-1, 2)
    _, path = play(optimal_policy(), _MIDDLE)
    for ax, title, policy in _panels(panels, policies, commands):
        actions, same = policy.predict(flat), agreement(policy, flat)
        ax.pcolormesh(
            *np.moveaxis(states, -1, 0),
            np.ma.array(actions, mask=~same).reshape(states.shape[:2]),
            cmap=ListedColormap(COLORS),
            vmin=-0.5,
            vmax=2.5,
            edgecolors=(INK, 0.2),
            linewidth=0.2,
        )
        for action, marker in enumerate("<o>"):
            others = flat[~same & (actions == action)].T
            ax.scatter(*others, s=9, c=INK, marker=marker, alpha=0.6, linewidth=0)
        ax.plot(*path.T, **_EPISODE)
        ax.set_title(f"{title}: {same.mean():.0%} agree")
    return figure


@house_style()
def action_distributions(policies: Policies, commands: Commands) -> Figure:
    """Draw action probabilities in the states of one episode of π* (Figure 5c).

    Args:
        policies: by title; None where not run.
        commands: by title, to show where not run.
    """
    figure = _figure("Probabilities of the actions along an episode of π*", 5.2)
    _, path = play(optimal_policy(), _MIDDLE)
    switches = np.flatnonzero(np.diff(optimal_policy().predict(path))) + 0.5
    axes = {
        "xlabel": "step of the episode (dashed: π* changes its action)",
        "xlim": (0, len(path) - 1),
        "ylabel": "probability",
        "ylim": (0, 1),
        "yticks": (0, 0.5, 1),
    }
    panels = figure.subplots(4, 1, sharex=True, sharey=True, subplot_kw=axes)
    for ax, _, policy in _panels(panels, policies, commands):
        shares = policy.probabilities(path).T
        ax.stackplot(np.arange(len(path)), shares, colors=COLORS, linewidth=0)
        ax.vlines(switches, 0, 1, INK, "--", linewidth=0.7)
    return figure


def _figure(label: str, height: float, *keys: Artist) -> Figure:
    """Create an empty figure with a legend of the actions and some more keys."""
    figure = Figure(figsize=(WIDTH, height), layout="constrained", label=label)
    patches = [Patch(color=color, label=name) for color, name in zip(COLORS, ACTIONS, strict=True)]
    figure.legend(handles=[*patches, *keys], loc="outside upper center", ncols=5)
    return figure


def _panels(
    panels: NDArray[Any], policies: Policies, commands: Commands
) -> Iterator[tuple[Any, str, DiscretePolicy]]:
    """Title a panel for each policy, label those not run, and yield the others to be drawn."""
    for ax, (title, policy) in zip(panels.flat, policies.items(), strict=True):
        ax.set_title(title)
        if policy is not None:
            yield ax, title, policy
            continue
        text = f"not run\n{fill(commands[title], 40)}"
        middle = {"xycoords": "axes fraction", "ha": "center", "va": "center"}
        ax.annotate(text, (0.5, 0.5), fontsize=SMALL, **middle)
