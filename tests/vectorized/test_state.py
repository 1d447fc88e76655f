from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch
from helpers.states import assert_equal_states, copied

from ril.vectorized.state import Stateful
from ril.vectorized.streams import Streams


class Part(Stateful):
    STATE: ClassVar = ("count",)

    def __init__(self, count: int) -> None:
        self.count = count


class Whole(Stateful):
    """An attribute of each kind; `other` is not part of the state."""

    STATE: ClassVar = ("tensor", "array", "flags", "plain", "none", "part", "pair", "by_name")

    def __init__(self, value: int) -> None:
        self.tensor = torch.full((2,), float(value))
        self.array = np.full((1, 2), value)
        self.flags = np.array([value > 0])
        self.plain = [value] * value
        self.none = None
        self.part = Part(value)
        self.pair = torch.full((3,), value), np.full(2, float(value))
        self.by_name = {"part": Part(value), "streams": Streams([value], "test")}
        self.other = value


def test_a_loaded_state_is_the_saved_one() -> None:
    saved, resumed = Whole(3), Whole(0)
    resumed.load_state_dict(copied(saved.state_dict()))
    assert_equal_states(resumed.state_dict(), saved.state_dict())
    assert resumed.other == 0


def test_tensors_are_loaded_in_place_since_others_may_be_views_of_them() -> None:
    resumed = Whole(0)
    view = resumed.tensor[:1]
    resumed.load_state_dict(copied(Whole(3).state_dict()))
    assert view.item() == 3


def test_parts_stay_the_same_objects() -> None:
    resumed = Whole(0)
    parts = resumed.part, resumed.by_name["part"]
    resumed.load_state_dict(copied(Whole(3).state_dict()))
    assert (resumed.part, resumed.by_name["part"]) == parts


def test_arrays_may_change_their_shape() -> None:
    saved, resumed = Whole(3), Whole(0)
    saved.array = np.arange(6).reshape(2, 3)
    resumed.load_state_dict(copied(saved.state_dict()))
    np.testing.assert_array_equal(resumed.array, saved.array)


def test_a_loaded_array_does_not_share_memory_with_the_state() -> None:
    state: Any = copied(Whole(3).state_dict())
    resumed = Whole(0)
    resumed.load_state_dict(state)
    resumed.array += 1
    assert state["array"].tolist() == [[3, 3]]
