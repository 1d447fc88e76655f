"""The rows that a run writes, one per seed, and their curves: schema, writing, reading."""

from __future__ import annotations

import math
import os
import reprlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ril.io.errors import UserError
from ril.io.files import write_atomically
from ril.io.numbers import LARGEST
from ril.io.tables import ALLOWED, LONGEST_TEXT, Faults, read_tables


@dataclass(frozen=True)
class Row:
    """One seed of one run: a line of `results.csv`.

    Attributes:
        run_id: the run's identifier, a hash of what can change its numbers.
        env: name of the environment.
        method: name of the method.
        variant: overridden keys and their values, key=value; "" for the method's defaults.
        seed: the agent's seed.
        k: eq. 2's slope; empty for methods without that equation.
        n: eq. 2's epochs; empty for methods without that equation.
        trajectories: expert trajectories trained on; empty for methods that see none.
        expert_return: the sub-optimal expert's requested return; empty for the default expert.
        epochs: trained; fewer than requested if the stopping rule ended the seed.
        total_timesteps: requested environment steps; empty if the budget is in epochs.
        best_epoch: the epoch after which the best policy was found.
        aer: average episodic return (§4) of the best policy, over fresh episodes.
        aer_std: standard deviation of the returns of these episodes.
        aer_last: average episodic return of the last policy, over the same episodes.
        performance: (aer − random) / (expert − random) (§4).
        env_samples: environment steps of the policy's training episodes (§5.2.2).
        expert_samples: expert transitions trained on, counted once per epoch (§5.2.2).
        pre_samples: transitions of I^pre, which the paper does not count.
        samples_to_best: env_samples + expert_samples up to best_epoch.
        random_return: measured mean return of random actions.
        expert_return_measured: mean return of all the expert's demonstrations.
        wall_seconds: duration of the whole run, all its seeds together.
        commit: the code's commit, with "-dirty" for uncommitted changes; "" outside a checkout.
        digits: "exact" if another machine computes the same digits, or else why it may not.
    """

    run_id: str
    env: str
    method: str
    variant: str
    seed: int
    k: float | None
    n: float | None
    trajectories: int | None
    expert_return: float | None
    epochs: int
    total_timesteps: int | None
    best_epoch: int
    aer: float
    aer_std: float
    aer_last: float
    performance: float
    env_samples: int
    expert_samples: int
    pre_samples: int
    samples_to_best: int
    random_return: float
    expert_return_measured: float
    wall_seconds: float
    commit: str
    digits: str


@dataclass(frozen=True)
class CurvePoint:
    """One seed at one evaluation during training: a line of `curve.csv`.

    Attributes:
        seed: the agent's seed.
        epoch: the epoch after which it was evaluated.
        samples: env_samples + expert_samples so far (§5.2.2).
        aer: mean return of the selection episodes.
        metrics: the method's diagnostics of this epoch, a column each; see the method's page in
            docs/. Methods with pseudo-labels add `label_accuracy`, the share of labels that equal
            the expert's true actions, which the method itself never sees.
    """

    seed: int
    epoch: int
    samples: int
    aer: float
    metrics: dict[str, float]


def write_csv(path: Path, lines: Sequence[Row] | Sequence[CurvePoint]) -> None:
    """Write rows or curve points below a header of their field names.

    Args:
        path: the file to write.
        lines: the lines to write, in order; a metric that a point lacks is empty in its line.

    Raises:
        WriteError: the file cannot be written.
        UserError: a value could not be read back; nothing is written.
    """
    plain = [asdict(line) for line in lines]
    for line in plain:
        line |= line.pop("metrics", {})
        if unreadable := _unreadable(line, _KINDS if "run_id" in line else _POINT_KINDS):
            raise UserError(f"{path}: is not written: seed {line['seed']}: {unreadable}")
    write_atomically(path, pd.DataFrame(plain).to_csv(index=False).encode())


_CAN_BE_EMPTY = {"performance": "float | None", "variant": "str | None", "commit": "str | None"}
_KINDS: dict[str, str] = {**Row.__annotations__, **_CAN_BE_EMPTY}
_POINT_KINDS = {
    name: CurvePoint.__annotations__[name] for name in ("seed", "epoch", "samples", "aer")
}


def _unreadable(line: dict[str, Any], kinds: Mapping[str, str]) -> str:
    """Return why `read_tables` would not give a line back as it is; "" if it would."""
    for column, kind in kinds.items():
        value = line[column]
        type_name, _, may_be_empty = kind.partition(" | ")
        if type_name == "str":
            fits = 1 <= len(value) <= LONGEST_TEXT and value.isprintable()
            value = reprlib.repr(value)
        elif value is None:
            fits = False
        elif type_name == "int":
            fits = 0 <= value <= LARGEST
        else:
            fits = math.isfinite(value)
        if not (fits or (may_be_empty and _is_empty(line[column]))):
            return f"{column} is {value}, {ALLOWED[type_name]}"
    return ""


