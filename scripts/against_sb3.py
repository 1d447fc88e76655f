"""What the comparisons with Stable-Baselines3 share: seeds, evaluations, files of rows."""

from __future__ import annotations

import csv
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import torch

from ril.config.schema import Config
from ril.run.prepare import prepare
from ril.vectorized.evaluation import Evaluation

CHECKS = Path(__file__).resolve().parents[1] / "docs" / "checks"
SEEDS = tuple(range(100, 110))
EPISODES, COPIES = 100, 20
KEYS = ("learner", "seed", "total_timesteps")  # the first columns of every file


def by_ril(config: Config, ends: Sequence[int]) -> list[list[float]]:
    """Train all seeds with ril; return their mean returns after some epochs, a row per seed."""
    cell = prepare(config)
    method, evaluation = cell.build_method(), Evaluation(cell.environment, config.seeds)
    assert method is not None
    returns = [
        evaluation.returns(method.policy, EPISODES, f"check {progress.epoch}").mean(axis=1)
        for progress in method.train()
        if progress.epoch in ends
    ]
    rows: list[list[float]] = np.stack(returns, axis=1).tolist()
    return rows


def fill(
    path: Path,
    columns: Sequence[str],
    total: int,
    ours: Callable[[], list[list[float]]],
    theirs: Callable[[int], list[float]],
) -> None:
    """Train every seed that has no row yet, and write a row as soon as a seed is finished.

    Args:
        path: the file of rows, to append to.
        columns: all of its columns.
        total: environment steps of each seed.
        ours: trains all seeds with ril; returns a row of returns per seed.
        theirs: trains one seed with Stable-Baselines3; returns its returns.
    """
    done = set()
    if path.exists():
        rows = pd.read_csv(path)
        done = set(zip(*(rows[key] for key in KEYS), strict=True))
    with path.open("a", newline="") as file:
        writer = csv.writer(file)
        if file.tell() == 0:
            writer.writerow(columns)

        def write(learner: str, seed: int, returns: list[float]) -> None:
            writer.writerow((learner, seed, total, *(f"{value:.2f}" for value in returns)))
            file.flush()

        if not {("ril", seed, total) for seed in SEEDS} <= done:
            started = time.perf_counter()
            for seed, returns in zip(SEEDS, ours(), strict=True):
                write("ril", seed, returns)
            print(f"ril: {time.perf_counter() - started:.0f} s for {len(SEEDS)} seeds", flush=True)
        for seed in SEEDS:
            if ("sb3", seed, total) in done:
                continue
            started = time.perf_counter()
            write("sb3", seed, theirs(seed))
            print(f"sb3: {time.perf_counter() - started:.0f} s for seed {seed}", flush=True)


def summary(name: str, side: pd.DataFrame, columns: Sequence[str]) -> list[tuple[str, list[str]]]:
    """Return two lines of a table, with their heads: means and deviations, and quantiles."""
    means = [f"{side[c].mean():.1f} ± {side[c].std(ddof=0):.1f}" for c in columns]
    quantiles = [", ".join(f"{q:.0f}" for q in side[c].quantile([0, 0.5, 1])) for c in columns]
    return [(f"{name} ({len(side)} seeds)", means), ("lowest, median, highest", quantiles)]


def command(run: Callable[[list[str]], None], show: Callable[[], None], usage: str | None) -> None:
    """Do what the command line asks for: `run OVERRIDE…`, or `show`.

    Args:
        run: takes overrides of the configuration.
        show: prints the comparison of the rows.
        usage: what is printed if neither is asked for.
    """
    torch.set_num_threads(1)
    match sys.argv[1:]:
        case ["run", *overrides]:
            run(overrides)
        case ["show"]:
            show()
        case _:
            sys.exit(usage)
