"""(g) DQN₂ beside DQN₁; (h) whole runs of RIL on the four environments."""

from __future__ import annotations

from functools import partial

from matched_dqn import composed

from bench.clock import in_turns, table
from bench.loops import SEEDS, WARM_UP, ril_rate, seconds_of_run

ENVIRONMENTS = ("cartpole", "mountaincar", "acrobot", "lunarlander")


def prioritized(rounds: int, steps: int) -> str:
    """Measure (g): seed-steps per second of both methods with their default values, compiled."""
    rows = []
    for env in ENVIRONMENTS[:3]:
        sides = {}
        for method in ("dqn", "dqn_prioritized"):
            config = composed(
                f"env={env}",
                f"method={method}",
                f"seeds={SEEDS}",
                f"method.q_learning.learning_starts={WARM_UP // 2}",
                f"method.total_timesteps={WARM_UP + steps}",
            )
            sides[method] = partial(ril_rate, config, compiled=True)
        rate = in_turns(sides, rounds)
        ratio = f"{rate['dqn_prioritized'] / rate['dqn']:.2f}×"
        rows.append((env, *(f"{each:,.0f}" for each in rate.values()), ratio))
    return table(("seed-steps per second", "`dqn`", "`dqn_prioritized`", "ratio"), rows)


def whole_runs(rounds: int, epochs: int) -> str:
    """Measure (h): processor time of runs of ten seeds, evaluations and scoring included."""
    rows = []
    for env in ENVIRONMENTS:
        cell = f"env={env}", "method=ril", f"method.epochs={epochs}", f"seeds={SEEDS}"
        sides = {
            "eager": partial(seconds_of_run, *cell, "compile=false"),
            "compiled": partial(seconds_of_run, *cell, "compile=true"),
        }
        took = in_turns(sides, rounds)
        rows.append((env, *(f"{each:.1f} s" for each in took.values())))
    return table((f"`method=ril`, {epochs} epochs", "eager", "compiled, loading included"), rows)
