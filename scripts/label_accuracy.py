"""How many of the expert's actions does M_θ infer when it has seen only I^pre? D6's table.

    python scripts/label_accuracy.py [mountaincar …]

Sixteen tuning seeds, the first trajectory, §4.1's learning rates, and no cloning, so that all
there is between two lines is what `method.inverse_dynamics.standardise` says. Two minutes each.
"""

from __future__ import annotations

import sys

import numpy as np
import torch
from matched_dqn import composed

from ril.demonstrations.files import load_demonstrations, shipped_path
from ril.environments import load_environment
from ril.methods.registry import METHODS
from ril.methods.ril import RIL
from ril.task import Task

SEEDS = list(range(105, 121))
STEPS = {"cartpole": 500, "acrobot": 2000, "mountaincar": 500, "lunarlander": 500}


def label_accuracies(env: str, standardise: str) -> np.ndarray:
    """(S,) shares of the expert's actions that are inferred."""
    config = composed(
        f"env={env}",
        "method=ril",
        f"seeds={SEEDS}",
        f"method.inverse_dynamics.standardise={standardise}",
        f"method.inverse_dynamics.updates={STEPS[env]}",
    )
    environment = load_environment(config.env)
    given = load_demonstrations(shipped_path(env), environment).first(1)
    expert = METHODS["ril"].shown(given, environment)
    task = Task(environment, expert, tuple(SEEDS), config.ablation, torch.device("cpu"))
    imitation = RIL(config.method, task).imitation
    imitation.generate_pre()
    _, labels = imitation.infer_actions(limit=0.0)
    return (labels.numpy() == given.actions).mean(axis=1)


def main() -> None:
    """Print a line for each environment and each way to standardise."""
    torch.set_num_threads(1)
    for env in sys.argv[1:] or STEPS:
        for standardise in ("change", "true", "false"):
            shares = label_accuracies(env, standardise)
            print(f"{env} {standardise}: {shares.mean():.2f}, worst seed {shares.min():.2f}")


if __name__ == "__main__":
    main()
