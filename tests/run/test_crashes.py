"""Commands that are crashed at some of their file operations; see scripts/check_crashes.py."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import pytest
from helpers.crashes import Cell, alone, points, warm
from helpers.server import CONTEXT
from helpers.sweeps import cell

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="follows files by /proc")


def in_a_fork(act: Callable[..., Any], *arguments: Any) -> Any:
    """What a function returns in a process without pytest's threads."""
    here, there = CONTEXT.Pipe()
    process = CONTEXT.Process(target=send, args=(there, act, *arguments))
    process.start()
    there.close()
    try:
        return here.recv()
    finally:
        process.join()


def send(connection: Connection, act: Callable[..., Any], *arguments: Any) -> None:
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    warm()
    with tempfile.TemporaryDirectory() as work:
        connection.send(act(*arguments, Path(work)))


def walked(launcher: str, method: str, every: int, work: Path) -> tuple[int, list[str]]:
    """Crash a command at every nth point; the number of crashes, and what was wrong."""
    crashed = cell(launcher, method, work)
    whole = crashed.whole()
    chosen = list(points(whole))[::every]
    faults = [
        f"{kind} at {whole.operations[number - 1]}: {fault}"
        for kind, number in chosen
        if (fault := crashed.crash(kind, number, whole).fault)
    ]
    return len(chosen), faults


@pytest.mark.parametrize(
    ("launcher", "method", "every"),
    [
        ("alone", "bc", 13),
        ("alone", "ril", 53),
        ("alone", "dqn", 131),
        ("alone", "gail", 79),
        ("basic", "bc", 101),
        ("joblib", "bc", 101),
    ],
)
def test_a_command_that_crashes_at_a_file_operation_resumes_bit_identically(
    launcher: str, method: str, every: int
) -> None:
    crashes, faults = in_a_fork(walked, launcher, method, every)
    assert crashes >= 4
    assert faults == []


def without_fsync(work: Path) -> list[list[str]]:
    """The faults that harm a run without fsync, at its rows' rename and at the next operation."""
    run = alone("random")

    def careless(output: Path) -> None:
        os.fsync = lambda _: None
        run(output)

    crashed = Cell(careless, work)
    whole = crashed.whole()
    names = [(each.name, each.file) for each in whole.operations]
    rows = names.index(("rename", "results.csv")) + 1
    return [
        [
            kind
            for kind, at in points(whole)
            if at == number and crashed.crash(kind, at, whole).fault
        ]
        for number in (rows, rows + 1)
    ]


def test_the_walk_notices_rows_without_fsync() -> None:
    at_rows, after_rows = in_a_fork(without_fsync)
    assert at_rows == ["reordered", "halved"]
    assert after_rows == ["lost", "reordered", "halved"]
