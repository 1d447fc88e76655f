"""The data of each figure, from our rows: the paper's figures, and some that it lacks."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass

import pandas as pd
from matplotlib.figure import Figure

from ril.io.errors import UserError
from ril.policy import load_policy
from ril.report import aggregates
from ril.report.evidence import Evidence, command
from ril.report.figures import mountaincar, statistics
from ril.report.figures.boxplots import boxplots
from ril.report.figures.curves import learning_curves
from ril.report.figures.limits import limits
from ril.report.figures.overview import THEMES, Line, Pair, Result, overview
from ril.report.figures.sensitivity import Point, sensitivity
from ril.report.figures.style import Reference
from ril.report.figures.variants import changes
from ril.report.findings import REFERENCES, Finding, find
from ril.report.mountaincar import DiscretePolicy, optimal_policy
from ril.report.paper.tables import (
    ENVIRONMENTS,
    Cell,
    Setting,
    main_setting,
    solved_return,
    table,
)
from ril.report.variants import variants


@dataclass(frozen=True)
class Drawing:
    """One figure.

    Attributes:
        name: the name of its files, and its anchor in the page.
        title: the title in words, with the paper's number if it has one.
        caption: below it.
        draw: draws it from our rows and a score ("best" or "last"); None without rows.
    """

    name: str
    title: str
    caption: str
    draw: Callable[[Evidence, str], Figure | None]


def _returns(method: str, evidence: Evidence) -> dict[str, float]:
    """Return our AER of Table 2's Random or Expert by environment; the paper's if not run."""
    returns = {}
    for cell in table("table2").cells():
        if cell.quantity == "aer" and cell.setting.method == method and cell.mean is not None:
            ours = find(cell, evidence).mean
            returns[cell.setting.env] = cell.mean if ours is None else ours
    return returns


def _references(evidence: Evidence) -> dict[str, Reference]:
    """Return the reference returns of each environment."""
    random, expert = _returns("Random", evidence), _returns("Expert", evidence)
    return {env: Reference(random[env], expert[env], solved_return(env)) for env in ENVIRONMENTS}


def overviews(evidence: Evidence) -> dict[str, str]:
    """Draw Table 2 at a glance, an SVG file per color theme."""
    shown = table("table2", evidence.beyond)
    pairs: dict[tuple[str, str, str], Pair] = {}
    for cell in shown.cells():
        place = cell.setting.method, cell.quantity, cell.setting.env
        pairs[place] = _ours(find(cell, evidence)), _papers(cell)
    methods = dict.fromkeys(method for method, _, _ in pairs if method not in REFERENCES)
    lines = [
        Line(
            method,
            [pairs[method, "aer", env] for env in ENVIRONMENTS],
            pairs[method, "performance", "average"],
        )
        for method in methods
    ]
    references = _references(evidence)
    panels = [(name, references[env]) for env, name in ENVIRONMENTS.items()]
    return {theme: overview(panels, lines, theme) for theme in THEMES}


def _ours(found: Finding) -> Result | None:
    """Return our mean and interval."""
    if found.mean is None:
        return None
    low, high = found.interval or (found.mean, found.mean)
    return Result(found.mean, low, high, bool(found.reduced))


def _papers(cell: Cell) -> Result | None:
    """Return the paper's mean and ±."""
    if cell.mean is None:
        return None
    return Result(cell.mean, cell.mean - (cell.std or 0), cell.mean + (cell.std or 0))


def _boxplots(evidence: Evidence, score: str) -> Figure:
    """Draw the methods of Table 4, and those beyond the paper."""
    ours: dict[str, dict[str, tuple[float, ...]]] = {}
    papers: dict[str, dict[str, tuple[float, float | None]]] = {}
    shown = table("table4", evidence.beyond)
    for cell in shown.cells():
        if cell.quantity == "aer":
            setting = cell.setting
            ours.setdefault(setting.method, {})[setting.env] = find(cell, evidence, score).values
            if cell.mean is not None:
                papers.setdefault(setting.method, {})[setting.env] = cell.mean, cell.std
    return boxplots(ours, papers, _references(evidence))


def _one_trajectory(evidence: Evidence) -> Iterator[Setting]:
    """Yield every method's main setting in every environment."""
    for method in aggregates.methods(evidence):
        for env in ENVIRONMENTS:
            yield main_setting(method, env)


def _curves(evidence: Evidence, score: str) -> Figure | None:
    frames = [
        evidence.curves_of(setting).assign(method=setting.method, env=setting.env)
        for setting in _one_trajectory(evidence)
    ]
    curves = pd.concat([frame for frame in frames if not frame.empty] or frames[:1])
    if curves.empty:
        return None
    samples, returns = (
        {
            cell.setting.env: cell.mean
            for cell in table(name).cells()
            if cell.quantity == quantity and cell.setting.method == "RIL" and cell.mean is not None
        }
        for name, quantity in (("table3", "samples_to_best"), ("table2", "aer"))
    )
    stars = {env: (samples[env], returns[env]) for env in ENVIRONMENTS}
    return learning_curves(curves, _references(evidence), stars, best_so_far=score == "best")


def _sensitivity(name: str, axis: str, words: str) -> Callable[[Evidence, str], Figure]:
    def draw(evidence: Evidence, score: str) -> Figure:
        experts = _returns("Expert", evidence)
        points = [
            Point(
                cell.setting.env,
                _position(cell, axis, experts),
                find(cell, evidence, score).values,
                cell.mean,
            )
            for cell in table(name).cells()
            if cell.quantity == "aer"
        ]
        return sensitivity(points, words)

    return draw


