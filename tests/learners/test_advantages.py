from __future__ import annotations

import numpy as np
import pytest

from ril.learners.advantages import generalized_advantages

STEPS, COPIES = 12, 40
GAMMA = 0.9


def rollout(seed: int = 0) -> dict[str, np.ndarray]:
    random = np.random.default_rng(seed)
    rewards, values, next_values = random.normal(size=(3, STEPS, COPIES)).astype(np.float32)
    ended = random.uniform(size=(STEPS, COPIES))
    return {
        "rewards": rewards,
        "values": values,
        "next_values": next_values,
        "terminated": ended < 0.1,
        "truncated": ended > 0.9,
    }


def by_the_sum(part: dict[str, np.ndarray], step: int, copy: int, gae_lambda: float) -> float:
    """Σ (γλ)ˡ δ of eq. 16, up to the end of the episode or the rollout."""
    total = 0.0
    for later in range(step, STEPS):
        after = 0.0 if part["terminated"][later, copy] else part["next_values"][later, copy]
        error = part["rewards"][later, copy] + GAMMA * after - part["values"][later, copy]
        total += (GAMMA * gae_lambda) ** (later - step) * error
        if part["terminated"][later, copy] or part["truncated"][later, copy]:
            break
    return total


@pytest.mark.parametrize("gae_lambda", [0.0, 0.8, 1.0])
def test_advantages_are_discounted_sums_of_errors(gae_lambda: float) -> None:
    part = rollout()
    found = generalized_advantages(**part, gamma=GAMMA, gae_lambda=gae_lambda)
    expected = [
        [by_the_sum(part, step, copy, gae_lambda) for copy in range(COPIES)]
        for step in range(STEPS)
    ]
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
    assert found.dtype == np.float32


def test_with_lambda_1_they_are_n_step_returns_less_the_value() -> None:
    part = rollout()
    # A state has the same value as next state and as state, except at an episode's end.
    over = part["terminated"] | part["truncated"]
    part["next_values"][:-1] = np.where(over[:-1], part["next_values"][:-1], part["values"][1:])
    found = generalized_advantages(**part, gamma=GAMMA, gae_lambda=1.0) + part["values"]
    for copy in range(COPIES):
        for step in range(STEPS):
            expected, discount = 0.0, 1.0
            for later in range(step, STEPS):
                expected += discount * part["rewards"][later, copy]
                discount *= GAMMA
                if over[later, copy]:
                    break
            if not part["terminated"][later, copy]:
                expected += discount * part["next_values"][later, copy]
            assert found[step, copy] == pytest.approx(expected, rel=1e-3, abs=1e-4)


@pytest.mark.parametrize(("ending", "worth"), [("terminated", 1.0), ("truncated", 1 + GAMMA * 5)])
def test_only_a_truncated_episode_is_worth_what_would_follow(ending: str, worth: float) -> None:
    no = np.zeros((1, 1), dtype=bool)
    ended = {"terminated": no, "truncated": no, ending: ~no}
    one = np.ones((1, 1), dtype=np.float32)
    found = generalized_advantages(one, 0 * one, 5 * one, **ended, gamma=GAMMA, gae_lambda=1.0)
    assert found.item() == pytest.approx(worth)
