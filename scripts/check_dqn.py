"""Compare `method=dqn` with Stable-Baselines3's DQN, with the same value of every key.

    python scripts/check_dqn.py run env=cartpole method.total_timesteps=50_000
    python scripts/check_dqn.py run env=mountaincar method.total_timesteps=120_000
    python scripts/check_dqn.py show

`run` trains ten seeds of each, and writes their greedy returns after each third of the budget to
docs/checks/dqn_<env>.csv, a row as soon as a seed is finished. The same command resumes with the
seeds that have no row. `show` prints the comparison in docs/checks/README.md.
"""

from __future__ import annotations

import ril  # noqa: F401 - first, because it fixes the kernels of NumPy and torch

# isort: split

import csv
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from matched_dqn import composed, make_scaled, stable_baselines_dqn
from scipy.stats import permutation_test
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from ril.config.schema import Config
from ril.environments import Environment, load_environment
from ril.methods.dqn import DQNConfig
from ril.run.prepare import prepare
from ril.vectorized.evaluation import Evaluation

CHECKS = Path(__file__).resolve().parents[1] / "docs" / "checks"
SEEDS = tuple(range(100, 110))
PARTS = 3  # of the budget; policies are scored after each
EPISODES, COPIES = 100, 20
COLUMNS = ("learner", "seed", "total_timesteps", *(f"return_{part + 1}" for part in range(PARTS)))


def by_ril(config: Config) -> list[list[float]]:
    """Train all seeds with ril; return their (S, PARTS) mean returns."""
    cell = prepare(config)
    method, evaluation = cell.build_method(), Evaluation(cell.environment, config.seeds)
    ends = [method.epochs * (part + 1) // PARTS for part in range(PARTS)]
    returns = [
        evaluation.returns(method.policy, EPISODES, f"check {progress.epoch}").mean(axis=1)
        for progress in method.train()
        if progress.epoch in ends
    ]
    return np.stack(returns, axis=1).tolist()


class Scores(BaseCallback):
    """Score the policy of Stable-Baselines3 after each part of its budget."""

    def __init__(self, environment: Environment, total: int, seed: int) -> None:
        super().__init__()
        self.ends = [total * (part + 1) // PARTS for part in range(PARTS)]
        self.returns: list[float] = []
        self.copies = make_vec_env(lambda: make_scaled(environment), COPIES, seed=1000 * seed)

    def _on_step(self) -> bool:
        if self.num_timesteps in self.ends:
            mean, _ = evaluate_policy(self.model, self.copies, EPISODES, deterministic=True)
            self.returns.append(float(mean))
        return True


def run(overrides: list[str]) -> None:
    """Train every seed that has no row yet."""
    config = composed("method=dqn", f"seeds={list(SEEDS)}", "compile=false", *overrides)
    assert isinstance(config.method, DQNConfig)
    environment, total = load_environment(config.env), config.method.total_timesteps
    path = CHECKS / f"dqn_{config.env.name}.csv"
    done = set()
    if path.exists():
        rows = pd.read_csv(path)
        done = set(zip(rows["learner"], rows["seed"], rows["total_timesteps"], strict=True))
    with path.open("a", newline="") as file:
        writer = csv.writer(file)
        if file.tell() == 0:
            writer.writerow(COLUMNS)

        def write(learner: str, seed: int, returns: list[float]) -> None:
            writer.writerow((learner, seed, total, *(f"{value:.2f}" for value in returns)))
            file.flush()

        if not {("ril", seed, total) for seed in SEEDS} <= done:
            started = time.perf_counter()
            for seed, returns in zip(SEEDS, by_ril(config), strict=True):
                write("ril", seed, returns)
            print(f"ril: {time.perf_counter() - started:.0f} s for {len(SEEDS)} seeds", flush=True)
        for seed in SEEDS:
            if ("sb3", seed, total) in done:
                continue
            started = time.perf_counter()
            scores = Scores(environment, total, seed)
            stable_baselines_dqn(config.method, environment, seed).learn(total, scores)
            write("sb3", seed, scores.returns)
            print(f"sb3: {time.perf_counter() - started:.0f} s for seed {seed}", flush=True)


def show() -> None:
    """Print means and standard deviations over seeds, and p of a permutation test."""
    for path in sorted(CHECKS.glob("dqn_*.csv")):
        rows = pd.read_csv(path)
        total = int(rows["total_timesteps"].iloc[0])
        heads = [f"{total * (part + 1) // PARTS:,} steps" for part in range(PARTS)]
        print(f"\n| {path.stem.removeprefix('dqn_')} | " + " | ".join(heads) + " |")
        print("|---" * (PARTS + 1) + "|")
        ours, theirs = (rows.loc[rows["learner"] == name] for name in ("ril", "sb3"))
        columns = COLUMNS[3:]
        for name, side in (("`method=dqn`", ours), ("Stable-Baselines3", theirs)):
            cells = [f"{side[c].mean():.1f} ± {side[c].std(ddof=0):.1f}" for c in columns]
            print(f"| {name} ({len(side)} seeds) | " + " | ".join(cells) + " |")
            cells = [", ".join(f"{q:.0f}" for q in side[c].quantile([0, 0.5, 1])) for c in columns]
            print("| lowest, median, highest | " + " | ".join(cells) + " |")
        p = [
            permutation_test(
                (ours[c], theirs[c]),
                lambda a, b: abs(np.mean(a) - np.mean(b)),
                alternative="greater",
                rng=0,
            ).pvalue
            for c in columns
        ]
        print("| p of a permutation test | " + " | ".join(f"{value:.2f}" for value in p) + " |")


if __name__ == "__main__":
    torch.set_num_threads(1)
    match sys.argv[1:]:
        case ["run", *overrides]:
            run(overrides)
        case ["show"]:
            show()
        case _:
            sys.exit(__doc__)
