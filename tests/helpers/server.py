"""A server that has imported everything, whose forks run cells without pytest's threads."""

from __future__ import annotations

import multiprocessing

CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(
    [
        "ril",  # first, because it fixes the kernels of NumPy and torch
        "pytest",
        "torch._dynamo",
        "helpers.sweeps",
        "ril.cli.display",
        "gymnasium.envs.classic_control",
        *(f"ril.methods.{name}" for name in ("bc", "dqn", "gail", "ril")),
    ]
)
