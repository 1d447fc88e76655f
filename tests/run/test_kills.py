"""Processes that are killed while they run a cell, and what is left when it has resumed."""

from __future__ import annotations

import io
import re
import shutil
import time
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from helpers.server import CONTEXT
from rich.console import Console

from ril.cli.display import ConsoleDisplay
from ril.config.schema import Config
from ril.run import training
from ril.run.experiment import run


def start(target: Callable[..., None], *arguments: Any) -> BaseProcess:
    process = CONTEXT.Process(target=target, args=arguments)
    process.start()
    return process


def run_to_the_end(config: Config) -> None:
    """What the processes do: a run with a checkpoint after each epoch."""
    torch.set_num_threads(1)
    training.CHECKPOINT_SECONDS = 0.0
    run(config, ConsoleDisplay(Console(file=io.StringIO()), live=False))


def run_and_say(config: Config, says: Path) -> None:
    """The same, with what it says in a file."""
    torch.set_num_threads(1)
    with says.open("w") as file:
        run(config, ConsoleDisplay(Console(file=file, width=300), live=False))


def left_by(folder: Path) -> tuple[str, str, list[str]]:
    """The rows without their time, the curve, and the names of all files."""
    rows = pd.read_csv(folder / "results.csv", dtype=str).drop(columns="wall_seconds")
    curve = (folder / "curve.csv").read_text() if (folder / "curve.csv").exists() else ""
    return rows.to_csv(), curve, sorted(path.name for path in folder.iterdir())


@pytest.fixture(scope="module")
def cell(quick: Any, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Config]:
    """The configuration of a cell that takes a second, in its own output folder."""

    def made(*overrides: str) -> Config:
        config: Config = quick(*overrides)
        config.output_dir = str(tmp_path_factory.mktemp("outputs"))
        return config

    return made


def only_run(config: Config) -> Path:
    [path] = Path(config.output_dir).rglob("results.csv")
    return path.parent


#: A method that is trained after each step, and one that is trained by episodes and the expert.
METHODS = {
    "dqn": ("method.total_timesteps=30", "evaluation.every=10%"),
    "ril": ("method.epochs=8",),
}
KILLS = 10


@pytest.mark.parametrize("name", METHODS)
def test_a_run_killed_at_random_moments_leaves_what_an_uninterrupted_one_does(
    cell: Callable[..., Config], name: str
) -> None:
    uninterrupted, killed = (cell(f"method={name}", *METHODS[name]) for _ in range(2))
    for _ in range(2):  # the first also starts the server
        shutil.rmtree(uninterrupted.output_dir)
        began = time.monotonic()
        start(run_to_the_end, uninterrupted).join()
        seconds = time.monotonic() - began
    expected = left_by(only_run(uninterrupted))

    moments, kills = np.random.default_rng(0), 0
    while True:
        process = start(run_to_the_end, killed)
        process.join(moments.uniform(0, seconds) if kills < KILLS else None)
        if process.exitcode is None:
            process.kill()
            process.join()
            kills += 1
            continue
        assert process.exitcode == 0
        assert left_by(only_run(killed)) == expected
        if kills == KILLS:
            return
        shutil.rmtree(killed.output_dir)


def test_of_two_processes_asked_for_a_cell_at_once_one_runs_it(
    cell: Callable[..., Config], tmp_path: Path
) -> None:
    config, files = cell("method.epochs=15"), [tmp_path / "one", tmp_path / "two"]
    processes = [start(run_and_say, config, file) for file in files]
    for process in processes:
        process.join()
        assert process.exitcode == 0
    first, second = sorted((file.read_text() for file in files), key=lambda text: "waiting" in text)
    assert "scoring" in first
    assert "waiting" not in first
    assert re.search(r"process \d+ on .* is running this cell; waiting for its rows", second)
    assert "scoring" not in second
    assert "already finished" in second
