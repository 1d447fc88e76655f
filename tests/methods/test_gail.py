from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from helpers.references import Adam, copies_of, flat_of
from torch.nn import functional

from ril.config.schema import Config
from ril.learners.normalization import Standardization
from ril.learners.ppo import PPOConfig, PPOLearner
from ril.methods.gail import GAIL
from ril.task import Task
from ril.vectorized.streams import Streams

#: PPO of a quick run.
PPO = PPOConfig([100, 100], 2, 32, 16, 2, 3e-4, 0.99, 0.95, 0.2, 0.0, 0.5, 0.5)


@pytest.fixture
def make(quick: Any, make_task: Callable[[Config], Task]) -> Callable[..., tuple[GAIL, Task]]:
    def made(*overrides: str) -> tuple[GAIL, Task]:
        config = quick("method=gail", *overrides)
        task = make_task(config)
        return GAIL(config.method, task), task

    return made


@pytest.fixture
def paid(monkeypatch: pytest.MonkeyPatch) -> list[torch.Tensor]:
    """The rewards (S, N) that policies are given, in order."""
    given: list[torch.Tensor] = []
    improve = PPOLearner.improve

    def recorded(self: PPOLearner, rewards: torch.Tensor) -> Any:
        given.append(rewards.clone())
        return improve(self, rewards)

    monkeypatch.setattr(PPOLearner, "improve", recorded)
    return given


@pytest.mark.parametrize("standardize", [False, True])
@pytest.mark.parametrize("kind", ["positive", "negative", "logit"])
def test_a_round_is_rollout_discriminator_rewards_and_policy(
    make: Any, paid: list[torch.Tensor], kind: str, standardize: bool
) -> None:
    settings = f"method.discriminator.reward={kind}", f"method.standardize_states={standardize}"
    method, task = make(*settings)
    begun, _ = make(*settings)
    modules = copies_of(begun.discriminator.network)
    epochs = method.train()
    metrics = [next(epochs).metrics for _ in range(2)]

    states, actions = map(torch.from_numpy, (task.expert.observations, task.expert.actions))
    moments = Standardization(task.expert.observations) if standardize else None
    if standardize:
        states = (states - states.mean(dim=0)) / states.std(dim=0, correction=0)
    expert = torch.cat((states, torch.eye(2)[actions]), dim=1)
    streams = Streams(task.seeds, "discriminator batches")
    optimizers = [Adam(module, 1e-3, None) for module in modules]
    learner = PPOLearner(PPO, task, 256, standardize=moments)
    rewards = list(paid)
    for epoch in range(2):
        drawn = streams.uniform(4, 2, 16)
        all_pairs = [
            torch.cat((s, torch.eye(2)[a]), dim=1) for s, a in zip(*learner.collect(), strict=True)
        ]  # line 3
        for seed, (pairs, module) in enumerate(zip(all_pairs, modules, strict=True)):
            for update in range(4):  # line 4
                ours = module(expert[(drawn[seed, update, 0] * len(expert)).astype(int)])
                theirs = module(pairs[(drawn[seed, update, 1] * len(pairs)).astype(int)])
                loss = functional.binary_cross_entropy_with_logits(ours, torch.ones_like(ours))
                zeros = torch.zeros_like(theirs)
                loss = loss + functional.binary_cross_entropy_with_logits(theirs, zeros)
                optimizers[seed].step(loss)
            d = module(pairs)[:, 0].sigmoid().detach()
            positive, negative = -(1 - d).log(), d.log()
            given = {"positive": positive, "negative": negative, "logit": positive + negative}
            expected = given[kind]
            found = rewards[epoch][seed]
            np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-5)
            mean = metrics[epoch]["imitation_reward"][seed]
            assert mean == pytest.approx(expected.mean().item(), rel=1e-3)
        learner.improve(rewards[epoch])  # line 5
    found = torch.stack([flat_of(module) for module in modules])
    torch.testing.assert_close(method.discriminator.network.flat, found, rtol=1e-3, atol=1e-4)
    assert torch.equal(method.policy.flat, learner.policy.flat)


def test_every_round_changes_every_policy(make: Any) -> None:
    method, _ = make()
    before = method.policy.flat.clone()
    for _ in method.train():
        assert (method.policy.flat != before).any(dim=1).all()
        before = method.policy.flat.clone()


@pytest.mark.parametrize(("steps", "rounds"), [(256, 4), (257, 5), (64, 1)])
def test_rounds_are_as_many_as_the_steps_need(make: Any, steps: int, rounds: int) -> None:
    method, _ = make(f"method.total_timesteps={steps}")
    assert method.epochs == rounds
    samples = [progress.env_samples.tolist() for progress in method.train()]
    assert samples == [[64 * (index + 1)] * 2 for index in range(rounds)]


def test_expert_samples_count_the_expert_once_per_round(make: Any) -> None:
    method, task = make()
    count = len(task.expert.observations)
    found = [progress.expert_samples.tolist() for progress in method.train()]
    assert found == [[count * (index + 1)] * 2 for index in range(4)]


@pytest.mark.parametrize(
    ("env", "kind"),
    [
        ("cartpole", "positive"),
        ("lunarlander", "logit"),
        ("mountaincar", "negative"),
        ("acrobot", "negative"),
    ],
)
def test_the_reward_has_the_sign_of_what_ends_an_episode(compose: Any, env: str, kind: str) -> None:
    assert compose(f"env={env}", "method=gail").method.discriminator.reward == kind
