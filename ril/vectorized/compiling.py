"""Compile functions of tensors into one graph, where a C++ compiler is installed."""

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

#: Compiling takes up to half a minute and pays off after this many updates. The number does not
#: depend on how many seeds are trained together: compiled and eager results differ in the last
#: bits, and a seed's results must not depend on the other seeds.
_WORTHWHILE = 15_000


def worth_compiling(wanted: bool | str, updates: int) -> bool:
    """Decide whether to compile an update step.

    If compiling is wanted but no compiler is installed, print a line that says so.

    Args:
        wanted: True, False, or "auto", which compiles where that pays off.
        updates: number of updates of each seed.
    """
    if not (wanted is True or (wanted == "auto" and updates >= _WORTHWHILE)):
        return False
    candidates = [os.environ["CXX"]] if "CXX" in os.environ else ["g++", "clang++", "c++"]
    header = Path(sysconfig.get_path("include"), "Python.h")
    if any(shutil.which(name) for name in candidates) and header.exists():
        return True
    _warn(f"no C++ compiler found ({', '.join(candidates)}), or {header} is missing")
    return False


def compile_graph(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function of tensors into one graph, at its first call.

    Args:
        function: must fit into one graph; code that torch cannot trace raises an error.

    Returns:
        The compiled function. It accepts only the shapes and strides of its first call.
    """
    import torch._inductor.config

    torch._inductor.config.compile_threads = 1  # the graphs are small: workers would cost more
    # Every call of a graph has the same shapes, so torch's checks of its arguments, a fifth of
    # each call's time, are switched off.
    options: dict[str, Any] = {"guard_filter_fn": lambda guards: [False] * len(guards)}
    options["cpp_wrapper"] = True  # also compile the code that calls the kernels
    lazily: Any = torch.compile(function, fullgraph=True, dynamic=False, options=options)
    graphs: list[Callable[..., Any]] = []

    def call(*arguments: Any) -> Any:
        if not graphs:
            graph = lazily.aot_compile((arguments, {}))
            graph.disable_guard_check()
            graphs.append(graph)
        return graphs[0](*arguments)

    return call


def with_fallback(compiled: Callable[..., Any], eager: Callable[..., Any]) -> Callable[..., Any]:
    """Use a compiled function, or its eager version if compiling fails.

    Args:
        compiled: compiles itself at its first call.
        eager: used from the first call on if that fails; a printed line says so.
    """
    chosen: list[Callable[..., Any]] = []

    def call(*arguments: Any) -> Any:
        if not chosen:
            try:
                answer = compiled(*arguments)
            except Exception as error:  # torch's compiler errors share no base class
                _warn(f"cannot compile here ({_cause(error)})")
                chosen.append(eager)
            else:
                chosen.append(compiled)
                return answer
        return chosen[0](*arguments)

    return call


def _cause(error: Exception) -> str:
    """Return an error's type and the beginning of its text."""
    return f"{type(error).__name__}: {one_line(error)[:120]}"


@functools.cache  # print each line once, however many functions it concerns
def _warn(problem: str) -> None:
    print(f"ril: {problem}; training without compiling, which is slower", file=sys.stderr)
