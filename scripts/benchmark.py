"""How fast `method=dqn` trains ten seeds, beside Stable-Baselines3's DQN.

    python scripts/benchmark.py

Both have the same environment, network, batch, schedule and one thread, and take turns. Each
side is timed from its first update on, without evaluations. A seed-step is an environment step
of one seed: ten seeds trained together take ten at once, Stable-Baselines3 takes one.
"""

from __future__ import annotations

import argparse
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import torch
from matched_dqn import composed, stable_baselines_dqn
from rich.console import Console
from rich.table import Table
from stable_baselines3.common.callbacks import BaseCallback

from ril.demonstrations.trajectories import StateTransitions
from ril.environments import load_environment
from ril.methods.dqn import DQN
from ril.schema import Config, DQNConfig
from ril.task import Task

BATCH = "method.q_learning.batch_size=64"
EVERY_STEP = ("method.q_learning.train_freq=1", "method.q_learning.updates=1")
EVERY_FOURTH = ("method.q_learning.train_freq=4", "method.q_learning.updates=1")
MOUNTAINCAR = ("env=mountaincar", "method.network.hidden=[32,32]", BATCH)  # networks of §4.1
CARTPOLE = ("env=cartpole", "method.network.hidden=[8,8]", BATCH)
#: What is compared, by name, as overrides of `ril-run method=dqn`.
SETTINGS = {
    "MountainCar, 2 × 32, an update per step": (*MOUNTAINCAR, *EVERY_STEP),
    "MountainCar, 2 × 32, an update per four steps": (*MOUNTAINCAR, *EVERY_FOURTH),
    "CartPole, 2 × 8, an update per step": (*CARTPOLE, *EVERY_STEP),
    "CartPole, 2 × 8, an update per four steps": (*CARTPOLE, *EVERY_FOURTH),
    "MountainCar, 2 × 64, as method=dqn comes": ("env=mountaincar",),
    "CartPole, 2 × 64, as method=dqn comes": ("env=cartpole",),
}
SEEDS = 10
WARM_UP = 1000  # steps before the clock starts; updates begin half way through them


def prepared(overrides: tuple[str, ...], steps: int) -> Config:
    """The configuration of both sides."""
    return composed(
        "method=dqn",
        *overrides,
        f"method.q_learning.learning_starts={WARM_UP // 2}",
        f"method.total_timesteps={WARM_UP + steps}",
    )


def ril_rate(config: Config, *, compiled: bool) -> float:
    """Seed-steps per second of ten seeds together."""
    assert isinstance(config.method, DQNConfig)
    environment = load_environment(config.env)
    expert = StateTransitions.none(environment)
    device, seeds = torch.device("cpu"), tuple(range(SEEDS))
    method = DQN(config.method, Task(environment, expert, seeds, config.ablation, device, compiled))
    started, before = 0.0, 0
    for progress in method.train():
        taken = int(progress.env_samples[0])
        if taken <= WARM_UP:
            started, before = time.perf_counter(), taken
    return SEEDS * (taken - before) / (time.perf_counter() - started)


class _Clock(BaseCallback):
    """Starts when the warm-up is over."""

    started = 0.0

    def _on_step(self) -> bool:
        if self.num_timesteps == WARM_UP:
            self.started = time.perf_counter()
        return True


def stable_baselines_rate(config: Config) -> float:
    """Steps per second of one seed."""
    assert isinstance(config.method, DQNConfig)
    model = stable_baselines_dqn(config.method, load_environment(config.env), seed=0)
    clock, total = _Clock(), config.method.total_timesteps
    model.learn(total, clock)
    return (total - WARM_UP) / (time.perf_counter() - clock.started)


def main() -> None:
    """Time every setting in turns and print the medians."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rounds", type=int, default=3, help="of which medians are taken")
    parser.add_argument("--steps", type=int, default=4000, help="timed, of each seed")
    parser.add_argument("--output", type=Path, help="also write the table there, as Markdown")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    lines = [
        "| | Stable-Baselines3 | `method=dqn` | compiled | ratio | compiled |",
        "|---" * 6 + "|",
    ]
    table = Table("seed-steps per second", "SB3", "ril", "ril compiled", "ratio", "compiled")
    for name, overrides in SETTINGS.items():
        config = prepared(overrides, arguments.steps)
        sides: list[Callable[[], float]] = [
            lambda config=config: stable_baselines_rate(config),
            lambda config=config: ril_rate(config, compiled=False),
            lambda config=config: ril_rate(config, compiled=True),
        ]
        rounds = [[side() for side in sides] for _ in range(arguments.rounds)]
        theirs, eager, compiled = (statistics.median(side) for side in zip(*rounds, strict=True))
        cells = [f"{rate:,.0f}" for rate in (theirs, eager, compiled)]
        cells += [f"{rate / theirs:.1f}×" for rate in (eager, compiled)]
        table.add_row(name, *cells)
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
        Console().print(f"{name}: {', '.join(cells)}")
    Console().print(table)
    machine = f"{platform.machine()}, torch {torch.__version__}, one thread each"
    Console().print(machine)
    if arguments.output:
        arguments.output.write_text("\n".join(lines) + f"\n\n{machine}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
