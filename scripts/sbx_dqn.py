"""Measure the steps per second of SBX's DQN, for `scripts/benchmark.py`.

SBX needs JAX, so it has a virtual environment of its own:

python -m venv .venv-sbx && .venv-sbx/bin/pip install sbx-rl
python scripts/benchmark.py --sbx .venv-sbx/bin/python
"""

from __future__ import annotations

import json
import os
import sys
import time

os.environ["JAX_PLATFORMS"] = "cpu"
os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"

from sbx import DQN
from stable_baselines3.common.callbacks import BaseCallback


class Clock(BaseCallback):
    """Start the clock after the warm-up, in which JAX compiles."""

    started = 0.0

    def __init__(self, warm_up: int) -> None:
        super().__init__()
        self.warm_up = warm_up

    def _on_step(self) -> bool:
        if self.num_timesteps == self.warm_up:
            self.started = time.process_time()
        return True


def main() -> None:
    """Train with the JSON settings of the command line and print the steps per second."""
    settings = json.loads(sys.argv[1])
    steps, warm_up = settings.pop("steps"), settings.pop("warm_up")
    env, network = settings.pop("env"), {"net_arch": settings.pop("net_arch")}
    model = DQN("MlpPolicy", env, policy_kwargs=network, **settings)
    clock = Clock(warm_up)
    model.learn(warm_up + steps, clock)
    print(steps / (time.process_time() - clock.started))


if __name__ == "__main__":
    main()
