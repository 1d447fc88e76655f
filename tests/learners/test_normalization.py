"""Ours beside Stable-Baselines3's VecNormalize, step for step on the same numbers."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from helpers.states import assert_equal_states, copied
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from ril.learners.normalization import Normalization, Standardization

SEEDS, COPIES, SIZE, STEPS = 3, 5, 2, 60
GAMMA = 0.9


def steps() -> Any:
    """Observations, rewards and ends of each step; some are far from the mean of all."""
    numbers = np.random.default_rng(0)
    for step in range(STEPS):
        shape = SEEDS * COPIES, SIZE
        seen = numbers.normal((3, -1), (1, 1e-3), shape).astype(np.float32)
        rewards = numbers.normal(size=SEEDS * COPIES).astype(np.float32)
        if step == 40:
            seen[7], rewards[7] = 1e4, 1e4
        yield seen, rewards, numbers.random(SEEDS * COPIES) < 0.1


class Given(DummyVecEnv):
    """One seed's part of the numbers."""

    def __init__(self, seed: int, first: np.ndarray) -> None:
        space = gym.spaces.Box(-np.inf, np.inf, (SIZE,), np.float32)
        self.part = slice(COPIES * seed, COPIES * (seed + 1))
        self.first = first[self.part]
        super(DummyVecEnv, self).__init__(COPIES, space, gym.spaces.Discrete(2))

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [None] * COPIES

    def reset(self) -> Any:
        return self.first

    def give(self, seen: np.ndarray, rewards: np.ndarray, over: np.ndarray) -> None:
        infos = [{"terminal_observation": seen[self.part][0]} for _ in range(COPIES)]
        self.step_wait = lambda: (  # type: ignore[method-assign]
            seen[self.part].copy(),
            rewards[self.part].copy(),
            over[self.part].copy(),
            infos,
        )


@pytest.fixture(scope="module")
def first() -> np.ndarray:
    numbers = np.random.default_rng(1)
    return numbers.normal((3, -1), (1, 1e-3), (SEEDS * COPIES, SIZE)).astype(np.float32)


def test_it_is_vec_normalize_of_each_seed(first: np.ndarray) -> None:
    ours = Normalization(first, SEEDS, GAMMA)
    given = [Given(seed, first) for seed in range(SEEDS)]
    theirs = [VecNormalize(each, gamma=GAMMA) for each in given]
    seen = np.concatenate([each.reset() for each in theirs])
    np.testing.assert_allclose(ours.observations(first), seen, rtol=1e-4, atol=1e-4)
    clipped = 0
    for observations, rewards, over in steps():
        ours.update(observations, rewards)
        found = ours.observations(observations), ours.rewards(rewards)
        ours.end(over)
        for each in given:
            each.give(observations, rewards, over)
        answers = [each.step_wait() for each in theirs]
        for index in range(2):
            expected = np.concatenate([answer[index] for answer in answers])
            assert found[index].dtype == np.float32
            np.testing.assert_allclose(found[index], expected, rtol=1e-3, atol=1e-3)
        clipped += np.count_nonzero(np.abs(found[0]) == 10)
        for seed, each in enumerate(theirs):
            np.testing.assert_allclose(ours.seen.mean[seed], each.obs_rms.mean, rtol=1e-5)
            np.testing.assert_allclose(ours.seen.variance[seed], each.obs_rms.var, rtol=1e-3)
            np.testing.assert_allclose(ours.earned.variance[seed], each.ret_rms.var, rtol=1e-5)
            assert ours.seen.count == each.obs_rms.count == each.ret_rms.count + COPIES
    assert clipped


def test_a_seed_does_not_depend_on_other_seeds(first: np.ndarray) -> None:
    part = slice(COPIES, 2 * COPIES)
    among, alone = Normalization(first, SEEDS, GAMMA), Normalization(first[part], 1, GAMMA)
    for observations, rewards, over in steps():
        among.update(observations, rewards)
        alone.update(observations[part], rewards[part])
        found = among.observations(observations)[part], among.rewards(rewards)[part]
        np.testing.assert_array_equal(found[0], alone.observations(observations[part]))
        np.testing.assert_array_equal(found[1], alone.rewards(rewards[part]))
        among.end(over)
        alone.end(over[part])


def test_a_loaded_state_resumes_bit_identically(first: np.ndarray) -> None:
    one, resumed = Normalization(first, SEEDS, GAMMA), Normalization(first + 1, SEEDS, GAMMA)
    for step, (observations, rewards, over) in enumerate(steps()):
        for each in (one, resumed):
            each.update(observations, rewards)
            each.end(over)
        if step == 5:
            resumed.load_state_dict(copied(one.state_dict()))
    assert_equal_states(resumed.state_dict(), one.state_dict())


def test_standardized_states_have_mean_0_and_deviation_1() -> None:
    states = np.random.default_rng(0).normal((3, -1), (0.5, 0.01), (200, 2)).astype(np.float32)
    found = Standardization(states)(states)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found.mean(axis=0), 0, atol=1e-4)
    np.testing.assert_allclose(found.std(axis=0), 1, rtol=1e-4)


def test_a_far_state_is_clipped() -> None:
    standardize = Standardization(np.array([[0, 1], [2, 5]], dtype=np.float32))
    assert standardize(np.array([[4, 3], [1e3, -1e3]], np.float32)).tolist() == [[3, 0], [10, -10]]


def test_a_feature_that_never_changes_is_only_centered() -> None:
    standardize = Standardization(np.array([[0, 0.1]] * 3 + [[2, 0.1]] * 3, dtype=np.float32))
    found = standardize(np.array([[1, 0.1], [1, 1.1]], dtype=np.float32))
    np.testing.assert_allclose(found, [[0, 0], [0, 1]], atol=1e-6)
