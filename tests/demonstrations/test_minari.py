"""Demonstrations in folders written by Minari."""

from __future__ import annotations

import json
import pickle
import shutil
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete
from helpers.demonstrations import Bomb, assert_pairs, refusal

from ril.demonstrations.files import load_demonstrations
from ril.environments.environment import Environment
from ril.experts.collection import Episode

minari = pytest.importorskip("minari")
h5py = pytest.importorskip("h5py")
pytest.importorskip("PIL")

Make = Callable[..., Path]


def random_episodes(lengths: Sequence[int], seed: int = 0) -> list[Episode]:
    rng = np.random.default_rng(seed)
    return [
        Episode(
            0,
            rng.uniform([-1.2, -0.07], [0.6, 0.07], (length + 1, 2)).astype(np.float32),
            rng.integers(3, size=length),
            rng.normal(size=length).astype(np.float32),
            True,
        )
        for length in lengths
    ]


@pytest.fixture
def make(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Make:
    """Writes episodes as a new dataset `car/random-v0`; gives its folder."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))

    def made(played: Sequence[Episode], **spaces: gym.Space) -> Path:
        buffers = [
            minari.data_collector.EpisodeBuffer(
                observations=each.observations,
                actions=each.actions,
                rewards=each.rewards,
                terminations=np.arange(each.length) == each.length - 1,
                truncations=np.zeros(each.length, dtype=bool),
            )
            for each in played
        ]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # minari warns of missing metadata
            minari.create_dataset_from_buffers(
                "car/random-v0", buffers, env="MountainCar-v0", **spaces
            )
        return tmp_path / "car" / "random-v0"

    return made


@pytest.fixture
def dataset(make: Make) -> Path:
    """Two episodes, of two steps and of one."""
    return make(random_episodes([2, 1]))


def replace(dataset: Path, name: str, content: Any) -> None:
    """Store another array in the place of one."""
    with h5py.File(dataset / "data" / "main_data.hdf5", "a") as file:
        del file[name]
        file.create_dataset(name, data=content)


@pytest.mark.parametrize("lengths", [[1], [2, 1], [3, 1, 4, 1, 5]])
def test_pairs_are_those_of_a_plain_loop(
    make: Make, mountaincar: Environment, lengths: list[int]
) -> None:
    played = random_episodes(lengths, seed=len(lengths))
    found = load_demonstrations(make(played), mountaincar)
    pairs = [
        (each.observations[t], each.actions[t], each.observations[t + 1])
        for each in played
        for t in range(each.length)
    ]
    assert_pairs(found, mountaincar, pairs)
    np.testing.assert_allclose(found.returns, [each.total_reward for each in played], rtol=1e-6)


def test_episodes_keep_their_order_beyond_ten(make: Make, mountaincar: Environment) -> None:
    lengths = list(range(1, 13))
    found = load_demonstrations(make(random_episodes(lengths)), mountaincar)
    assert found.lengths.tolist() == lengths


def test_the_data_folder_is_the_dataset_too(dataset: Path, mountaincar: Environment) -> None:
    whole, inner = (load_demonstrations(p, mountaincar) for p in (dataset, dataset / "data"))
    np.testing.assert_array_equal(whole.observations, inner.observations)
    assert whole.sha256 == inner.sha256


def test_reading_changes_no_file(dataset: Path, mountaincar: Environment) -> None:
    before = {file: file.read_bytes() for file in dataset.rglob("*") if file.is_file()}
    load_demonstrations(dataset, mountaincar)
    assert before == {file: file.read_bytes() for file in dataset.rglob("*") if file.is_file()}


def test_a_copy_has_the_same_hash(dataset: Path, mountaincar: Environment, tmp_path: Path) -> None:
    copy = shutil.copytree(dataset, tmp_path / "copy")
    hashes = {load_demonstrations(path, mountaincar).sha256 for path in (dataset, copy)}
    assert len(hashes) == 1


@pytest.mark.parametrize("change", ["a name", "a content"])
def test_the_hash_depends_on(dataset: Path, mountaincar: Environment, change: str) -> None:
    note = dataset / "data" / "note.txt"
    note.write_text("one")
    before = load_demonstrations(dataset, mountaincar).sha256
    if change == "a name":
        note.rename(note.with_name("other.txt"))
    else:
        note.write_text("two")
    assert load_demonstrations(dataset, mountaincar).sha256 != before


@pytest.mark.parametrize(
    ("kind", "space"),
    [
        ("observation", Box(-1, 1, (3,))),
        ("observation", Box(-1, 1, (1, 2))),
        ("observation", Discrete(5)),
        ("action", Discrete(5)),
        ("action", Discrete(3, start=1)),
        ("action", Box(-1, 1, (1,))),
    ],
)
def test_other_spaces_are_named(
    make: Make, mountaincar: Environment, kind: str, space: gym.Space
) -> None:
    says = refusal(make(random_episodes([2]), **{f"{kind}_space": space}), mountaincar)
    assert says.startswith(f"{kind}s are {space}, MountainCar-v0 has ")


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("observations", np.zeros((1, 2)), "trajectory 2 of 2 has 1 observations for 1 actions"),
        ("actions", np.array([3]), "actions lie in "),
        ("actions", np.array([0.5]), "actions must hold whole numbers"),
        ("actions", [[0, 0]], "minari cannot read it (ValueError: "),
        ("rewards", np.array([np.nan]), "rewards holds NaN or infinity"),
        ("rewards", np.zeros(2), "rewards has 4 entries, its lengths require 3"),
        ("observations", np.ones((2, 2)), "observations[:, 0] lie in"),
    ],
)
def test_a_fault_is_named(
    dataset: Path, mountaincar: Environment, name: str, content: Any, says: str
) -> None:
    replace(dataset, f"episode_1/{name}", content)
    assert refusal(dataset, mountaincar).startswith(says)


def test_an_episode_without_steps_is_named(dataset: Path, mountaincar: Environment) -> None:
    for name, content in (
        ("observations", np.zeros((1, 2))),
        ("actions", np.zeros(0, dtype=int)),
        ("rewards", np.zeros(0)),
    ):
        replace(dataset, f"episode_1/{name}", content)
    says = refusal(dataset, mountaincar)
    assert says.startswith("trajectory 2 of 2 has 0 pairs of successive states")


def test_a_dataset_without_episodes_is_named(make: Make, mountaincar: Environment) -> None:
    assert refusal(make([]), mountaincar) == "holds no trajectory"


@pytest.mark.parametrize("file", ["main_data.hdf5", "metadata.json"])
def test_a_torn_dataset_is_named(dataset: Path, mountaincar: Environment, file: str) -> None:
    path = dataset / "data" / file
    path.write_bytes(path.read_bytes()[:200])
    assert refusal(dataset, mountaincar).startswith("minari cannot read it (")


def test_nothing_is_unpickled(dataset: Path, mountaincar: Environment, tmp_path: Path) -> None:
    bomb = np.void(pickle.dumps(Bomb(tmp_path / "exploded")))
    replace(dataset, "episode_0/actions", np.array([bomb, bomb]))
    replace(dataset, "episode_1/actions", np.array([bomb]))
    assert refusal(dataset, mountaincar).endswith(", needs numbers")
    assert not (tmp_path / "exploded").exists()


def without_spaces(dataset: Path, leaves: Path) -> Path:
    """A dataset whose metadata name a function that writes a file instead of an environment."""
    path = dataset / "data" / "metadata.json"
    metadata = json.loads(path.read_text())
    del metadata["observation_space"]
    called = {"entry_point": "builtins:open", "kwargs": {"file": str(leaves), "mode": "w"}}
    metadata["env_spec"] = json.dumps(json.loads(metadata["env_spec"]) | called)
    path.write_text(json.dumps(metadata))
    return dataset


def test_no_environment_is_made(dataset: Path, mountaincar: Environment, tmp_path: Path) -> None:
    says = refusal(without_spaces(dataset, tmp_path / "exploded"), mountaincar)
    assert says == "metadata.json lacks observation_space or action_space"
    assert not (tmp_path / "exploded").exists()


@pytest.mark.filterwarnings("ignore")
def test_minari_alone_would_have_made_it(dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(Exception):  # noqa: B017, PT011  a file is no environment
        minari.MinariDataset(without_spaces(dataset, tmp_path / "exploded") / "data")
    assert (tmp_path / "exploded").exists()
