"""One run: train all seeds of a cell, look at them on the way, score them, leave rows."""

from __future__ import annotations

import dataclasses
import importlib
import io
import json
import math
import time
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
from ril.methods.base import Method, Progress, Task
from ril.policy import save_policies
from ril.provenance import commit, provenance
from ril.record import Record
from ril.results import Row, write_atomically, write_csv

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


def run(config: Config, display: Display) -> Path:
    """Train and score one cell.

    Returns:
        The run's folder, `<output_dir>/<env>/<method>/<run_id>`; `results.csv` in it has a row
        per seed.

    Raises:
        UserError: something that was asked for cannot be used; nothing has been written.
    """
    torch.set_num_threads(1)
    if config.method.name not in METHODS:
        raise UserError(f"method.name={config.method.name}: must be one of {', '.join(METHODS)}")
    environment = load_environment(config.env)
    device = _device(config.device)
    path = _demonstrations_path(config)
    demonstrations = load_demonstrations(path, environment)
    task = Task(
        environment,
        demonstrations.first(config.ablation.trajectories).states(environment),
        tuple(config.seeds),
        config.ablation,
        device,
    )
    identifier = run_id(config, demonstrations.sha256)
    folder = Path(config.output_dir) / config.env.name / config.method.name / identifier
    folder = _claim(folder, resume=config.resume)
    if (folder / "results.csv").exists():
        display.finished(folder / "results.csv", skipped=True)
        return folder

    details = {"run_id": identifier, **provenance(path, demonstrations.sha256)}
    write_atomically(folder / "provenance.json", json.dumps(details, indent=2).encode())
    settings = yaml.safe_dump(dataclasses.asdict(config), sort_keys=False, allow_unicode=True)
    write_atomically(folder / "config.yaml", settings.encode())

    module, name = METHODS[config.method.name].split(":")
    method: Method = getattr(importlib.import_module(module), name)(config.method, task)
    record = Record(config.seeds, method.policy.flat)
    evaluation = Evaluation(environment, config.seeds)
    display.started(config, folder)
    seconds = _train(config, method, record, evaluation, demonstrations, folder, display)
    display.scoring()
    started = time.monotonic()
    scores = {
        which: _score(evaluation, method, parameters, config.evaluation.episodes)
        for which, parameters in (("best", record.best), ("last", record.last))
    }
    rows = _rows(config, identifier, environment, demonstrations, record, scores)
    seconds += time.monotonic() - started
    rows = [dataclasses.replace(row, wall_seconds=round(seconds, 2)) for row in rows]

    save_policies(folder / "policy.pt", environment, method.policy.architecture, record)
    write_csv(folder / "curve.csv", record.curve)
    write_csv(folder / "results.csv", rows)  # last: a run with rows is a finished run
    (folder / "checkpoint.pt").unlink(missing_ok=True)
    display.finished(folder / "results.csv", skipped=False)
    return folder


def _train(
    config: Config,
    method: Method,
    record: Record,
    evaluation: Evaluation,
    demonstrations: Demonstrations,
    folder: Path,
    display: Display,
) -> float:
    """Train to the end, from the checkpoint if there is one; returns the seconds it took."""
    checkpoint = folder / "checkpoint.pt"
    seconds = _load_checkpoint(checkpoint, method, record)
    expert_actions = demonstrations.first(config.ablation.trajectories).actions
    started = saved = time.monotonic()
    for progress in method.train():
        live = ~record.stopped
        just_stopped = record.advance(progress, method.policy.flat)
        last = progress.epoch == config.method.epochs
        looked_at = live if last or progress.epoch % config.evaluation.every == 0 else just_stopped
        if looked_at.any():
            metrics = dict(progress.metrics)
            if progress.pseudo_labels is not None:
                right = progress.pseudo_labels == expert_actions
                metrics["label_accuracy"] = right.mean(axis=1)
            purpose = f"after epoch {progress.epoch}"
            returns = evaluation.returns(method.act, config.evaluation.selection_episodes, purpose)
            record.evaluated(returns.mean(axis=1), looked_at, metrics)
        display.advanced(progress, record)
        if time.monotonic() - saved > CHECKPOINT_SECONDS:
            saved = time.monotonic()
            state = {
                "seconds": seconds + saved - started,
                "method": method.state_dict(),
                "record": record.state_dict(),
            }
            buffer = io.BytesIO()
            torch.save(state, buffer)
            write_atomically(checkpoint, buffer.getvalue())
    return seconds + time.monotonic() - started


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


def _score(
    evaluation: Evaluation, method: Method, parameters: torch.Tensor, episodes: int
) -> NDArray[np.float64]:
    """(S, episodes) returns of given policies on fresh episodes, the same starts for each call."""
    method.policy.flat.copy_(parameters)
    return evaluation.returns(method.act, episodes, "of the result")


def _rows(
    config: Config,
    identifier: str,
    environment: Environment,
    demonstrations: Demonstrations,
    record: Record,
    scores: dict[str, NDArray[np.float64]],
) -> list[Row]:
    """A row per seed."""
    expert = float(demonstrations.returns.mean())
    random = float(random_returns(environment, config.evaluation.episodes).mean())
    method, ablation = config.method, config.ablation
    pre_steps = getattr(getattr(method, "goal_sampler", None), "pre_steps_per_action", 0)
    rows = []
    for index, seed in enumerate(config.seeds):
        best, last = scores["best"][index], scores["last"][index]
        aer = float(best.mean())
        rows.append(
            Row(
                run_id=identifier,
                env=config.env.name,
                method=method.name,
                seed=seed,
                k=ablation.k,
                n=ablation.n,
                trajectories=ablation.trajectories,
                expert_return=ablation.expert_return,
                epochs=int(record.epochs[index]),
                best_epoch=int(record.best_epoch[index]),
                aer=aer,
                aer_std=float(best.std()),
                aer_last=float(last.mean()),
                performance=(aer - random) / (expert - random) if expert != random else math.nan,
                env_samples=int(record.env_samples[index]),
                expert_samples=int(record.expert_samples[index]),
                pre_samples=pre_steps * environment.action_count,
                samples_to_best=int(record.samples_to_best[index]),
                random_return=random,
                expert_return_measured=expert,
                wall_seconds=0.0,
                commit=commit(),
            )
        )
    return rows


def _device(name: str) -> torch.device:
    try:
        device = torch.device(name)
        torch.zeros(1, device=device).item()
    except (RuntimeError, AssertionError):
        raise UserError(f"device={name}: torch cannot use it here") from None
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
