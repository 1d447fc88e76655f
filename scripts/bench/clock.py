"""How things are timed: in turns, by processor time, of which medians are taken."""

from __future__ import annotations

import os
import re
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from typing import NamedTuple

#: `ril-run`, which at its end says how much memory it had at its peak. (What the system says of
#: a child begins with its parent's.)
RUN = (
    sys.executable,
    "-c",
    "import atexit, sys; from ril.cli.run import main; status = '/proc/self/status'; "
    "atexit.register(lambda: print(open(status).read(), file=sys.stderr)); main()",
)


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
    """What a command of `RUN` costs.

    Raises:
        RuntimeError: it fails.
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
    """Markdown."""
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
