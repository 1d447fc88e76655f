"""Which of RIL's open choices matter? One changed at a time, on tuning seeds and another trajectory.

    python scripts/search_ril.py run ril mountaincar     # a row for each that has none yet
    python scripts/search_ril.py show                    # the tables of docs/search/README.md

Every choice is run with seeds 100 to 104, from a trajectory of the expert other than the one that
reported runs see. Rows go to docs/search/<method>.csv, one as soon as it is known; several
processes may run at once, for different methods or environments.
"""

from __future__ import annotations

import csv
import fcntl
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pandas as pd
from matched_dqn import composed
from rich.console import Console

from ril.collection import pack, put_first
from ril.demonstrations.files import load_demonstrations
from ril.display import ConsoleDisplay
from ril.environments import load_environment
from ril.experiment import run as run_cell

SEARCH = Path(__file__).resolve().parents[1] / "docs" / "search"
SEEDS = "[100,101,102,103,104]"
ENVIRONMENTS = ("cartpole", "acrobot", "mountaincar", "lunarlander")
COLUMNS = (
    *("changed", "env", "seeds", "performance", "aer", "aer_std", "worst", "aer_last"),
    *("aer_last_std", "samples_to_best", "processor_seconds"),
)
AS_IT_COMES = "as it comes"

#: What is changed, one setting at a time, as overrides of `ril-run`; by method.
CHOICES = {
    "ril": (
        AS_IT_COMES,
        "method.episodes=3",
        "method.goal_sampler.pre_steps_per_action=1000",
        "method.inverse_dynamics.inputs=states",
        "method.inverse_dynamics.updates=30",
        "method.inverse_dynamics.labels=sample",
        "method.cloning.updates=30",
        "method.cloning.updates=100",
        "method.cloning.updates=300",
        "method.q_learning.updates=10",
        "method.q_learning.updates=200",
        "method.q_learning.discount=0.99",
        "method.q_learning.target_interval=100",
        "method.q_learning.loss=mse",
        "method.exploration.kind=uniform",
        "method.goal_sampler.memory=epoch",
        "method.network.layer_norm=false",
        "method.network.attention=false",
        "evaluation.every=5",
        "fidelity=paper",
    ),
    "ril_consistent": (
        AS_IT_COMES,
        "method.q_learning.imitation_weight=1",
        "method.q_learning.imitation_weight=10",
        "method.q_learning.fade=false",
        "method.q_learning.temperature=0.1",
        "method.q_learning.temperature=1",
        "method.q_learning.replay_pre=false",
        "method.q_learning.n_steps=1",
        "method.q_learning.n_steps=10",
        "method.q_learning.discount=0.99",
        "method.q_learning.updates=100",
        "method.q_learning.tau=1",
        "method.q_learning.learning_rate=5e-4",
        "method.episodes=2",
    ),
}


def write_tuning_demonstrations(env: str, folder: Path) -> Path:
    """The environment's demonstrations without the first, another like it now in its place."""
    environment = load_environment(composed(f"env={env}").env)
    episodes = shipped_episodes(env)
    first, others = episodes[0], episodes[1:]
    others = put_first(others, first.length, first.total_reward, margin=5.0)
    path = folder / f"{env}.npz"
    np.savez_compressed(path, allow_pickle=False, **pack(others))
    return path
