from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from helpers.references import Adam, copies_of, flat_of
from torch.nn import functional

from ril.config.schema import Config
from ril.io.errors import UserError
from ril.learners.ppo import PPOAgent, PPOConfig
from ril.methods.gail import GAIL
from ril.task import Task
from ril.vectorized.streams import Streams

#: PPO of a quick run.
PPO = PPOConfig([100, 100], 2, 32, 16, 2, 3e-4, 0.99, 0.95, 0.2, 0.0)


@pytest.fixture
def make(quick: Any, make_task: Callable[[Config], Task]) -> Callable[..., tuple[GAIL, Task]]:
    def made(*overrides: str) -> tuple[GAIL, Task]:
        config = quick("method=gail", *overrides)
        task = make_task(config)
        return GAIL(config.method, task), task

    return made


@pytest.fixture
def paid(monkeypatch: pytest.MonkeyPatch) -> list[np.ndarray]:
    """The rewards that agents are given, in order."""
    given: list[np.ndarray] = []
    improve = PPOAgent.improve

    def recorded(self: PPOAgent, rewards: np.ndarray) -> None:
        given.append(rewards.copy())
        improve(self, rewards)

    monkeypatch.setattr(PPOAgent, "improve", recorded)
    return given


@pytest.mark.parametrize("kind", ["positive", "negative"])
def test_a_round_is_rollout_discriminator_rewards_and_policy(
    make: Any, paid: list[np.ndarray], kind: str
) -> None:
    reward = f"method.discriminator.reward={kind}"
    method, task = make(reward)
    begun, _ = make(reward)
    modules = copies_of(begun.discriminator.network)
    epochs = method.train()
    metrics = [next(epochs).metrics for _ in range(2)]

    states, actions = map(torch.from_numpy, (task.expert.observations, task.expert.actions))
    expert = torch.cat((states, torch.eye(2)[actions]), dim=1)
    streams = Streams(task.seeds, "discriminator batches")
    optimizers = [Adam(module, 1e-3, None) for module in modules]
    agents = [PPOAgent(PPO, task.environment, seed) for seed in task.seeds]
    rewards = list(paid)
    paid.clear()
    for epoch in range(2):
        drawn = streams.uniform(4, 2, 16)
        for seed, (agent, module) in enumerate(zip(agents, modules, strict=True)):
            seen, done = agent.collect()  # line 3
            pairs = torch.cat((torch.from_numpy(seen), torch.eye(2)[torch.from_numpy(done)]), dim=1)
            for update in range(4):  # line 4
                ours = module(expert[(drawn[seed, update, 0] * len(expert)).astype(int)])
                theirs = module(pairs[(drawn[seed, update, 1] * len(pairs)).astype(int)])
                loss = functional.binary_cross_entropy_with_logits(ours, torch.ones_like(ours))
                zeros = torch.zeros_like(theirs)
                loss = loss + functional.binary_cross_entropy_with_logits(theirs, zeros)
                optimizers[seed].step(loss)
            d = module(pairs)[:, 0].sigmoid().detach()
            expected = -(1 - d).log() if kind == "positive" else d.log()
            found = rewards[2 * epoch + seed]
            np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-5)
            mean = metrics[epoch]["imitation_reward"][seed]
            assert mean == pytest.approx(expected.mean().item(), rel=1e-3)
            agent.improve(found)  # line 5
    found = torch.stack([flat_of(module) for module in modules])
    torch.testing.assert_close(method.discriminator.network.flat, found, rtol=1e-3, atol=1e-4)
    assert torch.equal(method.policy.flat, torch.stack([agent.actor() for agent in agents]))


def test_the_policy_acts_as_its_agents_after_every_round(make: Any) -> None:
    method, _ = make()
    before = method.policy.flat.clone()
    for _ in method.train():
        agents = torch.stack(method.agents.each(PPOAgent.actor))
        assert torch.equal(method.policy.flat, agents)
        assert (agents != before).any(dim=1).all()
        before = agents


@pytest.mark.parametrize(("steps", "rounds"), [(256, 4), (257, 5), (1, 1)])
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
        ("lunarlander", "positive"),
        ("mountaincar", "negative"),
        ("acrobot", "negative"),
    ],
)
def test_where_success_ends_an_episode_a_step_costs(compose: Any, env: str, kind: str) -> None:
    assert compose(f"env={env}", "method=gail").method.discriminator.reward == kind


@pytest.mark.parametrize(
    ("size", "says"),
    [
        (1, "batch_size=1: must be above 1"),
        (48, "batch_size=48: must be above 1 and divide a rollout, n_envs · n_steps = 64"),
        (128, "batch_size=128: must be above 1 and divide"),
    ],
)
def test_minibatches_that_do_not_fit_a_rollout_are_refused(make: Any, size: int, says: str) -> None:
    with pytest.raises(UserError, match=rf"^method\.ppo\.{says}"):
        make(f"method.ppo.batch_size={size}")