def _is_empty(value: str | float | None) -> bool:
    return value is None or value == "" or value != value


def load_results(folders: Sequence[Path]) -> tuple[pd.DataFrame, list[str]]:
    """Read the usable rows of every `results.csv` below some folders.

    If a file has a seed twice, its first row counts; if two files have it, that of the newer file.

    Args:
        folders: where to search, at any depth; a missing folder holds no rows.

    Returns:
        The rows, those of older files first: the fields of `Row`, and `folder`, the run's folder.
        `performance` is NaN where the expert is as good as random.
        A line for each thing that was left out: its file, its line, its seed if it has one, and
        the reason.
    """
    faults = Faults()
    rows = read_tables(find_files(folders, "results.csv", faults), _KINDS, faults)
    no_performance = rows["performance"].isna() & np.isfinite(_performance(rows))
    rows = _without(rows, no_performance, "performance is '', must be a finite number", faults)
    repeated = rows.duplicated(["file", "run_id", "seed"])
    rows = _without(rows, repeated, "repeats an earlier line", faults)

    older = rows.duplicated(["run_id", "seed"], keep="last")
    newest = rows.loc[~older, ["run_id", "seed", "file"]]
    replaced = rows[older].merge(newest, on=["run_id", "seed"], suffixes=("", "_newer"))
    for file, group in replaced.groupby("file", sort=False):
        newer = ", ".join(group["file_newer"].unique())
        faults.add(str(file), 0, f"{_seeds(group)}: replaced by a newer run in {newer}")
    rows = rows[~older].reset_index(drop=True)
    rows["folder"] = pd.Series([Path(file).parent for file in rows["file"]], dtype=object)
    return rows[[*_KINDS, "folder"]], faults.messages()


def load_curves(rows: pd.DataFrame) -> tuple[pd.DataFrame, list[str]]:
    """Read the learning curves of some rows.

    Args:
        rows: as `load_results` returns them.

    Returns:
        run_id, seed, epoch, samples and aer of each point in the `curve.csv` of these seeds.
        A line for each thing that was left out, and for each seed of a learning method that has
        no usable point.
    """
    faults = Faults()
    seeds = rows.loc[~rows["method"].isin(["random", "expert"]), ["run_id", "seed", "folder"]]
    seeds["file"] = seeds["folder"].map(lambda folder: str(folder / "curve.csv")).astype(object)
    points = read_tables(map(Path, seeds["file"].unique()), _POINT_KINDS, faults, more_columns=True)
    repeated = points.duplicated(["file", "seed", "epoch"])
    points = _without(points, repeated, "repeats an epoch of an earlier line", faults)
    found = seeds.merge(points, how="left", on=["file", "seed"])
    lacking = found[found["aer"].isna()]
    for file, group in lacking[~lacking["file"].isin(faults.whole_files)].groupby(
        "file", sort=False
    ):
        faults.add(str(file), 0, f"{_seeds(group)}: has no usable point")
    found = found[["run_id", *_POINT_KINDS]].dropna().reset_index(drop=True)
    return found.astype({"epoch": int, "samples": int}), faults.messages()


def _performance(rows: pd.DataFrame) -> pd.Series[float]:
    """Compute the performance of rows again; not finite where the expert is as good as random."""
    above = rows["aer"].astype(float) - rows["random_return"].astype(float)
    return above / (rows["expert_return_measured"] - rows["random_return"]).astype(float)


def find_files(folders: Sequence[Path], name: str, faults: Faults) -> list[Path]:
    """Find every file of a name below some folders, each once, the oldest first.

    Args:
        folders: where to search, at any depth; links are followed.
        name: the file's name.
        faults: records each folder that cannot be read.
    """

    def refused(error: OSError) -> None:
        if not isinstance(error, FileNotFoundError):  # a missing folder holds no rows
            faults.add(error.filename, 0, f"cannot be read ({error.strerror})")

    found: dict[str, Path] = {}
    seen: set[str] = set()
    for folder in folders:
        for parent, below, names in os.walk(folder, onerror=refused, followlinks=True):
            real = os.path.realpath(parent)  # a link may lead back to a folder above it
            if real in seen:
                below.clear()
                continue
            seen.add(real)
            if name in (*below, *names):
                file = Path(parent) / name
                found.setdefault(os.path.realpath(file), file)
    return sorted(found.values(), key=lambda file: (file.lstat().st_mtime_ns, file))


def _without(rows: pd.DataFrame, unfit: pd.Series[bool], why: str, faults: Faults) -> pd.DataFrame:
    """Drop the unfit rows, and record why."""
    for file, line, seed in rows.loc[unfit, ["file", "line", "seed"]].to_numpy():
        faults.add(file, line, f"seed {seed}: {why}")
    return rows[~unfit]


def _seeds(rows: pd.DataFrame) -> str:
    """Name the seeds of some rows."""
    return f"seed{'s' if len(rows) > 1 else ''} {', '.join(map(str, rows['seed']))}"
