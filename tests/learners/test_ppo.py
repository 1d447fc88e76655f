from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from helpers.states import assert_equal_states, copied
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from torch import Tensor

from ril.environments import Environment
from ril.learners.ppo import PPOAgent, PPOConfig, actor_topology
from ril.vectorized.networks import Network
from ril.vectorized.stepping import SteppedEnvironments

SEED = 7


def config(**changes: object) -> PPOConfig:
    values = {
        "hidden": [16, 12],
        "n_envs": 2,
        "n_steps": 32,
        "batch_size": 16,
        "n_epochs": 2,
        "learning_rate": 3e-3,
        "gamma": 0.97,
        "gae_lambda": 0.9,
        "clip_range": 0.15,
        "ent_coef": 0.01,
    }
    return PPOConfig(**(values | changes))


def rounds(agent: PPOAgent, count: int) -> None:
    for _ in range(count):
        agent.collect()
        agent.improve()


def parameters(model: PPO) -> Tensor:
    return torch.cat([p.detach().flatten() for p in model.policy.parameters()])


class Plain(VecEnv):
    """The agent's episodes as Stable-Baselines3 has them from its own environments."""

    def __init__(self, environment: Environment, copies: int) -> None:
        self.stepped = SteppedEnvironments(environment, [SEED], copies, "ppo")
        space = gym.spaces.Box(-np.inf, np.inf, (environment.observation_size,), np.float32)
        super().__init__(copies, space, gym.spaces.Discrete(environment.action_count))

    def reset(self) -> np.ndarray:
        return self.stepped.observations.copy()

    def step_async(self, actions: np.ndarray) -> None:
        self.actions = actions

    def step_wait(self) -> Any:
        step = self.stepped.step(self.actions)
        infos: list[dict[str, Any]] = []
        for index, final in enumerate(step.next_observations):
            over = bool(step.terminated[index] or step.truncated[index])
            info = {"terminal_observation": final.copy()} if over else {}
            infos.append({"TimeLimit.truncated": bool(step.truncated[index]), **info})
        observations, dones = self.stepped.observations.copy(), step.terminated | step.truncated
        return observations, step.rewards.copy(), dones, infos

    def close(self) -> None: ...

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [None] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None: ...

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kw: Any) -> list[Any]:
        return [None] * self.num_envs

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs


class Rollouts(BaseCallback):
    """Keeps what each rollout holds before PPO learns from it, and the parameters it began with."""

    FIELDS = ("observations", "actions", "rewards", "values", "advantages", "returns")

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[dict[str, np.ndarray]] = []

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        buffer = self.model.rollout_buffer
        self.seen.append({name: getattr(buffer, name).copy() for name in self.FIELDS})


def trained_by_sb3(
    settings: PPOConfig, environment: Environment, count: int, *, zoo: bool
) -> tuple[PPO, list[dict[str, np.ndarray]]]:
    """Train by Stable-Baselines3's own `learn`; return the model and its rollouts.

    `zoo` adds what RL Baselines3 Zoo does for `normalize: true` and `lin_…`.
    """
    environments: VecEnv = Plain(environment, settings.n_envs)
    rate: Any = settings.learning_rate
    clip: Any = settings.clip_range
    if zoo:
        environments = VecNormalize(environments, gamma=settings.gamma, clip_obs=np.inf)
        rate, clip = (lambda left: left * settings.learning_rate), (lambda left: left * 0.15)
    model = PPO(
        "MlpPolicy",
        environments,
        policy_kwargs={"net_arch": list(settings.hidden)},
        seed=SEED,
        device="cpu",
        n_steps=settings.n_steps,
        batch_size=settings.batch_size,
        n_epochs=settings.n_epochs,
        learning_rate=rate,
        gamma=settings.gamma,
        gae_lambda=settings.gae_lambda,
        clip_range=clip,
        ent_coef=settings.ent_coef,
    )
    rollouts = Rollouts()
    model.learn(count * settings.n_steps * settings.n_envs, callback=rollouts)
    return model, rollouts.seen


# MountainCar's episodes are truncated after 200 steps: in a rollout's middle, and at its end.
TASKS = [("cartpole", 80), ("mountaincar", 160), ("mountaincar", 100)]


