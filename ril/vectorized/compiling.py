"""Functions of tensors as one compiled graph, where a C++ compiler is at hand."""

from __future__ import annotations

import functools
import os
import shutil
import sys
import sysconfig
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ril.io.errors import one_line

#: Updates after which compiling, half a minute the first time, has paid, whether of one seed or
#: of ten at once: which other seeds there are is not to decide how a seed's numbers are rounded.
_WORTHWHILE = 30_000


def worth_compiling(wanted: bool | str, updates: int) -> bool:
    """Whether to compile what is done so many times: as wanted, or where it pays if "auto".

    Where it is, but torch would find no compiler, a line says so and it is not compiled.
    """
    if not (wanted is True or (wanted == "auto" and updates >= _WORTHWHILE)):
        return False
    candidates = [os.environ["CXX"]] if "CXX" in os.environ else ["g++", "clang++", "c++"]
    header = Path(sysconfig.get_path("include"), "Python.h")
    if any(shutil.which(name) for name in candidates) and header.exists():
        return True
    _say(f"no C++ compiler found ({', '.join(candidates)}), or not {header}")
    return False


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same function of tensors, compiled at its first call for the shapes it is then given.

    All of it becomes one graph; what torch cannot take into that is an error, and so are other
    shapes later.
    """
    import torch._inductor.config

    torch._inductor.config.compile_threads = 1  # there is little to compile; start no workers
    # Whoever holds the graph calls it in one way, so torch need not look at each call, for a fifth
    # of its time, whether it still is the right one.
    options: dict[str, Any] = {"guard_filter_fn": lambda guards: [False] * len(guards)}
    options["cpp_wrapper"] = True  # what calls the kernels is compiled too
    lazily: Any = torch.compile(function, fullgraph=True, dynamic=False, options=options)
    graphs: list[Callable[..., Any]] = []

    def call(*arguments: Any) -> Any:
        if not graphs:
            graph = lazily.aot_compile((arguments, {}))
            graph.disable_guard_check()
            graphs.append(graph)
        return graphs[0](*arguments)

    return call


def unless_broken(whole: Callable[..., Any], eager: Callable[..., Any]) -> Callable[..., Any]:
    """The first function, or, where its first call fails, the second, after a line that says so."""
    chosen: list[Callable[..., Any]] = []

    def call(*arguments: Any) -> Any:
        if not chosen:
            try:
                answer = whole(*arguments)
            except Exception as error:  # torch's own have no base of their own
                _say(f"cannot compile here ({_cause(error)})")
                chosen.append(eager)
            else:
                chosen.append(whole)
                return answer
        return chosen[0](*arguments)

    return call


def _cause(error: Exception) -> str:
    """An error's type and the beginning of its text."""
    return f"{type(error).__name__}: {one_line(error)[:120]}"


@functools.cache  # once, however many functions it is true of
def _say(fault: str) -> None:
    print(f"ril: {fault}; going on without, which is slower", file=sys.stderr)
