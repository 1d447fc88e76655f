"""Measure how many of the expert's actions M_θ infers after training on I^pre (deviation D6).

    python scripts/label_accuracy.py              # all four environments, two minutes each
    python scripts/label_accuracy.py mountaincar

It uses sixteen tuning seeds, the first trajectory, §4.1's learning rates and no cloning, so that
the lines of an environment differ in `method.inverse_dynamics.standardize` only.
"""

from __future__ import annotations

import ril  # noqa: F401 - first, because it fixes the kernels of NumPy and torch

# isort: split

import sys

import numpy as np
from matched_dqn import composed

from ril.run.prepare import prepare

SEEDS = list(range(105, 121))
UPDATES = {"cartpole": 500, "acrobot": 2000, "mountaincar": 500, "lunarlander": 500}


def label_accuracies(env: str, standardize: str) -> np.ndarray:
    """Return (S,) shares of the expert's actions that are inferred."""
    config = composed(
        f"env={env}",
        "method=ril",
        f"seeds={SEEDS}",
        f"method.inverse_dynamics.standardize={standardize}",
        f"method.inverse_dynamics.updates={UPDATES[env]}",
    )
    cell = prepare(config)
    imitation = cell.build_method().imitation
    imitation.generate_pre()
    imitation.train(imitation.sample_dataset(limit=0.0))  # I^pre only
    labels = imitation.infer_actions()
    return (labels.numpy() == cell.given.actions).mean(axis=1)


def main() -> None:
    """Print a line for each environment and each value of `standardize`."""
    environments = sys.argv[1:] or list(UPDATES)
    if not set(environments) <= set(UPDATES):
        sys.exit(__doc__)
    for env in environments:
        for standardize in ("change", "true", "false"):
            shares = label_accuracies(env, standardize)
            print(f"{env} {standardize}: {shares.mean():.2f}, worst seed {shares.min():.2f}")


if __name__ == "__main__":
    main()
