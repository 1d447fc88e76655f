"""The lock on a run's folder: one process at a time writes it, and a killed one frees it."""

from __future__ import annotations

import errno
import os
import socket
import stat
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from io import FileIO
from pathlib import Path

from filelock import FileLock, Timeout

from ril.io.errors import UserError
from ril.io.files import make_folder, temporary_files

_LOCK, _HOLDER = ".lock", ".holder"
_POLL_SECONDS = 0.2
_NAME_READS = 5
#: What locking a file raises on file systems without locks, as some network file systems are.
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOTSUP, errno.EINVAL)


class BusyError(Exception):
    """Another process holds the folder."""


class Claim:
    """A folder that this process holds.

    Attributes:
        folder: the run's folder.
        exclusive: whether other processes are kept out; False on a file system without locks.
    """

    def __init__(self, folder: Path, holder: FileIO, *, exclusive: bool) -> None:
        self.folder = folder
        self.exclusive = exclusive
        self._holder = holder

    def check(self) -> None:
        """Check that the folder still exists and is still this process's.

        Raises:
            UserError: it was removed or replaced.
        """
        if not _is_at(self._holder, self.folder / _HOLDER):
            raise UserError(
                f"{self.folder}: was removed or replaced during the run, so nothing more is "
                "written; run the same command again to resume from what is left"
            )


@contextmanager
def claimed(
    folder: Path, *, new: bool = False, wait: Callable[[str], object] | None = None
) -> Iterator[Claim]:
    """Hold a folder until the end of the block, or of the process, however that ends.

    Temporary files of killed processes are removed; at the end, so is the folder if it is empty.

    Args:
        folder: the run's folder, which is made if it does not exist.
        new: whether to make and hold a new folder: the first of `folder`, `folder-2`,
            `folder-3`, … that does not exist.
        wait: called with the holder's name ("process … on … since …") before waiting for another
            process to free the folder. Without it, a busy folder is an error.

    Returns:
        The claim on the folder.

    Raises:
        BusyError: another process holds the folder, and `wait` is None.
        UserError: the folder cannot be written.
    """
    try:
        if new:
            folder = _new(folder)
        lock = _locked(folder, wait)
        try:
            holder = _signed(folder)
        except OSError:
            _release(folder, lock)
            raise
    except OSError as error:
        raise UserError(f"output_dir: {folder} cannot be written ({error.strerror})") from None
    try:
        for leftover in temporary_files(folder):
            with suppress(OSError):  # it does no harm
                leftover.unlink(missing_ok=True)
        yield Claim(folder, holder, exclusive=lock is not None)
    finally:
        is_ours = _is_at(holder, folder / _HOLDER)
        holder.close()
        if is_ours:
            _release(folder, lock)
        elif lock is not None:
            lock.release()


def _new(folder: Path) -> Path:
    """Make the first of `folder`, `folder-2`, `folder-3`, … that does not exist."""
    number, wanted = 1, folder
    while True:
        try:
            make_folder(folder)
            return folder
        except FileExistsError:
            number += 1
            folder = wanted.with_name(f"{wanted.name}-{number}")


def _locked(folder: Path, wait: Callable[[str], object] | None) -> FileLock | None:
    """Make and lock a folder; returns None if its file system has no locks."""
    while True:
        try:
            make_folder(folder)
        except FileExistsError:
            if any(map(_is_obstructed, (folder, *folder.parents))):
                raise
        # Without locks, filelock would fall back to a file whose existence is the lock, which a
        # killed process leaves behind.
        lock = FileLock(folder / _LOCK, fallback_to_soft=False, poll_interval=_POLL_SECONDS)
        try:
            try:
                lock.acquire(blocking=False)
            except Timeout:
                if wait is None:
                    raise BusyError from None
                wait(_holder_of(folder))
                lock.acquire()
            return lock
        except (FileNotFoundError, FileExistsError):
            continue  # the holder has removed the empty folder
        except OSError as error:
            if error.errno in _NO_LOCKS:
                return None
            raise


def _is_obstructed(path: Path) -> bool:
    """Return whether a path is of something other than a folder, such as a broken link."""
    try:
        return not stat.S_ISDIR(path.stat().st_mode)
    except OSError:
        return path.is_symlink()


def _signed(folder: Path) -> FileIO:
    """Write who holds a folder; the file stays open, to be told from a later one of its name."""
    since = datetime.now(UTC).isoformat(sep=" ", timespec="seconds")
    file = FileIO(folder / _HOLDER, "w")
    try:
        file.write(f"process {os.getpid()} on {socket.gethostname()} since {since}\n".encode())
    except OSError:
        file.close()
        raise
    return file


def _holder_of(folder: Path) -> str:
    """Read who holds a folder, without control characters that a terminal would obey."""
    for _ in range(_NAME_READS):  # the holder writes its name just after it locks the folder
        with suppress(OSError), FileIO(folder / _HOLDER) as file:
            name = "".join(filter(str.isprintable, file.read(200).decode(errors="replace")))
            if name:
                return name
        time.sleep(_POLL_SECONDS)
    return "another process"


def _release(folder: Path, lock: FileLock | None) -> None:
    """Remove the lock's files, and the folder if it is empty, before others can lock it."""
    with suppress(OSError):  # such as of a folder that is gone or not empty
        (folder / _HOLDER).unlink(missing_ok=True)
        (folder / _LOCK).unlink(missing_ok=True)
        folder.rmdir()
    if lock is not None:
        lock.release()


def _is_at(file: FileIO, path: Path) -> bool:
    """Return whether an open file is the one at a path."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except OSError:
        return False
