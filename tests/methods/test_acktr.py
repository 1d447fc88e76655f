from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from helpers.references import PlainKFAC, copies_of, flat_of
from torch import Tensor, nn

from ril.config.schema import Config
from ril.methods.acktr import ACKTR, ACKTRConfig, standardize_inputs
from ril.task import Task
from ril.vectorized.networks import Network
from ril.vectorized.stepping import SteppedEnvironments
from ril.vectorized.streams import Streams

Make = Callable[..., tuple[ACKTR, Task, ACKTRConfig]]


@pytest.fixture
def make(quick: Any, make_task: Callable[[Config], Task]) -> Make:
    def made(*overrides: str) -> tuple[ACKTR, Task, ACKTRConfig]:
        config = quick("method=acktr", *overrides)
        task = make_task(config)
        return ACKTR(config.method, task), task, config.method

    return made


class Slow:
    """One seed's ACKTR, sample by sample, in double precision."""

    def __init__(self, method: ACKTR, index: int, task: Task, config: ACKTRConfig) -> None:
        seed = task.seeds[index]
        self.config = config
        self.environments = SteppedEnvironments(task.environment, [seed], config.n_envs, "acktr")
        self.random, self.actions = Streams([seed], "random actions"), Streams([seed], "actions")
        self.policy = copies_of(method.policy)[index].double()
        self.value = copies_of(method.value)[index].double()
        drawn = self.random.integers(
            task.environment.action_count, config.standardize_steps, config.n_envs
        )[0]
        states = []
        for actions in drawn:
            states += list(self.environments.observations)
            self.environments.step(actions)
        self.standardize(torch.from_numpy(np.stack(states)).double())
        self.actor = PlainKFAC(self.policy, config.actor)
        self.critic = PlainKFAC(self.value, config.critic)
        self.truncations = 0

    def standardize(self, states: Tensor) -> None:
        for module in (self.policy, self.value):
            first = module[0]
            assert isinstance(first, nn.Linear)
            mean, deviation = states.mean(dim=0), states.std(dim=0) + 1e-3
            with torch.no_grad():
                first.weight.copy_(first.weight / deviation)
                first.bias.copy_(first.bias - first.weight @ mean)

    def returns(self, rewards: Any, steps: Any, values: Any) -> Tensor:
        """(T, K) targets of the value function, each by a sum of its own."""
        count, copies = rewards.shape
        found = torch.zeros(count, copies)
        for copy in range(copies):
            for first in range(count):
                total, weight = float(values[first, copy]), 1.0
                for step in range(first, count):
                    with torch.no_grad():
                        final = torch.from_numpy(steps[step].next_observations[copy]).double()
                        after = float(self.value(final))
                    after = 0.0 if steps[step].terminated[copy] else after
                    error = rewards[step, copy] + self.config.gamma * after - values[step, copy]
                    total += weight * float(error)
                    weight *= self.config.gamma * self.config.gae_lambda
                    if steps[step].terminated[copy] or steps[step].truncated[copy]:
                        break
                found[first, copy] = total
        return found

    def epoch(self) -> None:
        config = self.config
        numbers = self.actions.uniform(config.n_steps, config.n_envs)[0]
        states, chosen, steps = [], [], []
        for drawn in numbers:
            states.append(torch.from_numpy(self.environments.observations).double())
            with torch.no_grad():
                chances = self.policy(states[-1]).softmax(dim=-1).cumsum(dim=-1)
            chosen.append([int((row <= u).sum()) for row, u in zip(chances, drawn, strict=True)])
            steps.append(self.environments.step(np.array(chosen[-1])))
            self.truncations += int(steps[-1].truncated.sum())
        x, actions = torch.stack(states), torch.tensor(chosen)
        rewards = np.stack([step.rewards for step in steps])
        values = self.value(x)[..., 0]
        targets = self.returns(rewards, steps, values.detach())
        advantages = (targets - values.detach()).flatten()

        loss = (values - targets).square().mean() / 2
        # A unit Gaussian's −log p at one deviation from its mean.
        self.critic.step(
            x.flatten(0, 1), loss, lambda out, i: (out[0] - out[0].detach() + 1) ** 2 / 2
        )

        flat, chosen_actions = x.flatten(0, 1), actions.flatten()
        log_chances = self.policy(flat).log_softmax(dim=-1)
        log_probs_of_actions = log_chances[torch.arange(len(flat)), chosen_actions]
        entropy = -(log_chances.exp() * log_chances).sum(dim=-1).mean()
        loss = -(log_probs_of_actions * advantages).mean() - config.ent_coef * entropy
        self.actor.step(flat, loss, lambda out, i: -out.log_softmax(dim=-1)[chosen_actions[i]])


