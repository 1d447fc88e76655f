"""One run: train all seeds of a cell, look at them on the way, score them, leave rows."""

from __future__ import annotations

import dataclasses
import importlib
import json
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
import yaml
from numpy.typing import NDArray

from ril.config import Config, run_id
from ril.demonstrations import Demonstrations, load_demonstrations, shipped_path
from ril.environments import Environment, load_environment
from ril.errors import UserError
from ril.evaluation import Evaluation, random_returns
from ril.files import write_atomically, write_tensors
from ril.interrupts import stop_between_epochs
from ril.methods.base import Method, Progress, Task
from ril.policy import save_policies
from ril.provenance import provenance
from ril.record import Record
from ril.results import Row, write_csv

#: Where each method lives; imported only when it runs.
METHODS = {"ril": "ril.methods.ril:RIL"}
CHECKPOINT_SECONDS = 30.0


class Display(Protocol):
    """What shows a run to a person; see `ril.display`."""

    def started(self, config: Config, folder: Path) -> None:
        """Training begins or goes on."""

    def advanced(self, progress: Progress, record: Record) -> None:
        """An epoch is done."""

    def scoring(self) -> None:
        """Training is over; the best and last policies are being scored."""

    def finished(self, rows: Path, *, skipped: bool) -> None:
        """The rows are written; skipped says that an earlier run had written them."""


def run(config: Config, display: Display, variant: str = "") -> Path:
    """Train and score one cell.

    Args:
        config: what to run.
        display: what shows it.
        variant: how the rows are told from those of the method as it comes; see `Row`.

    Returns:
        The run's folder, `<output_dir>/<env>/<method>/<run_id>`; `results.csv` in it has a row
        per seed.

    Raises:
        UserError: something that was asked for cannot be used; no row has been written.
        KeyboardInterrupt: the user stopped it; its message says how to go on.
    """
    torch.set_num_threads(1)
    if config.method.name not in METHODS:
        raise UserError(f"method.name={config.method.name}: must be one of {', '.join(METHODS)}")
    environment = load_environment(config.env)
    device = _device(config.device)
    path = _demonstrations_path(config)
    demonstrations = load_demonstrations(path, environment)
    identifier = run_id(config, demonstrations.sha256)
    folder = Path(config.output_dir) / config.env.name / config.method.name / identifier
    if config.resume and (folder / "results.csv").exists():
        display.finished(folder / "results.csv", skipped=True)
        return folder

    task = Task(
        environment,
        demonstrations.first(config.ablation.trajectories).states(environment),
        tuple(config.seeds),
        config.ablation,
        device,
    )
    module, name = METHODS[config.method.name].split(":")
    method: Method = getattr(importlib.import_module(module), name)(config.method, task)
    folder = _claim(folder, resume=config.resume)
    details = {"run_id": identifier, **provenance(path, demonstrations.sha256)}
    details = _keep_start(folder / "provenance.json", details)
    settings = yaml.safe_dump(dataclasses.asdict(config), sort_keys=False, allow_unicode=True)
    write_atomically(folder / "config.yaml", settings.encode())

    cell = _Cell(
        config,
        environment,
        demonstrations,
        method,
        Record(config.seeds, method.policy.flat),
        Evaluation(environment, config.seeds),
        folder,
        variant,
    )
    display.started(config, folder)
    seconds = _train(cell, display)
    display.scoring()
    rows = _rows(cell, seconds, details)
    save_policies(folder / "policy.pt", environment, method.policy.architecture, cell.record)
    write_csv(folder / "curve.csv", cell.record.curve)
    write_csv(folder / "results.csv", rows)  # last: a run with rows is a finished run
    (folder / "checkpoint.pt").unlink(missing_ok=True)
    display.finished(folder / "results.csv", skipped=False)
    return folder


@dataclass(frozen=True)
class _Cell:
    """What one run works with."""

    config: Config
    environment: Environment
    demonstrations: Demonstrations
    method: Method
    record: Record
    evaluation: Evaluation
    folder: Path
    variant: str


def _train(cell: _Cell, display: Display) -> float:
    """Train to the end, from the checkpoint if there is one; returns the seconds it took."""
    method, record, settings = cell.method, cell.record, cell.config.evaluation
    checkpoint = cell.folder / "checkpoint.pt"
    seconds = _load_checkpoint(checkpoint, method, record)
    expert_actions = cell.demonstrations.first(cell.config.ablation.trajectories).actions
    started = saved = time.monotonic()
    with stop_between_epochs() as stop:
        for progress in method.train():
            live = ~record.stopped
            just_stopped = record.advance(progress, method.policy.flat)
            last = progress.epoch == cell.config.method.epochs
            # A stop is looked at for its own seed only: the others' looks are not to depend on it.
            looked_at = live if last or progress.epoch % settings.every == 0 else just_stopped
            if looked_at.any():
                metrics = dict(progress.metrics)
                if progress.pseudo_labels is not None:
                    metrics["label_accuracy"] = (progress.pseudo_labels == expert_actions).mean(
                        axis=1
                    )
                purpose = f"after epoch {progress.epoch}"
                returns = cell.evaluation.returns(method.act, settings.selection_episodes, purpose)
                record.evaluated(returns.mean(axis=1), looked_at, metrics)
            display.advanced(progress, record)
            if stop.is_set() or time.monotonic() - saved > CHECKPOINT_SECONDS:
                saved = time.monotonic()
                _save_checkpoint(checkpoint, method, record, seconds + saved - started)
            if stop.is_set():
                goes_on = "; the same command goes on from there" if cell.config.resume else ""
                raise KeyboardInterrupt(f"stopped after epoch {progress.epoch}{goes_on}")
    return seconds + time.monotonic() - started


