"""Train an expert, and write its trajectories beside a JSON record of how they were made."""

from __future__ import annotations

import hashlib
import json
import math
import os
import platform
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from ril.environments.environment import load_environment
from ril.environments.examination import examine
from ril.experts.collection import Episode, put_first, save
from ril.experts.training import ExpertConfig, OnStep, train
from ril.io.errors import UserError


def make_expert(
    config: ExpertConfig,
    command: str,
    on_step: OnStep,
    on_doubt: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """Train an expert, collect its trajectories, and write both files.

    Args:
        config: of `ril-expert`.
        command: the command line, for the record.
        on_step: called during training; see `OnStep`.
        on_doubt: called before training with each doubt about the environment.

    Returns:
        The record, as written to the `.json` file beside `config.output`.

    Raises:
        UserError: a value is not allowed, or the target is not reached; nothing is written.
    """
    import torch

    torch.set_num_threads(1)
    _check(config)
    environment = load_environment(config.env)
    started = time.monotonic()
    with closing(environment):
        doubts = examine(environment)
        for doubt in doubts:
            on_doubt(doubt)
        collected, steps, evaluation_mean = train(config, environment, on_step)
    episodes = put_first(collected, config.first_length, config.target_return, config.margin)
    record = {
        "command": command,
        "config": asdict(config),
        "versions": {
            "python": platform.python_version(),
            **{name: version(name) for name in ("torch", "stable-baselines3", "gymnasium")},
        },
        "seed": config.seed,
        "steps_trained": steps,
        "evaluation_mean_return": evaluation_mean,
        "episodes": len(episodes),
        "transitions": sum(e.length for e in episodes),
        "returns": _summary([e.total_reward for e in episodes]),
        "lengths": _summary([e.length for e in episodes]),
        "first": {
            "length": episodes[0].length,
            "return": episodes[0].total_reward,
            "collected_as": collected.index(episodes[0]),
        },
        "doubts": list(doubts),
        "reset_seeds": [e.seed for e in episodes],
        "wall_seconds": round(time.monotonic() - started, 1),
    }
    return _write(episodes, record, Path(config.output))


def _summary(values: Sequence[float]) -> dict[str, float]:
    array = np.asarray(values)
    return {name: float(getattr(array, name)()) for name in ("mean", "std", "min", "max")}


def _check(config: ExpertConfig) -> None:
    """Refuse values that are not allowed, before anything is trained."""
    import torch

    output = Path(config.output)
    existing = next(folder for folder in output.absolute().parents if folder.exists())
    budget, length = config.total_timesteps, config.first_length
    for key, is_allowed, allowed in (
        ("algorithm", config.algorithm in ("ppo", "dqn"), "ppo or dqn"),
        ("target_return", math.isfinite(config.target_return), "a finite number"),
        ("tolerance", 0 < config.tolerance < math.inf, "a number above 0, such as 0.03"),
        ("total_timesteps", budget >= 1, "1 or more"),
        ("check_every", 1 <= config.check_every <= budget, f"within 1..total_timesteps={budget}"),
        ("episodes", config.episodes >= 1, "1 or more"),
        ("first_length", length is None or length >= 1, "null, or 1 or more"),
        ("seed", 0 <= config.seed < 2**32, "within 0..4294967295"),
        ("output", output.suffix == ".npz" and not output.is_dir(), "a file named *.npz"),
        ("output", existing.is_dir() and os.access(existing, os.W_OK), "in a writable folder"),
    ):
        if not is_allowed:
            raise UserError(f"{key}={getattr(config, key)}: must be {allowed}")
    try:
        torch.zeros(1, device=config.device)
    except (RuntimeError, AssertionError):
        raise UserError(f"device={config.device}: torch cannot use it on this machine") from None


def _write(episodes: Sequence[Episode], record: dict[str, Any], output: Path) -> dict[str, Any]:
    """Write both files under temporary names, then rename them; return the record with SHA-256."""
    record_path = output.with_suffix(".json")
    arrays, text = (path.with_name(f".{os.getpid()}-{path.name}") for path in (output, record_path))
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        save(arrays, episodes)
        record = {"sha256": hashlib.sha256(arrays.read_bytes()).hexdigest(), **record}
        text.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
        arrays.replace(output)
        text.replace(record_path)
    except OSError as error:
        raise UserError(f"output={output}: cannot be written ({error.strerror})") from None
    finally:
        for temporary in (arrays, text):
            temporary.unlink(missing_ok=True)
    return record
