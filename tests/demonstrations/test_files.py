"""npz files of demonstrations, in ril's own layout and in that of IL-Datasets."""

from __future__ import annotations

import hashlib
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from gymnasium.spaces import Box
from helpers.demonstrations import Bomb, assert_pairs, refusal
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ril.demonstrations.files import load_demonstrations, shipped_path
from ril.demonstrations.trajectories import Demonstrations
from ril.environments.environment import Environment
from ril.experts.collection import Episode, save
from ril.io.errors import UserError

#: Two MountainCar trajectories, of two steps and of one.
OWN: dict[str, np.ndarray] = {
    "observations": np.array(
        [[-0.5, 0.0], [-0.4, 0.01], [-0.3, 0.02], [0.3, -0.01], [0.6, 0.07]], dtype=np.float32
    ),
    "actions": np.array([2, 1, 0]),
    "rewards": np.array([-1.0, -2.0, -4.0], dtype=np.float32),
    "lengths": np.array([2, 1]),
}
#: The same two trajectories; the actions and rewards of the last rows belong to no pair.
IL_DATASETS: dict[str, np.ndarray] = {
    "obs": OWN["observations"].astype(np.float64),
    "actions": np.array([2, 1, 2, 0, 2]),
    "rewards": np.array([-1.0, -2.0, -8.0, -4.0, -16.0]),
    "episode_returns": np.array([-11.0, -20.0]),
    "episode_starts": np.array([True, False, False, True, False]),
}
LAYOUTS = {"own": OWN, "IL-Datasets": IL_DATASETS}
OBSERVATIONS = OWN["observations"]

each_in_turn = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


def written(path: Path, arrays: Mapping[str, Any], **changes: Any) -> Path:
    """A file of the arrays; a change of None leaves one out."""
    changed = {n: a for n, a in {**arrays, **changes}.items() if a is not None}
    np.savez_compressed(path, **changed)
    return path


def assert_are_the_two(found: Demonstrations) -> None:
    np.testing.assert_array_equal(found.observations, OBSERVATIONS)
    assert found.actions.tolist() == [2, 1, 0]
    assert found.lengths.tolist() == [2, 1]


# --- what is read ------------------------------------------------------------------------------


@pytest.mark.parametrize("layout", LAYOUTS)
def test_each_layout_gives_the_same_trajectories(
    tmp_path: Path, mountaincar: Environment, layout: str
) -> None:
    found = load_demonstrations(written(tmp_path / "two.npz", LAYOUTS[layout]), mountaincar)
    assert_are_the_two(found)
    kinds = [array.dtype for array in (found.observations, found.actions, found.lengths)]
    assert kinds == [np.float32, np.int64, np.int64]


def test_returns_are_sums_of_rewards(tmp_path: Path, mountaincar: Environment) -> None:
    path = written(tmp_path / "two.npz", OWN)
    assert load_demonstrations(path, mountaincar).returns.tolist() == [-3.0, -4.0]


@pytest.mark.parametrize("given", [True, False])
def test_returns_of_il_datasets_count_the_last_reward(
    tmp_path: Path, mountaincar: Environment, given: bool
) -> None:
    changes = {} if given else {"episode_returns": None}
    path = written(tmp_path / "two.npz", IL_DATASETS, **changes)
    assert load_demonstrations(path, mountaincar).returns.tolist() == [-11.0, -20.0]


def test_returns_of_il_datasets_are_those_given_but_for_rounding(
    tmp_path: Path, mountaincar: Environment
) -> None:
    rounded = np.array([-11.0001, -20.0])
    path = written(tmp_path / "two.npz", IL_DATASETS, episode_returns=rounded)
    assert load_demonstrations(path, mountaincar).returns.tolist() == rounded.tolist()


@pytest.mark.parametrize("name", ["actions", "episode_starts"])
def test_whole_floats_count_as_integers(
    tmp_path: Path, mountaincar: Environment, name: str
) -> None:
    floats = IL_DATASETS[name].astype(np.float64)
    path = written(tmp_path / "floats.npz", IL_DATASETS, **{name: floats})
    assert_are_the_two(load_demonstrations(path, mountaincar))


@pytest.mark.parametrize("name", ["actions", "rewards", "episode_starts", "episode_returns"])
def test_columns_count_as_vectors(tmp_path: Path, mountaincar: Environment, name: str) -> None:
    path = written(tmp_path / "column.npz", IL_DATASETS, **{name: IL_DATASETS[name][:, None]})
    assert_are_the_two(load_demonstrations(path, mountaincar))


