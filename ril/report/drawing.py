"""What our rows give to each figure: the paper's, and those that it lacks."""

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
from ril.report.figures.sensitivity import Point, sensitivity
from ril.report.figures.style import Reference
from ril.report.figures.variants import changes
from ril.report.findings import find
from ril.report.mountaincar import DiscretePolicy, optimal_policy
from ril.report.paper.tables import ENVIRONMENTS, Cell, Setting, solved_return, table
from ril.report.variants import variants


@dataclass(frozen=True)
class Drawing:
    """One figure.

    Attributes:
        name: of its files and its place in the page.
        title: what it is, with the paper's number if it has one.
        caption: what is seen in it.
        draw: makes it from our rows and a score ("best" or "last"); None without any to draw.
    """

    name: str
    title: str
    caption: str
    draw: Callable[[Evidence, str], Figure | None]


def _returns(method: str, evidence: Evidence) -> dict[str, float]:
    """Ours of Table 2's Random or Expert by environment; the paper's where it is not run."""
    returns = {}
    for cell in table("table2").cells():
        if cell.quantity == "aer" and cell.setting.method == method and cell.mean is not None:
            ours = find(cell, evidence).mean
            returns[cell.setting.env] = cell.mean if ours is None else ours
    return returns


def _references(evidence: Evidence) -> dict[str, Reference]:
    """What returns are measured against in each environment."""
    random, expert = _returns("Random", evidence), _returns("Expert", evidence)
    return {env: Reference(random[env], expert[env], solved_return(env)) for env in ENVIRONMENTS}


def _boxplots(evidence: Evidence, score: str) -> Figure:
    """Table 4's methods, and those of one trajectory beside them."""
    ours: dict[str, dict[str, tuple[float, ...]]] = {}
    papers: dict[str, dict[str, tuple[float, float | None]]] = {}
    shown = table("table4", evidence.beyond)
    for cell in shown.cells():
        if cell.quantity == "aer":
            setting = cell.setting
            ours.setdefault(setting.method, {})[setting.env] = find(cell, evidence, score).values
            if cell.mean is not None:
                papers.setdefault(setting.method, {})[setting.env] = cell.mean, cell.spread
    return boxplots(ours, papers, _references(evidence))


def _one_trajectory(evidence: Evidence) -> Iterator[Setting]:
    """Every method in every environment, from one expert trajectory or rewards alone."""
    for method in aggregates.methods(evidence):
        for env in ENVIRONMENTS:
            yield Setting(method, env, trajectories=1, k=2, n=150)


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
        usual = _returns("Expert", evidence)
        points = [
            Point(
                cell.setting.env,
                _position(cell, axis, usual),
                find(cell, evidence, score).values,
                cell.mean,
            )
            for cell in table(name).cells()
            if cell.quantity == "aer"
        ]
        return sensitivity(points, words)

    return draw


def _position(cell: Cell, axis: str, usual: Mapping[str, float]) -> float:
    """Where a cell stands on an axis; the usual expert at its own return."""
    value: float | None = getattr(cell.setting, axis)
    return usual[cell.setting.env] if value is None else value


def _aggregates(evidence: Evidence, score: str) -> Figure | None:
    over_all = aggregates.aggregates(aggregates.performances(evidence, score))
    return statistics.aggregates(over_all) if over_all else None


def _improvement(evidence: Evidence, score: str) -> Figure | None:
    ahead = aggregates.improvements(aggregates.performances(evidence, score))
    return statistics.improvement(ahead) if ahead else None


def _variants(evidence: Evidence, score: str) -> Figure | None:
    apart = [each for each in variants(evidence, score) if each.keys and each.gains]
    return changes(apart) if apart else None


#: The policies of Table 1 by their titles in the paper.
_POLICIES = {"RL (DQN₁)": "DQN₁", "IL (IUPE)": "IUPE", "RIL": "RIL"}


