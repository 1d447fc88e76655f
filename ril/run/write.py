"""Write a run's files: configuration and provenance at its start, results at its end."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ril.io import ended
from ril.io.ended import Ended, write_ended
from ril.io.errors import UserError, printable
from ril.io.files import WriteError, write_atomically
from ril.io.rows import Row, write_csv
from ril.policy import save_policies
from ril.run.earlier import DAMAGED
from ril.run.prepare import Cell
from ril.run.provenance import digits, provenance
from ril.run.training import Outcome
from ril.vectorized.compiling import fallbacks
from ril.vectorized.evaluation import random_returns

#: What a resumed run adds to its provenance.
_AGAIN = ("command", "started", "commit", "processor", "digits")


def write_start(folder: Path, cell: Cell, doubts: Sequence[str]) -> str:
    """Write `config.yaml` and `provenance.json`; return the commit of the run's first start.

    Args:
        folder: the run's folder.
        cell: the cell that is run.
        doubts: the lines about its environment, for `provenance.json`.

    Raises:
        UserError: the run is resumed, and the provenance of its first start cannot be read.
    """
    sha256 = cell.demonstrations.sha256
    now = provenance(cell.demonstrations_path, sha256, cell.config)
    (folder / ended.FILE).unlink(missing_ok=True)
    details = _with_first_start(folder, {"run_id": cell.run_id, **now, "doubts": list(doubts)})
    settings = yaml.safe_dump(dataclasses.asdict(cell.config), sort_keys=False, allow_unicode=True)
    write_atomically(folder / "config.yaml", settings.encode())
    commit: str = details["commit"]
    return commit


def write_results(folder: Path, cell: Cell, outcome: Outcome, variant: str, commit: str) -> None:
    """Write policies, curve and rows, and remove the checkpoint.

    Args:
        folder: the run's folder.
        cell: the cell that was run.
        outcome: the result of its training.
        variant: the keys with non-default values.
        commit: the commit of the code.
    """
    record = outcome.record
    rows = _rows(cell, outcome, variant, commit)
    if outcome.architecture is not None:
        save_policies(
            folder / "policy.pt",
            cell.environment,
            outcome.architecture,
            record.seeds,
            best=record.best,
            last=record.last,
        )
        write_csv(folder / "curve.csv", record.curve)
    # A run that has rows counts as finished, so they are written last.
    write_csv(folder / "results.csv", rows)
    with suppress(OSError):  # the next start removes it
        (folder / "checkpoint.pt").unlink(missing_ok=True)


def write_end(folder: Path, cell: Cell, variant: str, why: str) -> None:
    """Write that a run ended without rows, and remove its checkpoint: it would end so again.

    Args:
        folder: the run's folder.
        cell: the cell that was run.
        variant: the keys with non-default values.
        why: the reason, in one line.
    """
    name, method, seeds = cell.config.env.name, cell.config.method.name, list(cell.config.seeds)
    about = Ended(cell.run_id, name, method, variant, seeds, **_ablation(cell), why=why)
    with suppress(WriteError, OSError):  # the message about the number matters more
        write_ended(folder, about)
        (folder / "checkpoint.pt").unlink(missing_ok=True)


def _ablation(cell: Cell) -> dict[str, Any]:
    """Return the values of `ablation` on which the method depends; None for the others."""
    return dataclasses.asdict(cell.config.ablation) | dict.fromkeys(cell.spec.idle_ablations)


def _rows(cell: Cell, outcome: Outcome, variant: str, commit: str) -> list[Row]:
    """Return a row per seed."""
    config, record = cell.config, outcome.record
    random = float(random_returns(cell.environment, [0], config.evaluation.episodes).mean())
    expert = float(cell.demonstrations.returns.mean())
    aer = outcome.best.mean(axis=1)
    with np.errstate(all="ignore"):
        performance = (aer - random) / np.float64(expert - random)
    performance[~np.isfinite(performance)] = math.nan  # the expert is as good as random
    kind = digits(config)
    if kind == "exact" and fallbacks:
        kind = f"not compiled: {fallbacks[0]}"
    return [
        Row(
            run_id=cell.run_id,
            env=config.env.name,
            method=config.method.name,
            variant=variant,
            seed=seed,
            **_ablation(cell),
            epochs=int(record.epochs[index]),
            total_timesteps=getattr(config.method, "total_timesteps", None),
            best_epoch=int(record.best_epoch[index]),
            aer=float(aer[index]),
            aer_std=float(outcome.best[index].std()),
            aer_last=float(outcome.last[index].mean()),
            performance=float(performance[index]),
            env_samples=int(record.env_samples[index]),
            expert_samples=int(record.expert_samples[index]),
            pre_samples=record.pre_samples,
            samples_to_best=int(record.samples_to_best[index]),
            random_return=random,
            expert_return_measured=expert,
            wall_seconds=round(outcome.seconds, 2),
            commit=commit,
            digits=printable(kind),
        )
        for index, seed in enumerate(config.seeds)
    ]


def _with_first_start(folder: Path, details: dict[str, Any]) -> dict[str, Any]:
    """Write and return the provenance; a resumed run keeps its first start's and adds its own."""
    path = folder / "provenance.json"
    if (folder / "checkpoint.pt").exists():
        try:
            first: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            resumed = [*first.get("resumed", [])]
            first["commit"]
        except DAMAGED:
            raise UserError(
                f"{path}: cannot be read, so the run's first start is unknown; "
                f"delete {folder}, or give resume=false, to start again"
            ) from None
        again = {key: details[key] for key in _AGAIN}
        details = first | {"resumed": [*resumed, again]}
    write_atomically(path, json.dumps(details, indent=2).encode())
    return details
