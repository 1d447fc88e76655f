"""What a stopped run resumes from: the named attributes of its objects."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor


class Stateful:
    """An object whose state is the value of some of its attributes, named in `STATE`.

    An attribute may be a tensor (restored in place, since others may be views of it), a NumPy
    array, a plain value, an object with `state_dict` and `load_state_dict`, or a dict of any of
    these. What a state consists of can be read by `torch.load(…, weights_only=True)`.
    """

    STATE: ClassVar[tuple[str, ...]]

    def state_dict(self) -> dict[str, Any]:
        """Return all that the object's next steps depend on."""
        return {name: _state_of(getattr(self, name)) for name in self.STATE}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume from a state that `state_dict` returned.

        Args:
            state: of an object that was built with the same arguments.
        """
        for name in self.STATE:
            setattr(self, name, _restored(getattr(self, name), state[name]))


def _state_of(value: Any) -> Any:
    if hasattr(value, "state_dict"):
        return value.state_dict()
    if isinstance(value, dict):
        return {key: _state_of(each) for key, each in value.items()}
    return torch.from_numpy(value) if isinstance(value, np.ndarray) else value


def _restored(current: Any, saved: Any) -> Any:
    if hasattr(current, "load_state_dict"):
        current.load_state_dict(saved)
        return current
    if isinstance(current, dict):
        return {key: _restored(each, saved[key]) for key, each in current.items()}
    if isinstance(current, Tensor):
        return current.copy_(saved)
    return saved.numpy().copy() if isinstance(current, np.ndarray) else saved