def test_the_return_of_one_episode_may_be_a_scalar(
    tmp_path: Path, mountaincar: Environment
) -> None:
    first = {name: array[:3] for name, array in IL_DATASETS.items()}
    path = written(tmp_path / "one.npz", first, episode_returns=np.array(-11.0))
    assert load_demonstrations(path, mountaincar).returns.tolist() == [-11.0]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_other_arrays_are_ignored(tmp_path: Path, mountaincar: Environment, layout: str) -> None:
    objects = np.array([{"any": "thing"}])
    path = written(tmp_path / "more.npz", LAYOUTS[layout], infos=objects)
    assert_are_the_two(load_demonstrations(path, mountaincar))


def test_hash_is_that_of_the_file(tmp_path: Path, mountaincar: Environment) -> None:
    path = written(tmp_path / "two.npz", OWN)
    expected = hashlib.sha256(path.read_bytes()).hexdigest()
    assert load_demonstrations(path, mountaincar).sha256 == expected


@pytest.mark.parametrize("name", ["cartpole", "acrobot", "mountaincar", "lunarlander"])
def test_the_package_ships_a_hundred_trajectories(
    environments: dict[str, Environment], name: str
) -> None:
    assert len(load_demonstrations(shipped_path(name), environments[name]).lengths) == 100


# --- round trips -------------------------------------------------------------------------------


