"""A run's folder, which one process at a time may write, whatever ends that process."""

from __future__ import annotations

import os
import socket
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from io import FileIO
from pathlib import Path

from ril.io.errors import UserError
from ril.io.files import unfinished

if sys.platform != "win32":
    import fcntl


class BusyError(Exception):
    """Another process holds the folder."""


class Claim:
    """A folder of this process's own.

    Attributes:
        folder: the run's.
        exclusive: whether others are kept out; some network file systems have no locks.
    """

    def __init__(self, folder: Path, file: FileIO, *, exclusive: bool) -> None:
        self.folder = folder
        self.exclusive = exclusive
        self._file = file

    def check(self) -> None:
        """Make sure that the folder is still there, and still this process's.

        Raises:
            UserError: it was removed or replaced.
        """
        if not _is_at(self._file, self.folder / ".lock"):
            raise UserError(
                f"{self.folder}: was removed or replaced while the run went on, so no more is "
                "written; the same command goes on with what is left"
            )


@contextmanager
def claimed(
    folder: Path, *, beside: bool = False, wait: Callable[[str], object] | None = None
) -> Iterator[Claim]:
    """Hold a folder until the end of the block, or of the process, however it ends.

    What a process that was killed had half-written is removed.

    Args:
        folder: the run's; it is made if it is not there.
        beside: take a folder that was not there before: the first free one of `folder`,
            `folder-2`, `folder-3`, ….
        wait: if another process holds it, is told which, and then that is waited for.

    Raises:
        BusyError: another process holds it, and it is not to be waited for.
        UserError: it cannot be written.
    """
    try:
        if beside:
            folder = _new(folder)
        file, exclusive = _locked(folder, wait)
    except OSError as error:
        raise UserError(f"output_dir: {folder} cannot be written ({error.strerror})") from None
    try:
        for left in unfinished(folder):
            left.unlink(missing_ok=True)
        yield Claim(folder, file, exclusive=exclusive)
    finally:
        _release(file, folder)


def _new(folder: Path) -> Path:
    """Make the first folder of its name and numbers that is not there."""
    number, wanted = 1, folder
    while True:
        try:
            folder.mkdir(parents=True)
            return folder
        except FileExistsError:
            number += 1
            folder = wanted.with_name(f"{wanted.name}-{number}")


def _locked(folder: Path, wait: Callable[[str], object] | None) -> tuple[FileIO, bool]:
    """The folder's lock file, open, and whether it is locked by this process."""
    while True:
        folder.mkdir(parents=True, exist_ok=True)
        file = FileIO(folder / ".lock", "a+")
        try:
            exclusive = _lock(file, wait)
        except BaseException:
            file.close()
            raise
        # Who had it may have removed it between opening and locking.
        if _is_at(file, folder / ".lock"):
            break
        file.close()
    now = datetime.now(UTC).isoformat(sep=" ", timespec="seconds")
    try:
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()} since {now}\n".encode())
    except OSError:
        _release(file, folder)
        raise
    return file, exclusive


def _lock(file: FileIO, wait: Callable[[str], object] | None) -> bool:
    """Lock a file for as long as it is open; False where that cannot be done."""
    if sys.platform == "win32":
        return False
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        if wait is None:
            raise BusyError from None
        file.seek(0)
        holder = "".join(filter(str.isprintable, file.read(200).decode(errors="replace")))
        wait(holder or "another process")
        fcntl.flock(file, fcntl.LOCK_EX)
    except OSError:  # a network file system without a lock service
        return False
    return True


def _release(file: FileIO, folder: Path) -> None:
    """Leave a folder to others; an empty one goes."""
    path = folder / ".lock"
    with suppress(OSError):  # of a folder that is gone or read-only
        if _is_at(file, path):
            path.unlink()
            folder.rmdir()  # unless something is in it
    file.close()


def _is_at(file: FileIO, path: Path) -> bool:
    """Whether an open file is the one that lies at a path."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except OSError:
        return False
