"""Environments: their sizes, scale and goals, and those that cannot be used."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.classic_control import MountainCarEnv

from ril.config.schema import EnvironmentConfig, GoalConfig
from ril.environments.environment import Environment, load_environment
from ril.environments.goal import reaches_goal
from ril.io.errors import UserError

NAMES = ("cartpole", "acrobot", "mountaincar", "lunarlander")


def config(**changes: Any) -> EnvironmentConfig:
    return EnvironmentConfig(**({"name": "mine", "id": "CartPole-v1"} | changes))


@pytest.mark.parametrize("name", NAMES)
def test_scale_maps_the_bounds_to_one(environments: dict[str, Environment], name: str) -> None:
    environment = environments[name]
    bounds = np.stack([environment.low, (environment.low + environment.high) / 2, environment.high])
    expected = np.repeat([[-1.0], [0.0], [1.0]], environment.observation_size, axis=1)
    np.testing.assert_allclose(environment.scale(bounds), expected, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "size", "actions", "steps"),
    [
        ("cartpole", 4, 2, 500),
        ("acrobot", 6, 3, 500),
        ("mountaincar", 2, 3, 200),
        ("lunarlander", 8, 4, 1000),
    ],
)
def test_sizes_are_those_of_the_environment(
    environments: dict[str, Environment], name: str, size: int, actions: int, steps: int
) -> None:
    found = environments[name]
    assert (found.observation_size, found.action_count, found.max_episode_steps) == (
        size,
        actions,
        steps,
    )


def test_given_bounds_replace_those_of_the_space() -> None:
    environment = load_environment(
        config(id="MountainCar-v0", observation_low=[-2.0, -1.0], observation_high=[2.0, 1.0])
    )
    assert environment.scale(np.array([1.0, -0.5])).tolist() == [0.5, -0.5]


def test_kwargs_reach_the_environment() -> None:
    environment = load_environment(config(id="MountainCar-v0", kwargs={"goal_velocity": 0.04}))
    assert environment.make().unwrapped.goal_velocity == 0.04


@pytest.fixture
def endless() -> Any:
    gym.register("Endless-v0", MountainCarEnv)
    yield "Endless-v0"
    del gym.registry["Endless-v0"]


BOUNDS = {"observation_low": [-1.0] * 4, "observation_high": [1.0] * 4}


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"id": "Nope-v0"}, "env.id=Nope-v0"),
        ({"id": "CartPole-v99"}, "env.id=CartPole-v99"),
        ({"id": "nosuchmodule:Mine-v0"}, "env.id=nosuchmodule:Mine-v0"),
        ({"kwargs": {"gravity": 1}}, "env.id=CartPole-v1: "),
        ({"id": "MountainCarContinuous-v0"}, "env.id=MountainCarContinuous-v0: actions"),
        ({"id": "FrozenLake-v1"}, "env.id=FrozenLake-v1: observations"),
        ({}, "env.observation_low: the observations of CartPole-v1 are unbounded; give 4"),
        (BOUNDS | {"observation_low": [-1.0] * 3}, "env.observation_low: has 3 entries"),
        (BOUNDS | {"observation_high": [np.nan] * 4}, "env.observation_high"),
        (BOUNDS | {"observation_low": [1.0] * 4}, "env.observation_low: every entry must be"),
    ],
)
def test_an_unusable_environment_is_refused_by_key(changes: dict[str, Any], says: str) -> None:
    with pytest.raises(UserError, match=f"^{says}"):
        load_environment(config(**changes))


def test_an_environment_without_a_step_limit_is_refused_until_one_is_given(endless: str) -> None:
    with pytest.raises(UserError, match="Endless-v0: has no max_episode_steps"):
        load_environment(config(id=endless))
    limited = load_environment(config(id=endless, kwargs={"max_episode_steps": 7}))
    assert limited.max_episode_steps == 7


def reached(goal: GoalConfig, **episodes: list[float]) -> list[bool]:
    columns = {"returns": [0.0], "final_rewards": [0.0], "terminated": [False]} | episodes
    arrays = {name: np.array(values) for name, values in columns.items()}
    return reaches_goal(goal, **arrays).tolist()


def test_a_goal_without_conditions_is_always_reached() -> None:
    assert reached(GoalConfig()) == [True]


@pytest.mark.parametrize(("total", "expected"), [(194.0, False), (195.0, True), (500.0, True)])
def test_minimum_return_is_reached_from_there_on(total: float, expected: bool) -> None:
    assert reached(GoalConfig(minimum_return=195), returns=[total]) == [expected]


def test_minimum_final_reward_is_reached_from_there_on() -> None:
    goal = GoalConfig(minimum_final_reward=100)
    assert reached(goal, returns=[300.0], final_rewards=[99.0]) == [False]
    assert reached(goal, returns=[-300.0], final_rewards=[100.0]) == [True]


@pytest.mark.parametrize("wanted", [True, False])
def test_terminated_must_be_as_wanted(wanted: bool) -> None:
    assert reached(GoalConfig(terminated=wanted), terminated=[wanted]) == [True]
    assert reached(GoalConfig(terminated=wanted), terminated=[not wanted]) == [False]


def test_every_condition_must_hold() -> None:
    goal = GoalConfig(minimum_return=10, terminated=True)
    assert reached(goal, returns=[10], terminated=[False]) == [False]
    assert reached(goal, returns=[9], terminated=[True]) == [False]
    assert reached(goal, returns=[10], terminated=[True]) == [True]


@pytest.mark.parametrize(
    ("name", "episode", "expected"),
    [
        ("cartpole", (195.0, 1.0, True), True),
        ("cartpole", (194.0, 1.0, True), False),
        ("acrobot", (-80.0, 0.0, True), True),
        ("acrobot", (-500.0, -1.0, False), False),
        ("mountaincar", (-199.0, -1.0, True), True),
        ("mountaincar", (-200.0, -1.0, False), False),
        ("lunarlander", (120.0, 100.0, True), True),
        ("lunarlander", (250.0, -100.0, True), False),  # crashed, or left the screen
        ("lunarlander", (90.0, 0.1, False), False),  # still hovering at the limit
    ],
)
def test_the_papers_environments_know_their_goals(
    environments: dict[str, Environment],
    name: str,
    episode: tuple[float, float, bool],
    expected: bool,
) -> None:
    total, final, terminated = episode
    goal = environments[name].config.goal
    found = reached(goal, returns=[total], final_rewards=[final], terminated=[terminated])
    assert found == [expected]
