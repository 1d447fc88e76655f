"""How things are timed: in turns, by processor time, of which medians are taken."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from typing import NamedTuple

RUN = (sys.executable, "-c", "from ril.cli import main; main()")


def seconds(work: Callable[[], object], times: int = 1) -> float:
    """Processor time of one call, of so many; other work on the machine hardly counts."""
    started = time.process_time()
    for _ in range(times):
        work()
    return (time.process_time() - started) / times


def in_turns(sides: Mapping[str, Callable[[], float]], rounds: int) -> dict[str, float]:
    """The median of what each side measures; one after another in each round."""
    measured: dict[str, list[float]] = {name: [] for name in sides}
    for _ in range(rounds):
        for name, side in sides.items():
            measured[name].append(side())
    return {name: statistics.median(values) for name, values in measured.items()}


class Cost(NamedTuple):
    """What a process took: processor time in seconds, and memory at its peak in MB."""

    seconds: float
    megabytes: float


def cost(command: tuple[str, ...], **environment: str) -> Cost:
    """What a command costs.

    Raises:
        RuntimeError: it fails.
    """
    process = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, env=os.environ | {"OMP_NUM_THREADS": "1"} | environment
    )
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise RuntimeError(f"{' '.join(command)}: exit status {process.returncode}")
    return Cost(used.ru_utime + used.ru_stime, used.ru_maxrss / 1024)


def table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """Markdown."""
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
