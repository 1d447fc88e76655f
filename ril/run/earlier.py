"""Find what earlier starts of a run left: its rows, or a checkpoint with other demonstrations."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path

import yaml

from ril.config.schema import Config
from ril.io.errors import UserError, one_line
from ril.io.files import temporary_files
from ril.io.locks import BusyError, claimed
from ril.io.rows import load_results
from ril.run.identity import run_id
from ril.run.provenance import command

#: Exceptions that reading a damaged JSON or YAML file of a run may raise.
DAMAGED = (
    *(OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError),
    yaml.YAMLError,
)


def has_rows(folder: Path, config: Config) -> bool:
    """Return whether a run's rows exist; if so, remove leftovers of an interrupted end.

    Args:
        folder: the run's folder.
        config: the run's configuration.

    Raises:
        UserError: `results.csv` cannot be read, or does not hold the rows of this run.
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
    leftovers = [folder / name for name in ("checkpoint.pt", ".lock", ".holder")]
    if any(path.exists() for path in (*leftovers, *temporary_files(folder))):
        # A crash of the machine may bring back any of them. Another process may still be ending the
        # run, or the disk may have become read-only.
        with suppress(BusyError, UserError, OSError), claimed(folder):
            (folder / "checkpoint.pt").unlink(missing_ok=True)
    return True


def refuse_changed_demonstrations(folder: Path, config: Config, sha256: str) -> None:
    """Refuse to start from scratch if a stopped run's demonstrations have changed since.

    Without this check a changed file would start a new run and silently abandon the stopped one.

    Args:
        folder: the run's folder.
        config: the run's configuration.
        sha256: hash of the demonstrations as they are now.

    Raises:
        UserError: a checkpoint of this run with the earlier demonstrations exists.
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
            continue  # the other run reports its damaged files when it is resumed
        if same_file:
            raise UserError(
                f"demonstrations={config.demonstrations}: has changed since the stopped run in "
                f"{other} began (SHA-256 {before[:10]}…, now {sha256[:10]}…); put the old file "
                "back to resume, or delete that folder, or give resume=false, to start again"
            )