def _save_checkpoint(checkpoint: Path, method: Method, record: Record, seconds: float) -> None:
    """Write all that the rest of the run depends on."""
    state = {"seconds": seconds, "method": method.state_dict(), "record": record.state_dict()}
    write_tensors(checkpoint, state)


def _load_checkpoint(checkpoint: Path, method: Method, record: Record) -> float:
    """Restore a stopped run; returns the seconds it had taken, 0 if there is none."""
    if not checkpoint.exists():
        return 0.0
    try:
        state: dict[str, Any] = torch.load(checkpoint, weights_only=True)
        method.load_state_dict(state["method"])
        record.load_state_dict(state["record"])
    except Exception as error:
        raise UserError(
            f"{checkpoint}: cannot be read ({type(error).__name__}); "
            "delete it, or give resume=false, to start again"
        ) from None
    return float(state["seconds"])


def _score(cell: _Cell, parameters: torch.Tensor) -> NDArray[np.float64]:
    """(S, episodes) returns of given policies on fresh episodes, the same starts for each call."""
    cell.method.policy.flat.copy_(parameters)
    episodes = cell.config.evaluation.episodes
    return cell.evaluation.returns(cell.method.act, episodes, "of the result")


def _rows(cell: _Cell, training_seconds: float, details: dict[str, Any]) -> list[Row]:
    """Score the best and last policies; a row per seed."""
    started = time.monotonic()
    config, record, ablation = cell.config, cell.record, cell.config.ablation
    best, last = _score(cell, record.best), _score(cell, record.last)
    aer = best.mean(axis=1)
    expert = float(cell.demonstrations.returns.mean())
    random = float(random_returns(cell.environment, config.evaluation.episodes).mean())
    performance = (aer - random) / (expert - random) if expert != random else aer * math.nan
    seconds = training_seconds + time.monotonic() - started
    return [
        Row(
            run_id=details["run_id"],
            env=config.env.name,
            method=config.method.name,
            variant=cell.variant,
            seed=seed,
            k=ablation.k,
            n=ablation.n,
            trajectories=ablation.trajectories,
            expert_return=ablation.expert_return,
            epochs=int(record.epochs[index]),
            best_epoch=int(record.best_epoch[index]),
            aer=float(aer[index]),
            aer_std=float(best[index].std()),
            aer_last=float(last[index].mean()),
            performance=float(performance[index]),
            env_samples=int(record.env_samples[index]),
            expert_samples=int(record.expert_samples[index]),
            pre_samples=record.pre_samples,
            samples_to_best=int(record.samples_to_best[index]),
            random_return=random,
            expert_return_measured=expert,
            wall_seconds=round(seconds, 2),
            commit=details["commit"],
        )
        for index, seed in enumerate(config.seeds)
    ]


def _device(name: str) -> torch.device:
    try:
        device = torch.device(name)
        torch.zeros(1, device=device).item()
    except (RuntimeError, AssertionError):
        raise UserError(f"device={name}: torch cannot use it here") from None
    if device.type not in ("cpu", "cuda"):
        raise UserError(f"device={name}: must be cpu or cuda")
    return device


def _demonstrations_path(config: Config) -> Path:
    """The file that is asked for, or the one that ships with ril."""
    if config.demonstrations is not None:
        return Path(config.demonstrations)
    level = config.ablation.expert_return
    name = config.env.name if level is None else f"{config.env.name}_{level:g}"
    path = shipped_path(name)
    if not path.is_file():
        key = "demonstrations=null" if level is None else f"ablation.expert_return={level:g}"
        shipped = ", ".join(sorted(file.stem for file in path.parent.glob("*.npz")))
        raise UserError(f"{key}: none ship for {name} (only {shipped}); give demonstrations=PATH")
    return path


def _keep_start(path: Path, details: dict[str, Any]) -> dict[str, Any]:
    """Write the provenance; of a run that goes on, the first start's, with a list of the later."""
    if path.exists():
        first: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        again = {key: details[key] for key in ("command", "started", "commit")}
        details = first | {"resumed": [*first.get("resumed", []), again]}
    write_atomically(path, json.dumps(details, indent=2).encode())
    return details


def _claim(folder: Path, *, resume: bool) -> Path:
    """Make sure the run can write, before it works for hours; beside an old run if not resumed."""
    if not resume:
        number = 2
        wanted = folder
        while folder.exists():
            folder = wanted.with_name(f"{wanted.name}-{number}")
            number += 1
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".writable"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise UserError(f"output_dir: {folder} cannot be written ({error.strerror})") from None
    return folder
