"""(b) Training loops of DQN, beside other libraries; (c) RIL's seeds together and one at a time."""

from __future__ import annotations

import json
import subprocess
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from matched_dqn import composed, stable_baselines_dqn
from rich.console import Console
from stable_baselines3.common.callbacks import BaseCallback

from bench.clock import in_turns, seconds, table, with_own_kernels
from ril.cli.display import ConsoleDisplay
from ril.config.schema import Config
from ril.environments.environment import load_environment
from ril.methods.dqn import DQNConfig
from ril.run.experiment import run
from ril.run.prepare import prepare

BATCH = "method.q_learning.batch_size=64"
EVERY_STEP = ("method.q_learning.train_freq=1", "method.q_learning.updates=1")
EVERY_FOURTH = ("method.q_learning.train_freq=4", "method.q_learning.updates=1")
MOUNTAINCAR = ("env=mountaincar", "method.network.hidden=[32,32]", BATCH)  # networks of §4.1
CARTPOLE = ("env=cartpole", "method.network.hidden=[8,8]", BATCH)
#: Settings to compare, by name: overrides of `ril-run method=dqn`.
SETTINGS = {
    "MountainCar, 2 × 32, an update per step": (*MOUNTAINCAR, *EVERY_STEP),
    "MountainCar, 2 × 32, an update per four steps": (*MOUNTAINCAR, *EVERY_FOURTH),
    "CartPole, 2 × 8, an update per step": (*CARTPOLE, *EVERY_STEP),
    "CartPole, 2 × 8, an update per four steps": (*CARTPOLE, *EVERY_FOURTH),
    "MountainCar, 2 × 64, method=dqn by default": ("env=mountaincar",),
    "CartPole, 2 × 64, method=dqn by default": ("env=cartpole",),
}
SEEDS = 10
WARM_UP = 1000  # steps before the clock starts; updates begin at half of them
WITHOUT_SBX = (
    "SBX was not measured. It needs JAX and therefore a virtual environment of its own: "
    "`python -m venv .venv-sbx`, `.venv-sbx/bin/pip install sbx-rl`, then "
    "`python scripts/benchmark.py --sbx .venv-sbx/bin/python`."
)


def configured(overrides: tuple[str, ...], steps: int) -> Config:
    """Return the configuration that all sides share."""
    return composed(
        "method=dqn",
        f"seeds={SEEDS}",
        *overrides,
        f"method.q_learning.learning_starts={WARM_UP // 2}",
        f"method.total_timesteps={WARM_UP + steps}",
    )


def ril_rate(config: Config, *, compiled: bool) -> float:
    """Return the seed-steps per second of ten seeds together."""
    method = prepare(replace(config, compile=compiled)).build_method()
    started, before = 0.0, 0
    for progress in method.train():
        steps = int(progress.env_samples[0])
        if steps <= WARM_UP:
            started, before = time.process_time(), steps
    return SEEDS * (steps - before) / (time.process_time() - started)


class _Clock(BaseCallback):
    """Start the clock after the warm-up."""

    started = 0.0

    def _on_step(self) -> bool:
        if self.num_timesteps == WARM_UP:
            self.started = time.process_time()
        return True


def stable_baselines_rate(config: Config) -> float:
    """Return Stable-Baselines3's steps per second of one seed."""
    assert isinstance(config.method, DQNConfig)
    torch.set_num_threads(1)
    model = stable_baselines_dqn(config.method, load_environment(config.env), seed=0)
    clock, total = _Clock(), config.method.total_timesteps
    model.learn(total, clock)
    return (total - WARM_UP) / (time.process_time() - clock.started)


def sbx_rate(python: Path, config: Config, steps: int) -> float:
    """Return SBX's steps per second of one seed.

    Args:
        python: interpreter that has SBX.
        config: the configuration, as for the other sides.
        steps: after the warm-up.
    """
    assert isinstance(config.method, DQNConfig)
    learning = config.method.q_learning
    settings = {
        "env": config.env.id,
        "net_arch": list(config.method.network.hidden),
        "learning_rate": learning.learning_rate,
        "batch_size": learning.batch_size,
        "buffer_size": learning.replay.capacity,
        "learning_starts": learning.learning_starts,
        "train_freq": learning.train_freq,
        "gradient_steps": learning.updates,
        "warm_up": WARM_UP,
        "steps": steps,
    }
    script = Path(__file__).parents[1] / "sbx_dqn.py"
    command = (str(python), str(script), json.dumps(settings))
    ended = subprocess.run(command, capture_output=True, text=True, check=True)
    return float(ended.stdout.split()[-1])


def dqn(rounds: int, steps: int, settings: int, sbx: Path | None) -> str:
    """Measure (b).

    Args:
        rounds: number of measurements.
        steps: steps of each measurement, after the warm-up.
        settings: number of SETTINGS to measure.
        sbx: interpreter that has SBX; None leaves it out.

    Returns:
        A table.
    """
    rows = []
    for name, overrides in list(SETTINGS.items())[:settings]:
        config = configured(overrides, steps)
        sides = {
            "SB3": partial(with_own_kernels, partial(stable_baselines_rate, config)),
            "eager": partial(ril_rate, config, compiled=False),
            "compiled": partial(ril_rate, config, compiled=True),
        }
        if sbx is not None:
            sides["SBX"] = partial(sbx_rate, sbx, config, steps)
        rate = in_turns(sides, rounds)
        best = rate["compiled"]
        to_sbx = f"{best / rate['SBX']:.1f}×" if sbx else "–"
        cells = [f"{rate[side]:,.0f}" if side in rate else "–" for side in ("SB3", "SBX")]
        cells += [f"{rate['eager']:,.0f}", f"{best:,.0f}"]
        cells += [f"{best / rate['SB3']:.1f}×", to_sbx]
        rows.append((name, *cells))
    head = (
        *("seed-steps per second", "Stable-Baselines3", "SBX"),
        *("`method=dqn`, eager", "compiled", "against SB3", "against SBX"),
    )
    return table(head, rows) + ("" if sbx else f"\n\n{WITHOUT_SBX}")


def seconds_of_run(*overrides: str) -> float:
    """Return the processor time of a whole run, evaluations and scoring included."""
    with TemporaryDirectory() as folder:
        config = composed(f"output_dir={folder}", *overrides)
        return seconds(lambda: run(config, ConsoleDisplay(Console(quiet=True), live=False)))


def ril_together(rounds: int, epochs: int) -> tuple[str, float]:
    """Measure (c); return its table, and the speed-up of training ten seeds together."""
    cell = "env=mountaincar", "method=ril", f"method.epochs={epochs}"
    sides = {
        "together": partial(seconds_of_run, *cell, "seeds=10"),
        "alone": partial(seconds_of_run, *cell, "seeds=1"),
    }
    took = in_turns(sides, rounds)
    ratio = 10 * took["alone"] / took["together"]
    row = f"{took['together']:.1f} s", f"10 × {took['alone']:.1f} s", f"{ratio:.1f}×"
    head = f"MountainCar, {epochs} epochs", "10 seeds together", "one at a time", "ratio"
    return table(head, [("`method=ril`", *row)]), ratio
