"""(f) The hours that every cell of Tables 2 to 9 would take here, ten seeds each."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator

import torch
from matched_dqn import composed

from bench.clock import seconds, table
from ril.demonstrations.files import demonstrations_path, load_demonstrations
from ril.environments import load_environment
from ril.methods.registry import METHODS
from ril.vectorized.evaluation import Evaluation
from ril.task import Task

ENVIRONMENTS = ("cartpole", "acrobot", "mountaincar", "lunarlander")
#: Cells of Table 9 besides the expert of the others.
WORSE_EXPERTS = {"cartpole": 4, "acrobot": 4, "mountaincar": 2, "lunarlander": 0}
#: Cells of an environment by method and trajectories, each once however many tables show it.
CELLS = {
    ("bc", 1): 2,  # one trajectory (Table 2), and 100 (Table 4), which take no longer
    ("gail", 1): 2,
    ("ilpo", 1): 2,
    ("iupe", 1): 1,
    ("iupe", 100): 1,
    ("ril", 1): 11,  # Table 2; six other k (Table 7), three other n (Table 8); half of RIL*
    ("ril", 100): 4,  # Table 4; 25, 50 and 75 trajectories (Table 6) take less
    ("ril_sequential", 1): 1,  # Table 5
    **{(name, 1): 1 for name in ("dqn", "dqn_prioritized", "ppo", "acktr")},  # Table 4
}
_ENOUGH = 1.5  # seconds of training that are measured
#: Table 5's RIL* is RIL's imitation, counted as a cell of RIL, and then this.
SECOND_HALF = "ril_sequential"


def hours(name: str, trajectories: int, env: str) -> float:
    """What a cell takes: its epochs at the pace of the first, and looks at such policies."""
    asked = [f"env={env}", f"method={name}", f"ablation.trajectories={trajectories}"]
    config = composed(*asked, *(["method.epochs=1"] if name == SECOND_HALF else []))
    environment = load_environment(config.env)
    demonstrations = load_demonstrations(demonstrations_path(config), environment)
    entry, seeds = METHODS[name], tuple(range(10))
    expert = entry.shown(demonstrations.first(trajectories), environment)
    task = Task(environment, expert, seeds, config.ablation, torch.device("cpu"), config.compile)
    method = entry.load()(config.method, task)
    progress = method.train()
    before = seconds(lambda: next(progress))
    each = _pace(progress)
    looks = math.ceil(method.epochs / epochs_between_looks(config.evaluation.every, method.epochs))
    episodes = looks * config.evaluation.selection_episodes + 2 * config.evaluation.episodes
    scoring = seconds(lambda: Evaluation(environment, seeds).returns(method.policy, 25, "pace"))
    return (before + method.epochs * each + scoring * episodes / 25) / 3600


def _pace(progress: Iterator[object]) -> float:
    """Seconds per epoch, after what comes before the first and compiling."""
    started, epochs = time.process_time(), 0
    while time.process_time() - started < _ENOUGH and next(progress, None) is not None:
        epochs += 1
    return (time.process_time() - started) / max(epochs, 1)


def projection() -> tuple[str, float]:
    """The table of (f), and all its hours."""
    rows, total = [], 0.0
    for (name, trajectories), cells in CELLS.items():
        each = []
        for env in ENVIRONMENTS:
            count = cells + (WORSE_EXPERTS[env] if (name, trajectories) == ("ril", 1) else 0)
            each.append(count * hours(name, trajectories, env))
        what = "`ril_sequential`, second half" if name == SECOND_HALF else f"`{name}`"
        what += f", {trajectories} trajectories" if trajectories > 1 else ""
        rows.append((what, *(f"{hour:.2f}" for hour in each), f"{sum(each):.1f}"))
        total += sum(each)
    rows.append(("all", "", "", "", "", f"{total:.1f}"))
    return table(("processor hours, all cells", *ENVIRONMENTS, "together"), rows), total
