"""The rows a run leaves: their schema, written whole or not at all, and read back."""

from __future__ import annotations

import csv
import os
import reprlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from operator import itemgetter
from pathlib import Path

import numpy as np
import pandas as pd

from ril.io.files import write_atomically


@dataclass(frozen=True)
class Row:
    """One seed of one run: a line of `results.csv`.

    Attributes:
        run_id: of the cell.
        env: name of the environment.
        method: name of the method.
        variant: keys that were set apart from the cell's own, "" for the method as it comes.
        seed: of the agent.
        k: eq. 2's slope; empty for methods without that equation.
        n: eq. 2's epochs; likewise.
        trajectories: expert trajectories learnt from; empty for methods that see none.
        expert_return: the level asked of a sub-optimal expert; empty for the usual one.
        epochs: trained, fewer than asked where the stopping rule ended the seed.
        total_timesteps: environment steps asked for; empty where epochs are the only budget.
        best_epoch: after which the best policy was found.
        aer: mean return of fresh episodes of the best policy.
        aer_std: standard deviation of these episodes' returns.
        aer_last: the same mean for the last policy.
        performance: (aer − random) / (expert − random) (§4).
        env_samples: steps of the policy's own training episodes (§5.2.2).
        expert_samples: expert transitions learnt from, counted once per epoch (§5.2.2).
        pre_samples: transitions of I^pre, which the paper does not count.
        samples_to_best: env_samples + expert_samples at the best policy's epoch.
        random_return: mean return of random actions, measured.
        expert_return_measured: mean return of all the expert's demonstrations.
        wall_seconds: of the whole run, all its seeds together.
        commit: of the code, "-dirty" with uncommitted changes; "" outside a checkout.
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


@dataclass(frozen=True)
class CurvePoint:
    """One seed at one evaluation during training: a line of `curve.csv`.

    Attributes:
        seed: of the agent.
        epoch: after which it was evaluated.
        samples: env_samples + expert_samples so far (§5.2.2).
        aer: mean return of the selection episodes.
        metrics: the method's own diagnostics of this epoch, each a column; see its page in docs/.
            Besides, of methods with pseudo-labels: `label_accuracy`, the share that equals the
            expert's true actions, which the method itself never sees.
    """

    seed: int
    epoch: int
    samples: int
    aer: float
    metrics: dict[str, float]


def write_csv(path: Path, lines: Sequence[Row] | Sequence[CurvePoint]) -> None:
    """Write rows or points under their field names."""
    plain = [asdict(line) for line in lines]
    for line in plain:
        line |= line.pop("metrics", {})
    write_atomically(path, pd.DataFrame(plain).to_csv(index=False).encode())


_LONGEST_LINE = 100_000  # characters; a line of ours has some hundreds
_KINDS: dict[str, str] = {**Row.__annotations__, "performance": "float | None"}
_POINT_KINDS = {
    name: CurvePoint.__annotations__[name] for name in ("seed", "epoch", "samples", "aer")
}
_ADDED_LATER = ("variant", "total_timesteps")  # columns that the first rows did not have
_MAY_BE_EMPTY = ("variant", "commit")
#: A file, a line of it (0 for all of it), and why that is left out.
_Fault = tuple[str, int, str]


def load_results(folders: Sequence[Path]) -> tuple[pd.DataFrame, list[str]]:
    """All usable rows of all `results.csv` below some folders, and what was left out.

    Of a seed that is twice in a file its first row counts; of one in two files, the newer's.

    Args:
        folders: where to look, at any depth; one that is not there holds nothing.

    Returns:
        The rows, older files first: the fields of `Row`, and `folder`, that of the run.
        `performance` is NaN where the expert is no better than random.
        A line for each thing left out: its file, its line, its seed where it has one, and why.
    """
    faults: list[_Fault] = []
    rows = _usable(_files(folders, faults), _KINDS, faults)
    unscaled = rows["expert_return_measured"] != rows["random_return"]
    rows = _without(rows, rows["performance"].isna() & unscaled, "performance is ''", faults)
    again = rows.duplicated(["file", "run_id", "seed"])
    rows = _without(rows, again, "is there in an earlier line", faults)

    older = rows.duplicated(["run_id", "seed"], keep="last")
    newest = rows.loc[~older, ["run_id", "seed", "file"]]
    replaced = rows[older].merge(newest, on=["run_id", "seed"], suffixes=("", "_newer"))
    for file, group in replaced.groupby("file", sort=False):
        newer = ", ".join(group["file_newer"].unique())
        faults.append((str(file), 0, f"{_listed(group['seed'])}: run again since, in {newer}"))
    rows = rows[~older].reset_index(drop=True)
    rows["folder"] = pd.Series([Path(file).parent for file in rows["file"]], dtype=object)
    return rows[[*_KINDS, "folder"]], _lines(faults)


def load_curves(rows: pd.DataFrame) -> tuple[pd.DataFrame, list[str]]:
    """How the policies of some rows did while they were trained, and what was left out.

    Args:
        rows: as `load_results` returns them.

    Returns:
        run_id, seed, epoch, samples and aer of each point in the `curve.csv` of these seeds.
        A line for each thing left out, and for seeds without a point though their method learns.
    """
    faults: list[_Fault] = []
    seeds = rows.loc[~rows["method"].isin(["random", "expert"]), ["run_id", "seed", "folder"]]
    seeds["file"] = seeds["folder"].map(lambda folder: str(folder / "curve.csv")).astype(object)
    points = _usable(map(Path, seeds["file"].unique()), _POINT_KINDS, faults, others=True)
    again = points.duplicated(["file", "seed", "epoch"])
    points = _without(points, again, "has this epoch in an earlier line", faults)
    found = seeds.merge(points, how="left", on=["file", "seed"])
    lacking = found[found["aer"].isna()]
    unread = {file for file, line, _ in faults if line == 0}  # which says it of all its seeds
    for file, group in lacking[~lacking["file"].isin(unread)].groupby("file", sort=False):
        faults.append((str(file), 0, f"{_listed(group['seed'])}: no point to use"))
    found = found[["run_id", *_POINT_KINDS]].dropna().reset_index(drop=True)
    return found.astype({"epoch": int, "samples": int}), _lines(faults)


def _files(folders: Sequence[Path], faults: list[_Fault]) -> list[Path]:
    """All that is called results.csv, each once, in the order in which they were written."""

    def refused(error: OSError) -> None:
        if not isinstance(error, FileNotFoundError):  # a folder that is gone holds no rows
            faults.append((error.filename, 0, f"cannot be read ({error.strerror})"))

    found: dict[str, Path] = {}
    seen: set[str] = set()
    for folder in folders:
        for parent, below, names in os.walk(folder, onerror=refused, followlinks=True):
            real = os.path.realpath(parent)  # a link may lead back to where it stands
            if real in seen:
                below.clear()
                continue
            seen.add(real)
            if "results.csv" in (*below, *names):
                file = Path(parent) / "results.csv"
                found.setdefault(os.path.realpath(file), file)
    return sorted(found.values(), key=lambda file: (file.lstat().st_mtime_ns, file))


def _usable(
    files: Iterable[Path], kinds: Mapping[str, str], faults: list[_Fault], *, others: bool = False
) -> pd.DataFrame:
    """The lines of some files that are as they should be: `file`, `line` and typed columns."""
    places: list[tuple[str, int]] = []
    contents: list[tuple[str, ...]] = []
    for file in files:
        for line, content in _read(file, list(kinds), others=others):
            if isinstance(content, str):
                faults.append((str(file), line, content))
            else:
                places.append((str(file), line))
                contents.append(content)
    rows = pd.DataFrame(contents, columns=list(kinds), dtype=object)
    rows["file"] = pd.Series([file for file, _ in places], dtype=object)
    rows["line"] = [line for _, line in places]
    why = pd.Series("", rows.index, dtype=object)
    for column, kind in kinds.items():
        text = rows[column]
        fits = text != ""
        if kind != "str":
            rows[column] = number = pd.to_numeric(text, errors="coerce").astype(float)
            fits = number.abs() < np.inf
            if kind.startswith("int"):  # all are counts; above 2**53 a float is not exact
                fits &= number.between(0, 2**53) & (number % 1 == 0)
        if kind.endswith("None") or column in _MAY_BE_EMPTY:
            fits |= text == ""
        why[~fits & (why == "")] = f"{column} is " + text[~fits].map(reprlib.repr)
    for index in rows.index[why != ""]:
        named = "" if why[index].startswith("seed ") else f"seed {rows['seed'][index]:.0f}: "
        faults.append((*places[index], named + why[index]))
    whole = {column: int for column, kind in kinds.items() if kind == "int"}
    return rows[why == ""].astype(whole)


def _read(
    file: Path, columns: Sequence[str], *, others: bool
) -> Iterator[tuple[int, tuple[str, ...] | str]]:
    """The number of each line of a file, with its text by column or what is wrong with it."""
    try:
        if not file.is_file():
            yield 0, "is not there" if not os.path.lexists(file) else "is no file"
            return
        lines = file.read_bytes().decode("utf-8-sig").replace("\r\n", "\n").split("\n")
    except OSError as error:
        yield 0, f"cannot be read ({error.strerror})"
        return
    except UnicodeDecodeError:
        yield 0, "is not text"
        return
    if not any(lines):
        yield 0, "is empty"
        return
    header = _fields(lines[0])
    problems = {
        "has no column": [c for c in columns if c not in header and c not in _ADDED_LATER],
        "has unknown columns": [c for c in header if c not in columns and not others],
        "has columns twice": [c for c in dict.fromkeys(header) if header.count(c) > 1],
    }
    for what, names in problems.items():
        if names:
            more = f" and {len(names) - 3} more" if len(names) > 3 else ""
            yield 0, f"{what} {', '.join(map(reprlib.repr, names[:3]))}{more}"
            return
    if not any(lines[1:]):
        yield 0, "has no rows"
    # A column that the file does not have is the empty text that is put at each line's end.
    pick = itemgetter(*(header.index(name) if name in header else -1 for name in columns))
    for number, line in enumerate(lines[1:-1], start=2):
        fields = _fields(line)
        if len(fields) == len(header):
            yield number, pick([*fields, ""])
        else:
            yield number, f"torn, {len(fields)} of {len(header)} columns"
    if lines[-1] and lines[1:]:
        yield len(lines), "torn, has no end"


def _fields(line: str) -> list[str]:
    """The columns of a line; none if it is not one of ours."""
    if len(line) > _LONGEST_LINE:
        return []
    if '"' not in line:  # several times faster
        return line.split(",")
    try:
        return next(csv.reader([line], strict=True))
    except csv.Error:
        return []


def _without(
    rows: pd.DataFrame, unfit: pd.Series[bool], why: str, faults: list[_Fault]
) -> pd.DataFrame:
    """The rows that are fit; the others are named."""
    for file, line, seed in rows.loc[unfit, ["file", "line", "seed"]].to_numpy():
        faults.append((file, line, f"seed {seed}: {why}"))
    return rows[~unfit]


def _listed(seeds: Iterable[int]) -> str:
    return f"seed {', '.join(map(str, seeds))}"


def _lines(faults: list[_Fault]) -> list[str]:
    """A line for each fault of a file, however many of its lines have it."""
    where: dict[tuple[str, str], list[int]] = {}
    for file, line, why in faults:
        where.setdefault((file, why), []).append(line)
    said = []
    for (file, why), numbers in where.items():
        shown = ", ".join(map(str, numbers[:3])) + (" …" if len(numbers) > 3 else "")
        said.append(f"{file}: {why}" if numbers == [0] else f"{file}: line {shown}: {why}")
    return said
