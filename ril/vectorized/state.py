"""The state that an interrupted run resumes from: named attributes of its objects."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor


class Stateful:
    """An object whose state is the value of the attributes that `STATE` names.

    Such an attribute is a tensor, a NumPy array, a plain value, an object with `state_dict` and
    `load_state_dict`, or a tuple or dict of these. A list counts as a plain value.
    `torch.load(…, weights_only=True)` can read the state.
    """

    STATE: ClassVar[tuple[str, ...]]

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the object's next steps depend on.

        Returns:
            The state of each attribute by its name. Tensors share memory with the object: save or
            copy them before its next step.
        """
        return {name: _state_of(getattr(self, name)) for name in self.STATE}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume from a state that `state_dict` returned.

        Args:
            state: from an object that was built with the same arguments.
        """
        for name in self.STATE:
            setattr(self, name, _restored(getattr(self, name), state[name]))


def _state_of(value: Any) -> Any:
    """Return a value's state, as tensors and plain values."""
    if hasattr(value, "state_dict"):
        return value.state_dict()
    if isinstance(value, dict):
        return {key: _state_of(each) for key, each in value.items()}
    if isinstance(value, tuple):
        return tuple(_state_of(each) for each in value)
    return torch.from_numpy(value) if isinstance(value, np.ndarray) else value


def _restored(current: Any, saved: Any) -> Any:
    """Return what an attribute's value becomes when its saved state is loaded."""
    if hasattr(current, "load_state_dict"):
        current.load_state_dict(saved)
        return current
    if isinstance(current, dict):
        return {key: _restored(each, saved[key]) for key, each in current.items()}
    if isinstance(current, tuple):
        return tuple(_restored(each, one) for each, one in zip(current, saved, strict=True))
    if isinstance(current, Tensor):
        # In place, because other tensors may be views of it.
        return current.copy_(saved)
    return saved.numpy().copy() if isinstance(current, np.ndarray) else saved
