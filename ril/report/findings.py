"""A number of the paper compared with ours: mean, interval and verdict."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from ril.io.errors import UserError
from ril.report.evidence import Evidence, command, reductions
from ril.report.paper.tables import ENVIRONMENTS, Cell, Setting, solved_return, table
from ril.report.samples import samples_to_best, samples_to_threshold
from ril.report.statistics import average_interval, mean_interval

Values = NDArray[np.float64]

#: Half a unit of the last digit that the paper prints, by quantity.
_ROUNDING = {
    "reward": 0.5,
    "samples_to_best": 0.5,
    "expert_samples": 0.5,
    "divergence": 5e-5,
    "greedy_divergence": 5e-5,
}
_MORE_IS_BETTER = ("aer", "performance", "reward")
#: Measured rather than learned: they get no verdict.
REFERENCES = ("Random", "Expert", "π*")
VERDICTS = ("matches", "better", "worse", "not run")
#: Verdicts have signs, so that color is never the only cue.
SIGNS = {"matches": "✓", "better": "▲", "worse": "▼", "not run": "○", "": "–"}


@dataclass(frozen=True)
class Finding:
    """Our result for one cell.

    Attributes:
        cell: the paper's number and its setting.
        values: one per seed; one per environment for an average.
        mean: mean of the values; None without any.
        std: standard deviation of the values, divided by their number; of an average that of a
            sample, over environments, as in the paper.
        interval: 95 % bootstrap interval of the mean over seeds; None for a single seed.
        verdict: one of `VERDICTS`; "" where the paper has no number, where ours is measured
            rather than learned, or where a run is shorter than the paper's number of samples.
        reduced: what the paper has more of, in words: "3 of 10 seeds".
        excluded: runs of the same setting that do not count, in words.
        command: the command that produces the rows.
        run_ids: the `run_id`s of the rows.
    """

    cell: Cell
    values: tuple[float, ...] = ()
    mean: float | None = None
    std: float | None = None
    interval: tuple[float, float] | None = None
    verdict: str = "not run"
    reduced: tuple[str, ...] = ()
    excluded: tuple[str, ...] = ()
    command: str = ""
    run_ids: tuple[str, ...] = ()

    @property
    def counts(self) -> bool:
        """Whether the headline counts it: P repeats AER, and references are not learned."""
        return (
            self.verdict != ""
            and self.cell.mean is not None
            and self.cell.quantity in ("aer", "samples_to_best")
            and self.cell.setting.method not in REFERENCES
        )


def find(cell: Cell, evidence: Evidence, score: str = "best") -> Finding:
    """Compare one cell with the rows.

    Args:
        cell: the cell of the paper.
        evidence: our rows.
        score: which policy of each run counts: "best" or "last".
    """
    if cell.setting.env == "average":
        return _average(cell, evidence, score)
    if cell.table == "table1":
        return _on_mountaincar(cell, evidence, score)
    rows = evidence.of_setting(cell.setting)
    to_run, excluded = command([cell.setting]), _excluded(cell.setting, rows, evidence)
    if rows.empty:
        return Finding(cell, excluded=excluded, command=to_run)
    known: dict[str, Any] = {
        "reduced": reductions(rows, table(cell.table), cell.setting.method),
        "excluded": excluded,
        "command": to_run,
        "run_ids": tuple(rows["run_id"].unique()),
    }
    values = _values(cell, rows, evidence, score)
    if not len(values):  # no seed reached the threshold
        return Finding(cell, verdict="" if cell.mean is None else "worse", **known)
    if cell.quantity == "samples_to_best" and _most_samples(rows) < (cell.mean or 0):
        known["reduced"] += ("shorter than the paper's number of samples",)
        return replace(_measured(cell, values, **known), verdict="")
    return _measured(cell, values, **known)


def _most_samples(rows: pd.DataFrame) -> float:
    """Return the samples of the seed that used most."""
    return float((rows["env_samples"] + rows["expert_samples"]).max())


def _measured(cell: Cell, values: Values, **known: Any) -> Finding:
    """Judge a cell that has a value per seed."""
    mean, interval = float(values.mean()), mean_interval(values)
    found = verdict(cell, mean, interval)
    return Finding(
        cell, tuple(values.tolist()), mean, float(values.std()), interval, found, **known
    )


def _on_mountaincar(cell: Cell, evidence: Evidence, score: str) -> Finding:
    """Measure a cell of Table 1 on saved policies."""
    from ril.report import mountaincar  # only Table 1 needs torch

    if cell.setting.method == "π*":
        optimal = mountaincar.measures(mountaincar.optimal_policy())
        return _measured(cell, np.array([getattr(optimal, cell.quantity)]))
    rows = evidence.of_setting(cell.setting)
    to_run = command([cell.setting])
    if rows.empty:
        return Finding(cell, command=to_run)
    try:
        measured = mountaincar.divergences(rows, score)
    except UserError as error:  # rows may be kept without policies
        return Finding(cell, excluded=(str(error),), command=to_run)
    return _measured(
        cell,
        measured[cell.quantity].to_numpy(),
        reduced=reductions(rows, table(cell.table), cell.setting.method),
        command=to_run,
        run_ids=tuple(rows["run_id"].unique()),
    )


def _excluded(setting: Setting, rows: pd.DataFrame, evidence: Evidence) -> tuple[str, ...]:
    """Say which runs of a setting are not among its reported rows."""
    found = []
    used, runs = rows["run_id"].nunique(), evidence.matching(setting)["run_id"].nunique()
    if used < runs:
        found.append(f"{used} of {runs} runs used, those of the budget with the most seeds")
    if variants := evidence.matching(setting, variants=True)["run_id"].nunique():
        found.append(f"{variants} run{'s' * (variants > 1)} with overridden keys excluded")
    found += dict.fromkeys(run.why for run in evidence.ended_of(setting))
    return tuple(found)


def verdict(cell: Cell, mean: float, interval: tuple[float, float] | None) -> str:
    """Judge whether our mean matches the paper's number, or is better or worse.

    It matches if the paper's number lies in our interval or our mean within the paper's ±, up to
    the paper's rounding. Better is a higher return, fewer samples or a smaller divergence.
    """
    is_measured = cell.quantity == "expert_samples" or cell.setting.method in REFERENCES
    if cell.mean is None or is_measured:
        return ""
    rounding = _ROUNDING.get(cell.quantity, 5e-3)
    low, high = interval or (mean, mean)
    in_ours = low - rounding <= cell.mean <= high + rounding
    in_theirs = abs(mean - cell.mean) <= (cell.std or 0.0) + rounding
    if in_ours or in_theirs:
        return "matches"
    return "better" if (mean > cell.mean) == (cell.quantity in _MORE_IS_BETTER) else "worse"


def _values(cell: Cell, rows: pd.DataFrame, evidence: Evidence, score: str) -> Values:
    """Return a value per seed; thresholds only have seeds that reach them."""
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
            values = samples_to_threshold(
                evidence.curves_of(cell.setting), solved_return(cell.setting.env)
            )
            if cell.quantity == "all_samples_to_solved":
                values = values + rows.set_index("seed")["pre_samples"].loc[values.index]
        case other:
            raise ValueError(other)
    return values.to_numpy(dtype=np.float64)


def _average(cell: Cell, evidence: Evidence, score: str) -> Finding:
    """Average performance over the four environments, once all of them are run."""
    parts = [
        find(Cell(cell.table, "performance", _in(cell.setting, env), None, None), evidence, score)
        for env in ENVIRONMENTS
    ]
    if missing := [part.cell.setting for part in parts if part.mean is None]:
        return Finding(cell, command=command(missing))
    means = np.array([part.mean for part in parts])
    reduced = sum(bool(part.reduced) for part in parts)
    mean = float(means.mean())
    interval = average_interval([np.array(part.values) for part in parts])
    return Finding(
        cell,
        tuple(means.tolist()),
        mean,
        float(means.std(ddof=1)),
        interval,
        verdict(cell, mean, interval),
        reduced=(f"fewer seeds or steps in {reduced} of 4 environments",) if reduced else (),
        command=command(part.cell.setting for part in parts),
        run_ids=tuple(run_id for part in parts for run_id in part.run_ids),
    )


def _in(setting: Setting, env: str) -> Setting:
    return replace(setting, env=env)
