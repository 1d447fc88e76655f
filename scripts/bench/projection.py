"""(f) Projected hours for all cells of Tables 2 to 9 on this machine, ten seeds each."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator

from matched_dqn import composed

from bench.clock import seconds, table
from ril.run.prepare import prepare
from ril.vectorized.evaluation import Evaluation

ENVIRONMENTS = ("cartpole", "acrobot", "mountaincar", "lunarlander")
#: Cells of Table 9 with a sub-optimal expert.
SUBOPTIMAL_EXPERTS = {"cartpole": 4, "acrobot": 4, "mountaincar": 2, "lunarlander": 0}
#: Cells per environment by method and trajectories; cells that several tables share count once.
CELLS = {
    ("bc", 1): 2,  # one trajectory (Table 2); 100 (Table 4) take as long
    ("gail", 1): 2,
    ("ilpo", 1): 2,
    ("iupe", 1): 1,
    ("iupe", 100): 1,
    ("ril", 1): 11,  # Table 2; six other k (Table 7), three other n (Table 8); half of RIL*
    ("ril", 100): 4,  # Table 4; 25, 50 and 75 trajectories (Table 6) take at most as long
    ("ril_sequential", 1): 1,  # Table 5
    **{(name, 1): 1 for name in ("dqn", "dqn_prioritized", "ppo", "acktr")},  # Table 4
}
_SECONDS = 1.5  # of training, to measure the pace
#: The first half of Table 5's RIL* is RIL's imitation, which CELLS counts as a cell of `ril`.
SECOND_HALF = "ril_sequential"


def hours(name: str, trajectories: int, env: str) -> float:
    """Project the hours of a cell from the pace of its first epochs and of one evaluation."""
    overrides = [f"env={env}", f"method={name}", f"ablation.trajectories={trajectories}"]
    if name == SECOND_HALF:
        overrides.append("method.epochs=1")
    config = composed(*overrides, "seeds=10")
    cell = prepare(config)
    method, evaluation = cell.build_method(), Evaluation(cell.environment, config.seeds)
    progress = method.train()
    first_epoch = seconds(lambda: next(progress))
    if name == SECOND_HALF:  # its own first epoch, in which its updates are compiled, is the second
        first_epoch += seconds(lambda: next(progress))
    each = _pace(progress)
    settings = config.evaluation
    evaluations = math.ceil(method.epochs / settings.interval(method.epochs))
    episodes = evaluations * settings.selection_episodes + 2 * settings.episodes
    scoring = seconds(lambda: evaluation.returns(method.policy, 25, "pace"))
    return (first_epoch + method.epochs * each + scoring * episodes / 25) / 3600


def _pace(progress: Iterator[object]) -> float:
    """Return the processor time per epoch, after the first, in which updates may be compiled."""
    started, epochs = time.process_time(), 0
    while time.process_time() - started < _SECONDS and next(progress, None) is not None:
        epochs += 1
    return (time.process_time() - started) / max(epochs, 1)


def projection() -> tuple[str, float]:
    """Measure (f); return its table, and the sum of its hours."""
    rows, total = [], 0.0
    for (name, trajectories), cells in CELLS.items():
        each = []
        for env in ENVIRONMENTS:
            count = cells + (SUBOPTIMAL_EXPERTS[env] if (name, trajectories) == ("ril", 1) else 0)
            each.append(count * hours(name, trajectories, env))
        label = "`ril_sequential`, second half" if name == SECOND_HALF else f"`{name}`"
        label += f", {trajectories} trajectories" if trajectories > 1 else ""
        rows.append((label, *(f"{hour:.2f}" for hour in each), f"{sum(each):.1f}"))
        total += sum(each)
    rows.append(("all", "", "", "", "", f"{total:.1f}"))
    return table(("processor hours, all cells", *ENVIRONMENTS, "together"), rows), total
