"""A number of the paper beside ours: what we measured, how sure we are, and a verdict."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from ril.io.errors import UserError
from ril.report.evidence import Evidence, command, shortfall
from ril.report.paper.tables import ENVIRONMENTS, Cell, Setting, table
from ril.report.samples import samples_to_best, samples_to_solved
from ril.report.statistics import average_interval, mean_interval

Values = NDArray[np.float64]

#: Half of the last digit that the paper prints, by quantity.
_ROUNDING = {
    "reward": 0.5,
    "samples_to_best": 0.5,
    "expert_samples": 0.5,
    "divergence": 5e-5,
    "greedy_divergence": 5e-5,
}
_MORE_IS_BETTER = ("aer", "performance", "reward")
#: Not learnt, so a difference from the paper's is one of the set-up.
REFERENCES = ("Random", "Expert", "π*")
VERDICTS = ("matches", "better", "worse", "not run")


@dataclass(frozen=True)
class Finding:
    """What our rows say of one cell.

    Attributes:
        cell: the paper's number and its setting.
        values: ours, one per seed (of an average, one per environment).
        mean: of the values; None if there are none.
        spread: standard deviation of the values; of an average, over environments, as the paper's.
        interval: 95 % bootstrap interval of the mean over seeds; None for a single one.
        verdict: one of `VERDICTS`; "" where the paper has no number, or ours is of the set-up, or
            of a run that is shorter than the paper's number of samples.
        short: in what fewer than the paper's, in words: "3 of 10 seeds".
        aside: which runs of the same setting do not count here, in words.
        command: what fills the cell, or would again.
        run_ids: of the runs whose rows these are.
    """

    cell: Cell
    values: tuple[float, ...] = ()
    mean: float | None = None
    spread: float | None = None
    interval: tuple[float, float] | None = None
    verdict: str = "not run"
    short: tuple[str, ...] = ()
    aside: tuple[str, ...] = ()
    command: str = ""
    run_ids: tuple[str, ...] = ()

    @property
    def counts(self) -> bool:
        """Whether the headline counts it: P repeats AER, and references are not learnt."""
        return (
            self.verdict != ""
            and self.cell.mean is not None
            and self.cell.quantity in ("aer", "samples_to_best")
            and self.cell.setting.method not in REFERENCES
        )


def find(cell: Cell, evidence: Evidence, score: str = "best") -> Finding:
    """What the rows say of one cell.

    Args:
        cell: of the paper.
        evidence: our rows.
        score: of each run's "best" or "last" policy.
    """
    if cell.setting.env == "average":
        return _average(cell, evidence, score)
    if cell.table == "table1":
        return _on_mountaincar(cell, evidence, score)
    rows = evidence.of_setting(cell.setting)
    fills, aside = command([cell.setting]), _aside(cell.setting, rows, evidence)
    if rows.empty:
        return Finding(cell, aside=aside, command=fills)
    known: dict[str, Any] = {
        "short": shortfall(rows, table(cell.table), cell.setting.method),
        "aside": aside,
        "command": fills,
        "run_ids": tuple(rows["run_id"].unique()),
    }
    values = _values(cell, rows, evidence, score)
    if not len(values):  # no seed ever got there
        return Finding(cell, verdict="" if cell.mean is None else "worse", **known)
    if cell.quantity == "samples_to_best" and _most_samples(rows) < (cell.mean or 0):
        known["short"] += ("too short for the paper's number of samples",)
        return replace(_measured(cell, values, **known), verdict="")
    return _measured(cell, values, **known)


def _most_samples(rows: pd.DataFrame) -> float:
    """Samples of the seed that has most, at its end."""
    return float((rows["env_samples"] + rows["expert_samples"]).max())


def _measured(cell: Cell, values: Values, **known: Any) -> Finding:
    """A cell with a value per seed."""
    mean, interval = float(values.mean()), mean_interval(values)
    found = verdict(cell, mean, interval)
    return Finding(
        cell, tuple(values.tolist()), mean, float(values.std()), interval, found, **known
    )


def _on_mountaincar(cell: Cell, evidence: Evidence, score: str) -> Finding:
    """A cell of Table 1, from saved policies."""
    from ril.report import mountaincar  # here: tables of rows need no torch

    if cell.setting.method == "π*":
        optimal = mountaincar.measures(mountaincar.optimal_policy())
        return _measured(cell, np.array([getattr(optimal, cell.quantity)]))
    rows = evidence.of_setting(cell.setting)
    fills = command([cell.setting])
    if rows.empty:
        return Finding(cell, command=fills)
    try:
        measured = mountaincar.divergences(rows, score)
    except UserError as error:  # rows are kept without policies
        return Finding(cell, aside=(str(error),), command=fills)
    return _measured(
        cell,
        measured[cell.quantity].to_numpy(),
        short=shortfall(rows, table(cell.table), cell.setting.method),
        command=fills,
        run_ids=tuple(rows["run_id"].unique()),
    )


def _aside(setting: Setting, rows: pd.DataFrame, evidence: Evidence) -> tuple[str, ...]:
    """Which runs of a setting are not among its reported rows, in words."""
    said = []
    shown, runs = rows["run_id"].nunique(), evidence.matching(setting)["run_id"].nunique()
    if shown < runs:
        said.append(f"{shown} of {runs} runs shown, the fullest")
    if apart := evidence.matching(setting, variants=True)["run_id"].nunique():
        said.append(f"{apart} {'run' if apart == 1 else 'runs'} with keys set apart left out")
    return tuple(said)


def verdict(cell: Cell, mean: float, interval: tuple[float, float] | None) -> str:
    """Whether our mean matches the paper's number, or is better or worse.

    It matches if the paper's number lies in our interval, or ours within the paper's ±; both
    up to the paper's rounding. More return is better; fewer samples and less divergence are.
    """
    is_set_up = cell.quantity == "expert_samples" or cell.setting.method in REFERENCES
    if cell.mean is None or is_set_up:
        return ""
    rounding = _ROUNDING.get(cell.quantity, 5e-3)
    low, high = interval or (mean, mean)
    in_ours = low - rounding <= cell.mean <= high + rounding
    in_theirs = abs(mean - cell.mean) <= (cell.spread or 0.0) + rounding
    if in_ours or in_theirs:
        return "matches"
    return "better" if (mean > cell.mean) == (cell.quantity in _MORE_IS_BETTER) else "worse"


def _values(cell: Cell, rows: pd.DataFrame, evidence: Evidence, score: str) -> Values:
    """A value per seed."""
    aer = rows["aer"] if score == "best" else rows["aer_last"]
    match cell.quantity:
        case "aer":
            values = aer
        case "performance":
            random, expert = rows["random_return"], rows["expert_return_measured"]
            values = (aer - random) / (expert - random)
        case "expert_samples":
            values = rows["expert_samples"] / rows["epochs"]
        case "samples_to_best":
            values = samples_to_best(evidence.curves_of(cell.setting))
        case "samples_to_solved" | "all_samples_to_solved":
            values = samples_to_solved(evidence.curves_of(cell.setting), cell.setting.env)
            if cell.quantity == "all_samples_to_solved":
                values = values + rows.set_index("seed")["pre_samples"].loc[values.index]
        case other:
            raise ValueError(other)
    return values.to_numpy(dtype=np.float64)


def _average(cell: Cell, evidence: Evidence, score: str) -> Finding:
    """Of the mean performance over the four environments, once all of them are run."""
    parts = [
        find(Cell(cell.table, "performance", _in(cell.setting, env), None, None), evidence, score)
        for env in ENVIRONMENTS
    ]
    if missing := [part.cell.setting for part in parts if part.mean is None]:
        return Finding(cell, command=command(missing))
    means = np.array([part.mean for part in parts])
    short = sum(bool(part.short) for part in parts)
    mean = float(means.mean())
    interval = average_interval([np.array(part.values) for part in parts])
    return Finding(
        cell,
        tuple(means.tolist()),
        mean,
        float(means.std(ddof=1)),
        interval,
        verdict(cell, mean, interval),
        short=(f"fewer seeds or steps in {short} of 4 environments",) if short else (),
        command=command(part.cell.setting for part in parts),
        run_ids=tuple(run_id for part in parts for run_id in part.run_ids),
    )


def _in(setting: Setting, env: str) -> Setting:
    return replace(setting, env=env)
