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


import numpy as np
import pandas as pd
from against_sb3 import CHECKS, COPIES, EPISODES, KEYS, SEEDS, by_ril, command, fill, summary
from matched_dqn import composed, make_scaled, stable_baselines_dqn
from scipy.stats import permutation_test
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from ril.environments.environment import Environment, load_environment
from ril.learners.online_q_learning import EPOCHS
from ril.methods.dqn import DQNConfig

PARTS = 3  # of the budget; policies are scored after each
COLUMNS = (*KEYS, *(f"return_{part + 1}" for part in range(PARTS)))


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
    epochs = min(EPOCHS, total)
    ends = [epochs * (part + 1) // PARTS for part in range(PARTS)]

    def theirs(seed: int) -> list[float]:
        scores = Scores(environment, total, seed)
        stable_baselines_dqn(config.method, environment, seed).learn(total, scores)
        return scores.returns

    path = CHECKS / f"dqn_{config.env.name}.csv"
    fill(path, COLUMNS, total, lambda: by_ril(config, ends), theirs)


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
            for head, cells in summary(name, side, columns):
                print(f"| {head} | " + " | ".join(cells) + " |")
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
    command(run, show, __doc__)
