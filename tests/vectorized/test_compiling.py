from __future__ import annotations

from typing import Any

import pytest
import torch
import torch._inductor
from torch._dynamo.exc import TorchDynamoException

from ril.vectorized import compiling
from ril.vectorized.compiling import compile_graph, with_fallback


def broken(*_: Any, **__: Any) -> Any:
    """Torch's compiler on a machine whose disk is full."""
    raise TorchDynamoException("OSError: No space left on device\n\nSet …")


def test_a_function_that_torch_cannot_compile_stays_eager_and_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    compiling._warn.cache_clear()
    monkeypatch.setattr(torch._inductor, "standalone_compile", broken)
    function = with_fallback(compile_graph(torch.add), torch.add)
    for _ in range(2):
        assert function(torch.ones(1), torch.ones(1)) == 2
    assert capsys.readouterr().err == (
        "ril: cannot compile here (TorchDynamoException: OSError: No space left on device Set …); "
        "training without compiling: slower, and with other last digits\n"
    )


def test_a_graph_refuses_other_shapes_than_its_first() -> None:
    function = compile_graph(torch.add)
    function(torch.ones(4, 8), torch.ones(4, 8))
    with pytest.raises((AssertionError, RuntimeError), match=r"size|shape"):
        function(torch.ones(4, 6), torch.ones(4, 6))


def test_a_file_that_another_process_is_writing_is_read_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    compiler, tries = torch._inductor.standalone_compile, []

    def torn_at_first(*arguments: Any, **named: Any) -> Any:
        tries.append(1)
        if len(tries) == 1:
            raise TorchDynamoException("ImportError: main.so: file too short")
        return compiler(*arguments, **named)

    monkeypatch.setattr(compiling.time, "sleep", lambda _: None)
    monkeypatch.setattr(torch._inductor, "standalone_compile", torn_at_first)
    assert compile_graph(torch.add)(torch.ones(1), torch.ones(1)) == 2
    assert len(tries) == 2
