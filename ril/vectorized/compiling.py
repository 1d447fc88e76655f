"""Compile functions of tensors into one graph, where a C++ compiler is installed."""

from __future__ import annotations

import contextlib
import functools
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from torch import Tensor
from torch.nn import functional

from ril import kernels
from ril.io.errors import one_line

#: Compiling takes up to half a minute and pays off after this many updates. The number does not
#: depend on how many seeds are trained together: compiled and eager results differ in the last
#: bits, and a seed's results must not depend on the other seeds.
_WORTHWHILE = 15_000

#: A graph's batches have at least so many rows. With fewer, those of a single seed would not fill a
#: vector register, and round differently from those of several seeds.
LEAST_ROWS = 16

#: torch's message about a library that is not completely written.
_UNFINISHED = re.compile(
    r"ImportError: (.+?\.so): (?:file too short|invalid ELF header|cannot read file data)"
)
_ABANDONED_SECONDS = 10  # since the last change of such a file; writing takes less than one
_ATTEMPTS = 20

_tracing = False
#: Why functions were not compiled although that was wanted. A run clears it at its start.
fallbacks: list[str] = []

#: torch's options that make a graph's digits the same on every machine (`ril.kernels`).
_EXACT: dict[str, Any] = {
    "cpp.simdlen": 256,
    "cpp.march": "haswell",  # instead of the machine's own instructions
    "cpp.enable_floating_point_contract_flag": "off",  # a·b + c rounds twice, as it is written
    "cpp.enable_unsafe_math_opt_flag": False,
    # Products are C++ too, twice as fast as MKL's that are the same on every processor.
    "max_autotune_gemm": True,
    "max_autotune_gemm_backends": "CPP",
    "epilogue_fusion": False,  # torch 2.13 fails to compile it for a single seed
    "deterministic": True,  # no choice depends on a measurement
}


def worth_compiling(wanted: bool | str, updates: int) -> bool:
    """Decide whether to compile an update step.

    If compiling is wanted but no compiler is installed, print a line that says so.

    Args:
        wanted: True, False, or "auto", which compiles where that pays off.
        updates: number of updates of each seed.
    """
    if not (wanted is True or (wanted == "auto" and updates >= _WORTHWHILE)):
        return False
    header = Path(sysconfig.get_path("include"), "Python.h")
    if any(shutil.which(name) for name in _compilers()) and header.exists():
        return True
    _fall_back(f"no C++ compiler found ({', '.join(_compilers())}), or {header} is missing")
    return False


def compiler_version() -> str:
    """Return the first line of the C++ compiler's own version; "" without one."""
    found = next(filter(None, map(shutil.which, _compilers())), None)
    if found is None:
        return ""
    said = subprocess.run([found, "--version"], capture_output=True, text=True, check=False)
    return said.stdout.partition("\n")[0]


def _compilers() -> list[str]:
    return [os.environ["CXX"]] if "CXX" in os.environ else ["g++", "clang++", "c++"]


def compile_graph(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function of tensors into one graph, at its first call.

    The graph is kept in torch's cache on disk (`TORCHINDUCTOR_CACHE_DIR`): the next process that
    needs the same one starts in a second.

    Args:
        function: a function from tensors, tuples of tensors and None to tensors. It is traced
            once, so it must use no other tensors, and may write to its arguments only.

    Returns:
        The compiled function. It accepts only the shapes and strides of its first call.
    """
    graphs: list[Callable[..., Any]] = []

    def call(*arguments: Any) -> Any:
        tensors = _flattened(arguments)
        if not graphs:
            graphs.append(_compiled_despite_unfinished(function, arguments, tensors))
        return graphs[0](*tensors)

    return call


def _compiled_despite_unfinished(
    function: Callable[..., Any], arguments: Sequence[Any], tensors: Sequence[Tensor]
) -> Callable[..., Any]:
    """Do as `_compiled`, again while a file of torch's cache is unfinished."""
    attempts = 0
    while True:
        attempts += 1
        try:
            return _compiled(function, arguments, tensors)
        except Exception as error:  # torch's compiler errors share no base class
            if attempts == _ATTEMPTS or not _clear_unfinished(error):
                raise


def _clear_unfinished(error: Exception) -> bool:
    """Wait for the process that is writing a file of torch's cache, or remove a killed one's file.

    torch does not do so, and would never again compile a graph whose file is unfinished.

    Returns:
        Whether the error was about such a file, so that compiling again makes sense.
    """
    found = _UNFINISHED.search(str(error))
    if found is None:
        return False
    with contextlib.suppress(FileNotFoundError):  # another process has removed it
        file = Path(found[1])
        if time.time() - file.stat().st_mtime > _ABANDONED_SECONDS:
            file.unlink()
        else:
            time.sleep(1)
    return True


def is_tracing() -> bool:
    """Return whether a function is being traced for `compile_graph`."""
    return _tracing


def pad_rows(x: Tensor) -> Tensor:
    """Pad (S, B, …) with zeros to at least `LEAST_ROWS` rows of each seed."""
    missing = max(0, LEAST_ROWS - x.shape[1])
    return functional.pad(x, (0, 0) * (x.dim() - 2) + (0, missing))


def _flattened(arguments: Sequence[Any]) -> list[Tensor]:
    """Return the tensors of arguments, each of which is a tensor, a tuple of tensors, or None."""
    tensors: list[Tensor] = []
    for argument in arguments:
        if isinstance(argument, Tensor):
            tensors.append(argument)
        elif argument is not None:
            tensors.extend(argument)
    return tensors


def _compiled(
    function: Callable[..., Any], arguments: Sequence[Any], tensors: Sequence[Tensor]
) -> Callable[..., Any]:
    """Trace and compile a function, as one of the tensors in its arguments."""
    import torch._inductor
    from torch.fx.experimental.proxy_tensor import make_fx

    def flat(*tensors: Tensor) -> Any:
        rest = iter(tensors)

        def given(argument: Any) -> Any:
            if argument is None:
                return None
            if isinstance(argument, Tensor):
                return next(rest)
            parts = [next(rest) for _ in argument]
            return argument._make(parts) if hasattr(argument, "_make") else tuple(parts)

        return function(*map(given, arguments))

    global _tracing
    _tracing = True
    try:
        # Differentiated here, since torch's cache accepts no graph with a gradient to be taken.
        graph = make_fx(flat, tracing_mode="fake")(*tensors)
    finally:
        _tracing = False
    options: dict[str, Any] = {
        "cpp_wrapper": True,  # also compile the code that calls the kernels
        "compile_threads": 1,  # the graphs are small: workers would cost more
    }
    if tensors[0].is_cpu and not kernels.difference():
        options |= _EXACT
    compiled: Callable[..., Any] = torch._inductor.standalone_compile(
        graph,
        list(tensors),
        dynamic_shapes="from_example_inputs",
        options={"config_patches": options},
    )
    return compiled


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
                _fall_back(f"cannot compile here ({_cause(error)})")
                chosen.append(eager)
            else:
                chosen.append(compiled)
                return answer
        return chosen[0](*arguments)

    return call


def _cause(error: Exception) -> str:
    """Return an error's type and the beginning of its text."""
    return f"{type(error).__name__}: {one_line(error)[:120]}"


def _fall_back(problem: str) -> None:
    fallbacks.append(problem)
    _print_once(f"ril: {problem}; training without compiling: slower, and with other last digits")


@functools.cache
def _print_once(line: str) -> None:
    print(line, file=sys.stderr)
