"""Where the rows of each run come from: its `provenance.json`, read back."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

_LIBRARIES = ("torch", "numpy", "gymnasium")


@dataclass(frozen=True)
class Run:
    """What is known of one run; "" where it is not.

    Attributes:
        run_id: of the cell.
        env: name of the environment.
        method: name of the method.
        variant: keys that were set apart from the cell's own.
        seeds: in words, "0–9".
        commit: of the code.
        command: that started it.
        started: date and time in UTC.
        software: versions of Python and of the libraries that make the numbers.
        machine: processor and number of cores.
        fault: what is wrong with its `provenance.json`.
    """

    run_id: str
    env: str
    method: str
    variant: str
    seeds: str
    commit: str
    command: str = ""
    started: str = ""
    software: str = ""
    machine: str = ""
    fault: str = ""


def runs(rows: pd.DataFrame) -> list[Run]:
    """The runs that rows are of, in the rows' order.

    Args:
        rows: a row per run and seed, as `results.Row` has them, and the run's `folder`.
    """
    found = []
    for _, of_run in rows.groupby(["run_id", "folder"], sort=False):
        first = of_run.iloc[0]
        names = {key: str(first[key]) for key in ("run_id", "env", "method", "variant", "commit")}
        read = _read(Path(first["folder"]) / "provenance.json")
        found.append(Run(**{**names, "seeds": _ranges(of_run["seed"]), **read}))
    return found


def _read(file: Path) -> dict[str, str]:
    """What a `provenance.json` adds to the rows, or what is wrong with it."""
    try:
        content = json.loads(file.read_bytes())
        libraries: dict[str, Any] = content.get("versions", {})
        versions = {"Python": content.get("python"), **{k: libraries.get(k) for k in _LIBRARIES}}
    except FileNotFoundError:
        return {"fault": "no provenance.json"}
    except (OSError, ValueError, AttributeError, RecursionError):
        return {"fault": "provenance.json cannot be read"}
    said = {key: str(content.get(key) or "") for key in ("command", "started", "processor")}
    cores = [f"{content['cores']} cores"] if content.get("cores") else []
    return {
        "command": said["command"],
        "started": said["started"][:16].replace("T", " "),
        "software": ", ".join(f"{name} {version}" for name, version in versions.items() if version),
        "machine": ", ".join(filter(None, [said["processor"], *cores])),
    }


def _ranges(seeds: Iterable[int]) -> str:
    """Whole numbers in words: "0–3, 7"."""
    spans: list[list[int]] = []
    for seed in sorted(set(seeds)):
        if spans and seed == spans[-1][1] + 1:
            spans[-1][1] = seed
        else:
            spans.append([seed, seed])
    return ", ".join(f"{low}–{high}" if low < high else str(low) for low, high in spans)
