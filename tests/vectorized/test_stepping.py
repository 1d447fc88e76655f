from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from helpers.states import assert_equal_states, copied
from hypothesis import given, settings
from hypothesis import strategies as st

from ril.config.schema import EnvironmentConfig
from ril.environments.environment import Environment, load_environment
from ril.vectorized.copies import EnvironmentCopies, make_copies
from ril.vectorized.stepping import Step, SteppedEnvironments

NAMES = ("cartpole", "mountaincar", "lunarlander")
SEEDS = (3, 5, 9)


def plan(environment: Environment, steps: int, copies: int) -> np.ndarray:
    """(steps, copies) actions, in an order of their own for each copy."""
    return np.random.default_rng(0).integers(environment.action_count, size=(steps, copies))


def play(environments: SteppedEnvironments, actions: np.ndarray) -> list[tuple[np.ndarray, Step]]:
    """The states of the steps, and the steps."""
    return [(environments.observations, environments.step(chosen)) for chosen in actions]


def assert_same_play(found: Any, expected: Any) -> None:
    for (one, step), (other, reference) in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)
        for field in ("next_observations", "rewards", "terminated", "truncated"):
            np.testing.assert_array_equal(getattr(step, field), getattr(reference, field))


def recorded(
    environment: Environment, monkeypatch: pytest.MonkeyPatch, seeds: tuple[int, ...], copies: int
) -> tuple[SteppedEnvironments, list[list[int]]]:
    """Stepped environments, and a list of each copy's reset seeds, which grows."""
    resets: list[list[int]] = [[] for _ in range(len(seeds) * copies)]

    def recording(environment: Environment, count: int) -> EnvironmentCopies:
        made = make_copies(environment, count)
        reset = made.reset

        def recorded_reset(index: int, seed: int) -> None:
            resets[index].append(seed)
            reset(index, seed)

        monkeypatch.setattr(made, "reset", recorded_reset)
        return made

    with monkeypatch.context() as patch:
        patch.setattr("ril.vectorized.stepping.make_copies", recording)
        return SteppedEnvironments(environment, seeds, copies, "tests"), resets