def _of_policies(
    draw: Callable[[mountaincar.Policies, mountaincar.Commands], Figure],
) -> Callable[[Evidence, str], Figure]:
    """A figure of the policies on MountainCar, each of the run's median seed."""

    def drawn(evidence: Evidence, score: str) -> Figure:
        policies: dict[str, DiscretePolicy | None] = {"π*": optimal_policy()}
        commands = {}
        for title, method in _POLICIES.items():
            setting = Setting(method, "mountaincar", trajectories=1, k=2, n=150)
            policies[title] = _median_policy(evidence.of_setting(setting), score)
            commands[title] = command([setting])
        return draw(policies, commands)

    return drawn


def _median_policy(rows: pd.DataFrame, score: str) -> DiscretePolicy | None:
    """The saved policy of the median seed; None without one."""
    if rows.empty:
        return None
    seed = mountaincar.representative_seed(rows)
    folder = rows.loc[rows["seed"] == seed, "folder"].iloc[0]
    try:
        return load_policy(folder / "policy.pt", seed, score)
    except UserError:
        return None


_MEDIAN = "Of each method the seed whose return is its run's median."
DRAWINGS: dict[str, tuple[Drawing, ...]] = {
    "figure2": (
        Drawing(
            "figure2",
            "Figure 2. Probability of the likeliest action on MountainCar",
            f"By state, for an optimal policy π* and three learnt ones. {_MEDIAN}",
            _of_policies(mountaincar.probability_meshes),
        ),
    ),
    "figure3": (
        Drawing(
            "figure3",
            "Figure 3. Where policies act as an optimal one does on MountainCar",
            f"20 × 20 states, coloured by action where it is π*'s. {_MEDIAN}",
            _of_policies(mountaincar.action_maps),
        ),
    ),
    "figure4": (
        Drawing(
            "figure4",
            "Figure 4. Returns of all methods",
            "Boxes are quartiles over seeds, dots the seeds; imitation from 100 trajectories, as "
            "in Table 4. The paper's boxes are most likely over episodes.",
            _boxplots,
        ),
    ),
    "figure5": (
        Drawing(
            "figure5ab",
            "Figure 5a, b. Equation 2: the upper limit of the policy's own samples",
            "By k with n = 150, and by n with k = 2, over 150 epochs.",
            lambda evidence, score: limits(),
        ),
        Drawing(
            "figure5c",
            "Figure 5c. Action probabilities along one trajectory on MountainCar",
            f"The states of π*'s trajectory, for every policy. {_MEDIAN}",
            _of_policies(mountaincar.action_distributions),
        ),
    ),
    "curves": (
        Drawing(
            "curves",
            "Learning curves",
            "Return of each seed's best look so far (with --score last, of its last) against "
            "samples as §5.2.2 counts them, from one expert trajectory or rewards alone; means "
            "over seeds and their 95 % intervals. A look is of few episodes and the best of many "
            "is lucky, so lines may end above the tables' returns, which are of fresh episodes. "
            "The star is what the paper says of RIL.",
            _curves,
        ),
    ),
    "sensitivity": tuple(
        Drawing(
            f"sensitivity_{axis}",
            f"RIL by {words} (Table {number})",
            "Means over seeds with 95 % intervals, seeds as dots, beside the paper's means.",
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
            "From one expert trajectory or rewards alone; only of methods that are run on all "
            "four environments. The line is the expert's.",
            _aggregates,
        ),
        Drawing(
            "improvement",
            "Probability that RIL improves on each method",
            "Mean over environments of the share of pairs of seeds in which RIL's is better.",
            _improvement,
        ),
    ),
    "variants": (
        Drawing(
            "variants",
            "What each key changes",
            "Performance P of runs with keys set apart less that of the same seeds of the method "
            "as it comes; means over seeds and their 95 % intervals.",
            _variants,
        ),
    ),
}


def drawings(targets: Iterable[str]) -> Iterator[Drawing]:
    """The figures among what is asked for."""
    return (drawing for name in targets for drawing in DRAWINGS.get(name, ()))
