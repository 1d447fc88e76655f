"""The same digits on every machine: those of `digits.json`, and under other kernel levels."""

from __future__ import annotations

import json
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Mapping
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.digits import ENVIRONMENTS, GOLDEN, LIBRARIES, cells, digits

from ril import kernels

KEPT = json.loads(GOLDEN.read_text(encoding="utf-8"))
HERE = {name: version(name) for name in LIBRARIES}
same_versions = pytest.mark.skipif(
    bool(kernels.difference()) or KEPT["versions"] != HERE,
    reason=kernels.difference() or f"digits.json is of {KEPT['versions']}, this is {HERE}",
)
#: Runs that use every library whose kernels differ: products, eigenvectors, exponentials, NumPy.
TELLING = (
    "mountaincar ril",
    "mountaincar ril compiled",
    "acrobot acktr",
    "acrobot ppo compiled",
    "cartpole ilpo",
)


def test_digits_are_kept_of_every_method_on_every_environment_eager_and_compiled() -> None:
    assert list(KEPT["cells"]) == cells()


#: Compiling takes minutes, so each day compares the compiled runs on one of the environments.
COMPILED_TODAY = ENVIRONMENTS[datetime.now(UTC).toordinal() % len(ENVIRONMENTS)]


@same_versions
@pytest.mark.parametrize("cell", cells())
def test_digits_are_those_of_the_machine_that_kept_them(cell: str) -> None:
    env, *_, last = cell.split()
    if last == "compiled" and env != COMPILED_TODAY and "RIL_ALL_DIGITS" not in os.environ:
        pytest.skip("compared on another day, or with RIL_ALL_DIGITS=1")
    assert digits(cell) == KEPT["cells"][cell], f"kept on {KEPT['processor']}, {KEPT['libc']}"


def digits_in(environment: Mapping[str, str]) -> dict[str, Any]:
    """The digits of the telling runs in a process with these environment variables."""
    command = [sys.executable, "-m", "helpers.digits", *TELLING]
    path = str(Path(__file__).parents[1])
    variables = os.environ | {"PYTHONPATH": path} | environment
    done = subprocess.run(command, env=variables, capture_output=True, text=True, check=True)
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


@same_versions
def test_kernel_levels_that_the_user_asks_for_change_no_digit() -> None:
    asked = {
        "ATEN_CPU_CAPABILITY": "default",
        "MKL_CBWR": "AUTO",
        "MKL_ENABLE_INSTRUCTIONS": "SSE4_2",
        "NPY_DISABLE_CPU_FEATURES": "",
        "ONEDNN_MAX_CPU_ISA": "SSE41",
        "TORCHINDUCTOR_CPP_MARCH": "native",
        "TORCHINDUCTOR_CPP_ENABLE_FLOATING_POINT_CONTRACT_FLAG": "fast",
    }
    assert digits_in(asked) == {cell: KEPT["cells"][cell] for cell in TELLING}


@same_versions
@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
def test_another_make_of_processor_changes_no_digit(tmp_path: Path) -> None:
    """MKL asks this function of its whether the processor is Intel's; it gets the other answer."""
    makes = tmp_path / "intel.c"
    makes.write_text("int mkl_serv_intel_cpu_true(void) { return INTEL; }\n")
    other = "0" if "GenuineIntel" in Path("/proc/cpuinfo").read_text() else "1"
    library = tmp_path / "make.so"
    compile_it = ["cc", "-shared", "-fPIC", f"-DINTEL={other}", "-o", library, makes]
    subprocess.run(compile_it, check=True)
    found = digits_in({"LD_PRELOAD": str(library)})
    assert found == {cell: KEPT["cells"][cell] for cell in TELLING}


def run_python(code: str, **environment: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.strip()


AT_LEVEL = not kernels.difference()
at_level = pytest.mark.skipif(not AT_LEVEL, reason=kernels.difference() or "at the level")


@at_level
def test_the_libraries_are_at_the_level_in_the_tests() -> None:
    assert torch.backends.cpu.get_cpu_capability() == "AVX2"
    found = np.show_config(mode="dicts")["SIMD Extensions"].get("found", [])
    assert not [name for name in found if "V4" in name or "AVX512" in name]


@at_level
def test_importing_numpy_or_torch_first_is_told() -> None:
    clean = dict.fromkeys(kernels.LEVEL, "")
    say = "import ril; print(ril.kernels.difference())"
    for library in ("numpy", "torch"):
        told = run_python(f"import {library}; {say}", **clean)
        assert told == f"{library} was imported before ril; import ril first"
    assert run_python(say, **clean) == ""
    assert run_python(f"import numpy; {say}") == ""  # in a process that one of ril has started


@at_level
def test_released_kernels_are_those_of_before() -> None:
    code = """
import os, subprocess, sys
from ril import kernels
kernels.release()
assert os.environ["MKL_CBWR"] == "AVX2" and "ATEN_CPU_CAPABILITY" not in os.environ
assert kernels.difference() == "exact=false"
code = "import ril, os; print(os.environ['MKL_CBWR'], ril.kernels.difference())"
print(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout)
"""
    environment = {name: each for name, each in os.environ.items() if name not in kernels.LEVEL}
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=environment | {"MKL_CBWR": "AVX2"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == "AVX2 exact=false"


@pytest.mark.parametrize(
    ("machine", "flags", "why"),
    [
        ("aarch64", "flags: fp", "this is Linux aarch64, not Linux x86_64"),
        ("x86_64", "flags : sse4_2 avx", "the processor has no AVX2"),
        ("x86_64", "flags : avx2 fma", ""),
    ],
)
def test_a_machine_without_the_level_is_told(
    machine: str, flags: str, why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "cpuinfo").write_text(f"processor : 0\n{flags}\n")
    monkeypatch.setattr(kernels, "_CPUINFO", tmp_path / "cpuinfo")
    monkeypatch.setattr(platform, "machine", lambda: machine)
    monkeypatch.setattr(platform, "system", lambda: "Linux")
    assert kernels._lacking() == why
