"""Small commands that are crashed at a file operation, started again, and compared.

One process that has imported everything forks a process for each command, so that a start takes
milliseconds instead of seconds.
"""

from __future__ import annotations

import csv
import ctypes
import functools
import gc
import hashlib
import os
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import torch

from helpers.faults import KINDS, NEED_SPACE, Fault, Operation, operations, revert
from helpers.injection import install
from helpers.runs import CARTPOLE, Silence, composed, quick_method
from ril.cli.command import MISTAKES, in_one_line
from ril.cli.configuration import from_hydra
from ril.run import provenance, training
from ril.run.experiment import run

_SECONDS = 120.0  # after which a command counts as stuck
_SUBREAPER = 36  # prctl's number for: orphans of my processes become my children

#: Budgets below `quick_method`'s, for runs of a tenth of a second with a few checkpoints.
_TINY = {
    "dqn": ("method.total_timesteps=12",),
    "dqn_prioritized": ("method.total_timesteps=12",),
    "ril_sequential": ("method.total_timesteps=12", "method.epochs=2"),
}
_RUN = ("seeds=2", "evaluation.episodes=2", "evaluation.selection_episodes=1")


def overrides(method: str) -> tuple[str, ...]:
    """The overrides of a method's cell."""
    return (*_RUN, *quick_method(method), *_TINY.get(method, ()), *CARTPOLE, f"method={method}")


def warm() -> None:
    """Prepare this process for forks: a checkpoint after each epoch; nothing is found out twice."""
    torch.set_num_threads(1)
    training.CHECKPOINT_SECONDS = 0.0
    os.fsync = lambda _: None  # takes time, and the machine does not really end
    for name in ("commit", "compiler_version", "version", "_code", "_processor"):
        setattr(provenance, name, functools.cache(getattr(provenance, name)))
    ctypes.CDLL(None).prctl(_SUBREAPER, 1, 0, 0, 0)


#: Runs a command, given its output folder; ends like a command's process.
Command = Callable[[Path], None]


def alone(method: str) -> Command:
    """A run of a cell, as `ril-run` makes it but for Hydra and the display."""
    config = from_hydra(composed(*overrides(method)))

    def command(output: Path) -> None:
        sys.argv = ["ril-run", *overrides(method)]
        config.output_dir = str(output)
        try:
            run(config, Silence())
        except MISTAKES as error:
            sys.exit(f"ril-run: {in_one_line(error)}")

    return command


class Ended(NamedTuple):
    """How a command ended: its exit status, or minus the signal's number, and what it printed."""

    status: int
    said: str


