"""The provenance of each run's rows, read from its `provenance.json`."""

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
    """The provenance of one run; "" where it is unknown.

    Attributes:
        run_id: the run's identifier.
        env: name of the environment.
        method: name of the method.
        variant: overridden keys.
        seeds: "0–9".
        commit: the commit of the code.
        command: the command that started it.
        started: date and time in UTC.
        software: versions of Python and of the libraries that make the numbers.
        machine: processor and number of cores.
        fault: why its `provenance.json` cannot be used.
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
    """Return the provenance of the runs that rows belong to, in the rows' order.

    Args:
        rows: a row per run and seed with the fields of `ril.io.rows.Row` and the run's `folder`.
    """
    found = []
    for _, of_run in rows.groupby(["run_id", "folder"], sort=False):
        first = of_run.iloc[0]
        names = {key: str(first[key]) for key in ("run_id", "env", "method", "variant", "commit")}
        read = _read(Path(first["folder"]) / "provenance.json")
        found.append(Run(**{**names, "seeds": _ranges(of_run["seed"]), **read}))
    return found


def _read(file: Path) -> dict[str, str]:
    """Read what a `provenance.json` adds to the rows, or why it cannot be used."""
    try:
        content = json.loads(file.read_bytes())
        libraries: dict[str, Any] = content.get("versions", {})
        versions = {"Python": content.get("python"), **{k: libraries.get(k) for k in _LIBRARIES}}
    except FileNotFoundError:
        return {"fault": "no provenance.json"}
    except (OSError, ValueError, AttributeError, RecursionError):
        return {"fault": "provenance.json cannot be read"}
    texts = {key: str(content.get(key) or "") for key in ("command", "started", "processor")}
    cores = [f"{content['cores']} cores"] if content.get("cores") else []
    return {
        "command": texts["command"],
        "started": texts["started"][:16].replace("T", " "),
        "software": ", ".join(f"{name} {version}" for name, version in versions.items() if version),
        "machine": ", ".join(filter(None, [texts["processor"], *cores])),
    }


def _ranges(seeds: Iterable[int]) -> str:
    """Write whole numbers as ranges: "0–3, 7"."""
    spans: list[list[int]] = []
    for seed in sorted(set(seeds)):
        if spans and seed == spans[-1][1] + 1:
            spans[-1][1] = seed
        else:
            spans.append([seed, seed])
    return ", ".join(f"{low}–{high}" if low < high else str(low) for low, high in spans)
