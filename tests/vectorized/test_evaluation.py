from __future__ import annotations

from collections.abc import Callable

import gymnasium as gym
import numpy as np
import pytest
import torch
from torch.nn.functional import one_hot

from ril.environments.environment import Environment, Floats
from ril.vectorized.evaluation import Evaluation, random_returns
from ril.vectorized.streams import Streams


class Policy:
    """Acts by a function of scaled observations."""

    def __init__(self, greedy: Callable[[Floats], np.ndarray]) -> None:
        self._greedy = greedy

    def frozen(self) -> Callable[[Floats], torch.Tensor]:
        return lambda observations: one_hot(torch.from_numpy(self._greedy(observations)))


def towards_the_fall(observations: Floats) -> np.ndarray:
    return (observations[:, 3] > 0).astype(np.int64)


lean = Policy(towards_the_fall)


@pytest.mark.parametrize("episodes", [1, 7, 20, 23])
def test_returns_are_those_of_plain_episodes(cartpole: Environment, episodes: int) -> None:
    seeds = (4, 9)
    returns = Evaluation(cartpole, seeds).returns(lean, episodes, "test")
    assert returns.shape == (2, episodes)
    starts = Streams(seeds, "evaluation test").integers(2**31, episodes)
    copy = gym.make("CartPole-v1")
    for index in np.ndindex(starts.shape):
        observation, _ = copy.reset(seed=int(starts[index]))
        total, over = 0.0, False
        while not over:
            observation, reward, terminated, truncated, _ = copy.step(int(observation[3] > 0))
            total, over = total + float(reward), terminated or truncated
        assert returns[index] == total


def test_each_seeds_own_policy_plays_its_episodes(cartpole: Environment) -> None:
    def act(observations: Floats) -> np.ndarray:
        by_seed = observations.reshape(2, -1, 4)
        return np.stack(
            (towards_the_fall(by_seed[0]), np.ones(by_seed.shape[1], dtype=np.int64))
        ).ravel()

    leaning, pushing = Evaluation(cartpole, (0, 1)).returns(Policy(act), 10, "test")
    assert leaning.min() > 100
    assert pushing.max() < 15


def test_a_seeds_returns_do_not_depend_on_other_seeds(cartpole: Environment) -> None:
    alone = Evaluation(cartpole, (5,)).returns(lean, 6, "test")
    among = Evaluation(cartpole, (3, 5, 9)).returns(lean, 6, "test")
    np.testing.assert_array_equal(among[1], alone[0])


def test_the_same_purpose_plays_the_same_episodes(cartpole: Environment) -> None:
    evaluation = Evaluation(cartpole, (0,))
    first = evaluation.returns(lean, 6, "test")
    np.testing.assert_array_equal(evaluation.returns(lean, 6, "test"), first)


def test_another_purpose_plays_other_episodes(cartpole: Environment) -> None:
    evaluation = Evaluation(cartpole, (0,))
    first = evaluation.returns(lean, 6, "test")
    assert (evaluation.returns(lean, 6, "another") != first).any()


@pytest.mark.parametrize("episodes", [1, 7, 45])
def test_random_returns_are_as_many_as_asked(cartpole: Environment, episodes: int) -> None:
    assert random_returns(cartpole, [0, 7], episodes).shape == (2, episodes)


def test_random_returns_are_always_the_same(cartpole: Environment) -> None:
    once, again = (random_returns(cartpole, [0], 30) for _ in range(2))
    np.testing.assert_array_equal(once, again)


def test_a_seeds_random_returns_do_not_depend_on_other_seeds(cartpole: Environment) -> None:
    alone, among = random_returns(cartpole, [5], 30), random_returns(cartpole, [3, 5, 9], 30)
    np.testing.assert_array_equal(among[1], alone[0])
    assert (among[0] != among[1]).any()


def test_random_returns_are_of_different_episodes(cartpole: Environment) -> None:
    assert len(set(random_returns(cartpole, [0], 60)[0].tolist())) > 10


@pytest.mark.parametrize(
    ("name", "low", "high"), [("cartpole", 18, 27), ("mountaincar", -200, -199)]
)
def test_random_returns_are_those_of_random_play(
    environments: dict[str, Environment], name: str, low: float, high: float
) -> None:
    assert low <= random_returns(environments[name], [0], 100).mean() <= high