@pytest.fixture
def in_double_precision() -> Any:
    """The default while plain references compute."""

    def run(work: Callable[[], Any]) -> Any:
        torch.set_default_dtype(torch.float64)
        try:
            return work()
        finally:
            torch.set_default_dtype(torch.float32)

    return run


TASKS = {
    "cartpole": ("method.n_steps=24", "method.total_timesteps=300"),
    # Whose episodes are truncated after 200 steps.
    "mountaincar": ("method.n_steps=40", "method.total_timesteps=440"),
}


@pytest.mark.parametrize("env", TASKS)
def test_epochs_are_those_of_one_seed_after_the_other(
    make: Make, in_double_precision: Any, env: str
) -> None:
    overrides = (
        f"env={env}",
        "env.goal.minimum_return=null",
        "method.hidden=[6,5]",
        "method.ent_coef=0.2",
        "method.gae_lambda=0.9",
        "method.standardize_steps=100",
        # A trust region and a momentum in which the size of a gradient still shows.
        *("method.actor.kl_clip=10", "method.critic.kl_clip=10"),
        *("method.actor.momentum=0.3", "method.critic.momentum=0.3"),
        *TASKS[env],
    )
    method, task, config = make(*overrides)
    slow = in_double_precision(
        lambda: [Slow(method, index, task, config) for index in range(len(task.seeds))]
    )
    networks = (method.policy, method.value)
    before = None
    for _ in method.train():
        for each in slow:
            in_double_precision(each.epoch)
        expected = [
            torch.stack([flat_of(module) for module in modules])
            for modules in ([each.policy for each in slow], [each.value for each in slow])
        ]
        for index, network in enumerate(networks):
            error = (network.flat - expected[index]).norm(dim=1)
            size = expected[index] if before is None else expected[index] - before[index]
            assert (error < 0.01 * size.norm(dim=1)).all()
        before = expected
    if env == "mountaincar":
        assert all(each.truncations == config.n_envs for each in slow)


@pytest.mark.parametrize(("steps", "epochs"), [(220, 5), (221, 6), (1, 1)])
def test_epochs_are_as_many_as_the_steps_need(make: Make, steps: int, epochs: int) -> None:
    method, _, config = make(f"method.total_timesteps={steps}", "method.n_steps=20")
    assert config.n_envs * config.n_steps == 40
    assert method.epochs == epochs
    progress = list(method.train())
    found = [each.env_samples.tolist() for each in progress]
    assert found == [[20 + 40 * (index + 1)] * 2 for index in range(epochs)]  # 20 at random
    assert not any(each.expert_samples.any() for each in progress)


def test_a_shorter_run_is_the_beginning_of_a_longer_one(make: Make) -> None:
    (short, *_), (long, *_) = (make(f"method.total_timesteps={steps}") for steps in (80, 400))
    epochs = long.train()
    for _ in short.train():
        next(epochs)
        assert torch.equal(short.policy.flat, long.policy.flat)


@pytest.mark.parametrize("steps", [0, 7])
def test_random_steps_are_samples(make: Make, steps: int) -> None:
    method, _, config = make(f"method.standardize_steps={steps}")
    first = next(iter(method.train()))
    assert first.env_samples.tolist() == [config.n_envs * (steps + config.n_steps)] * 2
    assert first.pre_samples == 0


def test_a_standardized_network_answers_as_the_first_did_to_standardized_states(
    make: Make,
) -> None:
    method, _, _ = make()
    before = Network(method.policy.architecture, method.policy.flat.clone())
    random = torch.Generator().manual_seed(0)
    states = 3 + torch.tensor([0.1, 1, 10, 100]) * torch.randn(2, 500, 4, generator=random)
    states[1] *= 2
    standardize_inputs(method.policy, states)
    deviation = states.std(dim=1, keepdim=True) + 1e-3
    expected = before((states - states.mean(dim=1, keepdim=True)) / deviation)
    torch.testing.assert_close(method.policy(states), expected, rtol=1e-3, atol=1e-4)


def test_a_feature_that_never_changes_can_be_standardized(make: Make) -> None:
    method, _, _ = make()
    standardize_inputs(method.policy, torch.ones(2, 500, 4))
    assert method.policy.flat.isfinite().all()


def test_actor_and_critic_have_their_own_steps(make: Make) -> None:
    method, _, _ = make("method.critic.learning_rate=0.1")
    assert (method.actor.config.learning_rate, method.critic.config.learning_rate) == (0.25, 0.1)
