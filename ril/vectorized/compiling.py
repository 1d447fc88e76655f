"""Functions of tensors as one compiled graph, where a C++ compiler is at hand."""

from __future__ import annotations

import os
import shutil
import sysconfig
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ril.errors import UserError

#: Updates after which compiling, half a minute, has paid, whether of one seed or of ten at once:
#: which other seeds there are is not to decide how a seed's numbers are rounded.
_WORTHWHILE = 100_000


def worth_compiling(wanted: bool | str, updates: int) -> bool:
    """Whether to compile what is done so many times: as wanted, or where it pays if "auto".

    Raises:
        UserError: it is wanted, and torch finds no compiler.
    """
    candidates = [os.environ["CXX"]] if "CXX" in os.environ else ["g++", "clang++", "c++"]
    header = Path(sysconfig.get_path("include"), "Python.h")
    possible = any(shutil.which(name) for name in candidates) and header.exists()
    if wanted is True and not possible:
        raise UserError(
            f"compile=true: no C++ compiler found ({', '.join(candidates)}), or not {header}"
        )
    return possible if wanted is True else wanted == "auto" and possible and updates >= _WORTHWHILE


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same function, compiled at its first call for the shapes it is then given.

    It raises UserError if it cannot be: a compiler may be there and broken, or the disk be full.
    """
    import torch._dynamo
    import torch._inductor.config

    torch._dynamo.config.recompile_limit = 64  # of one function, by runs of other shapes
    torch._inductor.config.compile_threads = 1  # there is little to compile; start no workers
    graph = torch.compile(function, fullgraph=True, dynamic=False)

    def call(*arguments: Any) -> Any:
        try:
            return graph(*arguments)
        except torch._dynamo.exc.TorchDynamoException as error:
            said = str(error).partition("\n")[0]
            raise UserError(f"compile: torch cannot ({said}); compile=false goes without") from None

    return call
