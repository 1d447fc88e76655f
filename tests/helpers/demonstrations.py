"""What is asked of files of demonstrations, whatever their layout."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ril.demonstrations.files import load_demonstrations
from ril.demonstrations.trajectories import Demonstrations
from ril.environments.environment import Environment
from ril.io.errors import UserError


def refusal(path: Path, environment: Environment) -> str:
    """The fault that is named, without the file's name."""
    with pytest.raises(UserError) as refused:
        load_demonstrations(path, environment)
    prefix, _, fault = str(refused.value).partition(": ")
    assert prefix == f"demonstrations={path}"
    assert "\n" not in fault
    return fault


def assert_pairs(
    found: Demonstrations, environment: Environment, pairs: list[tuple[Any, Any, Any]]
) -> None:
    """Exactly these (s_t, a_t, s_{t+1}), in this order."""
    seen = found.labeled(environment)
    for array, column in zip(
        (seen.observations, seen.actions, seen.next_observations), zip(*pairs, strict=True),
        strict=True,
    ):  # fmt: skip
        expected = np.array(column)
        np.testing.assert_array_equal(
            array, environment.scale(expected) if expected.ndim == 2 else expected
        )


class Bomb:
    """What leaves a file when it is unpickled."""

    def __init__(self, leaves: Path) -> None:
        self.leaves = leaves

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.leaves,)