@pytest.mark.parametrize("zoo", [False, True], ids=["plain", "zoo"])
@pytest.mark.parametrize(("name", "n_steps"), TASKS)
def test_with_the_environments_rewards_it_is_what_sb3_learns(
    environments: dict[str, Environment], name: str, n_steps: int, zoo: bool
) -> None:
    settings = config(n_steps=n_steps, batch_size=20)
    model, expected = trained_by_sb3(settings, environments[name], 3, zoo=zoo)
    schedule_steps = 3 * n_steps * 2 if zoo else None
    agent = PPOAgent(
        settings, environments[name], SEED, normalize=zoo, schedule_steps=schedule_steps
    )
    for reference in expected:
        observations, actions = agent.collect()
        np.testing.assert_array_equal(
            observations, reference["observations"].reshape(-1, observations.shape[1])
        )
        np.testing.assert_array_equal(actions, reference["actions"].ravel())
        agent.improve()
        buffer = agent.model.rollout_buffer
        np.testing.assert_array_equal(buffer.rewards, reference["rewards"])
        for field in ("values", "advantages", "returns"):
            by_copy = reference[field].swapaxes(0, 1).ravel()  # as PPO's update leaves them
            np.testing.assert_array_equal(getattr(buffer, field).ravel(), by_copy, err_msg=field)
    assert torch.equal(parameters(agent.model), parameters(model))


def test_a_rate_that_has_fallen_to_0_stays_there(cartpole: Environment) -> None:
    agent = PPOAgent(config(), cartpole, SEED, schedule_steps=100)  # of rollouts of 64
    rounds(agent, 1)
    trained = parameters(agent.model)
    rounds(agent, 2)
    assert torch.equal(parameters(agent.model), trained)
    assert not torch.equal(parameters(PPOAgent(config(), cartpole, SEED).model), trained)


def test_only_a_truncated_episode_is_worth_more_than_its_rewards(mountaincar: Environment) -> None:
    agent = PPOAgent(config(n_steps=220, batch_size=20), mountaincar, SEED)
    agent.collect()
    agent.improve(np.zeros(440, dtype=np.float32))
    steps, copies = np.nonzero(agent.model.rollout_buffer.rewards)
    assert list(zip(steps.tolist(), copies.tolist(), strict=True)) == [(199, 0), (199, 1)]


def test_a_failure_is_worth_its_reward_alone(cartpole: Environment) -> None:
    agent = PPOAgent(config(), cartpole, SEED)
    agent.collect()
    assert agent.model.rollout_buffer.episode_starts[1:].any()
    agent.improve(np.zeros(64, dtype=np.float32))
    assert not agent.model.rollout_buffer.rewards.any()


def test_the_environments_own_rewards_are_not_used(cartpole: Environment) -> None:
    one, other = (PPOAgent(config(), cartpole, SEED) for _ in range(2))
    given = np.random.default_rng(0).normal(size=64).astype(np.float32)
    one.collect()
    other.collect()
    other.model.rollout_buffer.rewards[:] = 1000.0
    one.improve(given)
    other.improve(given)
    assert torch.equal(parameters(one.model), parameters(other.model))


def test_rewards_belong_to_the_pairs_of_their_place(cartpole: Environment) -> None:
    agent = PPOAgent(config(), cartpole, SEED)
    observations, actions = agent.collect()
    observations, actions = observations.copy(), actions.copy()
    agent.improve(np.arange(64, dtype=np.float32))
    buffer = agent.model.rollout_buffer
    # PPO's update leaves a copy's steps side by side.
    order = buffer.rewards.T.ravel().astype(int)
    np.testing.assert_array_equal(buffer.observations, observations[order])
    np.testing.assert_array_equal(buffer.actions.ravel(), actions[order])


def test_what_is_collected_begins_where_the_last_rollout_ended(cartpole: Environment) -> None:
    agent = PPOAgent(config(), cartpole, SEED)
    stepped = SteppedEnvironments(cartpole, [SEED], 2, "ppo")
    for _ in range(3):
        observations, actions = agent.collect()
        for before, chosen in zip(
            observations.reshape(32, 2, -1), actions.reshape(32, 2), strict=True
        ):
            np.testing.assert_array_equal(before, stepped.observations)
            stepped.step(chosen)
        agent.improve()


