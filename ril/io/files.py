"""Files that are there whole or not at all, even if the machine stops meanwhile."""

from __future__ import annotations

import io
import os
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

from ril.io.errors import UserError

Bytes = bytes | memoryview


class WriteError(UserError):
    """A file cannot be written: the disk is full, read-only or gone."""


def write_atomically(path: Path, *parts: Bytes) -> None:
    """Write a file so that a reader sees all of it or none, whatever happens meanwhile.

    Args:
        path: of the file.
        *parts: its content, one after another.

    Raises:
        WriteError: it cannot be; what was there before still is.
    """
    aside = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with aside.open("wb") as file:
            for part in parts:
                file.write(part)
            file.flush()
            os.fsync(file.fileno())
        aside.replace(path)
        _sync_folder(path.parent)
    except OSError as error:
        raise WriteError(f"{path}: cannot be written ({error.strerror})") from None
    finally:
        with suppress(OSError):
            aside.unlink(missing_ok=True)


def _sync_folder(folder: Path) -> None:
    """Have the disk know of a renamed file, where a folder can be opened for that."""
    try:
        opened = os.open(folder, os.O_RDONLY)
    except PermissionError:
        return
    try:
        os.fsync(opened)
    finally:
        os.close(opened)


def unfinished(folder: Path) -> Iterable[Path]:
    """What `write_atomically` left of files when its process was killed."""
    return folder.glob(".*.tmp")


def tensor_bytes(content: dict[str, Any]) -> memoryview:
    """Tensors and plain values as bytes, to be read by `torch.load(…, weights_only=True)`."""
    import torch  # here: who only reads rows need not wait for it

    buffer = io.BytesIO()
    torch.save(content, buffer)
    return buffer.getbuffer()
