"""Compare `method=ppo` with Stable-Baselines3's PPO, with the same value of every key.

    python scripts/check_ppo.py run env=cartpole method.total_timesteps=100_000
    python scripts/check_ppo.py run env=mountaincar method.total_timesteps=100_000
    python scripts/check_ppo.py show

`run` trains ten seeds of each, and writes their greedy returns after a quarter, half and all of the
budget to docs/checks/ppo_<env>.csv, a row as soon as a seed is finished. The same command resumes
with the seeds that have no row. `show` prints the comparison in docs/checks/README.md.
"""

from __future__ import annotations

import ril  # noqa: F401 - first, because it fixes the kernels of NumPy and torch

# isort: split

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from against_sb3 import CHECKS, COPIES, EPISODES, KEYS, SEEDS, by_ril, command, fill, summary
from matched_dqn import composed, make_scaled
from matched_ppo import stable_baselines_ppo
from scipy.stats import permutation_test
from scipy.stats import t as student
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from ril.environments.environment import Environment, load_environment
from ril.methods.ppo import PPOMethodConfig

SHARES = 0.25, 0.5, 1  # of the budget; policies are scored after each
RETURNS = tuple(f"return_{100 * share:.0f}" for share in SHARES)
COLUMNS = (*KEYS, *RETURNS)


def rollouts(config: PPOMethodConfig) -> list[int]:
    """Return the numbers of the rollouts after whose updates policies are scored."""
    total = math.ceil(config.total_timesteps / (config.ppo.n_envs * config.ppo.n_steps))
    return [round(share * total) for share in SHARES]


class Scores(BaseCallback):
    """Score the policy of Stable-Baselines3 after the updates on some rollouts."""

    def __init__(self, environment: Environment, ends: Sequence[int], seed: int) -> None:
        super().__init__()
        self.ends = ends
        self.rollouts = 0
        self.returns: list[float] = []
        self.copies: VecEnv = make_vec_env(
            lambda: make_scaled(environment), COPIES, seed=1000 * seed
        )

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:  # after the updates on the last one
        self._score()

    def _on_rollout_end(self) -> None:
        self.rollouts += 1

    def _on_training_end(self) -> None:
        self._score()

    def _score(self) -> None:
        if self.rollouts not in self.ends:
            return
        copies = self.copies
        trained = self.model.get_vec_normalize_env()
        if trained is not None:
            copies = VecNormalize(copies, training=False, norm_reward=False)
            copies.obs_rms = trained.obs_rms
        mean, _ = evaluate_policy(self.model, copies, EPISODES, deterministic=True)
        assert isinstance(mean, float)
        self.returns.append(mean)


def run(overrides: list[str]) -> None:
    """Train every seed that has no row yet."""
    config = composed("method=ppo", f"seeds={list(SEEDS)}", *overrides)
    method = config.method
    assert isinstance(method, PPOMethodConfig)
    environment, total, ends = (
        load_environment(config.env),
        method.total_timesteps,
        rollouts(method),
    )

    def theirs(seed: int) -> list[float]:
        scores = Scores(environment, ends, seed)
        model = stable_baselines_ppo(method.ppo, lambda: make_scaled(environment), seed)
        model.learn(total, scores)
        return scores.returns

    path = CHECKS / f"ppo_{config.env.name}.csv"
    fill(path, COLUMNS, total, lambda: by_ril(config, ends), theirs)


def difference(ours: pd.Series, theirs: pd.Series) -> str:
    """Format the difference of two means, and its 95 % interval by Welch's approximation."""
    value = ours.mean() - theirs.mean()
    squares = [(side.var() / len(side), len(side) - 1) for side in (ours, theirs)]
    total = sum(square for square, _ in squares)
    if total == 0:
        return f"{value:.1f}"
    freedom = total**2 / sum(square**2 / degrees for square, degrees in squares)
    margin = math.sqrt(total) * student.ppf(0.975, freedom)
    return f"{value:.1f} [{value - margin:.1f}, {value + margin:.1f}]"


def exact_p(ours: pd.Series, theirs: pd.Series) -> float:
    """Compute p of the permutation test of equal means, over all divisions of the seeds."""

    def distance(a: Any, b: Any, axis: int) -> Any:
        # Rounded, so that equal sums in another order count as equal.
        return np.abs(np.mean(a, axis=axis) - np.mean(b, axis=axis)).round(9)

    test = permutation_test(
        (ours, theirs), distance, vectorized=True, n_resamples=np.inf, alternative="greater"
    )
    return float(test.pvalue)


def show() -> None:
    """Print means and standard deviations over seeds, their differences, and exact p-values."""
    for path in sorted(CHECKS.glob("ppo_*.csv")):
        rows = pd.read_csv(path)
        total = int(rows["total_timesteps"].iloc[0])
        heads = [f"{share * total:,.0f} steps" for share in SHARES]
        print(f"\n| {path.stem.removeprefix('ppo_')} | " + " | ".join(heads) + " |")
        print("|---" * (len(SHARES) + 1) + "|")
        ours, theirs = (rows.loc[rows["learner"] == name] for name in ("ril", "sb3"))
        lines: list[tuple[str, list[str]]] = []
        for name, side in (("`method=ppo`", ours), ("Stable-Baselines3", theirs)):
            lines += summary(name, side, RETURNS)
        cells = [difference(ours[c], theirs[c]) for c in RETURNS]
        lines.append(("difference, 95 % interval", cells))
        cells = [f"{exact_p(ours[c], theirs[c]):.2f}" for c in RETURNS]
        lines.append(("p of a permutation test", cells))
        for name, cells in lines:
            print(f"| {name} | " + " | ".join(cells).replace("-", "−") + " |")


if __name__ == "__main__":
    command(run, show, __doc__)
