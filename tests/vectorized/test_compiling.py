from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
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
    compiling._print_once.cache_clear()
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


@pytest.mark.parametrize("age", [0, 60])
def test_an_unfinished_file_of_the_cache_is_waited_for_and_then_removed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, age: float
) -> None:
    """Its writer may still be at work; one that was killed left it for good."""
    file, compiler, slept = tmp_path / "x.main.so", torch._inductor.standalone_compile, []
    file.touch()
    os.utime(file, (time.time() - age,) * 2)

    def torn(*arguments: Any, **named: Any) -> Any:
        if file.exists() and file.stat().st_size == 0:
            raise TorchDynamoException(f"ImportError: {file}: file too short")
        return compiler(*arguments, **named)

    def sleep(seconds: float) -> None:
        slept.append(seconds)
        file.write_text("whole")  # by its writer

    monkeypatch.setattr(compiling.time, "sleep", sleep)
    monkeypatch.setattr(torch._inductor, "standalone_compile", torn)
    assert compile_graph(torch.add)(torch.ones(1), torch.ones(1)) == 2
    assert len(slept) == (1 if age == 0 else 0)
    assert file.exists() == (age == 0)


def test_a_graph_that_a_killed_process_left_unfinished_compiles(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """With torch's real cache and error."""
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path))
    compile_graph(lambda x: x * 3 + 1)(torch.ones(20))
    [library] = tmp_path.rglob("*.main.so")
    library.unlink()  # this process has mapped its content
    library.touch()
    os.utime(library, (time.time() - 60,) * 2)
    program = (
        "import torch; from ril.vectorized.compiling import compile_graph; "
        "print(compile_graph(lambda x: x * 3 + 1)(torch.ones(20))[0].item())"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert ended.stdout == "4.0\n", ended.stderr