def test_the_actor_answers_as_sb3s_policy(cartpole: Environment) -> None:
    settings = config()
    agent = PPOAgent(settings, cartpole, SEED)
    rounds(agent, 1)  # biases begin as zeros
    x = torch.randn(50, 4, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        distribution = agent.model.policy.get_distribution(x).distribution
        found = Network(actor_topology(settings, cartpole), agent.actor()[None])(x[None])[0]
    # SB3 keeps logits less the log of their sum.
    torch.testing.assert_close(found.log_softmax(dim=-1), distribution.logits)


@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.parametrize("hidden", [[16, 12], []])
def test_the_actors_greedy_actions_are_sb3s(
    environments: dict[str, Environment], hidden: list[int], normalize: bool
) -> None:
    environment = environments["acrobot"]  # observations of unequal spread, three actions
    settings = config(hidden=hidden, learning_rate=0.02)
    agent = PPOAgent(settings, environment, SEED, normalize=normalize)
    rounds(agent, 4)
    x = np.random.default_rng(0).normal(size=(500, 6)).astype(np.float32)
    normalizer = agent.model.get_vec_normalize_env()
    assert (normalizer is not None) is normalize
    seen = normalizer.normalize_obs(x) if normalizer is not None else x
    expected, _ = agent.model.predict(seen, deterministic=True)
    network = Network(actor_topology(settings, environment), agent.actor()[None])
    np.testing.assert_array_equal(network.greedy(x), expected)
    assert len(set(expected.tolist())) == 3


def outside() -> tuple[Any, ...]:
    """Numbers that the global generators would give next."""
    torch_state, numpy_state, python_state = (
        torch.get_rng_state(),
        np.random.get_state(),  # noqa: NPY002 - what SB3 draws from
        random.getstate(),
    )
    drawn = (torch.rand(3).tolist(), np.random.rand(3).tolist(), random.random())  # noqa: NPY002
    torch.set_rng_state(torch_state)
    np.random.set_state(numpy_state)  # noqa: NPY002
    random.setstate(python_state)
    return drawn


WORK: dict[str, Callable[[PPOAgent], Any]] = {
    "collect": lambda agent: agent.collect(),
    "improve": lambda agent: agent.improve(),
    "save": lambda agent: agent.state_dict(),
    "load": lambda agent: agent.load_state_dict(copied(agent.state_dict())),
}


@pytest.mark.parametrize("work", WORK)
def test_work_leaves_the_global_random_numbers_alone(cartpole: Environment, work: str) -> None:
    agent = PPOAgent(config(), cartpole, SEED)
    agent.collect()
    before = outside()
    WORK[work](agent)
    assert outside() == before


def test_a_new_agent_leaves_the_global_random_numbers_alone(cartpole: Environment) -> None:
    random.seed(1)  # and not with the agent's seed, as an agent before this one would have left it
    before = outside()
    PPOAgent(config(), cartpole, SEED)
    assert outside() == before


def test_global_random_numbers_do_not_reach_an_agent(cartpole: Environment) -> None:
    agents = []
    for seed in (1, 2):
        numbers = np.random.default_rng(seed)
        agent = None
        for _ in range(3):
            torch.manual_seed(int(numbers.integers(1000)))
            np.random.seed(int(numbers.integers(1000)))  # noqa: NPY002
            random.seed(int(numbers.integers(1000)))
            agent = agent or PPOAgent(config(), cartpole, SEED)
            rounds(agent, 1)
        assert agent is not None
        agents.append(agent)
    assert_equal_states(agents[1].state_dict(), agents[0].state_dict())


def test_agents_side_by_side_do_not_reach_each_other(cartpole: Environment) -> None:
    alone = []
    for seed in (SEED, 8):
        agent = PPOAgent(config(), cartpole, seed)
        rounds(agent, 3)
        alone.append(agent.state_dict())
    together = [PPOAgent(config(), cartpole, seed) for seed in (SEED, 8)]
    for _ in range(3):
        for agent in together:
            agent.collect()
        for agent in reversed(together):
            agent.improve()
    for agent, expected in zip(together, alone, strict=True):
        assert_equal_states(agent.state_dict(), expected)


def test_agents_of_other_seeds_differ(cartpole: Environment) -> None:
    one, other = (PPOAgent(config(), cartpole, seed) for seed in (SEED, 8))
    assert not torch.equal(one.actor(), other.actor())
    assert (one.collect()[0] != other.collect()[0]).all(axis=1).any()


@pytest.mark.parametrize("zoo", [{}, {"normalize": True, "schedule_steps": 1000}])
@pytest.mark.parametrize("name", ["cartpole", "mountaincar"])
def test_a_loaded_state_resumes_bit_identically(
    environments: dict[str, Environment], name: str, zoo: dict[str, Any]
) -> None:
    settings = config(n_steps=120)
    agent, resumed = (PPOAgent(settings, environments[name], SEED, **zoo) for _ in range(2))
    rounds(agent, 2)
    resumed.load_state_dict(copied(agent.state_dict()))
    rounds(agent, 2)
    rounds(resumed, 2)
    assert_equal_states(resumed.state_dict(), agent.state_dict())