def _position(cell: Cell, axis: str, experts: Mapping[str, float]) -> float:
    """Return a cell's position on an axis; that of the usual expert is its own return."""
    value: float | None = getattr(cell.setting, axis)
    return experts[cell.setting.env] if value is None else value


def _aggregates(evidence: Evidence, score: str) -> Figure | None:
    found = aggregates.aggregates(aggregates.performances(evidence, score))
    return statistics.aggregates(found) if found else None


def _improvement(evidence: Evidence, score: str) -> Figure | None:
    found = aggregates.improvements(aggregates.performances(evidence, score))
    return statistics.improvement(found) if found else None


def _variants(evidence: Evidence, score: str) -> Figure | None:
    found = [each for each in variants(evidence, score) if each.keys and each.gains]
    return changes(found) if found else None


#: The policies of Table 1, by their titles in the paper's figures.
_POLICIES = {"RL (DQN₁)": "DQN₁", "IL (IUPE)": "IUPE", "RIL": "RIL"}


def _of_policies(
    draw: Callable[[mountaincar.Policies, mountaincar.Commands], Figure],
) -> Callable[[Evidence, str], Figure]:
    """Return a figure of the policies on MountainCar, each of its run's median seed."""

    def drawn(evidence: Evidence, score: str) -> Figure:
        policies: dict[str, DiscretePolicy | None] = {"π*": optimal_policy()}
        commands = {}
        for title, method in _POLICIES.items():
            setting = main_setting(method, "mountaincar")
            policies[title] = _median_policy(evidence.of_setting(setting), score)
            commands[title] = command([setting])
        return draw(policies, commands)

    return drawn


def _median_policy(rows: pd.DataFrame, score: str) -> DiscretePolicy | None:
    """Load the saved policy of the median seed; None without one."""
    if rows.empty:
        return None
    seed = mountaincar.representative_seed(rows)
    folder = rows.loc[rows["seed"] == seed, "folder"].iloc[0]
    try:
        return load_policy(folder / "policy.pt", seed, score)
    except UserError:
        return None


_MEDIAN = "Each learned policy is of the seed with the median return."
DRAWINGS: dict[str, tuple[Drawing, ...]] = {
    "figure2": (
        Drawing(
            "figure2",
            "Figure 2. Probability of the most likely action on MountainCar",
            f"By state, for an optimal policy π* and three learned policies. {_MEDIAN}",
            _of_policies(mountaincar.probability_meshes),
        ),
    ),
    "figure3": (
        Drawing(
            "figure3",
            "Figure 3. Agreement with an optimal policy on MountainCar",
            f"20 × 20 states, colored by action where it is that of π*. {_MEDIAN}",
            _of_policies(mountaincar.action_maps),
        ),
    ),
    "figure4": (
        Drawing(
            "figure4",
            "Figure 4. Returns of all methods",
            "Boxes show quartiles over seeds, dots show seeds. Imitation uses 100 trajectories, as "
            "in Table 4. The paper's boxes are most likely over episodes.",
            _boxplots,
        ),
    ),
    "figure5": (
        Drawing(
            "figure5ab",
            "Figure 5a, b. Equation 2: upper limit on the policy's own samples",
            "Over 150 epochs, for each k with n = 150, and for each n with k = 2.",
            lambda evidence, score: limits(),
        ),
        Drawing(
            "figure5c",
            "Figure 5c. Action probabilities along one trajectory on MountainCar",
            f"In the states of a trajectory of π*. {_MEDIAN}",
            _of_policies(mountaincar.action_distributions),
        ),
    ),
    "curves": (
        Drawing(
            "curves",
            "Learning curves",
            "Return of each seed's best evaluation so far (with --score last: its latest) against "
            "samples as counted in §5.2.2, from one expert trajectory or rewards alone: means over "
            "seeds with 95 % intervals. An evaluation has few episodes, and the best of many "
            "evaluations is biased upwards: lines may end above the tables' returns, which are "
            "measured on fresh episodes. The star is the paper's RIL.",
            _curves,
        ),
    ),
    "sensitivity": tuple(
        Drawing(
            f"sensitivity_{axis}",
            f"RIL by {words} (Table {number})",
            "Our means over seeds with 95 % intervals, seeds as dots, and the paper's means.",
            _sensitivity(f"table{number}", axis, words),
        )
        for number, axis, words in (
            (6, "trajectories", "number of expert trajectories"),
            (7, "k", "k of equation 2"),
            (8, "n", "n of equation 2"),
            (9, "expert_return", "return of the expert"),
        )
    ),
    "statistics": (
        Drawing(
            "aggregates",
            "Performance over all environments",
            "From one expert trajectory or rewards alone, for methods that are run on all four "
            "environments. The dashed line is the expert.",
            _aggregates,
        ),
        Drawing(
            "improvement",
            "Probability that RIL improves on each method",
            "Share of pairs of seeds in which RIL is better, averaged over environments.",
            _improvement,
        ),
    ),
    "variants": (
        Drawing(
            "variants",
            "Effect of each overridden key",
            "Performance P of runs with overridden keys minus that of the same seeds by default: "
            "means over seeds with 95 % intervals.",
            _variants,
        ),
    ),
}


def drawings(targets: Iterable[str]) -> Iterator[Drawing]:
    """Iterate over the figures of some targets."""
    return (drawing for name in targets for drawing in DRAWINGS.get(name, ()))
