"""The rows on disk that speak for a setting of the paper, and the command that makes them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from ril.io.rows import load_curves, load_results
from ril.report.paper.tables import Setting, Table, known_methods

TUNING_SEEDS = 100  # settings are chosen on seeds from here up, which are not reported on
#: Methods that see no expert: its trajectories are not theirs to vary.
_WITHOUT_EXPERT = ("dqn", "dqn_prioritized", "ppo", "acktr")

_AXES = ("trajectories", "k", "n", "expert_return")


@dataclass(frozen=True)
class Evidence:
    """What some folders of runs hold.

    Attributes:
        rows: a row per run and seed, as `results.Row` has them, and the run's `folder`; of
            reported seeds only, the method as it comes or not.
        curves: a row per look at a policy while it trained: run_id, seed, epoch, samples, aer.
        left_out: what was found and not used, a line each.
    """

    rows: pd.DataFrame
    curves: pd.DataFrame
    left_out: tuple[str, ...] = ()

    @classmethod
    def of(cls, folders: Sequence[Path]) -> Evidence:
        """Read all runs below some folders."""
        rows, bad_rows = load_results(folders)
        rows = rows[rows["seed"] < TUNING_SEEDS].reset_index(drop=True)
        curves, bad_curves = load_curves(rows)
        return cls(rows, curves, (*bad_rows, *bad_curves))

    @property
    def beyond(self) -> tuple[str, ...]:
        """Methods among the rows that the paper does not have."""
        return tuple(sorted(set(self.rows["method"]) - known_methods()))

    @cached_property
    def _places(self) -> dict[tuple[Any, ...], NDArray[np.int64]]:
        """Positions of rows by method, environment, variant or not, and values of `_AXES`."""
        apart = self.rows["variant"] != ""
        keys = [self.rows["method"], self.rows["env"], apart, *(self.rows[axis] for axis in _AXES)]
        return cast(dict[tuple[Any, ...], Any], self.rows.groupby(keys, dropna=False).indices)

    def matching(self, setting: Setting, *, variants: bool = False) -> pd.DataFrame:
        """All rows that were run in a setting, of runs of any length.

        Args:
            setting: what to look for; None in it fits the usual expert, or anything.
            variants: those with keys set apart instead of the method as it comes.
        """
        method, level = (setting.method_key, setting.env, variants), setting.expert_return
        numbers = (setting.trajectories, setting.k, setting.n)
        fitting = [
            at
            for (*of, trajectories, k, n, expert_return), at in self._places.items()
            if tuple(of) == method
            and (pd.isna(expert_return) if level is None else expert_return == level)
            # Empty where a method has no such thing.
            and all(
                pd.isna(x) or x == y for x, y in zip((trajectories, k, n), numbers, strict=True)
            )
        ]
        return self.rows.iloc[np.sort(np.concatenate([np.empty(0, np.int64), *fitting]))]

    def of_setting(self, setting: Setting) -> pd.DataFrame:
        """The rows that are reported of a setting, a row per seed; empty if there are none."""
        return fullest(self.matching(setting))

    def curves_of(self, setting: Setting) -> pd.DataFrame:
        """The curves of the rows that are reported of a setting, ordered by seed and epoch."""
        return self.curves.merge(self.of_setting(setting)[["run_id", "seed"]])


def fullest(rows: pd.DataFrame) -> pd.DataFrame:
    """Of several runs of one setting, the seeds of those that trained equally long, together.

    Of different lengths, that with the most seeds, then the longest; of a seed that was run
    twice, its newer row. The empty frame if there are none.
    """
    if rows.empty:
        return rows
    length = lengths(rows)
    seeds = rows.groupby(length)["seed"].nunique().sort_index()
    chosen = seeds[seeds == seeds.max()].index[-1]
    together: pd.DataFrame = rows[length == chosen].drop_duplicates("seed", keep="last")
    return together.sort_values("seed")


def lengths(rows: pd.DataFrame) -> pd.Series:
    """How long the run of each row trained: (total_timesteps, epochs)."""
    budgets = rows.groupby("run_id")[["total_timesteps", "epochs"]].transform("max").fillna(0)
    return pd.Series(list(budgets.itertuples(index=False, name=None)), rows.index, dtype=object)


def shortfall(rows: pd.DataFrame, table: Table, method: str) -> tuple[str, ...]:
    """In what a setting's rows fall short of a table's seeds and the method's budget, in words."""
    beyond = rows["method"].iloc[0] not in known_methods()  # such are given what RIL is
    budget = table.budget.get("RIL" if beyond else method, {})
    wanted = {"seeds": table.seeds, **budget}
    names = dict.fromkeys(("env_samples", "total_timesteps"), "environment steps")
    short = []
    for what, full in wanted.items():
        have = len(rows) if what == "seeds" else int(rows[what].fillna(0).min())
        if have < full:
            short.append(f"{have:,} of {full:,} {names.get(what, what)}")
    return tuple(short)


def command(settings: Iterable[Setting]) -> str:
    """The command that runs some settings of one method; a sweep over all that they differ in."""
    several = list(settings)
    parts = ["ril-run", f"env={_joined(s.env for s in several)}"]
    parts.append(f"method={_joined(s.method_key for s in several)}")
    usual = {"trajectories": 1, "k": 2, "n": 150, "expert_return": None}
    for key, default in usual.items():
        values = [getattr(s, key) for s in several]
        idle = key == "trajectories" and several[0].method_key in _WITHOUT_EXPERT
        if not idle and any(value not in (default, None) for value in values):
            shown = ("null" if value is None else f"{value:g}" for value in values)
            parts.append(f"ablation.{key}={_joined(shown)}")
    if any("," in part for part in parts):
        parts.insert(1, "-m")
    return " ".join(parts)


def _joined(values: Iterable[str]) -> str:
    return ",".join(dict.fromkeys(values))
