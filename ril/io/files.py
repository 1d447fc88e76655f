"""Files that are written completely or not at all, even if the machine stops in between."""

from __future__ import annotations

import errno
import io
import os
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

from ril.io.errors import UserError

#: What `fsync` raises where a file system cannot flush, as for folders on CIFS and some shared
#: folders of virtual machines.
_CANNOT_SYNC = (errno.EINVAL, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS)
#: What opening a folder raises where only files can be opened, or this one may not be read.
_CANNOT_OPEN = (errno.EACCES, errno.EPERM, errno.EISDIR, *_CANNOT_SYNC)


class WriteError(UserError):
    """A file cannot be written, such as on a full or read-only disk."""


def write_atomically(path: Path, *parts: bytes) -> None:
    """Write a file such that readers see its old or its new content, and never a part of it.

    Args:
        path: the file to write, in an existing folder.
        *parts: the content, one part after another.

    Raises:
        WriteError: the file cannot be written; its old content is unchanged.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            for part in parts:
                file.write(part)
            file.flush()
            _sync(file.fileno())
        temporary.replace(path)
        _sync_folder(path.parent)
    except OSError as error:
        raise WriteError(f"{path}: cannot be written ({error.strerror})") from None
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def _sync(number: int) -> None:
    """Flush an open file or folder to disk, where the file system can."""
    try:
        os.fsync(number)
    except OSError as error:
        if error.errno not in _CANNOT_SYNC:
            raise


def make_folder(folder: Path, *, exist_ok: bool = False) -> None:
    """Make a folder and the missing ones above it, so that a crash of the machine keeps them.

    Args:
        folder: the folder to make.
        exist_ok: whether it may exist.

    Raises:
        OSError: it cannot be made; FileExistsError if it exists and may not.
    """
    missing = [each for each in (folder, *folder.parents) if not each.exists()]
    folder.mkdir(parents=True, exist_ok=exist_ok)
    for each in missing:
        _sync_folder(each.parent)


def _sync_folder(folder: Path) -> None:
    """Flush a folder's new names to disk, where the system lets a folder be opened."""
    try:
        opened = os.open(folder, os.O_RDONLY)
    except OSError as error:
        if error.errno in _CANNOT_OPEN:
            return
        raise
    try:
        _sync(opened)
    finally:
        os.close(opened)


def temporary_files(folder: Path) -> Iterable[Path]:
    """Find the temporary files of killed processes that were in `write_atomically`."""
    return folder.glob(".*.tmp")


def tensor_bytes(content: dict[str, Any]) -> bytes:
    """Serialize tensors and plain values.

    Args:
        content: tensors and plain values to serialize.

    Returns:
        What `torch.load(…, weights_only=True)` reads.
    """
    import torch  # here: reading rows does not need it, and importing it takes seconds

    buffer = io.BytesIO()
    torch.save(content, buffer)
    return buffer.getvalue()  # without a copy
