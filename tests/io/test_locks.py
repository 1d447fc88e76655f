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
from ril.environments.environment import Environment
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

# Each claim leaves the folder empty, so it is removed and made again.
COUNT = """
import sys
from pathlib import Path
from ril.io.locks import claimed
folder, file = map(Path, sys.argv[1:])
for _ in range(20):
    with claimed(folder, wait=lambda _: None):
        number = int(file.read_text())
        file.write_text(str(number + 1))
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


def test_a_waiting_process_is_told_the_holder(folder: Path, holder: subprocess.Popen[str]) -> None:
    holders = []

    def wait(name: str) -> None:
        holders.append(name)
        holder.kill()

    with claimed(folder, wait=wait) as claim:
        assert claim.exclusive
    [name] = holders
    since = r"[-+:\d ]{25}"
    assert re.fullmatch(rf"process {holder.pid} on {socket.gethostname()} since {since}", name)


def test_a_folder_is_free_when_its_holder_ends(folder: Path, holder: subprocess.Popen[str]) -> None:
    holder.communicate("")
    with claimed(folder) as claim:
        assert claim.exclusive


def test_a_folder_is_free_at_once_when_its_holder_is_killed(
    folder: Path, holder: subprocess.Popen[str]
) -> None:
    holder.send_signal(signal.SIGKILL)
    holder.wait()
    with claimed(folder) as claim:
        assert claim.exclusive


def test_a_busy_folder_stays_its_holders(folder: Path) -> None:
    with claimed(folder) as claim:
        for _ in range(2):
            with pytest.raises(BusyError), claimed(folder):
                pass
        claim.check()


def test_the_locks_files_are_removed(folder: Path) -> None:
    with claimed(folder):
        (folder / "results.csv").touch()
    assert [path.name for path in folder.iterdir()] == ["results.csv"]


def test_an_empty_folder_is_removed(folder: Path) -> None:
    with claimed(folder):
        pass
    assert not folder.exists()


def test_temporary_files_of_a_killed_process_are_removed(folder: Path) -> None:
    folder.mkdir()
    (folder / ".checkpoint.pt.123.tmp").write_bytes(b"half")
    (folder / "checkpoint.pt").write_bytes(b"whole")
    with claimed(folder):
        names = sorted(path.name for path in folder.iterdir())
        assert names == [".holder", ".lock", "checkpoint.pt"]


def test_new_folders_are_numbered(folder: Path) -> None:
    with ExitStack() as held:
        claims = [held.enter_context(claimed(folder, new=True)) for _ in range(3)]
        assert [claim.folder.name for claim in claims] == ["cell", "cell-2", "cell-3"]


@pytest.mark.parametrize("replaced", [False, True])
def test_a_folder_that_is_removed_or_replaced_is_noticed(folder: Path, replaced: bool) -> None:
    with claimed(folder) as claim:
        copy = shutil.copytree(folder, folder.with_name("copy"))
        shutil.rmtree(folder)
        if replaced:
            copy.rename(folder)
        with pytest.raises(UserError, match="was removed or replaced during the run"):
            claim.check()
    assert [(folder / name).exists() for name in (".lock", ".holder")] == [replaced] * 2


def test_a_folder_removed_while_a_process_waits_is_made_again(
    folder: Path, holder: subprocess.Popen[str]
) -> None:
    with claimed(folder, wait=lambda _: shutil.rmtree(folder)) as claim:
        claim.check()
        assert claim.exclusive
        with pytest.raises(BusyError), claimed(folder):
            pass


@pytest.mark.parametrize("new", [False, True])
def test_a_folder_below_a_file_is_refused(tmp_path: Path, new: bool) -> None:
    (tmp_path / "file").touch()
    said = rf"^output_dir: {tmp_path}/file/cell cannot be written \(Not a directory\)$"
    with pytest.raises(UserError, match=said), claimed(tmp_path / "file" / "cell", new=new):
        pass


@pytest.mark.parametrize("below", ["", "method"])
def test_a_folder_below_a_broken_link_is_refused(tmp_path: Path, below: str) -> None:
    (tmp_path / "link").symlink_to("nowhere")
    with (
        pytest.raises(UserError, match=r"^output_dir: .*/cell cannot be written"),
        claimed(tmp_path / "link" / below / "cell"),
    ):
        pass


def test_a_file_in_the_folders_place_is_refused(folder: Path) -> None:
    folder.touch()
    said = rf"^output_dir: {folder} cannot be written \(File exists\)$"
    with pytest.raises(UserError, match=said), claimed(folder):
        pass
    assert folder.is_file()


def test_processes_hold_a_folder_one_at_a_time(folder: Path, tmp_path: Path) -> None:
    file = tmp_path / "number"
    file.write_text("0")
    command = [sys.executable, "-c", COUNT, str(folder), str(file)]
    processes = [subprocess.Popen(command) for _ in range(4)]
    assert [process.wait() for process in processes] == [0] * 4
    assert file.read_text() == "80"
    assert not folder.exists()


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.ENOSYS])
def test_without_locks_a_run_warns_and_runs(
    quick: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    def no_locks(*_: Any) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr("fcntl.flock", no_locks)
    config, display = quick(), Notes()
    config.output_dir = str(tmp_path)
    folder = run(config, display)
    [line] = display.lines
    assert line.startswith(f"{folder}: this file system has no locks")
    assert (folder / "results.csv").exists()


class Notes(Silence):
    """Records the notes of a run."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.skipped: list[bool] = []
        self.once_noted: Callable[[], object] = lambda: None

    def noted(self, line: str) -> None:
        self.lines.append(line)
        self.once_noted()

    def finished(self, rows: Path, *, skipped: bool) -> None:
        self.skipped.append(skipped)


def test_a_run_waits_for_another_process_that_runs_its_cell(
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
    assert line.endswith(" is running this cell; waiting for its rows")
    assert display.skipped == [False]


def test_tables_that_share_a_cell_share_its_run(quick: Any, tmp_path: Path) -> None:
    skipped = []
    for table in (("ablation.k=1", "ablation.k=3"), ("ablation.k=3", "ablation.k=5")):
        for cell in table:
            config, display = quick(cell), Notes()
            config.output_dir = str(tmp_path)
            run(config, display)
            skipped += display.skipped
    assert skipped == [False, False, True, False]
    assert len(list(tmp_path.rglob("results.csv"))) == 3


def test_a_temporary_file_that_cannot_be_removed_does_no_harm(tmp_path: Path) -> None:
    leftover = tmp_path / ".results.csv.1.tmp"
    leftover.mkdir()  # which unlink refuses
    with claimed(tmp_path) as claim:
        assert claim.exclusive
    assert leftover.exists()
