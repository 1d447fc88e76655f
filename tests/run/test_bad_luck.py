"""Disks that fill up or vanish, files that are torn or changed, clocks that jump."""

from __future__ import annotations

import errno
import os
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from helpers.runs import Silence

from ril.config.schema import Config
from ril.io import files
from ril.io.errors import UserError
from ril.io.locks import claimed
from ril.io.signals import Stopped
from ril.methods.base import Progress
from ril.run import training, write
from ril.run.experiment import run
from ril.run.record import Record
from ril.vectorized.evaluation import Evaluation

Cell = Callable[..., Config]
EPOCHS = 5


@pytest.fixture
def cell(quick: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Cell:
    """A cell with a checkpoint after each of its five epochs, below `outputs`."""
    monkeypatch.setattr(training, "CHECKPOINT_SECONDS", 0.0)

    def made(*overrides: str, output: Path = tmp_path / "outputs") -> Config:
        config: Config = quick(f"method.epochs={EPOCHS}", *overrides)
        config.output_dir = str(output)
        return config

    return made


class Script(Silence):
    """Does something after an epoch, or before scoring (epoch 0), and remembers what happened."""

    def __init__(self, epoch: int = -1, act: Callable[[], object] = lambda: None) -> None:
        self.epoch, self.act = epoch, act
        self.epochs: list[int] = []
        self.lines: list[str] = []

    def advanced(self, progress: Progress, record: Record) -> None:
        self.epochs.append(progress.epoch)
        if progress.epoch == self.epoch:
            self.act()

    def scoring(self) -> None:
        if self.epoch == 0:
            self.act()

    def noted(self, line: str) -> None:
        self.lines.append(line)


def interrupt() -> None:
    raise KeyboardInterrupt


def left_by(folder: Path) -> tuple[str, str]:
    rows = pd.read_csv(folder / "results.csv", dtype=str).drop(columns=["run_id", "wall_seconds"])
    return rows.to_csv(), (folder / "curve.csv").read_text()


@pytest.fixture
def expected(cell: Cell, tmp_path: Path) -> tuple[str, str]:
    """What a run leaves that has no bad luck."""
    return left_by(run(cell(output=tmp_path / "elsewhere"), Silence()))


def refusal(config: Config, display: Any = None) -> str:
    with pytest.raises(UserError) as refused:
        run(config, display or Script())
    assert "\n" not in str(refused.value)
    return str(refused.value)


@pytest.fixture
def interrupted(cell: Cell, tmp_path: Path) -> Path:
    """The folder of a run that was stopped in its fourth epoch."""
    with pytest.raises(KeyboardInterrupt):
        run(cell(), Script(4, interrupt))
    [checkpoint] = (tmp_path / "outputs").rglob("checkpoint.pt")
    return checkpoint.parent


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of half a megabyte."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = shutil.which("mount")
    command = [mount or "true", "-t", "tmpfs", "-o", "size=512k", "tmpfs", disk]
    if mount is None or subprocess.run(command, capture_output=True).returncode:
        pytest.skip("only root can mount a small file system")
    yield disk
    subprocess.run(["umount", "--lazy", disk], check=True)


def fill(disk: Path) -> None:
    with suppress(OSError), (disk / "filler").open("wb", buffering=0) as file:
        while True:
            file.write(bytes(4096))
    assert shutil.disk_usage(disk).free == 0


FULL = os.strerror(errno.ENOSPC)


def half_written(folder: Path) -> list[Path]:
    return list(folder.rglob(".*"))


def test_a_full_disk_at_the_start_is_named_and_nothing_is_left(
    cell: Cell, small_disk: Path
) -> None:
    fill(small_disk)
    said = refusal(cell(output=small_disk / "outputs"))
    assert str(small_disk / "outputs") in said
    assert f"cannot be written ({FULL})" in said
    assert [path for path in small_disk.rglob("*") if path.is_file()] == [small_disk / "filler"]


def test_a_full_disk_at_a_checkpoint_is_said_once_and_waited_out(
    cell: Cell, small_disk: Path, expected: tuple[str, str]
) -> None:
    display = Script(2, lambda: fill(small_disk))
    display.scoring = (small_disk / "filler").unlink  # type: ignore[method-assign]
    folder = run(cell(output=small_disk / "outputs"), display)
    path = folder / "checkpoint.pt"
    [line] = display.lines
    assert line.startswith(f"{path}: cannot be written ({FULL}); training continues")
    assert left_by(folder) == expected
    assert not half_written(small_disk)


def test_a_run_stopped_on_a_full_disk_says_so_and_resumes_from_the_checkpoint_before(
    cell: Cell, small_disk: Path, expected: tuple[str, str]
) -> None:
    def fill_and_stop() -> None:
        fill(small_disk)
        signal.raise_signal(signal.SIGTERM)

    config = cell(output=small_disk / "outputs")
    full = re.escape(f"checkpoint.pt: cannot be written ({FULL})")
    with pytest.raises(
        Stopped, match=rf"^stopped after epoch 3; {small_disk}.*{full}; resume with"
    ):
        run(config, Script(3, fill_and_stop))
    (small_disk / "filler").unlink()
    display = Script()
    assert left_by(run(config, display)) == expected
    assert display.epochs == [3, 4, 5]


#: Each file that is written at the end, and the call after which the disk is full.
AT_THE_END = {
    "policy.pt": (Evaluation, "returns"),
    "curve.csv": (write, "save_policies"),
    "results.csv": (write, "write_csv"),  # of the curve
}


@pytest.mark.parametrize("name", AT_THE_END)
def test_a_full_disk_at_the_end_is_named_and_only_scoring_is_done_again(
    cell: Cell,
    small_disk: Path,
    expected: tuple[str, str],
    monkeypatch: pytest.MonkeyPatch,
    name: str,
) -> None:
    owner, function = AT_THE_END[name]
    before = getattr(owner, function)

    def then_full(*arguments: Any, **options: Any) -> Any:
        result = before(*arguments, **options)
        fill(small_disk)
        return result

    config = cell(output=small_disk / "outputs")
    with monkeypatch.context() as patched:
        # From scoring on, so that the last checkpoint is whole.
        said = refusal(config, Script(0, lambda: patched.setattr(owner, function, then_full)))
    assert f"/{name}: cannot be written ({FULL}); resume with " in said
    assert not half_written(small_disk)
    assert not list(small_disk.rglob("results.csv"))
    (small_disk / "filler").unlink()
    display = Script()
    assert left_by(run(config, display)) == expected
    assert display.epochs == []


def test_a_checkpoint_that_cannot_be_removed_does_no_harm_to_finished_rows(
    cell: Cell, expected: tuple[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    unlink = Path.unlink

    def refused(path: Path, missing_ok: bool = False) -> None:
        if path.name == "checkpoint.pt":
            raise OSError(errno.EIO, os.strerror(errno.EIO), str(path))
        unlink(path, missing_ok)

    with monkeypatch.context() as patched:
        patched.setattr(Path, "unlink", refused)
        folder = run(cell(), Silence())
    assert (folder / "checkpoint.pt").exists()
    assert left_by(folder) == expected
    assert run(cell(), Script()) == folder
    assert not (folder / "checkpoint.pt").exists()


@pytest.mark.parametrize("name", [".lock", ".holder", "checkpoint.pt", ".results.csv.1.tmp"])
def test_what_a_crash_brings_back_beside_finished_rows_is_removed(cell: Cell, name: str) -> None:
    folder = run(cell(), Silence())
    (folder / name).touch()
    assert run(cell(), Script()) == folder
    assert not (folder / name).exists()


def test_a_full_disk_does_no_harm_to_finished_rows(cell: Cell, small_disk: Path) -> None:
    config = cell(output=small_disk / "outputs")
    folder = run(config, Silence())
    before = (folder / "results.csv").read_bytes()
    fill(small_disk)
    refusal(cell("ablation.k=3", output=small_disk / "outputs"))
    assert run(config, Script()) == folder
    assert (folder / "results.csv").read_bytes() == before


def test_temporary_files_have_no_place_in_a_run(
    cell: Cell, small_disk: Path, expected: tuple[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    fill(small_disk)
    monkeypatch.setenv("TMPDIR", str(small_disk))
    monkeypatch.setattr("tempfile.tempdir", None)
    assert left_by(run(cell(), Silence())) == expected


def read_only(disk: Path) -> None:
    subprocess.run(["mount", "-o", "remount,ro", disk], check=True)


def test_a_read_only_disk_is_named(cell: Cell, small_disk: Path) -> None:
    read_only(small_disk)
    said = refusal(cell(output=small_disk / "outputs"))
    assert said.startswith(f"output_dir: {small_disk}/outputs/cartpole/ril/")
    assert said.endswith(f"cannot be written ({os.strerror(errno.EROFS)})")


def test_a_finished_run_on_a_read_only_disk_is_shown(cell: Cell, small_disk: Path) -> None:
    config = cell(output=small_disk / "outputs")
    folder = run(config, Silence())
    read_only(small_disk)
    assert run(config, Script()) == folder


def test_a_disk_that_becomes_read_only_is_waited_out(
    cell: Cell, expected: tuple[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_: Any) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    fsync = os.fsync
    display = Script(2, lambda: monkeypatch.setattr(files.os, "fsync", refused))
    display.scoring = lambda: monkeypatch.setattr(files.os, "fsync", fsync)  # type: ignore[method-assign]
    folder = run(cell(), display)
    [line] = display.lines
    assert f"checkpoint.pt: cannot be written ({os.strerror(errno.EROFS)})" in line
    assert left_by(folder) == expected


@pytest.fixture
def someone_elses(tmp_path: Path) -> Iterator[Path]:
    """A folder that this process may not write; to root, modes mean nothing."""
    folder = tmp_path / "outputs"
    folder.mkdir(mode=0o500)
    is_root = os.geteuid() == 0
    if is_root:
        os.seteuid(65534)
    yield folder
    if is_root:
        os.seteuid(0)


def test_a_folder_of_someone_elses_is_named(someone_elses: Path) -> None:
    said = f"{someone_elses}/cell cannot be written ({os.strerror(errno.EACCES)})"
    with (
        pytest.raises(UserError, match=f"^output_dir: {re.escape(said)}$"),
        claimed(someone_elses / "cell"),
    ):
        pass


def test_an_output_folder_that_vanishes_ends_the_run_in_one_line(
    cell: Cell, tmp_path: Path, expected: tuple[str, str]
) -> None:
    output = tmp_path / "outputs"
    display = Script(2, lambda: shutil.rmtree(output))
    said = refusal(cell(), display)
    assert said.startswith(f"{output}/cartpole/ril/")
    assert "was removed or replaced during the run" in said
    assert display.epochs == [1, 2]
    assert not output.exists()
    assert left_by(run(cell(), Silence())) == expected


def test_an_output_folder_that_vanishes_while_scoring_ends_the_run_in_one_line(
    cell: Cell, tmp_path: Path
) -> None:
    output = tmp_path / "outputs"
    said = refusal(cell(), Script(0, lambda: shutil.rmtree(output)))
    assert "was removed or replaced during the run" in said
    assert not output.exists()


@pytest.mark.parametrize("content", [b"", b'{"run_id": "0', b"[]", b"\xff\xfe"])
def test_provenance_that_is_torn_is_named(cell: Cell, interrupted: Path, content: bytes) -> None:
    path = interrupted / "provenance.json"
    path.write_bytes(content)
    assert refusal(cell()).startswith(f"{path}: cannot be read")
    assert path.read_bytes() == content
    assert (interrupted / "checkpoint.pt").exists()


def test_provenance_that_is_lost_is_named(cell: Cell, interrupted: Path) -> None:
    (interrupted / "provenance.json").unlink()
    assert "provenance.json: cannot be read" in refusal(cell())


def test_of_a_run_that_left_no_checkpoint_torn_provenance_does_not_matter(
    cell: Cell, interrupted: Path, expected: tuple[str, str]
) -> None:
    (interrupted / "checkpoint.pt").unlink()
    (interrupted / "provenance.json").write_bytes(b"torn")
    assert left_by(run(cell(), Silence())) == expected


def test_a_torn_configuration_is_written_again(
    cell: Cell, interrupted: Path, expected: tuple[str, str]
) -> None:
    path = interrupted / "config.yaml"
    whole = path.read_bytes()
    path.write_bytes(whole[:50])
    assert left_by(run(cell(), Silence())) == expected
    assert path.read_bytes() == whole


def test_a_checkpoint_of_another_cell_is_named(cell: Cell, interrupted: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        run(cell("ablation.k=3"), Script(2, interrupt))
    [other] = set(interrupted.parent.iterdir()) - {interrupted}
    shutil.copy(interrupted / "checkpoint.pt", other)
    said = refusal(cell("ablation.k=3"))
    assert f"belongs to another run or other code (run_id {interrupted.name}; now run_id" in said


def test_a_checkpoint_of_other_code_is_named(
    cell: Cell, interrupted: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ril.run.provenance._code", lambda: "0123456789ab")
    assert "(code " in refusal(cell())
    assert (interrupted / "checkpoint.pt").exists()


def torn(whole: bytes) -> dict[str, bytes]:
    lines = whole.splitlines(keepends=True)
    return {
        "empty": b"",
        "no row": lines[0],
        "a row lost": b"".join(lines[:-1]),
        "half a row": whole[:-20],
        "the last digit": whole[:-2],
        "no newline": whole[:-1],
        "not text": b"\xff\x00" + whole,
        "another run's": whole.replace(b"\n", b"\nother", len(lines) - 1),
        "a row too many": whole + lines[-1].replace(b",1,", b",2,", 1),
    }


@pytest.mark.parametrize("how", torn(b"a\nb\n"))
def test_torn_rows_are_named_and_left_alone(cell: Cell, how: str) -> None:
    path = run(cell(), Silence()) / "results.csv"
    path.write_bytes(torn(path.read_bytes())[how])
    before = path.read_bytes()
    said = refusal(cell())
    assert said.startswith(f"{path}: ")
    assert "; delete it, and " in said
    assert path.read_bytes() == before
    path.unlink()
    run(cell(), Silence())
    assert len(pd.read_csv(path)) == 2


@pytest.mark.parametrize("seconds", [-1e6, 1e6])
def test_a_clock_that_jumps_changes_nothing(
    cell: Cell, expected: tuple[str, str], monkeypatch: pytest.MonkeyPatch, seconds: float
) -> None:
    now = time.time
    jump = Script(2, lambda: monkeypatch.setattr(time, "time", lambda: now() + seconds))
    began = time.monotonic()
    folder = run(cell(), jump)
    wall = pd.read_csv(folder / "results.csv")["wall_seconds"]
    assert wall.between(0, time.monotonic() - began).all()
    assert left_by(folder) == expected


def test_the_seconds_of_all_starts_are_added(cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    now = time.monotonic

    def later() -> None:
        monkeypatch.setattr(time, "monotonic", lambda: now() + 1000)
        signal.raise_signal(signal.SIGTERM)

    with pytest.raises(KeyboardInterrupt):
        run(cell(), Script(2, later))
    monkeypatch.setattr(time, "monotonic", now)
    wall = pd.read_csv(run(cell(), Silence()) / "results.csv")["wall_seconds"]
    assert wall.between(1000, 1100).all()


@pytest.fixture
def demonstrations(demonstration_files: dict[str, Path], tmp_path: Path) -> Path:
    """A file of one's own."""
    return Path(shutil.copy(demonstration_files["cartpole"], tmp_path / "own.npz"))


def changed(path: Path) -> bytes:
    """Change a file of demonstrations; what it was."""
    whole = path.read_bytes()
    with np.load(path) as archive:
        arrays = dict(archive)
    np.savez(path, **arrays | {"actions": 1 - arrays["actions"]})
    return whole


def test_a_run_does_not_resume_with_other_demonstrations(
    cell: Cell, demonstrations: Path, tmp_path: Path
) -> None:
    config = cell(f"demonstrations={demonstrations}")
    with pytest.raises(KeyboardInterrupt):
        run(config, Script(4, interrupt))
    whole = changed(demonstrations)
    said = refusal(config)
    assert said.startswith(
        f"demonstrations={demonstrations}: has changed since the stopped run in "
    )
    assert len(list((tmp_path / "outputs" / "cartpole" / "ril").iterdir())) == 1

    demonstrations.write_bytes(whole)
    display = Script()
    run(config, display)
    assert display.epochs == [4, 5]


@pytest.mark.parametrize("way", ["a folder deleted", "resume=false", "another file"])
def test_with_other_demonstrations_a_run_begins_again_if_that_is_meant(
    cell: Cell, demonstrations: Path, tmp_path: Path, way: str
) -> None:
    given = f"demonstrations={demonstrations}"
    with pytest.raises(KeyboardInterrupt):
        run(cell(given), Script(4, interrupt))
    if way == "a folder deleted":
        shutil.rmtree(tmp_path / "outputs")
    if way == "another file":
        given = f"demonstrations={shutil.copy(demonstrations, tmp_path / 'other.npz')}"
        changed(tmp_path / "other.npz")
    else:
        changed(demonstrations)
    display = Script()
    run(cell(given, *(["resume=false"] if way == "resume=false" else [])), display)
    assert display.epochs == [1, 2, 3, 4, 5]
