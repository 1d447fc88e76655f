"""Performance P of the methods over all four environments, and the probability that RIL leads."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ril.report.evidence import Evidence
from ril.report.findings import REFERENCES, find
from ril.report.layout import Grid
from ril.report.numbers import with_interval
from ril.report.paper.tables import ENVIRONMENTS, Cell, main_setting, table
from ril.report.statistics import Aggregate, aggregate, probability_of_improvement

Scores = dict[str, NDArray[np.float64]]  # performance P per seed, by environment


def methods(evidence: Evidence) -> list[str]:
    """List all learning methods: the paper's by its names, then those beyond it."""
    papers = [
        cell.setting.method
        for name in ("table2", "table4", "table5")
        for cell in table(name).cells()
        if cell.setting.method not in REFERENCES
    ]
    return list(dict.fromkeys([*papers, *evidence.beyond]))


def performances(evidence: Evidence, score: str) -> dict[str, Scores]:
    """Compute P of every method from one expert trajectory or rewards alone, where it is run.

    Args:
        evidence: our rows.
        score: which policy of each run counts: "best" or "last".
    """
    every: dict[str, Scores] = {}
    for method in methods(evidence):
        for env in ENVIRONMENTS:
            cell = Cell("table2", "performance", main_setting(method, env), None, None)
            found = find(cell, evidence, score)
            if found.values:
                every.setdefault(method, {})[env] = np.array(found.values)
    return every


def aggregates(every: dict[str, Scores]) -> dict[str, Aggregate]:
    """Aggregate the methods that are run on all four environments."""
    return {
        method: aggregate(scores)
        for method, scores in every.items()
        if len(scores) == len(ENVIRONMENTS)
    }


def improvements(every: dict[str, Scores]) -> dict[str, tuple[float, float, float]]:
    """Estimate the probability that RIL improves on each other method, where both are run."""
    if "RIL" not in every:
        return {}
    return {
        method: probability_of_improvement(every["RIL"], scores)
        for method, scores in every.items()
        if method != "RIL" and every["RIL"].keys() & scores.keys()
    }


def statistics_grid(every: dict[str, Scores]) -> Grid:
    """Lay out aggregates and probabilities as one table."""
    aggregated, improved = aggregates(every), improvements(every)
    body = []
    for method, scores in every.items():
        found = aggregated.get(method)
        parts = (
            (found.mean, found.median, found.iqm, found.optimality_gap) if found else (None,) * 4
        )
        seeds = [len(values) for values in scores.values()]
        count = str(seeds[0]) if len(set(seeds)) == 1 else f"{min(seeds)}–{max(seeds)}"
        texts = [
            "" if part is None else with_interval(part) for part in (*parts, improved.get(method))
        ]
        body.append([method, str(len(scores)), count, *texts])
    return Grid(
        "statistics",
        "Performance P from one expert trajectory or rewards alone, with 95 % intervals",
        1,
        [
            "Method",
            "Environments",
            "Seeds",
            "Mean",
            "Median",
            "IQM",
            "Optimality gap",
            "P(RIL > it)",
        ],
        body,
        ["aggregates need runs on all four environments"],
    )
