from __future__ import annotations

from typing import Any

import pytest
import torch
from torch._dynamo.exc import TorchDynamoException

from ril.errors import UserError
from ril.vectorized.compiling import compiled


def test_a_function_that_torch_cannot_compile_is_a_mistake_in_one_line(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def broken(*_: Any, **__: Any) -> Any:
        def fails(*_: Any) -> None:
            raise TorchDynamoException("OSError: No space left on device\n\nSet …")

        return fails

    monkeypatch.setattr(torch, "compile", broken)
    expected = r"^compile: torch cannot \(OSError: No space left on device\); compile=false goes"
    with pytest.raises(UserError, match=expected):
        compiled(torch.add)(torch.zeros(1), torch.zeros(1))
