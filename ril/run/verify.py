"""Run a finished run again, and compare every digit of its rows and its curve."""

from __future__ import annotations

import dataclasses
import json
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from ril.config.schema import Config
from ril.io.errors import UserError
from ril.run.earlier import DAMAGED
from ril.run.experiment import run
from ril.run.training import Display

#: Columns that differ between two equal runs; `run_id` also covers the seeds that ran together.
OF_THE_RUN = ["run_id", "wall_seconds", "commit"]


@dataclass(frozen=True)
class Comparison:
    """A finished run beside its repetition.

    Attributes:
        seeds: the repeated seeds.
        columns: by seed, the columns of its row that differ; none for a seed that agrees.
        first_epoch: by seed, the first epoch whose evaluation differs; none if all agree.
        evaluations: number of compared lines of the curve.
        reasons: what differs between the two runs' circumstances, as "then (now)".
    """

    seeds: list[int]
    columns: dict[int, list[str]]
    first_epoch: dict[int, int]
    evaluations: int
    reasons: list[str]

    @property
    def differing(self) -> list[int]:
        """The seeds of which some digit differs."""
        return [seed for seed in self.seeds if seed in self.columns or seed in self.first_epoch]


def verify(folder: Path, config: Config, display: Display) -> Comparison:
    """Run a finished run again in a temporary folder, and compare.

    Args:
        folder: the run's folder.
        config: its configuration; `seeds` may be some of its seeds, because the digits of a seed
            do not depend on the others.
        display: shows the repetition to the user.

    Raises:
        UserError: the run's files cannot be read, or its demonstrations have changed.
    """
    rows, curve = _table(folder / "results.csv"), _table(folder / "curve.csv")
    try:
        then = json.loads((folder / "provenance.json").read_text(encoding="utf-8"))
        variant = rows["variant"].iloc[0]
    except DAMAGED as error:
        raise UserError(f"{folder}: cannot be read ({error})") from None
    with tempfile.TemporaryDirectory(prefix="ril-verify-") as temporary:
        again = dataclasses.replace(config, output_dir=temporary, resume=True, logging=None)
        repeated = run(again, display, variant)
        now = json.loads((repeated / "provenance.json").read_text(encoding="utf-8"))
        if then["demonstrations"]["sha256"] != now["demonstrations"]["sha256"]:
            raise UserError(f"{folder}: the demonstrations have changed since the run")
        new_rows, new_curve = _table(repeated / "results.csv"), _table(repeated / "curve.csv")
    columns, first_epoch = {}, {}
    for seed in config.seeds:
        before, after = (_of_seed(each, seed).drop(columns=OF_THE_RUN) for each in (rows, new_rows))
        if different := _different(before, after):
            columns[seed] = different
        points, new_points = _of_seed(curve, seed), _of_seed(new_curve, seed)
        epochs = [epoch for epoch in points.index if _different(points, new_points, epoch)]
        if epochs:
            first_epoch[seed] = int(points["epoch"][epochs[0]])
    return Comparison(list(config.seeds), columns, first_epoch, len(new_curve), _reasons(then, now))


def _table(path: Path) -> pd.DataFrame:
    """Read a table as text; a reference has no curve, and so an empty one."""
    if path.name == "curve.csv" and not path.exists():
        return pd.DataFrame({"seed": [], "epoch": []}, dtype=str)
    try:
        return pd.read_csv(path, dtype=str, keep_default_na=False)
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: cannot be read ({error})") from None


def _of_seed(table: pd.DataFrame, seed: int) -> pd.DataFrame:
    return table[table["seed"] == str(seed)].reset_index(drop=True)


def _different(before: pd.DataFrame, after: pd.DataFrame, line: int = 0) -> list[str]:
    """Return the columns of both tables whose values in a line differ."""
    if line >= min(len(before), len(after)):
        return ["seed"]
    common = [name for name in before.columns if name in after.columns]
    return [name for name in common if before[name][line] != after[name][line]]


def _reasons(then: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Return what differs between two provenances and can change digits."""
    facts = ["ril", "commit", "python", "platform", "libc", "compiler", "digits"]
    if then.get("digits") != "exact" or now["digits"] != "exact":
        facts.append("processor")
    pairs = [(name, then.get(name, "unknown"), now[name]) for name in facts]
    pairs += [(name, then["versions"].get(name), each) for name, each in now["versions"].items()]
    return [f"{name} {before} (now {after})" for name, before, after in pairs if before != after]
