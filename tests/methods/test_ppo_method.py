from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from helpers.states import assert_equal_states, copied

from ril.config.schema import Config
from ril.environments import Environment
from ril.learners.ppo import PPOAgent
from ril.methods.gail import GAIL
from ril.methods.ppo import PPO
from ril.task import Task

Make = Callable[..., Any]


@pytest.fixture
def make(quick: Any, make_task: Callable[[Config], Task]) -> Make:
    def made(*overrides: str, method: type = PPO, processes: int = 1) -> Any:
        config = quick(f"method={method.__name__.lower()}", *overrides)
        return method(config.method, replace(make_task(config), processes=processes))

    return made


def test_an_epoch_is_a_rollout_and_an_update_of_every_agent(
    make: Make, quick: Any, cartpole: Environment
) -> None:
    config = quick("method=ppo").method.ppo
    method = make()
    agents = [
        PPOAgent(config, cartpole, seed, normalize=True, schedule_steps=256) for seed in (0, 1)
    ]
    for progress in method.train():
        for index, agent in enumerate(agents):
            agent.collect()
            agent.improve()
            assert torch.equal(method.policy.flat[index], agent.actor())
            for name, value in agent.diagnostics().items():
                assert progress.metrics[name][index] == value
    assert progress.epoch == 4


@pytest.mark.parametrize(("steps", "rollouts"), [(256, 4), (257, 5), (1, 1)])
def test_rollouts_are_as_many_as_the_steps_need(make: Make, steps: int, rollouts: int) -> None:
    method = make(f"method.total_timesteps={steps}")
    assert method.epochs == rollouts
    samples = [progress.env_samples.tolist() for progress in method.train()]
    assert samples == [[64 * (index + 1)] * 2 for index in range(rollouts)]


def test_no_expert_is_used(make: Make) -> None:
    for progress in make().train():
        assert progress.expert_samples.tolist() == [0, 0]
        assert progress.pre_samples == 0


def test_the_policy_grows_surer_as_its_entropy_falls(make: Make) -> None:
    first, *_, last = make("method.total_timesteps=2000", "method.ppo.learning_rate=3e-3").train()
    assert (first.metrics["entropy"] < np.log(2) + 1e-6).all()  # two actions
    assert (first.metrics["entropy"] > 0.68).all()
    assert (last.metrics["entropy"] < first.metrics["entropy"]).all()


def test_two_processes_give_what_one_does(make: Make) -> None:
    """Of GAIL, whose agents do all that PPO's do, and are paid by the discriminator."""
    seeds = "seeds=[3,5,9]"
    one, two = (make(seeds, method=GAIL, processes=count) for count in (1, 2))
    for expected, found in zip(one.train(), two.train(), strict=True):
        assert torch.equal(two.policy.flat, one.policy.flat)
        for name, values in expected.metrics.items():
            np.testing.assert_array_equal(found.metrics[name], values)
        if expected.epoch == 2:
            middle = copied(one.state_dict())
    assert_equal_states(copied(two.state_dict()), copied(one.state_dict()))
    two.load_state_dict(middle)
    assert [progress.epoch for progress in two.train()] == [3, 4]
    assert_equal_states(copied(two.state_dict()), copied(one.state_dict()))


# RL Baselines3 Zoo, hyperparams/ppo.yml; Stable-Baselines3's defaults where that says nothing.
ZOO = {
    "cartpole": (8, 32, 256, 20, 1e-3, 0.98, 0.8, 0.2, 0.0, False, True),
    "acrobot": (16, 256, 64, 4, 3e-4, 0.99, 0.94, 0.2, 0.0, True, False),
    "mountaincar": (16, 16, 64, 4, 3e-4, 0.99, 0.98, 0.2, 0.0, True, False),
    "lunarlander": (16, 1024, 64, 4, 3e-4, 0.999, 0.98, 0.2, 0.01, True, False),  # docs/ppo.md, P2
}


@pytest.mark.parametrize("env", ZOO)
def test_hyperparameters_are_the_zoos(compose: Any, env: str) -> None:
    found = vars(compose(f"env={env}", "method=ppo").method.ppo)
    assert found.pop("hidden") == [64, 64]
    keys = ("n_envs", "n_steps", "batch_size", "n_epochs", "learning_rate", "gamma", "gae_lambda")
    keys = (*keys, "clip_range", "ent_coef", "normalize", "linear_schedule")
    assert found == dict(zip(keys, ZOO[env], strict=True))
