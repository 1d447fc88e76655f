from __future__ import annotations

import errno
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from helpers.runs import Silence

from ril.demonstrations.files import load_demonstrations
from ril.environments import Environment
from ril.io import locks as locking
from ril.io.errors import UserError
from ril.io.locks import BusyError, claimed
from ril.run.experiment import run
from ril.run.identity import run_id

HOLD = """
import sys
from pathlib import Path
from ril.io.locks import claimed
with claimed(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "cell"


@pytest.fixture
def holder(folder: Path) -> Iterator[subprocess.Popen[str]]:
    """Another process that holds the folder until its standard input ends."""
    command = [sys.executable, "-c", HOLD, str(folder)]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        yield process
        process.kill()


def test_who_waits_for_a_folder_is_told_its_holder(
    folder: Path, holder: subprocess.Popen[str]
) -> None:
    said = []

    def wait(who: str) -> None:
        said.append(who)
        holder.kill()

    with claimed(folder, wait=wait) as claim:
        assert claim.exclusive
    [who] = said
    assert re.fullmatch(
        rf"process {holder.pid} on {socket.gethostname()} since [-+:\d ]{{25}}", who
    )


def test_a_folder_is_free_once_its_holder_is_done(
    folder: Path, holder: subprocess.Popen[str]
) -> None:
    holder.communicate("")
    with claimed(folder) as claim:
        assert claim.exclusive


def test_a_folder_is_free_once_its_holder_is_killed(
    folder: Path, holder: subprocess.Popen[str]
) -> None:
    holder.send_signal(signal.SIGKILL)
    holder.wait()
    with claimed(folder) as claim:
        assert claim.exclusive


def test_one_who_finds_it_held_leaves_it_to_its_holder(folder: Path) -> None:
    with claimed(folder) as claim:
        for _ in range(2):
            with pytest.raises(BusyError), claimed(folder):
                pass
        claim.check()


def test_nothing_is_left_of_a_lock(folder: Path) -> None:
    with claimed(folder):
        (folder / "results.csv").touch()
    assert [path.name for path in folder.iterdir()] == ["results.csv"]


def test_a_folder_in_which_nothing_was_written_is_not_left(folder: Path) -> None:
    with claimed(folder):
        pass
    assert not folder.exists()


def test_what_a_killed_process_had_half_written_is_removed(folder: Path) -> None:
    folder.mkdir()
    (folder / ".checkpoint.pt.123.tmp").write_bytes(b"half")
    (folder / "checkpoint.pt").write_bytes(b"whole")
    with claimed(folder):
        assert sorted(path.name for path in folder.iterdir()) == [".lock", "checkpoint.pt"]


def test_beside_others_a_folder_is_new(folder: Path) -> None:
    with ExitStack() as held:
        claims = [held.enter_context(claimed(folder, beside=True)) for _ in range(3)]
        assert [claim.folder.name for claim in claims] == ["cell", "cell-2", "cell-3"]


@pytest.mark.parametrize("again", [False, True])
def test_a_folder_that_vanished_is_noticed(folder: Path, again: bool) -> None:
    with claimed(folder) as claim:
        shutil.rmtree(folder)
        if again:
            folder.mkdir()
            (folder / ".lock").touch()  # another's
        with pytest.raises(UserError, match="was removed or replaced while the run went on"):
            claim.check()
    assert (folder / ".lock").exists() is again


def test_a_lock_removed_while_it_was_waited_for_is_not_taken_for_one(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lock, calls = locking._lock, []

    def removed_first(file: Any, wait: Any) -> bool:
        calls.append(file)
        if len(calls) == 1:
            (folder / ".lock").unlink()  # as its holder does at the end
        return lock(file, wait)

    monkeypatch.setattr(locking, "_lock", removed_first)
    with claimed(folder) as claim:
        claim.check()
    assert len(calls) == 2


def no_locks(*_: Any) -> None:
    raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))


def test_where_there_are_no_locks_a_run_says_so_and_goes_on(
    quick: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fcntl.flock", no_locks)
    config, display = quick(), Notes()
    config.output_dir = str(tmp_path)
    folder = run(config, display)
    assert display.lines == [f"{folder}: cannot be locked here; do not run the cell twice at once"]
    assert (folder / "results.csv").exists()


class Notes(Silence):
    """Remembers what was said."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.skipped: list[bool] = []
        self.once_noted: Callable[[], object] = lambda: None

    def noted(self, line: str) -> None:
        self.lines.append(line)
        self.once_noted()

    def finished(self, rows: Path, *, skipped: bool) -> None:
        self.skipped.append(skipped)


def test_a_cell_that_is_being_run_is_waited_for(
    quick: Any, tmp_path: Path, cartpole: Environment, holder: subprocess.Popen[str]
) -> None:
    config, display = quick(), Notes()
    config.output_dir = str(tmp_path)
    expert = load_demonstrations(Path(config.demonstrations), cartpole)
    folder = tmp_path / "cartpole" / "ril" / run_id(config, expert.sha256)
    folder.parent.mkdir(parents=True)
    (tmp_path / "cell").rename(folder)  # the holder keeps its lock
    display.once_noted = holder.kill
    assert run(config, display) == folder
    [line] = display.lines
    assert line.startswith(f"env=cartpole method=ril: process {holder.pid} on ")
    assert line.endswith(" runs it already; waiting for its rows")
    assert display.skipped == [False]


def test_two_tables_that_share_a_cell_share_its_run(quick: Any, tmp_path: Path) -> None:
    skipped = []
    for table in (("ablation.k=1", "ablation.k=3"), ("ablation.k=3", "ablation.k=5")):
        for cell in table:
            config, display = quick(cell), Notes()
            config.output_dir = str(tmp_path)
            run(config, display)
            skipped += display.skipped
    assert skipped == [False, False, True, False]
    assert len(list(tmp_path.rglob("results.csv"))) == 3
