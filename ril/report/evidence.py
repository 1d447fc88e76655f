"""The rows on disk that belong to a setting of the paper, and the command that produces them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from ril.io.ended import Ended, load_ended
from ril.io.rows import load_curves, load_results
from ril.report.paper.tables import Setting, Table, known_methods

TUNING_SEEDS = 100  # settings are tuned on seeds from here up, which are not reported

_AXES = ("trajectories", "k", "n", "expert_return")


@dataclass(frozen=True)
class Evidence:
    """The rows and learning curves of some folders of runs.

    Attributes:
        rows: a row per run and seed with the fields of `ril.io.rows.Row` and the run's `folder`;
            reported seeds only, default and overridden configurations alike.
        curves: a row per evaluation during training: run_id, seed, epoch, samples, aer.
        skipped: files and lines that could not be used, a line each.
        ended: runs that ended without rows.
    """

    rows: pd.DataFrame
    curves: pd.DataFrame
    skipped: tuple[str, ...] = ()
    ended: tuple[Ended, ...] = ()

    @classmethod
    def of(cls, folders: Sequence[Path]) -> Evidence:
        """Read all runs below some folders."""
        rows, bad_rows = load_results(folders)
        rows = rows[rows["seed"] < TUNING_SEEDS].reset_index(drop=True)
        curves, bad_curves = load_curves(rows)
        ended, bad_ended = load_ended(folders)
        finished = set(rows["run_id"])  # beside them, with resume=false
        reported = [
            run for run in ended if min(run.seeds) < TUNING_SEEDS and run.run_id not in finished
        ]
        return cls(rows, curves, (*bad_rows, *bad_curves, *bad_ended), tuple(reported))

    @property
    def beyond(self) -> tuple[str, ...]:
        """Methods among the rows that are not in the paper."""
        return tuple(sorted(set(self.rows["method"]) - known_methods()))

    @cached_property
    def _places(self) -> dict[tuple[Any, ...], NDArray[np.int64]]:
        """Positions of rows by method, environment, variant or not, and values of `_AXES`."""
        is_variant = self.rows["variant"] != ""
        axes = (self.rows[axis] for axis in _AXES)
        keys = [self.rows["method"], self.rows["env"], is_variant, *axes]
        return cast(dict[tuple[Any, ...], Any], self.rows.groupby(keys, dropna=False).indices)

    @cached_property
    def _reported(self) -> dict[Setting, pd.DataFrame]:
        """Rows by setting, since several tables and figures use the same ones."""
        return {}

    def matching(self, setting: Setting, *, variants: bool = False) -> pd.DataFrame:
        """Return all rows of a setting, whatever their budget.

        Args:
            setting: its `expert_return` None matches the usual expert only; of the other fields,
                rows match that have the same value or, as their method has no such key, none.
            variants: return runs with overridden keys instead of the default configuration.
        """
        method, level = (setting.method_key, setting.env, variants), setting.expert_return
        numbers = (setting.trajectories, setting.k, setting.n)
        fitting = [
            at
            for (*of, trajectories, k, n, expert_return), at in self._places.items()
            if tuple(of) == method
            and (pd.isna(expert_return) if level is None else expert_return == level)
            and all(
                pd.isna(x) or x == y for x, y in zip((trajectories, k, n), numbers, strict=True)
            )
        ]
        return self.rows.iloc[np.sort(np.concatenate([np.empty(0, np.int64), *fitting]))]

    def ended_of(self, setting: Setting) -> list[Ended]:
        """Return the runs of a setting that ended without rows."""
        of = setting.method_key, setting.env, "", setting.expert_return
        numbers = setting.trajectories, setting.k, setting.n
        return [
            run
            for run in self.ended
            if (run.method, run.env, run.variant, run.expert_return) == of
            and all(
                x is None or x == y
                for x, y in zip((run.trajectories, run.k, run.n), numbers, strict=True)
            )
        ]

    def of_setting(self, setting: Setting) -> pd.DataFrame:
        """Return the rows reported for a setting, one per seed; empty if there are none."""
        if setting not in self._reported:
            self._reported[setting] = largest_group(self.matching(setting))
        return self._reported[setting]

    def curves_of(self, setting: Setting) -> pd.DataFrame:
        """Return the curves of the rows reported for a setting, ordered by seed and epoch."""
        return self.curves.merge(self.of_setting(setting)[["run_id", "seed"]])


def largest_group(rows: pd.DataFrame) -> pd.DataFrame:
    """Select, of several runs of one setting, those of one budget that have the most seeds.

    Of budgets with equally many seeds the longest is selected; of a seed that was run twice, the
    newer row. Without rows the result is empty.
    """
    if rows.empty:
        return rows
    budget = budgets(rows)
    seeds = rows.groupby(budget)["seed"].nunique().sort_index()
    chosen = seeds[seeds == seeds.max()].index[-1]
    together: pd.DataFrame = rows[budget == chosen].drop_duplicates("seed", keep="last")
    return together.sort_values("seed")


def budgets(rows: pd.DataFrame) -> pd.Series:
    """Return the training budget of each row's run: (total_timesteps, epochs)."""
    found = rows.groupby("run_id")[["total_timesteps", "epochs"]].transform("max").fillna(0)
    return pd.Series(list(found.itertuples(index=False, name=None)), rows.index, dtype=object)


def reductions(rows: pd.DataFrame, table: Table, method: str) -> tuple[str, ...]:
    """Say where rows have fewer seeds or a smaller budget than the paper: "3 of 10 seeds".

    Args:
        rows: the rows of one setting.
        table: the table of the paper, with its number of seeds and its budgets.
        method: by the paper's name; one beyond the paper is compared with RIL's budget.
    """
    is_beyond = rows["method"].iloc[0] not in known_methods()
    budget = table.budget.get("RIL" if is_beyond else method, {})
    names = dict.fromkeys(("env_samples", "total_timesteps"), "environment steps")
    found = []
    for what, full in {"seeds": table.seeds, **budget}.items():
        have = len(rows) if what == "seeds" else int(rows[what].fillna(0).min())
        if have < full:
            found.append(f"{have:,} of {full:,} {names.get(what, what)}")
    return tuple(found)


def command(settings: Iterable[Setting]) -> str:
    """Return the command that runs some settings of one method, as a sweep if they are several."""
    several = list(settings)
    parts = ["ril-run", f"env={_joined(s.env for s in several)}"]
    parts.append(f"method={_joined(s.method_key for s in several)}")
    defaults = {"trajectories": 1, "k": 2, "n": 150, "expert_return": None}
    for key, default in defaults.items():
        values = [getattr(s, key) for s in several]
        if any(value not in (default, None) for value in values):
            shown = ("null" if value is None else f"{value:g}" for value in values)
            parts.append(f"ablation.{key}={_joined(shown)}")
    if any("," in part for part in parts):
        parts.insert(1, "-m")
    return " ".join(parts)


def _joined(values: Iterable[str]) -> str:
    return ",".join(dict.fromkeys(values))
