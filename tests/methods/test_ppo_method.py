from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from ril.config.schema import Config
from ril.learners.ppo import PPOLearner
from ril.methods.ppo import PPO
from ril.task import Task
from ril.vectorized.architectures import Standardized

Make = Callable[..., Any]


@pytest.fixture
def make(quick: Any, make_task: Callable[[Config], Task]) -> Make:
    def made(*overrides: str) -> PPO:
        config = quick("method=ppo", *overrides)
        return PPO(config.method, make_task(config))

    return made


def test_an_epoch_is_a_rollout_and_an_update(
    make: Make, quick: Any, make_task: Callable[[Config], Task]
) -> None:
    config = quick("method=ppo")
    method = make()
    settings = config.method.ppo
    learner = PPOLearner(settings, make_task(config), 256, normalize=True, linear_schedule=True)
    for progress in method.train():
        learner.collect()
        metrics = learner.improve()
        assert torch.equal(method.policy.flat, learner.policy.flat)
        assert progress.metrics.keys() == metrics.keys()
        for name, values in metrics.items():
            np.testing.assert_array_equal(progress.metrics[name], values)
    assert progress.epoch == 4


@pytest.mark.parametrize("normalize", [False, True])
def test_the_policy_standardizes_where_training_does(make: Make, normalize: bool) -> None:
    policy = make(f"method.ppo.normalize={normalize}").policy
    assert isinstance(policy.architecture, Standardized) == normalize


@pytest.mark.parametrize(("steps", "rollouts"), [(256, 4), (257, 5), (64, 1)])
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


# RL Baselines3 Zoo, hyperparams/ppo.yml; Stable-Baselines3's defaults where that says nothing.
ZOO = {
    "cartpole": (8, 32, 256, 20, 1e-3, 0.98, 0.8, 0.2, 0.0, False, True),
    "acrobot": (16, 256, 64, 4, 3e-4, 0.99, 0.94, 0.2, 0.0, True, False),
    "mountaincar": (16, 16, 64, 4, 3e-4, 0.99, 0.98, 0.2, 0.0, True, False),
    "lunarlander": (16, 1024, 64, 4, 3e-4, 0.999, 0.98, 0.2, 0.01, True, False),  # P2
}


@pytest.mark.parametrize("env", ZOO)
def test_hyperparameters_are_the_zoos(compose: Any, env: str) -> None:
    found = vars(compose(f"env={env}", "method=ppo").method.ppo)
    shared = ("hidden", "vf_coef", "max_grad_norm")
    assert [found.pop(key) for key in shared] == [[64, 64], 0.5, 0.5]
    keys = ("n_envs", "n_steps", "batch_size", "n_epochs", "learning_rate", "gamma", "gae_lambda")
    keys = (*keys, "clip_range", "ent_coef", "normalize", "linear_schedule")
    assert found == dict(zip(keys, ZOO[env], strict=True))
