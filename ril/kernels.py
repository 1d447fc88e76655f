"""Fix the level of the processor's kernels, so that a run has the same digits on every machine.

NumPy, torch and the libraries below torch choose among several kernels by what the processor can
do. The kernels round differently, and training turns a different last bit into a different result.
"""

from __future__ import annotations

import os
import platform
import sys
from importlib.metadata import version
from pathlib import Path

#: The environment variables that fix the level, which every x86-64 processor since 2013 has.
LEVEL = {
    "ATEN_CPU_CAPABILITY": "avx2",  # torch's own kernels
    "MKL_CBWR": "COMPATIBLE",  # torch's matrix products, decompositions and vector functions
    "ONEDNN_MAX_CPU_ISA": "AVX2",  # torch's other products
    "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR",  # NumPy's kernels above AVX2
}
#: NumPy's names of these kernels before 2.4; NumPy warns of a name that it does not know.
_BEFORE_2_4 = "AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL AVX512_SPR"
#: Set by `release` for this process and those that it starts.
_RELEASED = "RIL_EXACT"
_LIBRARIES = ("torch", "numpy")  # torch imports numpy
_CPUINFO = Path("/proc/cpuinfo")

_before: dict[str, str | None] = {}  # the variables' values before `fix`
_difference = ""


def fix() -> None:
    """Fix the kernels of all libraries that are not yet imported; `import ril` calls this.

    The variables replace those that the user has set, because another level has other digits.
    """
    global _difference
    if os.environ.get(_RELEASED) == "false":
        _difference = "exact=false"
        return
    if _difference := _lacking():
        return
    level = dict(LEVEL)
    if tuple(map(int, version("numpy").split(".")[:2])) < (2, 4):
        level["NPY_DISABLE_CPU_FEATURES"] = _BEFORE_2_4
    _before.update({name: os.environ.get(name) for name in level})
    imported = [name for name in _LIBRARIES if name in sys.modules]
    if imported and _before != level:  # equal in a process that another one of ril has started
        _difference = f"{imported[0]} was imported before ril; import ril first"
    os.environ.update(level)


def release() -> None:
    """Let the libraries choose their fastest kernels again (`exact=false`).

    It concerns the libraries that are not yet imported, and the processes started from here on.
    """
    global _difference
    for name, value in _before.items():
        if value is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = value
    os.environ[_RELEASED] = "false"
    _difference = "exact=false"


def difference() -> str:
    """Return why this process's digits may differ from other machines'; "" if they do not."""
    return _difference


def _lacking() -> str:
    """Return why this machine cannot have the level; "" if it can."""
    machine = f"{platform.system()} {platform.machine()}"
    if machine != "Linux x86_64":
        return f"this is {machine}, not Linux x86_64"
    lines = _CPUINFO.read_text(encoding="utf-8").splitlines()
    flags = next((line.split() for line in lines if line.startswith("flags")), [])
    return "" if {"avx2", "fma"} <= set(flags) else "the processor has no AVX2"