@st.composite
def episodes(draw: st.DrawFn) -> list[Episode]:
    """Random MountainCar episodes of 2 to 6 steps."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    return [
        Episode(
            0,
            rng.uniform([-1.2, -0.07], [0.6, 0.07], (length + 1, 2)).astype(np.float32),
            rng.integers(3, size=length),
            rng.normal(size=length).astype(np.float32),
            bool(rng.integers(2)),
        )
        for length in draw(st.lists(st.integers(2, 6), min_size=1, max_size=5))
    ]


@each_in_turn
@given(played=episodes())
def test_what_ril_expert_saves_is_read_back(
    tmp_path: Path, mountaincar: Environment, played: list[Episode]
) -> None:
    save(tmp_path / "saved.npz", played)
    found = load_demonstrations(tmp_path / "saved.npz", mountaincar)
    pairs = [
        (each.observations[t], each.actions[t], each.observations[t + 1])
        for each in played
        for t in range(each.length)
    ]
    assert_pairs(found, mountaincar, pairs)
    np.testing.assert_allclose(found.returns, [each.total_reward for each in played])


@each_in_turn
@given(played=episodes())
def test_il_datasets_pairs_are_those_of_a_plain_loop(
    tmp_path: Path, mountaincar: Environment, played: list[Episode]
) -> None:
    file = {
        "obs": np.concatenate([each.observations[:-1] for each in played]),
        "actions": np.concatenate([each.actions for each in played]),
        "rewards": np.concatenate([each.rewards for each in played]),
        "episode_returns": np.array([each.rewards.sum() for each in played]).squeeze(),
        "episode_starts": np.concatenate([np.arange(each.length) == 0 for each in played]),
    }
    path = written(tmp_path / "il.npz", file)
    pairs = [
        (file["obs"][row], file["actions"][row], file["obs"][row + 1])
        for row in range(len(file["obs"]) - 1)
        if not file["episode_starts"][row + 1]
    ]
    assert_pairs(load_demonstrations(path, mountaincar), mountaincar, pairs)


# --- what is refused ---------------------------------------------------------------------------


def spoiled(array: np.ndarray, fault: str) -> np.ndarray:
    """An array with a fault that needs no knowledge of its layout."""
    floats = array.astype(np.float64)
    match fault:
        case "text":
            return array.astype(str)
        case "dimension":
            return np.stack([floats, floats], axis=-1)
        case "longer":
            return np.concatenate([array, array[-1:]])
        case "NaN" | "inf":
            return np.where(np.arange(floats.size).reshape(floats.shape) == 0, float(fault), floats)
        case _:
            return floats + 0.5  # not whole


WHOLE = {"actions", "lengths", "episode_starts"}
SPOILED = [
    (layout, name, fault)
    for layout, arrays in LAYOUTS.items()
    for name in arrays
    for fault in ("text", "dimension", "longer", "NaN", "inf", "fraction")
    if fault != "fraction" or name in WHOLE
]


@each_in_turn
@given(case=st.sampled_from(SPOILED))
def test_the_array_with_a_fault_is_named(
    tmp_path: Path, mountaincar: Environment, case: tuple[str, str, str]
) -> None:
    layout, name, fault = case
    arrays = LAYOUTS[layout]
    path = written(tmp_path / "faulty.npz", arrays, **{name: spoiled(arrays[name], fault)})
    says = refusal(path, mountaincar)
    if fault == "longer":  # two arrays then disagree, of which either may be named
        assert re.match(rf"({'|'.join(arrays)}|trajectory \d) has \d+ ", says)
    else:
        assert says.startswith(f"{name} ")


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"observations": np.full((5, 2), 1e39)}, "observations holds NaN or infinity"),
        ({"lengths": np.array([2**62] * 4 + [3])}, "lengths must hold whole numbers"),
        ({"lengths": np.array([], dtype=int)}, "holds no trajectory"),
        ({"lengths": np.array([3, 0])}, "trajectory 2 of 2 has 0 pairs of successive states"),
        ({"lengths": np.array([-1, 4])}, "trajectory 1 of 2 has -1 pairs of successive states"),
        ({"lengths": np.array([2, 2])}, "actions has 3 entries, its lengths require 4"),
        ({"observations": OBSERVATIONS[:4]}, "observations has 4 entries, its lengths require 5"),
        ({"actions": np.array([0, 3, 0])}, "actions lie in 0..3, MountainCar-v0 has 0..2"),
        ({"actions": np.array([0, -1, 0])}, "actions lie in -1..0, MountainCar-v0 has 0..2"),
        (
            {"observations": np.zeros((5, 4))},
            "observations have 4 entries each, MountainCar-v0 has 2",
        ),
        (
            {"observations": OBSERVATIONS * [1, 1 / 0.07]},
            "observations[:, 1] lie in -0.142857..1, MountainCar-v0 has -0.07..0.07; "
            "they must be raw, not scaled",
        ),
        ({"observations": OBSERVATIONS - [1, 0]}, "observations[:, 0] lie in -1.5..-0.4,"),
    ],
)
def test_a_fault_of_ril_layout_is_named(
    tmp_path: Path, mountaincar: Environment, changes: dict[str, Any], says: str
) -> None:
    assert refusal(written(tmp_path / "faulty.npz", OWN, **changes), mountaincar).startswith(says)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        (
            {"obs": np.zeros((6, 2))},
            "obs has 6 rows; needs 5, as many as episode_starts, or 7 with",
        ),
        ({"episode_starts": np.array([1, 0, 0])}, "actions has 5 rows, episode_starts 3"),
        ({"episode_starts": np.array([0, 1, 0, 0, 0])}, "episode_starts must hold 0 and 1 only"),
        ({"episode_starts": np.array([1, 0, 2, 0, 0])}, "episode_starts must hold 0 and 1 only"),
        ({"episode_starts": np.array([1, 0, 1, 1, 0])}, "trajectory 2 of 3 has 0 pairs"),
        ({name: IL_DATASETS[name][:0] for name in IL_DATASETS}, "holds no trajectory"),
        (
            {"episode_returns": np.array([-11.0])},
            "episode_returns has 1 entries, episode_starts 2 starts",
        ),
        (
            {"episode_returns": np.array([-11.0, -19.0])},
            "episode_returns of trajectory 2 is -19, its rewards sum to -20",
        ),
    ],
)
def test_a_fault_of_the_il_datasets_layout_is_named(
    tmp_path: Path, mountaincar: Environment, changes: dict[str, Any], says: str
) -> None:
    path = written(tmp_path / "faulty.npz", IL_DATASETS, **changes)
    assert refusal(path, mountaincar).startswith(says)


def test_a_file_in_neither_layout_names_both(tmp_path: Path, mountaincar: Environment) -> None:
    path = written(tmp_path / "other.npz", {"states": OBSERVATIONS, "actions": OWN["actions"]})
    assert refusal(path, mountaincar) == (
        "has the arrays actions, states; needs observations, actions, rewards, lengths "
        "(ril's layout) or obs, actions, rewards, episode_starts (IL-Datasets')"
    )


def test_observations_just_beyond_a_bound_are_accepted(
    tmp_path: Path, mountaincar: Environment
) -> None:
    path = written(tmp_path / "edge.npz", OWN, observations=OBSERVATIONS + np.array([0.001, 0]))
    assert len(load_demonstrations(path, mountaincar).lengths) == 2


def test_unbounded_entries_may_be_anything(tmp_path: Path, cartpole: Environment) -> None:
    states = np.tile([0, 1e6, 0.41, -1e6], (5, 1))
    path = written(tmp_path / "fast.npz", OWN, observations=states, actions=np.array([0, 1, 0]))
    load_demonstrations(path, cartpole)


def test_bounded_entries_beside_unbounded_ones_are_held(
    tmp_path: Path, cartpole: Environment
) -> None:
    states = np.tile([0, 1e6, 0.5, -1e6], (5, 1))
    path = written(tmp_path / "far.npz", OWN, observations=states, actions=np.array([0, 1, 0]))
    assert refusal(path, cartpole).startswith("observations[:, 2] lie in 0.5..0.5, CartPole-v1")


def test_a_bound_on_one_side_is_held(
    tmp_path: Path, mountaincar: Environment, monkeypatch: pytest.MonkeyPatch
) -> None:
    high = np.array([0.5, np.inf], dtype=np.float32)
    made = SimpleNamespace(observation_space=Box(-np.inf, high), close=lambda: None)
    monkeypatch.setattr(Environment, "make", lambda self: made)
    says = refusal(written(tmp_path / "two.npz", OWN), mountaincar)
    assert says.startswith("observations[:, 0] lie in -0.5..0.6, MountainCar-v0 has -inf..0.5;")


def test_a_missing_file_is_named(tmp_path: Path, mountaincar: Environment) -> None:
    assert refusal(tmp_path / "none.npz", mountaincar) == "no such file or folder"


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


@pytest.mark.parametrize(
    ("layout", "name"),
    [(layout, name) for layout, arrays in LAYOUTS.items() for name in arrays],
)
def test_nothing_is_unpickled(
    tmp_path: Path, mountaincar: Environment, layout: str, name: str
) -> None:
    objects = np.array([Bomb(tmp_path / "exploded")] * len(LAYOUTS[layout][name]))
    path = written(tmp_path / "pickle.npz", LAYOUTS[layout], **{name: objects})
    assert refusal(path, mountaincar) == f"{name} holds Python objects, which are never unpickled"
    assert not (tmp_path / "exploded").exists()


def test_the_bomb_would_go_off(tmp_path: Path) -> None:
    objects = np.array([Bomb(tmp_path / "exploded")])
    with np.load(written(tmp_path / "pickle.npz", {"a": objects}), allow_pickle=True) as archive:
        archive["a"]
    assert (tmp_path / "exploded").exists()


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return written(tmp_path_factory.mktemp("whole") / "two.npz", OWN).read_bytes()


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
def test_a_damaged_file_is_refused_or_read_correctly(
    tmp_path: Path, mountaincar: Environment, whole: bytes, share: float, flip: int
) -> None:
    path, at = tmp_path / "damaged.npz", int(share * len(whole))
    path.write_bytes(whole[:at] + bytes([whole[at] ^ flip]) + whole[at + 1 :])
    try:
        found = load_demonstrations(path, mountaincar)
    except UserError:
        return
    assert_are_the_two(found)


# --- folders, without minari -------------------------------------------------------------------


def test_a_folder_of_something_else_is_named(tmp_path: Path, mountaincar: Environment) -> None:
    says = refusal(tmp_path, mountaincar)
    assert says == "a folder without data/metadata.json, so not a Minari dataset"


def test_without_minari_its_extra_is_named(
    tmp_path: Path, mountaincar: Environment, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "minari", None)
    (tmp_path / "metadata.json").write_text('{"observation_space": "", "action_space": ""}')
    says = refusal(tmp_path, mountaincar)
    assert says.startswith("reading Minari needs pip install -e '.[minari]'")


def test_final_states_in_il_datasets_layout_lose_no_pair(
    tmp_path: Path, mountaincar: Environment
) -> None:
    # Episodes of 3 and 2 steps, each with the state that it ends in.
    obs = np.linspace(-0.5, 0.4, 14).reshape(7, 2) * [1, 0.1]
    path = written(tmp_path / "with_final.npz", IL_DATASETS, obs=obs)
    found = load_demonstrations(path, mountaincar)
    np.testing.assert_array_equal(found.observations, obs.astype(np.float32))
    assert found.lengths.tolist() == [3, 2]
    assert found.actions.tolist() == IL_DATASETS["actions"].ravel().tolist()


@pytest.mark.parametrize(("outside", "refused"), [(10, False), (11, True)])
def test_a_tenth_of_the_states_may_lie_outside_the_space(
    tmp_path: Path, mountaincar: Environment, outside: int, refused: bool
) -> None:
    observations = np.zeros((100, 2))
    observations[:outside, 0] = 5.0
    arrays = {
        "observations": observations,
        "actions": np.zeros(99, dtype=int),
        "rewards": np.zeros(99),
        "lengths": np.array([99]),
    }
    path = tmp_path / "leaving.npz"
    np.savez(path, **arrays)
    if refused:
        assert refusal(path, mountaincar).startswith("observations[:, 0] lie in 0..5")
    else:
        assert load_demonstrations(path, mountaincar).lengths.tolist() == [99]