class Process:
    """A command in a fork, with a process group of its own."""

    def __init__(self, command: Command, output: Path, control: Path, fault: Fault | None) -> None:
        self._said = control / "said"
        self.pid = os.fork()
        if self.pid == 0:
            os.setpgid(0, 0)
            printed = os.open(self._said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(printed, 1)
            os.dup2(printed, 2)
            gc.disable()  # a collection would copy the memory that this process shares
            status = 1
            try:
                if fault is not None:
                    install(fault)
                command(output)
                status = 0
            except SystemExit as end:  # as the interpreter answers it
                status = end.code if isinstance(end.code, int) else int(end.code is not None)
                if isinstance(end.code, str):
                    print(end.code, file=sys.stderr)
            except BaseException:
                traceback.print_exc()
            finally:
                with suppress(Exception):
                    sys.stdout.flush()
                    sys.stderr.flush()
                os._exit(status)
        with suppress(OSError):  # whichever of the two is first
            os.setpgid(self.pid, self.pid)

    def wait(self) -> Ended:
        """Wait for the command, not for what it has started."""
        limit, options = time.monotonic() + _SECONDS, os.WEXITED | os.WNOHANG | os.WNOWAIT
        # Its process stays a zombie until `end`, so that no other process gets its number.
        while (ended := os.waitid(os.P_PID, self.pid, options)) is None:
            if time.monotonic() > limit:
                os.kill(self.pid, signal.SIGKILL)
                return Ended(-signal.SIGALRM, f"stuck: {self._said.read_text()}")
            time.sleep(0.001)
        is_exit = ended.si_code == os.CLD_EXITED
        status = ended.si_status if is_exit else -ended.si_status
        return Ended(status, self._said.read_text(errors="replace"))

    def end(self) -> None:
        """Kill everything that the command has started and that is left, and wait for its end."""
        with suppress(ProcessLookupError):
            os.killpg(self.pid, signal.SIGKILL)
        with suppress(ChildProcessError):
            while True:
                os.waitpid(-self.pid, 0)


def left_by(output: Path) -> dict[str, list[str]]:
    """By run: its rows without their time, its curve, its policies' digest, its files' names."""
    found = {}
    for path in sorted(output.glob("*/*/*/results.csv")):
        rows = list(csv.DictReader(path.read_text().splitlines()))
        for row in rows:
            del row["wall_seconds"]
        files = {each.name: each for each in path.parent.iterdir()}
        curve = files["curve.csv"].read_text() if "curve.csv" in files else ""
        policy = files["policy.pt"].read_bytes() if "policy.pt" in files else b""
        digest = hashlib.sha256(policy).hexdigest()
        found[path.parent.name] = [str(rows), curve, digest, *sorted(files)]
    return found


@dataclass(frozen=True)
class Whole:
    """A command that nothing disturbed: its operations, and what it left."""

    operations: list[Operation]
    left: dict[str, list[str]]


@dataclass(frozen=True)
class Outcome:
    """The outcome of a crash.

    Attributes:
        first: how the first command ended: killed, finished, or refused in one line.
        fault: what is wrong; "" if the second command left what an undisturbed one leaves.
    """

    first: str
    fault: str


class Cell:
    """A command that can be crashed at each of its file operations.

    Args:
        command: runs it, given its output folder.
        work: an empty folder for it.
        watched: the folder whose operations count, below the output folder.
    """

    def __init__(self, command: Command, work: Path, watched: str = "") -> None:
        self._command, self._earlier = command, work / "earlier"
        self._output, self._control = work / "outputs", work / "control"
        self._watched = self._output / watched

    def whole(self) -> Whole:
        """Run the command undisturbed."""
        gc.freeze()
        self._clear()
        process = self._start(Fault(self._control, self._watched))
        status, said = process.wait()
        process.end()
        assert status == 0, said
        return Whole(operations(self._control), left_by(self._output))

    def interrupt(self, number: int) -> None:
        """From now on, start with what a command leaves whose process ends after an operation."""
        self._clear()
        process = self._start(Fault(self._control, self._watched, "after", number))
        process.wait()
        process.end()
        self._output.rename(self._earlier)

    def crash(self, kind: str, number: int, whole: Whole) -> Outcome:
        """Run the command with a fault, run it again without one, and compare with the whole."""
        self._clear()
        had_rows = self._has_rows()
        process = self._start(Fault(self._control, self._watched, kind, number))
        first = process.wait()
        if (self._control / "plan").exists():
            process.end()
            revert(self._control, self._output)
        done, answer = operations(self._control), _answer(first)
        had_rows |= answer == "killed" and _goes_on_after_rows(done)
        lost = had_rows and not self._has_rows()
        again = self._start(None)
        second = again.wait()
        process.end()
        again.end()
        if len(done) < number:
            return Outcome(answer, f"ended before operation {number}")
        if answer == "":
            return Outcome(answer, f"first command: {first}")
        if lost:
            return Outcome(answer, "the rows of a finished run were lost")
        if second.status:
            return Outcome(answer, f"second command: {second}")
        if left_by(self._output) != whole.left:
            return Outcome(answer, f"left {left_by(self._output)}\ninstead of {whole.left}")
        return Outcome(answer, "")

    def _start(self, fault: Fault | None) -> Process:
        return Process(self._command, self._output, self._control, fault)

    def _clear(self) -> None:
        for folder in (self._output, self._control):
            shutil.rmtree(folder, ignore_errors=True)
        self._control.mkdir()
        if self._earlier.exists():
            shutil.copytree(self._earlier, self._output)

    def _has_rows(self) -> bool:
        return any(self._watched.rglob("results.csv"))


def _answer(ended: Ended) -> str:
    """Name how a first command ended; "" if it should not end like this."""
    if ended.status == -signal.SIGKILL:
        return "killed"
    if ended.status == 0:
        return "finished"
    said = ended.said.splitlines()
    is_plain = "Traceback" not in ended.said and "Errno" not in ended.said
    is_sweep = said[:1] and said[0].startswith("sweep: ")
    named = said[-1:] and said[-1].startswith("ril-run: ") and (is_sweep or len(said) == 1)
    return "refused" if ended.status == 1 and is_plain and named else ""


def _goes_on_after_rows(done: list[Operation]) -> bool:
    """Return whether an operation followed the rows' rename: a fsync, or one that relies on it."""
    names = [(each.name, each.file) for each in done]
    return ("rename", "results.csv") in names[:-1]


def points(whole: Whole) -> Iterator[tuple[str, int]]:
    """All faults of a command that differ: kind and number of the operation."""
    last = len(whole.operations)
    for number, operation in enumerate(whole.operations, 1):
        after = whole.operations[number] if number < last else None
        for kind in KINDS:
            applies = {
                "torn": operation.name == "write",
                "lost": after is None or after.loses_names or after.loses_bytes,
                "reordered": after is not None and after.loses_bytes,
                "halved": after is not None and after.loses_bytes,
                "newest": after is not None and after.loses_older_names,
                "ENOSPC": operation.name in NEED_SPACE,
            }
            if applies.get(kind, True):
                yield kind, number
