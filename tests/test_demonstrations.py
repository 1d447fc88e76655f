from __future__ import annotations

import dataclasses
import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ril.demonstrations import Demonstrations, StateTransitions, load_demonstrations
from ril.environments import Environment
from ril.errors import UserError

#: Two MountainCar trajectories, of two steps and of one.
ARRAYS: dict[str, np.ndarray] = {
    "observations": np.array(
        [[-0.5, 0.0], [-0.4, 0.01], [-0.3, 0.02], [0.3, -0.01], [0.6, 0.07]], dtype=np.float32
    ),
    "actions": np.array([2, 1, 0]),
    "rewards": np.array([-1.0, -2.0, -4.0], dtype=np.float32),
    "lengths": np.array([2, 1]),
    "terminated": np.array([False, True]),
}


def written(path: Path, **changes: np.ndarray | None) -> Path:
    """A file of the two trajectories; a change of None leaves the array out."""
    arrays = {n: a for n, a in (ARRAYS | changes).items() if a is not None}
    np.savez_compressed(path, **arrays)  # type: ignore[arg-type]
    return path


@pytest.fixture
def demonstrations(tmp_path: Path, mountaincar: Environment) -> Demonstrations:
    return load_demonstrations(written(tmp_path / "two.npz"), mountaincar)


@pytest.mark.parametrize("name", ARRAYS)
def test_saved_arrays_come_back(tmp_path: Path, mountaincar: Environment, name: str) -> None:
    path = tmp_path / "saved.npz"
    Demonstrations(**ARRAYS).save(path)
    found = getattr(load_demonstrations(path, mountaincar), name)
    np.testing.assert_array_equal(found, ARRAYS[name])


def test_hash_is_that_of_the_file(tmp_path: Path, mountaincar: Environment) -> None:
    path = written(tmp_path / "two.npz")
    expected = hashlib.sha256(path.read_bytes()).hexdigest()
    assert load_demonstrations(path, mountaincar).sha256 == expected


def test_returns_sum_each_trajectory(demonstrations: Demonstrations) -> None:
    assert demonstrations.returns.tolist() == [-3.0, -4.0]


def test_first_takes_whole_trajectories(demonstrations: Demonstrations) -> None:
    first = demonstrations.first(1)
    np.testing.assert_array_equal(first.observations, ARRAYS["observations"][:3])
    assert first.actions.tolist() == [2, 1]
    assert first.rewards.tolist() == [-1.0, -2.0]
    assert first.lengths.tolist() == [2]
    assert first.terminated.tolist() == [False]


def test_first_of_all_is_all(demonstrations: Demonstrations) -> None:
    np.testing.assert_array_equal(demonstrations.first(2).observations, ARRAYS["observations"])


@pytest.mark.parametrize("trajectories", [-1, 0, 3])
def test_first_refuses_what_there_is_not(demonstrations: Demonstrations, trajectories: int) -> None:
    with pytest.raises(UserError, match=rf"ablation\.trajectories={trajectories}: .* 1\.\.2"):
        demonstrations.first(trajectories)


def test_states_pair_each_state_with_its_next(
    demonstrations: Demonstrations, mountaincar: Environment
) -> None:
    states = demonstrations.states(mountaincar)
    # MountainCar's bounds are −1.2..0.6 and −0.07..0.07; no pair crosses a trajectory's end.
    scaled = (ARRAYS["observations"] - [-0.3, 0.0]) / [0.9, 0.07]
    np.testing.assert_allclose(states.observations, scaled[[0, 1, 3]], atol=1e-6)
    np.testing.assert_allclose(states.next_observations, scaled[[1, 2, 4]], atol=1e-6)


def test_states_know_the_mean_length(
    demonstrations: Demonstrations, mountaincar: Environment
) -> None:
    assert demonstrations.states(mountaincar).mean_length == 1.5


def test_states_hold_neither_actions_nor_rewards() -> None:
    fields = {field.name for field in dataclasses.fields(StateTransitions)}
    assert fields == {"observations", "next_observations", "trajectories"}


def refusal(path: Path, environment: Environment) -> str:
    with pytest.raises(UserError) as refused:
        load_demonstrations(path, environment)
    prefix, _, fault = str(refused.value).partition(": ")
    assert prefix == f"demonstrations={path}"
    assert "\n" not in fault
    return fault


