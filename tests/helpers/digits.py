"""The digits of short runs: of every method, on all four environments, eager and compiled.

PYTHONPATH=tests python -m helpers.digits                # write tests/run/digits.json
PYTHONPATH=tests python -m helpers.digits "acrobot ril"  # print these cells' digits
"""

from __future__ import annotations

import ril  # noqa: F401 - first, because it fixes the kernels of NumPy and torch

# isort: split

import hashlib
import json
import platform
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pandas as pd
import torch

from helpers.runs import QUICK_RUN, Silence, composed, quick_method
from ril.cli.configuration import from_hydra
from ril.methods.registry import names, spec
from ril.run.experiment import run
from ril.run.provenance import provenance
from ril.run.verify import OF_THE_RUN

GOLDEN = Path(__file__).parents[1] / "run" / "digits.json"
ENVIRONMENTS = ("cartpole", "acrobot", "mountaincar", "lunarlander")
#: Libraries whose versions the digits depend on.
LIBRARIES = ("torch", "numpy", "gymnasium", "Box2D")


def cells() -> list[str]:
    """ "environment method", and " compiled" behind it for a compiled run."""
    methods = [[name, f"{name} compiled"] if spec(name).compiles else [name] for name in names()]
    return [f"{env} {method}" for env in ENVIRONMENTS for each in methods for method in each]


def digits(cell: str) -> dict[str, Any]:
    """Run a cell; return its returns, and digests of its rows, its curve and its policies."""
    env, method, *compiled = cell.split()
    small = [each for each in quick_method(method) if ".batch_size" not in each or "ppo" in each]
    with tempfile.TemporaryDirectory() as folder:
        overrides = (*QUICK_RUN, *small, f"env={env}", f"method={method}", f"output_dir={folder}")
        config = from_hydra(composed(*overrides, f"compile={'true' if compiled else 'false'}"))
        done = run(config, Silence())
        rows = pd.read_csv(done / "results.csv", dtype=str).drop(columns=OF_THE_RUN)
        found = {
            "aer": [float(each) for each in rows["aer"]],
            "rows": _digest(rows.to_csv(index=False).encode()),
        }
        if (done / "policy.pt").exists():
            policy = torch.load(done / "policy.pt", weights_only=True)
            found["curve"] = _digest((done / "curve.csv").read_bytes())
            found["best"], found["last"] = (
                _digest(policy[name].numpy().tobytes()) for name in ("best", "last")
            )
    return found


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]


def main() -> None:
    """Print the digits of some cells, or write those of all."""
    torch.set_num_threads(1)
    if chosen := sys.argv[1:]:
        print(json.dumps({cell: digits(cell) for cell in chosen}))
        return
    here = provenance(GOLDEN, "", from_hydra(composed()))
    golden = {
        "processor": here["processor"],
        "libc": here["libc"],
        "compiler": here["compiler"],
        "python": platform.python_version(),
        "versions": {name: version(name) for name in LIBRARIES},
        "cells": {cell: digits(cell) for cell in cells()},
    }
    lines = json.dumps(golden, indent=1)
    GOLDEN.write_text(lines + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
