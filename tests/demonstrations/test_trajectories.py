from __future__ import annotations

import gc
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from ril.demonstrations.files import load_demonstrations, shipped_path
from ril.demonstrations.trajectories import Demonstrations
from ril.environments.environment import Environment
from ril.io.errors import UserError


@pytest.fixture
def demonstrations() -> Demonstrations:
    """Two MountainCar trajectories, of two steps and of one."""
    return Demonstrations(
        np.array(
            [[-0.5, 0.0], [-0.4, 0.01], [-0.3, 0.02], [0.3, -0.01], [0.6, 0.07]], dtype=np.float32
        ),
        np.array([2, 1, 0]),
        np.array([2, 1]),
        np.array([-3.0, -4.0]),
        "hash",
    )


# --- the first n -------------------------------------------------------------------------------


def test_first_returns_whole_trajectories(demonstrations: Demonstrations) -> None:
    first = demonstrations.first(1)
    np.testing.assert_array_equal(first.observations, demonstrations.observations[:3])
    assert first.actions.tolist() == [2, 1]
    assert first.lengths.tolist() == [2]
    assert first.returns.tolist() == [-3.0]
    assert first.sha256 == "hash"


def test_first_of_all_is_all(demonstrations: Demonstrations) -> None:
    np.testing.assert_array_equal(demonstrations.first(2).observations, demonstrations.observations)


@pytest.mark.parametrize("trajectories", [-1, 0, 3])
def test_first_refuses_a_number_out_of_range(
    demonstrations: Demonstrations, trajectories: int
) -> None:
    with pytest.raises(UserError, match=rf"ablation\.trajectories={trajectories}: .* 1\.\.2"):
        demonstrations.first(trajectories)


# --- with and without actions ------------------------------------------------------------------


@pytest.mark.parametrize("view", ["states", "labeled"])
def test_a_view_pairs_each_state_with_its_next(
    demonstrations: Demonstrations, mountaincar: Environment, view: str
) -> None:
    seen = getattr(demonstrations, view)(mountaincar)
    # MountainCar's bounds are −1.2..0.6 and −0.07..0.07; no pair crosses a trajectory's end.
    scaled = (demonstrations.observations - [-0.3, 0.0]) / [0.9, 0.07]
    np.testing.assert_allclose(seen.observations, scaled[[0, 1, 3]], atol=1e-6)
    np.testing.assert_allclose(seen.next_observations, scaled[[1, 2, 4]], atol=1e-6)


def test_a_view_knows_the_mean_length(
    demonstrations: Demonstrations, mountaincar: Environment
) -> None:
    assert demonstrations.states(mountaincar).mean_length == 1.5


def test_labels_are_the_experts_actions(
    demonstrations: Demonstrations, mountaincar: Environment
) -> None:
    assert demonstrations.labeled(mountaincar).actions.tolist() == [2, 1, 0]


def test_a_method_cannot_relabel_the_file(
    demonstrations: Demonstrations, mountaincar: Environment
) -> None:
    demonstrations.labeled(mountaincar).actions[:] = 0
    assert demonstrations.actions.tolist() == [2, 1, 0]


def reachable_arrays(thing: Any) -> Iterator[np.ndarray]:
    """All arrays that something holds, and those whose memory they borrow."""
    seen: set[int] = set()
    waiting = [thing]
    while waiting:
        found = waiting.pop()
        if id(found) in seen or isinstance(found, type):
            continue
        seen.add(id(found))
        if isinstance(found, np.ndarray):
            yield found
            waiting.append(found.base)
        waiting.extend(gc.get_referents(found))


@pytest.mark.parametrize("name", ["cartpole", "acrobot", "mountaincar", "lunarlander"])
def test_actions_cannot_be_reached_from_the_states(
    environments: dict[str, Environment], name: str
) -> None:
    demonstrations = load_demonstrations(shipped_path(name), environments[name]).first(2)
    actions = demonstrations.actions
    arrays = list(reachable_arrays(demonstrations.states(environments[name])))
    assert len(arrays) == 2
    for array in arrays:
        assert array.shape == (len(actions), environments[name].observation_size)
        assert not np.shares_memory(array, actions)
        assert not (array == actions[:, None]).all(axis=0).any()


def test_reachable_actions_would_be_found(demonstrations: Demonstrations) -> None:
    borrowing = demonstrations.actions[:1]
    for leaky in (demonstrations, {"hidden": [borrowing]}):
        assert any(array is demonstrations.actions for array in reachable_arrays(leaky))