OBSERVATIONS = ARRAYS["observations"]


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"actions": None}, "lacks the array(s) actions"),
        ({"lengths": None, "rewards": None}, "lacks the array(s) lengths, rewards"),
        ({"observations": OBSERVATIONS[:, 0]}, "observations has 1 dimension(s), needs 2"),
        ({"actions": ARRAYS["actions"][:, None]}, "actions has 2 dimension(s), needs 1"),
        ({"rewards": np.array(["a", "b", "c"])}, "rewards holds <U1, needs numbers"),
        ({"observations": OBSERVATIONS * np.nan}, "observations holds NaN or infinity"),
        ({"rewards": np.array([0, np.inf, 0])}, "rewards holds NaN or infinity"),
        ({"actions": np.array([2.0, 1.0, 0.0])}, "actions holds float64, needs integers"),
        ({"lengths": np.array([2.0, 1.0])}, "lengths holds float64, needs integers"),
        ({"lengths": np.array([], dtype=int)}, "lengths must name at least one trajectory"),
        ({"lengths": np.array([3, 0])}, "lengths must name at least one trajectory, each of one"),
        ({"lengths": np.array([4, -1])}, "lengths must name at least one trajectory, each of one"),
        ({"terminated": np.array([True])}, "terminated has 1 entries, lengths 2"),
        ({"actions": np.array([0, 1])}, "actions has 2 entries, its lengths say 3"),
        ({"rewards": np.zeros(4)}, "rewards has 4 entries, its lengths say 3"),
        ({"observations": OBSERVATIONS[:4]}, "observations has 4 entries, its lengths say 5"),
        ({"lengths": np.array([2, 2])}, "actions has 3 entries, its lengths say 4"),
        ({"actions": np.array([0, 3, 0])}, "actions lie in 0..3, MountainCar-v0 has 0..2"),
        ({"actions": np.array([0, -1, 0])}, "actions lie in -1..0, MountainCar-v0 has 0..2"),
        (
            {"observations": np.zeros((5, 4))},
            "observations have 4 entries each, MountainCar-v0 has 2",
        ),
    ],
)
def test_a_fault_is_named(
    tmp_path: Path, mountaincar: Environment, changes: dict[str, Any], says: str
) -> None:
    assert refusal(written(tmp_path / "faulty.npz", **changes), mountaincar).startswith(says)


def test_a_missing_file_is_named(tmp_path: Path, mountaincar: Environment) -> None:
    assert refusal(tmp_path / "none.npz", mountaincar) == "no such file"


NOT_NPZ = "not a readable npz file of plain arrays"


@pytest.mark.parametrize("content", [b"", b"s,a\n1,2\n", b"PK\x03\x04 not a zip"])
def test_another_kind_of_file_is_named(
    tmp_path: Path, mountaincar: Environment, content: bytes
) -> None:
    path = tmp_path / "other.npz"
    path.write_bytes(content)
    assert refusal(path, mountaincar) == NOT_NPZ


def test_a_single_array_is_named(tmp_path: Path, mountaincar: Environment) -> None:
    path = tmp_path / "single.npy"
    np.save(path, OBSERVATIONS)
    assert refusal(path, mountaincar) == NOT_NPZ


class Bomb:
    """What must never be unpickled."""

    exploded = False

    def __reduce__(self) -> tuple[Any, ...]:
        return setattr, (Bomb, "exploded", True)


def test_nothing_is_unpickled(tmp_path: Path, mountaincar: Environment) -> None:
    path = written(tmp_path / "pickle.npz", actions=np.array([Bomb(), Bomb(), Bomb()]))
    assert refusal(path, mountaincar) == NOT_NPZ
    assert not Bomb.exploded


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return written(tmp_path_factory.mktemp("whole") / "two.npz").read_bytes()


each_in_turn = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


@each_in_turn
@given(share=st.floats(0, 1, exclude_max=True))
def test_a_torn_file_is_refused(
    tmp_path: Path, mountaincar: Environment, whole: bytes, share: float
) -> None:
    path = tmp_path / "torn.npz"
    path.write_bytes(whole[: int(share * len(whole))])
    refusal(path, mountaincar)


@settings(each_in_turn, max_examples=300)
@given(share=st.floats(0, 1, exclude_max=True), flip=st.integers(1, 255))
def test_a_damaged_file_is_refused_or_read_alike(
    tmp_path: Path, mountaincar: Environment, whole: bytes, share: float, flip: int
) -> None:
    path, at = tmp_path / "damaged.npz", int(share * len(whole))
    path.write_bytes(whole[:at] + bytes([whole[at] ^ flip]) + whole[at + 1 :])
    try:
        found = load_demonstrations(path, mountaincar)
    except UserError:
        return
    for name, expected in ARRAYS.items():
        np.testing.assert_array_equal(getattr(found, name), expected)


@pytest.mark.parametrize("name", ["cartpole", "acrobot", "mountaincar", "lunarlander"])
def test_the_package_ships_a_hundred_trajectories(
    environments: dict[str, Environment], name: str
) -> None:
    from ril.demonstrations import shipped_path

    assert len(load_demonstrations(shipped_path(name), environments[name]).lengths) == 100
