"""Copy and compare states of learners, as checkpoints store them."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import torch
from torch import Tensor


def copied(state: Any) -> Any:
    """Copy a state by torch.save and the safe torch.load."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    buffer.seek(0)
    return torch.load(buffer, weights_only=True)


def assert_equal_states(found: Any, expected: Any, where: str = "state") -> None:
    """Assert that two states are bit-identical; NaN equals NaN."""
    assert type(found) is type(expected), where
    if isinstance(expected, Tensor):
        np.testing.assert_array_equal(found.numpy(), expected.numpy(), err_msg=where)
    elif isinstance(expected, dict):
        assert found.keys() == expected.keys(), where
        for name in expected:
            assert_equal_states(found[name], expected[name], f"{where}.{name}")
    elif isinstance(expected, list | tuple):
        assert len(found) == len(expected), where
        for index, (one, other) in enumerate(zip(found, expected, strict=True)):
            assert_equal_states(one, other, f"{where}[{index}]")
    else:
        assert found == expected or (found != found and expected != expected), where
