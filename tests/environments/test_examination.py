"""What an environment may do wrong, before training and at each of its answers."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from helpers.strange import ALLOWED, ID, RESETS, STEPS, Strange, registered, strange

from ril.environments.environment import Environment
from ril.environments.examination import examine
from ril.io.errors import NotFiniteError, UserError
from ril.vectorized.rollout import Environments
from ril.vectorized.stepping import SteppedEnvironments

LATER = 250  # calls, which is before the last trial ends

SAYS = {
    "four values": "step returned another number of values (not enough values to unpack (expected "
    "5, got 4)), must be observation, reward, terminated, truncated, info",
    "nothing": "step returned another number of values (cannot unpack non-iterable NoneType ",
    "one entry": "step returned an observation of shape (1,) and type float32, must be numbers of "
    "shape (2,), as observation_space says",
    "a number as observation": "step returned an observation of shape ()",
    "a ragged observation": "step returned an observation that is no array (",
    "text": "step returned an observation of shape (2,) and type <U1",
    "reward of shape (1,)": "step returned the reward an array of shape (1,), must be one number",
    "a vector reward": "step returned the reward an array of shape (2,), must be one number",
    "a ragged reward": "step returned the reward [1.0, [2.0, 3.0]], must be one number",
    "no reward": "step returned the reward None, must be one number",
    "an end of shape (1,)": "step returned terminated = an array of shape (1,), must be True or",
    "an end that is text": "step returned terminated = 'no', must be True or False",
    "NaN observation": "the observation[0] is nan, must be finite",
    "an infinite entry": "the observation[1] is inf, must be finite",
    "too large for single precision": "the observation[0] is ",
    "NaN reward": "the reward is nan, must be finite",
    "info that is no dict": "step returned info = None, must be a dict",
    "unpacks too much": "step: ValueError: not enough values to unpack (expected 3, got 2)",
    "reset: info that is no dict": "reset returned info = 5, must be a dict",
    "raises": "step: RuntimeError: the simulator is gone",
    "is out of memory": "step: MemoryError",
    "reset raises": "reset: KeyError: 'level'",
    "reset: the observation alone": "reset returned an array of shape (2,), must be observation, i",
    "reset: three values": "reset returned a tuple of 3, must be observation, info",
    "reset: one entry": "reset returned an observation of shape (1,)",
    "reset: NaN": "the observation[0] is nan",
}


@pytest.fixture(autouse=True)
def fresh() -> Iterator[None]:
    with registered():
        yield


def test_every_wrong_answer_has_a_test() -> None:
    assert set(STEPS) | set(RESETS) <= set(SAYS)


@pytest.mark.parametrize("after", [0, LATER])
@pytest.mark.parametrize("how", SAYS)
def test_a_wrong_answer_is_named_before_training(how: str, after: int) -> None:
    with pytest.raises(UserError) as told:
        examine(strange(how, after))
    assert str(told.value).startswith(f"env.id={ID}: {SAYS[how]}")
    assert "\n" not in str(told.value)


@pytest.mark.parametrize("how", SAYS)
def test_a_wrong_answer_is_named_at_any_time(how: str) -> None:
    """Thousands of steps later, in one of many copies."""
    copies = SteppedEnvironments(strange(how, after=2000), range(5), 4, "strange")
    actions = np.zeros(20, dtype=np.int64)

    def play() -> None:
        for _ in range(120):
            copies.step(actions)

    with pytest.raises(UserError) as told:
        play()
    assert str(told.value).startswith(f"env.id={ID}: {SAYS[how]}")
    is_number = "nan" in str(told.value) or "is inf" in str(told.value)
    assert isinstance(told.value, NotFiniteError) is is_number


def test_a_buffer_that_is_changed_in_place_is_copied() -> None:
    with pytest.raises(NotFiniteError, match=r"the observation\[1\] is nan"):
        examine(strange("NaN in a buffer that it keeps"))


@pytest.mark.parametrize("how", ["", "close raises", "a constant entry", *ALLOWED])
def test_an_environment_without_fault_passes(how: str) -> None:
    assert examine(strange(how)) == ()


@pytest.mark.parametrize("how", ["ignores its seed", "keeps a state"])
def test_episodes_that_cannot_be_repeated_are_doubtful(how: str) -> None:
    assert examine(strange(how)) == (
        f"env.id={ID}: the same seed and actions give different episodes; results cannot be "
        "repeated, and a stopped run cannot be resumed exactly",
    )


@pytest.mark.parametrize(
    ("how", "says"), [("wide bounds", "it hardly moves"), ("narrow bounds", "far beyond")]
)
def test_useless_bounds_are_doubtful(how: str, says: str) -> None:
    [line] = examine(strange(how))
    assert line.startswith("env.observation_high: observation[0] moves between -")
    assert says in line
    assert examine(strange(how, scale_observations=False)) == ()
    assert examine(strange(how, observation_low=[-2, 0], observation_high=[2, 2])) == ()


@pytest.mark.parametrize("how", ["unbounded", "huge bounds"])
def test_bounds_beyond_any_observation_are_none(how: str) -> None:
    with pytest.raises(UserError, match=r"^env.observation_low: the observations of .* unbounded"):
        strange(how)


def test_a_constant_entry_is_scaled_to_0() -> None:
    environment = strange("a constant entry")
    assert environment.scale(np.array([[2.0, 1.0], [-2.0, 1.0]])).tolist() == [[1, 0], [-1, 0]]


def test_a_constant_bound_of_the_user_is_refused() -> None:
    with pytest.raises(UserError, match=r"^env.observation_low: every entry must be below"):
        strange(observation_low=[-2.0, 1.0], observation_high=[2.0, 1.0])


def test_an_environment_of_which_there_can_be_one_is_refused_by_its_own_words() -> None:
    with pytest.raises(UserError, match=f"^env.id={ID}: the port is in use$"):
        examine(strange("one only"))


def test_what_ril_ships_is_not_tried(environments: dict[str, Environment]) -> None:
    assert all(examine(environment) == () for environment in environments.values())


@pytest.mark.parametrize("how", ["", "four values", "ignores its seed", "close raises"])
def test_every_copy_of_a_trial_is_closed(how: str) -> None:
    try:
        examine(strange(how))
    except UserError:
        assert how == "four values"
    assert set(Strange.made) == set(Strange.closed)


def test_closing_closes_each_copy_once() -> None:
    environment = strange()
    environment.make().close()
    Environments(environment, copies=3)
    environment.close()
    environment.close()
    assert sorted(map(id, Strange.made)) == sorted(map(id, Strange.closed))