@pytest.mark.parametrize(("name", "steps"), [(NAMES[0], 120), (NAMES[1], 450), (NAMES[2], 250)])
def test_each_copy_is_a_plain_loop(
    environments: dict[str, Environment], name: str, steps: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    environment = environments[name]
    stepped, resets = recorded(environment, monkeypatch, (3, 5), copies=3)
    actions = plan(environment, steps, 6)
    played = play(stepped, actions)
    ends = 0
    for index in range(6):
        copy, starts = gym.make(environment.config.id), iter(resets[index])
        state, _ = copy.reset(seed=next(starts))
        for (before, step), action in zip(played, actions[:, index], strict=True):
            np.testing.assert_array_equal(before[index], environment.scale(state))
            state, reward, terminated, truncated, _ = copy.step(int(action))
            # Of an episode that ends, its final state and not the next one's first.
            np.testing.assert_array_equal(step.next_observations[index], environment.scale(state))
            assert step.rewards[index] == np.float32(reward)
            assert (step.terminated[index], step.truncated[index]) == (terminated, truncated)
            if terminated or truncated:
                ends += 1
                state, _ = copy.reset(seed=next(starts))
        np.testing.assert_array_equal(stepped.observations[index], environment.scale(state))
    assert ends >= 4


def test_an_end_by_the_step_limit_is_truncated(mountaincar: Environment) -> None:
    steps = [
        step
        for _, step in play(
            SteppedEnvironments(mountaincar, SEEDS, 1, "tests"), plan(mountaincar, 400, 3)
        )
    ]
    assert [number for number, step in enumerate(steps) if step.truncated.all()] == [199, 399]
    assert not any(step.terminated.any() for step in steps)


class Both(gym.Env):
    """Ends by itself with its second step, at which the limit truncates it too."""

    observation_space = gym.spaces.Box(0, 10, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        self.count = 0
        return np.zeros(1, dtype=np.float32), {}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.count += 1
        return np.full(1, self.count, dtype=np.float32), 1.0, self.count == 2, False, {}


@pytest.fixture
def both() -> Any:
    gym.register("Both-v0", Both, max_episode_steps=2)
    yield load_environment(EnvironmentConfig(name="both", id="Both-v0"))
    del gym.registry["Both-v0"]


def test_an_end_at_the_step_limit_is_the_environments_own(both: Environment) -> None:
    _, (_, step) = play(SteppedEnvironments(both, [0], 1, "tests"), np.zeros((2, 1), np.int64))
    assert (step.terminated.tolist(), step.truncated.tolist()) == ([True], [False])


@pytest.mark.parametrize("name", NAMES)
def test_a_seeds_episodes_do_not_depend_on_other_seeds(
    environments: dict[str, Environment], name: str
) -> None:
    environment = environments[name]
    actions = plan(environment, 220, 6)
    among = play(SteppedEnvironments(environment, SEEDS, 2, "tests"), actions)
    alone = play(SteppedEnvironments(environment, [5], 2, "tests"), actions[:, 2:4])
    for (_, several), (_, one) in zip(among, alone, strict=True):
        for field in ("next_observations", "rewards", "terminated", "truncated"):
            np.testing.assert_array_equal(getattr(several, field)[2:4], getattr(one, field))


def test_a_copys_episodes_do_not_depend_on_the_number_of_copies(cartpole: Environment) -> None:
    actions = plan(cartpole, 100, 3)
    three = play(SteppedEnvironments(cartpole, [5], 3, "tests"), actions)
    one = play(SteppedEnvironments(cartpole, [5], 1, "tests"), actions[:, :1])
    for (_, several), (_, single) in zip(three, one, strict=True):
        np.testing.assert_array_equal(several.next_observations[:1], single.next_observations)


def test_every_episode_has_a_start_of_its_own(
    cartpole: Environment, monkeypatch: pytest.MonkeyPatch
) -> None:
    stepped, resets = recorded(cartpole, monkeypatch, SEEDS, copies=4)
    play(stepped, plan(cartpole, 300, 12))
    every = [start for of_copy in resets for start in of_copy]
    assert len(every) > 60
    assert len(set(every)) == len(every)


def test_the_same_purpose_gives_the_same_starts(cartpole: Environment) -> None:
    one, other = (SteppedEnvironments(cartpole, SEEDS, 2, "same") for _ in range(2))
    np.testing.assert_array_equal(one.observations, other.observations)


def test_another_purpose_gives_other_starts(cartpole: Environment) -> None:
    one, other = (SteppedEnvironments(cartpole, SEEDS, 2, name) for name in ("one", "other"))
    assert (one.observations != other.observations).any(axis=1).all()


def test_observations_are_not_written_over_by_the_next_step(cartpole: Environment) -> None:
    stepped = SteppedEnvironments(cartpole, SEEDS, 1, "tests")
    kept = [(stepped.observations, stepped.step(chosen)) for chosen in plan(cartpole, 60, 3)]
    values = [(before.copy(), step.next_observations.copy()) for before, step in kept]
    play(stepped, plan(cartpole, 60, 3))
    for (before, step), (one, other) in zip(kept, values, strict=True):
        np.testing.assert_array_equal(before, one)
        np.testing.assert_array_equal(step.next_observations, other)


@pytest.mark.parametrize(("name", "steps"), [(NAMES[0], 97), (NAMES[1], 230), (NAMES[2], 157)])
def test_a_loaded_state_resumes_bit_identically(
    environments: dict[str, Environment], name: str, steps: int
) -> None:
    environment = environments[name]
    actions = plan(environment, steps + 250, 6)
    uninterrupted = SteppedEnvironments(environment, SEEDS, 2, "tests")
    play(uninterrupted, actions[:steps])
    state = copied(uninterrupted.state_dict())
    assert all(state["actions"])  # so that every copy is in the middle of an episode
    resumed = SteppedEnvironments(environment, SEEDS, 2, "tests")
    play(resumed, actions[::-1][:50])  # what was played before leaves no trace
    resumed.load_state_dict(state)
    assert_equal_states(resumed.state_dict(), state)  # and may be saved again at once
    assert_same_play(play(resumed, actions[steps:]), play(uninterrupted, actions[steps:]))
    assert_equal_states(resumed.state_dict(), uninterrupted.state_dict())


@settings(max_examples=20)
@given(before=st.integers(0, 70), after=st.integers(1, 40))
def test_a_state_may_be_saved_at_any_step(cartpole: Environment, before: int, after: int) -> None:
    actions = plan(cartpole, before + after, 2)
    uninterrupted, resumed = (SteppedEnvironments(cartpole, [4], 2, "tests") for _ in range(2))
    play(uninterrupted, actions[:before])
    resumed.load_state_dict(copied(uninterrupted.state_dict()))
    np.testing.assert_array_equal(resumed.observations, uninterrupted.observations)
    assert_same_play(play(resumed, actions[before:]), play(uninterrupted, actions[before:]))


def test_a_state_does_not_change_with_what_is_played_after(cartpole: Environment) -> None:
    stepped = SteppedEnvironments(cartpole, SEEDS, 1, "tests")
    play(stepped, plan(cartpole, 5, 3))
    state = stepped.state_dict()
    kept = copied(state)
    play(stepped, plan(cartpole, 5, 3))
    assert_equal_states(state, kept)
