from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from ril.config.schema import EnvironmentConfig
from ril.environments.environment import Environment, load_environment
from ril.vectorized.rollout import Environments, Episodes

NAMES = ("cartpole", "acrobot", "mountaincar", "lunarlander")
RESETS = np.array([3, 11, 4, 2**31 - 1])


def random_actions(environment: Environment) -> np.ndarray:
    """(steps, copies) actions of a fixed plan."""
    shape = (environment.max_episode_steps, len(RESETS))
    return np.random.default_rng(0).integers(environment.action_count, size=shape)


def play_plan(environments: Environments, plan: np.ndarray, **limit: int) -> Episodes:
    return environments.play(lambda _, step: plan[step], RESETS, **limit)


def plain_episode(
    environment: Environment, seed: int, actions: np.ndarray, max_steps: int
) -> dict[str, Any]:
    """One episode by the usual Gymnasium loop."""
    copy = gym.make(environment.config.id)
    states = [copy.reset(seed=int(seed))[0]]
    rewards, terminated, truncated = [], False, False
    while not (terminated or truncated) and len(rewards) < max_steps:
        state, reward, terminated, truncated, _ = copy.step(int(actions[len(rewards)]))
        states.append(state)
        rewards.append(reward)
    scaled = environment.scale(np.array(states, dtype=np.float32))
    return {
        "observations": scaled[:-1],
        "actions": actions[: len(rewards)],
        "rewards": np.array(rewards, dtype=np.float32),
        "next_observations": scaled[1:],
        "terminated": np.array([False] * (len(rewards) - 1) + [terminated]),
    }


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("max_steps", [None, 15])
def test_episodes_are_those_of_a_plain_loop(
    environments: dict[str, Environment], name: str, max_steps: int | None
) -> None:
    environment = environments[name]
    plan = random_actions(environment)
    copies = Environments(environment, len(RESETS))
    play_plan(copies, plan[::-1], max_steps=30)  # what was played before leaves no trace
    episodes = play_plan(copies, plan, **({"max_steps": max_steps} if max_steps else {}))
    for index, seed in enumerate(RESETS):
        expected = plain_episode(
            environment, seed, plan[:, index], max_steps or environment.max_episode_steps
        )
        assert episodes.lengths[index] == len(expected["rewards"])
        for field, values in expected.items():
            found = getattr(episodes, field)[index, : len(values)]
            np.testing.assert_array_equal(found, values, err_msg=field)


def test_an_end_by_the_environment_is_terminated(cartpole: Environment) -> None:
    episodes = play_plan(Environments(cartpole, 4), random_actions(cartpole))
    assert (episodes.lengths < cartpole.max_episode_steps).all()
    assert episodes.ends.all()


def test_an_end_by_the_step_limit_is_not_terminated(mountaincar: Environment) -> None:
    episodes = play_plan(Environments(mountaincar, 4), random_actions(mountaincar))
    assert episodes.lengths.tolist() == [200] * 4
    assert not episodes.terminated.any()


def test_an_end_by_max_steps_is_not_terminated(cartpole: Environment) -> None:
    episodes = play_plan(Environments(cartpole, 4), random_actions(cartpole), max_steps=5)
    assert episodes.lengths.tolist() == [5] * 4
    assert not episodes.terminated.any()


def test_an_episode_does_not_depend_on_other_copies(cartpole: Environment) -> None:
    plan = random_actions(cartpole)
    among = play_plan(Environments(cartpole, 4), plan)
    alone = Environments(cartpole, 1).play(lambda _, step: plan[step, 1:2], RESETS[1:2])
    length = alone.lengths[0]
    assert among.lengths[1] == length
    np.testing.assert_array_equal(among.observations[1, :length], alone.observations[0])


class Countdown(gym.Env):
    """Ends after as many steps as its reset seed says, and then must not be stepped."""

    observation_space = gym.spaces.Box(0, 100, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        assert seed is not None
        self.left = seed
        return np.array([self.left], dtype=np.float32), {}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        assert self.left > 0, "stepped after its end"
        self.left -= 1
        reward = 10.0 if self.left == 0 else float(action)
        return np.array([self.left], dtype=np.float32), reward, self.left == 0, False, {}


@pytest.fixture
def countdown() -> Any:
    gym.register("Countdown-v0", Countdown, max_episode_steps=9)
    yield load_environment(EnvironmentConfig(name="countdown", id="Countdown-v0"))
    del gym.registry["Countdown-v0"]


def count_down(countdown: Environment, starts: list[int]) -> Episodes:
    copies = Environments(countdown, len(starts))
    return copies.play(lambda _, step: np.full(len(starts), 1), np.array(starts))


def test_a_copy_is_stepped_only_while_its_episode_lasts(countdown: Environment) -> None:
    assert count_down(countdown, [2, 7, 1]).lengths.tolist() == [2, 7, 1]


def test_playing_stops_with_the_longest_episode(countdown: Environment) -> None:
    assert count_down(countdown, [2, 7, 1]).rewards.shape == (3, 7)


def test_rewards_beyond_an_end_are_zero(countdown: Environment) -> None:
    assert count_down(countdown, [2, 4]).rewards[0].tolist() == [1, 10, 0, 0]


def test_returns_sum_an_episodes_rewards(countdown: Environment) -> None:
    assert count_down(countdown, [2, 4]).returns.tolist() == [11, 13]


def test_final_rewards_are_those_of_the_last_steps(countdown: Environment) -> None:
    assert count_down(countdown, [2, 4, 20]).final_rewards.tolist() == [10, 10, 1]


def test_ends_tell_an_end_from_a_truncation(countdown: Environment) -> None:
    assert count_down(countdown, [2, 9, 20]).ends.tolist() == [True, True, False]


def test_terminated_marks_last_steps_only(countdown: Environment) -> None:
    terminated = count_down(countdown, [2, 4]).terminated
    assert terminated.tolist() == [[False, True, False, False], [False, False, False, True]]


def test_act_sees_scaled_observations_and_the_step(countdown: Environment) -> None:
    seen: list[tuple[int, list[float]]] = []

    def act(observations: np.ndarray, step: int) -> np.ndarray:
        seen.append((step, observations[:, 0].tolist()))
        return np.zeros(2, dtype=np.int64)

    Environments(countdown, 2).play(act, np.array([2, 2]))
    # 2 and 1 of 0..100, scaled to [−1, 1].
    assert seen == [(0, pytest.approx([-0.96] * 2)), (1, pytest.approx([-0.98] * 2))]
