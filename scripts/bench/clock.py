"""Measure processor time and memory: alternatives take turns, and medians are reported."""

from __future__ import annotations

import os
import re
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import NamedTuple
from unittest.mock import patch

from ril import kernels

#: `ril-run` that prints its own peak memory at exit. (The system's figure for a child process
#: includes memory of its parent.)
RUN = (
    sys.executable,
    "-c",
    "import atexit, sys; from ril.cli.run import main; status = '/proc/self/status'; "
    "atexit.register(lambda: print(open(status).read(), file=sys.stderr)); main()",
)


def seconds(work: Callable[[], object], times: int = 1) -> float:
    """Return the processor time of one call, the mean of several.

    Other processes hardly affect it, unlike wall-clock time.
    """
    started = time.process_time()
    for _ in range(times):
        work()
    return (time.process_time() - started) / times


def in_turns(sides: Mapping[str, Callable[[], float]], rounds: int) -> dict[str, float]:
    """Return the median of each side's measurements; in every round each side has one turn."""
    measured: dict[str, list[float]] = {name: [] for name in sides}
    for _ in range(rounds):
        for name, side in sides.items():
            measured[name].append(side())
    return {name: statistics.median(values) for name, values in measured.items()}


def with_own_kernels(work: Callable[[], float]) -> float:
    """Return what `work` measures in a process of its own, without ril's fixed kernels.

    Other libraries are measured so, because the fixed kernels may be slower than their own.
    """
    kept = {name: value for name, value in os.environ.items() if name not in kernels.LEVEL}
    alone = ProcessPoolExecutor(1, mp_context=get_context("spawn"))
    with patch.dict(os.environ, kept | {"RIL_EXACT": "false"}, clear=True), alone:
        return alone.submit(work).result()


class Cost(NamedTuple):
    """Processor time of a process in seconds, and its peak memory in MB."""

    seconds: float
    megabytes: float


def cost(command: tuple[str, ...], **environment: str) -> Cost:
    """Run a command that begins with `RUN`, and return its cost.

    Args:
        command: the command to run.
        environment: variables to add.

    Raises:
        RuntimeError: the command fails.
    """
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    ended = subprocess.run(
        command,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"} | environment,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    peak = re.search(r"VmHWM:\s*(\d+) kB", ended.stderr)
    if ended.returncode or peak is None:
        raise RuntimeError(f"{' '.join(command)}: {ended.stderr}")
    took = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Cost(took, int(peak[1]) / 1024)


def table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """Format a table in Markdown."""
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
