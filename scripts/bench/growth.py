"""(d) The start-up cost of commands; (e) how the cost grows with the amount of work."""

from __future__ import annotations

import shutil
import statistics
from tempfile import mkdtemp

from bench.clock import RUN, cost, table

RIL = "method=ril", "method.epochs=5", "evaluation.episodes=10", "evaluation.selection_episodes=10"
DQN = "method=dqn", "compile=false", "evaluation.episodes=10", "evaluation.every=100%"
SWEEPS = {
    "seeds of RIL": [(str(n), (*RIL, f"seeds={n}")) for n in (1, 10, 100)],
    "trajectories of RIL": [
        (str(n), (*RIL, "seeds=10", f"ablation.trajectories={n}")) for n in (1, 10, 100)
    ],
    "replay memory of DQN": [
        (
            f"{n:,}",
            (*DQN, "method.total_timesteps=10_000", f"method.q_learning.replay.capacity={n}"),
        )
        for n in (10_000, 100_000, 1_000_000)
    ],
}


def start_up(rounds: int) -> tuple[str, float]:
    """Measure (d); return its table, and the seconds of `ril-run --help`."""
    commands = {
        "`ril-run --help`": (*RUN, "--help"),
        "`ril-run --cfg job`": (*RUN, "--cfg", "job"),
        "tab completion": (*RUN, "-sc", "query=bash"),
    }
    took = {
        name: statistics.median(
            cost(command, COMP_LINE="ril-run method=", COMP_POINT="15").seconds
            for _ in range(rounds)
        )
        for name, command in commands.items()
    }
    rows = [(name, f"{each:.2f} s") for name, each in took.items()]
    return table(("start-up", "processor time"), rows), took["`ril-run --help`"]


def growth(quick: bool) -> tuple[str, float]:
    """Measure (e); return its table, and the peak memory of ten seeds of RIL in MB."""
    rows, ten_seeds = [], 0.0
    for name, sweep in SWEEPS.items():
        first = None
        for size, overrides in sweep[: 2 if quick else 3]:
            folder = mkdtemp()
            used = cost((*RUN, "env=mountaincar", f"output_dir={folder}", *overrides))
            shutil.rmtree(folder)
            first = first or used.seconds
            took = f"{used.seconds:.1f} s", f"{used.seconds / first:.1f}×"
            rows.append((name, size, *took, f"{used.megabytes:,.0f} MB"))
            if name == "seeds of RIL" and size == "10":
                ten_seeds = used.megabytes
    head = "MountainCar", "how many", "processor time, start-up included", "", "peak memory"
    return table(head, rows), ten_seeds
