"""Crash small runs at each of their file operations, start them again, and compare what they leave.

    export PYTHONPATH=tests
    python scripts/check_crashes.py                         # all
    python scripts/check_crashes.py --method bc --every 10  # a tenth of the points of bc
    python scripts/check_crashes.py --table                 # of what has been run

Every method runs alone (`ril-run`) and in a sweep of two cells by each launcher. Each point is a
kind of fault (`helpers.faults.KINDS`) at one file operation: the command runs with the fault, then
again without one, and its rows, curve and policies must equal those of an undisturbed command. The
outcomes are appended to a log; points in the log are not run again. The script prints the tables
in docs/resuming.md; its exit status is 1 if anything differs.
"""

from __future__ import annotations

import ril  # noqa: F401 - first, because it fixes the kernels of NumPy and torch

# isort: split

import argparse
import json
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

from helpers.crashes import points, warm
from helpers.faults import KINDS
from helpers.sweeps import LAUNCHERS, cell, is_installed

from ril.methods.registry import names

Key = tuple[str, str, str, int]  # launcher, method, kind, number of the operation


def walk(launcher: str, method: str, every: int, log: Path, known: set[Key]) -> None:
    """Crash one command at every nth point, and append the outcomes to the log."""
    with tempfile.TemporaryDirectory() as work:
        crashed = cell(launcher, method, Path(work))
        whole = crashed.whole()
        chosen = list(points(whole))[::every]
        left = [each for each in chosen if (launcher, method, *each) not in known]
        began = time.monotonic()
        for done, (kind, number) in enumerate(left, 1):
            outcome = crashed.crash(kind, number, whole)
            line = [launcher, method, kind, number, outcome.first, outcome.fault]
            with log.open("a") as file:
                file.write(json.dumps(line) + "\n")
            operation = whole.operations[number - 1]
            at = f"{launcher} {method}: {kind} at {number}, {operation.name} {operation.file}"
            if outcome.fault:
                print(f"{at}: {outcome.fault}", file=sys.stderr, flush=True)
            if done % 100 == 0 or done == len(left):
                seconds = (time.monotonic() - began) / done
                print(f"{at}: {done} of {len(left)}, {seconds:.2f} s each", file=sys.stderr)


def read(log: Path) -> list[list[Any]]:
    """Return the lines of the log."""
    return [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []


def print_tables(lines: list[list[Any]]) -> None:
    """Print the crashes by method and launcher, and their outcomes by kind of fault."""
    by_cell = Counter((launcher, method) for launcher, method, *_ in lines)
    print(f"| method | {' | '.join(LAUNCHERS)} |\n|---{'|--:' * len(LAUNCHERS)}|")
    for method in names():
        counts = (f"{by_cell[launcher, method]:,}" for launcher in LAUNCHERS)
        print(f"| `{method}` | {' | '.join(counts)} |")
    totals = (f"{sum(line[0] == launcher for line in lines):,}" for launcher in LAUNCHERS)
    print(f"| all | {' | '.join(totals)} |\n")
    print("| fault | what happens | killed | one line | finished | then bit-identical |")
    print("|---|---|--:|--:|--:|--:|")
    for kind, meaning in KINDS.items():
        of_kind = [line for line in lines if line[2] == kind]
        first = Counter(line[4] for line in of_kind)
        counts = (f"{first[name]:,}" for name in ("killed", "refused", "finished"))
        same = sum(not line[5] for line in of_kind)
        print(f"| {kind} | {meaning} | {' | '.join(counts)} | {same:,} of {len(of_kind):,} |")


def main() -> None:
    """Walk the points that the command line chooses."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--method", nargs="*", choices=names(), default=names())
    parser.add_argument("--launcher", nargs="*", choices=LAUNCHERS, default=list(LAUNCHERS))
    parser.add_argument("--every", type=int, default=1, help="crash at every nth point only")
    parser.add_argument("--log", type=Path, default=Path("crashes.jsonl"))
    parser.add_argument("--table", action="store_true", help="only print the tables")
    arguments = parser.parse_args()
    if not arguments.table:
        warm()
        known: set[Key] = {tuple(line[:4]) for line in read(arguments.log)}  # type: ignore[misc]
        for launcher in arguments.launcher:
            if not is_installed(launcher):
                print(f"{launcher}: not installed, skipped", file=sys.stderr)
                continue
            for method in arguments.method:
                walk(launcher, method, arguments.every, arguments.log, known)
    lines = read(arguments.log)
    print_tables(lines)
    sys.exit(any(line[5] for line in lines))


if __name__ == "__main__":
    main()
