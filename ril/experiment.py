"""One run: train all seeds of a cell, look at them on the way, score them, leave rows."""

from __future__ import annotations

import dataclasses
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

from ril.config import run_id, uses_equation_2
from ril.demonstration_files import demonstrations_path, load_demonstrations
from ril.demonstrations import Demonstrations
from ril.environments import Environment, load_environment
from ril.errors import UserError
from ril.evaluation import Evaluation, random_returns
from ril.files import write_atomically, write_tensors
from ril.interrupts import stop_between_epochs
from ril.methods.base import Method, Progress
from ril.methods.registry import METHODS
from ril.policy import save_policies
from ril.provenance import provenance
from ril.record import Record
from ril.results import Row, write_csv
from ril.schema import METHOD_CONFIGS, Config
from ril.task import Task

CHECKPOINT_SECONDS = 30.0


class Display(Protocol):
    """What shows a run to a person; see `ril.display`."""

    def started(self, config: Config, folder: Path, epochs: int) -> None:
        """Training for that many epochs begins or goes on."""

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
    name = config.method.name
    if name not in METHOD_CONFIGS:
        raise UserError(f"method.name={name}: must be one of {', '.join(METHOD_CONFIGS)}")
    environment = load_environment(config.env)
    device = _device(config.device)
    path = demonstrations_path(config)
    demonstrations = load_demonstrations(path, environment)
    given = demonstrations.first(config.ablation.trajectories)
    identifier = run_id(config, demonstrations.sha256)
    folder = Path(config.output_dir) / config.env.name / name / identifier
    if config.resume and (folder / "results.csv").exists():
        display.finished(folder / "results.csv", skipped=True)
        return folder

    method = None
    if name in METHODS:
        entry = METHODS[name]
        expert = entry.shown(given, environment)
        task = Task(environment, expert, tuple(config.seeds), config.ablation, device)
        method = entry.load()(config.method, task)
    folder = _claim(folder, resume=config.resume)
    details = {"run_id": identifier, **provenance(path, demonstrations.sha256)}
    details = _keep_start(folder / "provenance.json", details)
    settings = yaml.safe_dump(dataclasses.asdict(config), sort_keys=False, allow_unicode=True)
    write_atomically(folder / "config.yaml", settings.encode())

    display.started(config, folder, 0 if method is None else method.epochs)
    started = time.monotonic()
    evaluation = Evaluation(environment, config.seeds)
    if method is None:
        record = Record(config.seeds, torch.zeros(len(config.seeds), 0))
        best = last = _reference_returns(config, environment, demonstrations)
    else:
        record = Record(config.seeds, method.policy.flat)
        cell = _Cell(config, method, record, evaluation, given.actions, folder)
        started -= _train(cell, display)
        display.scoring()
        best, last = _score(cell, record.best), _score(cell, record.last)
        save_policies(folder / "policy.pt", environment, method.policy.architecture, record)
        write_csv(folder / "curve.csv", record.curve)
    shared = {
        "run_id": identifier,
        "variant": variant,
        "random_return": random_returns(environment, [0], config.evaluation.episodes).mean(),
        "expert_return_measured": demonstrations.returns.mean(),
        "wall_seconds": round(time.monotonic() - started, 2),
        "commit": details["commit"],
    }
    # Last: a run with rows is a finished run.
    write_csv(folder / "results.csv", _rows(config, record, best, last, shared))
    (folder / "checkpoint.pt").unlink(missing_ok=True)
    display.finished(folder / "results.csv", skipped=False)
    return folder


def _reference_returns(
    config: Config, environment: Environment, demonstrations: Demonstrations
) -> NDArray[np.float64]:
    """(S, episodes) returns that `performance` counts from (random) and to (expert)."""
    if config.method.name == "random":
        return random_returns(environment, config.seeds, config.evaluation.episodes)
    return np.tile(demonstrations.returns, (len(config.seeds), 1))


@dataclass(frozen=True)
class _Cell:
    """What one run works with."""

    config: Config
    method: Method
    record: Record
    evaluation: Evaluation
    expert_actions: NDArray[np.int64]
    folder: Path


def _train(cell: _Cell, display: Display) -> float:
    """Train to the end, from the checkpoint if there is one.

    Returns:
        The seconds that training had taken before it was stopped and went on here.
    """
    method, record, settings = cell.method, cell.record, cell.config.evaluation
    checkpoint = cell.folder / "checkpoint.pt"
    before = _load_checkpoint(checkpoint, method, record)
    started = saved = time.monotonic()
    with stop_between_epochs() as stop:
        for progress in method.train():
            live = ~record.stopped
            just_stopped = record.advance(progress, method.policy.flat)
            last = progress.epoch == method.epochs
            # A stop is looked at for its own seed only: the others' looks are not to depend on it.
            looked_at = live if last or progress.epoch % settings.every == 0 else just_stopped
            if looked_at.any() and progress.can_act:
                metrics = dict(progress.metrics)
                if progress.pseudo_labels is not None:
                    right = progress.pseudo_labels == cell.expert_actions
                    metrics["label_accuracy"] = right.mean(axis=1)
                purpose = f"after epoch {progress.epoch}"
                returns = cell.evaluation.returns(
                    method.policy, settings.selection_episodes, purpose
                )
                record.evaluated(returns.mean(axis=1), looked_at, metrics)
            display.advanced(progress, record)
            if stop.is_set() or time.monotonic() - saved > CHECKPOINT_SECONDS:
                saved = time.monotonic()
                _save_checkpoint(checkpoint, method, record, before + saved - started)
            if stop.is_set():
                goes_on = "; the same command goes on from there" if cell.config.resume else ""
                raise KeyboardInterrupt(f"stopped after epoch {progress.epoch}{goes_on}")
    return before


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
    return cell.evaluation.returns(cell.method.policy, episodes, "of the result")


def _rows(
    config: Config,
    record: Record,
    best: NDArray[np.float64],
    last: NDArray[np.float64],
    shared: dict[str, Any],
) -> list[Row]:
    """A row per seed, of (S, episodes) returns of the best and last policies."""
    aer = best.mean(axis=1)
    random, expert = shared["random_return"], shared["expert_return_measured"]
    performance = (aer - random) / (expert - random) if expert != random else aer * math.nan
    ablation = dataclasses.asdict(config.ablation)
    if not uses_equation_2(config):
        ablation |= {"k": None, "n": None}
    return [
        Row(
            env=config.env.name,
            method=config.method.name,
            seed=seed,
            **ablation,
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
            **shared,
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
