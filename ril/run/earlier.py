"""What earlier starts of a run left in its folder, or under other demonstrations beside it."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path

import yaml

from ril.config.schema import Config
from ril.io.errors import UserError, one_line
from ril.io.locks import BusyError, claimed
from ril.io.rows import load_results
from ril.run.identity import run_id
from ril.run.provenance import command

#: What reading a damaged JSON or YAML file of a run may raise.
DAMAGED = (
    *(OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError),
    yaml.YAMLError,
)


def has_rows(folder: Path, config: Config) -> bool:
    """Return whether a run has left its rows; remove leftovers of an interrupted end.

    Args:
        folder: of the run, or of one beside it.
        config: of the run.

    Raises:
        UserError: the file of rows holds others than the run's.
    """
    path = folder / "results.csv"
    if not path.exists():
        return False
    again = f"delete it, and {command()} runs the cell again"
    try:
        rows, left_out = load_results([folder])
    except OSError as error:
        raise UserError(f"{one_line(error)}; {again}") from None
    if left_out:
        raise UserError(f"{left_out[0]}; {again}")
    if rows["seed"].tolist() != config.seeds or set(rows["run_id"]) != {folder.name}:
        raise UserError(f"{path}: does not hold a row per seed of {folder.name}; {again}")
    if any((folder / name).exists() for name in ("checkpoint.pt", ".lock")):
        # Another process may still be ending the run, or the disk may be read-only by now.
        with suppress(BusyError, UserError, OSError), claimed(folder):
            (folder / "checkpoint.pt").unlink(missing_ok=True)
    return True


def refuse_changed_demonstrations(folder: Path, config: Config, sha256: str) -> None:
    """Refuse to abandon a stopped run because its demonstrations have changed since.

    Args:
        folder: of the run.
        config: of the run.
        sha256: of the demonstrations now.

    Raises:
        UserError: there is a checkpoint of this run with the former demonstrations.
    """
    for checkpoint in folder.parent.glob("*/checkpoint.pt"):
        other = checkpoint.parent
        try:
            kept = json.loads((other / "provenance.json").read_text(encoding="utf-8"))
            before = kept["demonstrations"]["sha256"]
            if before == sha256 or run_id(config, before) != other.name:
                continue
            settings = yaml.safe_load((other / "config.yaml").read_text(encoding="utf-8"))
            same_file = settings["demonstrations"] == config.demonstrations
        except DAMAGED:
            continue  # of another run, which reports it itself
        if same_file:
            raise UserError(
                f"demonstrations={config.demonstrations}: has changed since the stopped run in "
                f"{other} began (SHA-256 {before[:10]}…, now {sha256[:10]}…); put the old file "
                "back to resume, or delete that folder, or give resume=false, to start again"
            )
