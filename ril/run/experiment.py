"""One run of one cell: check what is asked for, have it trained and scored, leave rows."""

from __future__ import annotations

import dataclasses
import json
import math
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml

from ril.config.checks import idle_ablations, run_folder, run_id
from ril.config.schema import METHOD_CONFIGS, Config
from ril.demonstrations.files import check_level, demonstrations_path, load_demonstrations
from ril.demonstrations.trajectories import Demonstrations
from ril.environments import Environment, load_environment
from ril.io.errors import UserError, one_line
from ril.io.files import WriteError, write_atomically
from ril.io.locks import BusyError, claimed
from ril.io.rows import Row, load_results, write_csv
from ril.io.signals import Stopped, stop_on_signals
from ril.methods.registry import METHODS
from ril.policy import save_policies
from ril.run.evaluation import random_returns
from ril.run.provenance import command, provenance
from ril.run.record import Record
from ril.run.training import Cell, Display, Outcome, train_and_score
from ril.task import Task
from ril.vectorized.processes import usable_processes

#: What reading a file of the run raises that is not as it was left.
_TORN = (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError)


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
        Stopped: the user stopped it; the message says how to go on.
    """
    torch.set_num_threads(1)
    name = config.method.name
    fitting = [known for known, kind in METHOD_CONFIGS.items() if kind is type(config.method)]
    if name not in fitting:
        raise UserError(f"method.name={name}: must be {' or '.join(fitting)}")
    environment = load_environment(config.env)
    device = _device(config.device)
    path = demonstrations_path(config)
    demonstrations = load_demonstrations(path, environment)
    check_level(config, demonstrations)
    given = demonstrations.first(config.ablation.trajectories)
    wanted = run_folder(config, demonstrations.sha256)
    identifier = wanted.name
    if config.resume:
        if has_rows(wanted, config, identifier):
            display.finished(wanted / "results.csv", skipped=True)
            return wanted
        _refuse_changed_demonstrations(wanted, config, demonstrations.sha256)

    method = None
    if name in METHODS:
        entry = METHODS[name]
        expert = entry.shown(given, environment)
        task = Task(
            environment,
            expert,
            tuple(config.seeds),
            config.ablation,
            device,
            config.compile,
            usable_processes(config.processes),
        )
        method = entry.load()(config.method, task)

    def say_who(holder: str) -> None:
        cell = f"env={config.env.name} method={name}"
        display.noted(f"{cell}: {holder} runs it already; waiting for its rows")

    goes_on = f"; go on with {command()}" if config.resume else ""
    try:
        with (
            claimed(wanted, new=not config.resume, wait=say_who) as claim,
            stop_on_signals() as stop,
        ):
            folder = claim.folder
            stop.immediate = method is None
            if config.resume and has_rows(folder, config, identifier):
                display.finished(folder / "results.csv", skipped=True)  # meanwhile, by another
                return folder
            if not claim.exclusive:
                display.noted(f"{folder}: cannot be locked here; do not run the cell twice at once")
            details = {"run_id": identifier, **provenance(path, demonstrations.sha256)}
            details = _keep_start(folder, details)
            settings = yaml.safe_dump(
                dataclasses.asdict(config), sort_keys=False, allow_unicode=True
            )
            write_atomically(folder / "config.yaml", settings.encode())

            display.started(config, folder, 0 if method is None else method.epochs)
            if method is None:
                outcome = _measure_reference(config, environment, demonstrations)
            else:
                cell = Cell(config, identifier, environment, method, given.actions, claim, stop)
                outcome = train_and_score(cell, display)
            random = random_returns(environment, [0], config.evaluation.episodes)
            claim.check()
            if method is not None:
                architecture = method.policy.architecture
                save_policies(folder / "policy.pt", environment, architecture, outcome.record)
                write_csv(folder / "curve.csv", outcome.record.curve)
            shared = {
                "run_id": identifier,
                "variant": variant,
                "random_return": float(random.mean()),
                "expert_return_measured": float(demonstrations.returns.mean()),
                "wall_seconds": round(outcome.seconds, 2),
                "commit": details["commit"],
            }
            # Last: a run with rows is a finished run.
            write_csv(folder / "results.csv", _rows(config, outcome, shared))
            (folder / "checkpoint.pt").unlink(missing_ok=True)
    except Stopped as stopped:
        raise Stopped(f"{stopped}{goes_on}", stopped.number) from None
    except WriteError as error:
        raise UserError(f"{error}{goes_on}") from None
    display.finished(folder / "results.csv", skipped=False)
    return folder


def _measure_reference(
    config: Config, environment: Environment, demonstrations: Demonstrations
) -> Outcome:
    """What `performance` counts from (random) and to (expert); nothing is learnt."""
    started = time.monotonic()
    if config.method.name == "random":
        returns = random_returns(environment, config.seeds, config.evaluation.episodes)
    else:
        returns = np.tile(demonstrations.returns, (len(config.seeds), 1))
    record = Record(config.seeds, torch.zeros(len(config.seeds), 0))
    return Outcome(record, best=returns, last=returns, seconds=time.monotonic() - started)


def _rows(config: Config, outcome: Outcome, shared: dict[str, Any]) -> list[Row]:
    """A row per seed."""
    record, best, last = outcome.record, outcome.best, outcome.last
    aer = best.mean(axis=1)
    random, expert = shared["random_return"], shared["expert_return_measured"]
    performance = (aer - random) / (expert - random) if expert != random else aer * math.nan
    ablation = dataclasses.asdict(config.ablation) | dict.fromkeys(idle_ablations(config))
    return [
        Row(
            env=config.env.name,
            method=config.method.name,
            seed=seed,
            **ablation,
            epochs=int(record.epochs[index]),
            total_timesteps=getattr(config.method, "total_timesteps", None),
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


def has_rows(folder: Path, config: Config, identifier: str) -> bool:
    """Whether a run left its rows; what it had no time to remove is removed.

    Args:
        folder: of the run.
        config: of the run.
        identifier: its run_id.

    Raises:
        UserError: they are not the rows that it wrote.
    """
    path = folder / "results.csv"
    if not path.exists():
        return False
    anew = f"delete it, and {command()} runs the cell again"
    try:
        rows, left_out = load_results([folder])
    except OSError as error:
        raise UserError(f"{one_line(error)}; {anew}") from None
    if left_out:
        raise UserError(f"{left_out[0]}; {anew}")
    if rows["seed"].tolist() != config.seeds or set(rows["run_id"]) != {identifier}:
        raise UserError(f"{path}: does not hold the rows of {identifier}, a seed each; {anew}")
    if any((folder / name).exists() for name in ("checkpoint.pt", ".lock")):
        # Of one that still ends by itself, or is read-only by now, nothing is removed.
        with suppress(BusyError, UserError, OSError), claimed(folder):
            (folder / "checkpoint.pt").unlink(missing_ok=True)
    return True


def _refuse_changed_demonstrations(folder: Path, config: Config, sha256: str) -> None:
    """Refuse to leave a stopped run behind because its demonstrations have changed meanwhile.

    Raises:
        UserError: there is a checkpoint of what would be this run, had they not.
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
        except (*_TORN, yaml.YAMLError):
            continue  # another run's trouble, which that run will name
        if same_file:
            raise UserError(
                f"demonstrations={config.demonstrations}: changed since the stopped run in {other} "
                f"began (SHA-256 {before[:10]}…, now {sha256[:10]}…); put the old file back to go "
                "on, or delete that folder, or give resume=false, to start with the new one"
            )


def _keep_start(folder: Path, details: dict[str, Any]) -> dict[str, Any]:
    """Write the provenance; of a run that goes on, the first start's, with a list of the later."""
    path = folder / "provenance.json"
    if (folder / "checkpoint.pt").exists():
        try:
            first: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            resumed = [*first.get("resumed", [])]
            first["commit"]
        except _TORN:
            raise UserError(
                f"{path}: cannot be read, so where the run began is not known; "
                f"delete {folder}, or give resume=false, to start again"
            ) from None
        again = {key: details[key] for key in ("command", "started", "commit", "processor")}
        details = first | {"resumed": [*resumed, again]}
    write_atomically(path, json.dumps(details, indent=2).encode())
    return details
