"""Runs that ended without rows, because their numbers would mean nothing."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

from ril.io.files import write_atomically
from ril.io.rows import find_files
from ril.io.tables import Faults

FILE = "ended.json"


@dataclass(frozen=True)
class Ended:
    """A run that ended without rows; the fields of `ril.io.rows.Row` that say which.

    Attributes:
        run_id: the run's identifier.
        env: name of the environment.
        method: name of the method.
        variant: the keys with non-default values.
        seeds: the seeds that were trained together.
        k: k of eq. 2; None for a method without it.
        n: n of eq. 2; None for a method without it.
        trajectories: the expert's trajectories; None for a method without them.
        expert_return: mean return of a sub-optimal expert; None for the usual one.
        why: "ended: … is not finite since epoch 12".
    """

    run_id: str
    env: str
    method: str
    variant: str
    seeds: list[int]
    k: float | None
    n: float | None
    trajectories: int | None
    expert_return: float | None
    why: str

    def __str__(self) -> str:
        """Describe the run and its end in one line."""
        parts = [f"env={self.env}", f"method={self.method}", self.variant, f"seeds={self.seeds}"]
        return f"{' '.join(filter(None, parts))}: {self.why}"


def write_ended(folder: Path, ended: Ended) -> None:
    """Write `ended.json` into a run's folder.

    Raises:
        WriteError: the file cannot be written.
    """
    write_atomically(folder / FILE, json.dumps(asdict(ended), indent=2).encode())


def load_ended(folders: Sequence[Path]) -> tuple[list[Ended], list[str]]:
    """Read the `ended.json` of all runs below some folders.

    Returns:
        The runs, and a line for each file that cannot be read.
    """
    found, faults = [], Faults()
    names = {field.name for field in fields(Ended)}
    for file in find_files(folders, FILE, faults):
        try:
            content = json.loads(file.read_text(encoding="utf-8"))
            run = Ended(**{name: content[name] for name in names})
            texts = run.run_id, run.env, run.method, run.variant, run.why
            are_texts = all(isinstance(each, str) for each in texts)
            if not (are_texts and run.seeds and all(type(seed) is int for seed in run.seeds)):
                raise TypeError
            found.append(run)
        except (OSError, ValueError, LookupError, TypeError):
            faults.add(str(file), 0, "cannot be read")
    return found, faults.messages()
