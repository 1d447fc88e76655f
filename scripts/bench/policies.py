"""Loops of PPO and GAIL, beside Stable-Baselines3's PPO."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial

import torch
from matched_dqn import composed
from matched_ppo import stable_baselines_ppo
from stable_baselines3.common.callbacks import BaseCallback

from bench.clock import in_turns, table, with_own_kernels
from ril.config.schema import Config
from ril.environments.environment import load_environment
from ril.methods.gail import GAIL, GAILConfig
from ril.methods.ppo import PPO, PPOMethodConfig
from ril.run.prepare import prepare

ENVIRONMENTS = {
    "CartPole": "cartpole",
    "Acrobot": "acrobot",
    "MountainCar": "mountaincar",
    "LunarLander": "lunarlander",
}
SEEDS = 10


def configured(method: str, env: str, steps: int) -> Config:
    """Return the configuration that all sides share: a rollout to warm up, and about `steps`."""
    base = f"method={method}", f"env={env}"
    settings = composed(*base).method
    assert isinstance(settings, PPOMethodConfig | GAILConfig)
    rollout = settings.ppo.n_envs * settings.ppo.n_steps
    total = rollout * (1 + max(1, round(steps / rollout)))
    return composed(*base, f"method.total_timesteps={total}")


def ril_rate(config: Config, *, seeds: int, compiled: bool) -> float:
    """Return the seed-steps per second of all seeds together, after the first rollout."""
    cell = prepare(replace(config, seeds=list(range(seeds)), compile=compiled))
    method = cell.build_method()
    assert isinstance(method, PPO | GAIL)
    epochs = method.train()
    before = int(next(epochs).env_samples[0])
    started = time.process_time()
    for _ in epochs:
        pass
    return seeds * (method.learner.steps - before) / (time.process_time() - started)


class _Clock(BaseCallback):
    """Start the clock after the first rollout and its updates."""

    rollouts, before, started = 0, 0, 0.0

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        if self.rollouts == 1:
            self.before, self.started = self.num_timesteps, time.process_time()
        self.rollouts += 1


def stable_baselines_rate(config: Config) -> float:
    """Return Stable-Baselines3's steps per second of one agent."""
    assert isinstance(config.method, PPOMethodConfig | GAILConfig)
    torch.set_num_threads(1)
    make = load_environment(config.env).make
    model, clock = stable_baselines_ppo(config.method.ppo, make, seed=0), _Clock()
    model.learn(config.method.total_timesteps, clock)
    return (model.num_timesteps - clock.before) / (time.process_time() - clock.started)


def ppo_and_gail(rounds: int, steps: int) -> str:
    """Measure PPO and GAIL in every environment.

    Args:
        rounds: number of measurements.
        steps: steps of each measurement, after the first rollout.

    Returns:
        A table.
    """
    rows = []
    for method in ("ppo", "gail"):
        for name, env in ENVIRONMENTS.items():
            config = configured(method, env, steps)
            sides = {
                "SB3": partial(with_own_kernels, partial(stable_baselines_rate, config)),
                "eager": partial(ril_rate, config, seeds=SEEDS, compiled=False),
                "compiled": partial(ril_rate, config, seeds=SEEDS, compiled=True),
                "alone": partial(ril_rate, config, seeds=1, compiled=True),
            }
            rate = in_turns(sides, rounds)
            ratios = [f"{rate[side] / rate['SB3']:.1f}×" for side in ("compiled", "alone")]
            rows.append((f"`{method}`, {name}", *(f"{rate[s]:,.0f}" for s in sides), *ratios))
    head = (
        *("seed-steps per second", "Stable-Baselines3's PPO", "ten seeds, eager", "compiled"),
        *("one seed, compiled", "ten against SB3", "one against SB3"),
    )
    return table(head, rows)
