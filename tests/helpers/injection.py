"""Replace what Python calls to change files by functions that a `Disk` can make fail."""

from __future__ import annotations

import builtins
import io
import os
import stat
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from helpers.faults import Disk, Fault

Undo = Callable[[Path], list[tuple[str, ...]]]


def install(fault: Fault) -> None:
    """Bring about a fault in this process or one of its forks, for the rest of their lives."""
    disk = Disk(fault)
    opened = _opening(disk)
    os.open, os.write, os.fsync = opened, _writing(disk), _syncing(disk)  # type: ignore[assignment]
    os.mkdir = _naming(disk, "mkdir", os.mkdir, lambda path: [("remove", str(path))])
    os.rmdir = _naming(disk, "rmdir", os.rmdir, lambda path: [("make", str(path))])
    os.unlink = os.remove = _naming(disk, "unlink", os.unlink, disk.kept)
    os.rename, os.replace = _renaming(disk, os.rename), _renaming(disk, os.replace)
    file = _file(disk)
    builtins.open = io.open = _io_opening(disk, file)
    io.FileIO = file  # type: ignore[misc]
    for module in list(sys.modules.values()):  # that imported it by name
        if getattr(module, "__name__", "").startswith("ril.") and hasattr(module, "FileIO"):
            module.FileIO = file  # type: ignore[attr-defined]


def _created(disk: Disk, path: Path) -> None:
    disk.durable[path.stat().st_ino] = b""
    disk.changed([("remove", str(path))], path)


def _path_of(fd: int) -> Path:
    return Path(f"/proc/self/fd/{fd}").readlink()


def _opening(disk: Disk) -> Callable[..., int]:
    real = os.open

    def opens(path: Any, flags: int, mode: int = 0o777, *, dir_fd: int | None = None) -> int:
        is_new = flags & os.O_CREAT and dir_fd is None and disk.watches(path)
        if not is_new or Path(path).exists():
            return real(path, flags, mode, dir_fd=dir_fd)

        def act() -> int:
            fd = real(path, flags, mode)
            _created(disk, Path(path).absolute())
            return fd

        opened: int = disk.does("create", Path(path), act)
        return opened

    return opens


def _writing(disk: Disk) -> Callable[[int, Any], int]:
    real = os.write

    def writes(fd: int, data: Any) -> int:
        path = _path_of(fd)
        if not disk.watches(path):
            return real(fd, data)
        inode = os.fstat(fd).st_ino
        if inode not in disk.durable:
            disk.durable[inode] = path.read_bytes()
        half = memoryview(data).cast("B")
        half = half[: len(half) // 2]
        written: int = disk.does("write", path, lambda: real(fd, data), lambda: real(fd, half))
        return written

    return writes


def _syncing(disk: Disk) -> Callable[[int], None]:
    real = os.fsync

    def syncs(fd: int) -> None:
        path, status = _path_of(fd), os.fstat(fd)

        def act() -> None:  # without the real one, which takes time
            if stat.S_ISDIR(status.st_mode):
                disk.synced(path)
            else:
                disk.durable.pop(status.st_ino, None)

        if disk.watches(path):
            disk.does("fsync", path, act)
        else:
            real(fd)
            act()  # a folder above the watched one holds its name

    return syncs


def _naming(disk: Disk, name: str, real: Callable[..., None], undo: Undo) -> Callable[..., None]:
    """Replace what makes or removes one name."""

    def changes(path: Any, *rest: Any, **options: Any) -> None:
        if options.get("dir_fd") is not None or not disk.watches(path):
            return real(path, *rest, **options)
        absolute = Path(path).absolute()
        possible = absolute.exists()
        if name == "mkdir":
            possible = not possible and absolute.parent.is_dir()
        if name == "rmdir":
            possible = possible and not any(absolute.iterdir())
        if not possible:
            return real(path, *rest, **options)  # fails, and changes nothing

        def act() -> None:
            before = undo(absolute)
            real(path, *rest, **options)
            disk.changed(before, absolute)

        disk.does(name, absolute, act)

    return changes


def _renaming(disk: Disk, real: Callable[..., None]) -> Callable[..., None]:
    def renames(source: Any, target: Any, **options: Any) -> None:
        if options or not disk.watches(source):
            return real(source, target, **options)
        before, after = Path(source).absolute(), Path(target).absolute()

        def act() -> None:
            kept = disk.kept(after)
            real(source, target)
            disk.changed([("move", str(after), str(before)), *kept], after, before)

        disk.does("rename", after, act)

    return renames


def _file(disk: Disk) -> type[io.FileIO]:
    class File(io.FileIO):
        """A file whose creation and writes are operations."""

        def __init__(
            self, file: Any, mode: str = "r", closefd: bool = True, opener: Any = None
        ) -> None:
            self._is_watched = disk.watches(file) and "r" not in mode
            if not self._is_watched:
                super().__init__(file, mode, closefd, opener)
                return
            path = Path(file).absolute()
            is_new = not path.exists()

            def act() -> None:
                before = b"" if is_new else path.read_bytes()
                super(File, self).__init__(file, mode, closefd, opener)
                if is_new:
                    _created(disk, path)
                elif "w" in mode:
                    disk.durable.setdefault(path.stat().st_ino, before)

            disk.does("create" if is_new else "truncate", path, act)

        def write(self, data: Any) -> int:
            return os.write(self.fileno(), data) if self._is_watched else super().write(data)

    return File


def _io_opening(disk: Disk, raw_file: type[io.FileIO]) -> Callable[..., Any]:
    real = io.open

    def opens(
        file: Any,
        mode: str = "r",
        buffering: int = -1,
        encoding: str | None = None,
        errors: str | None = None,
        newline: str | None = None,
        closefd: bool = True,
        opener: Any = None,
    ) -> Any:
        if not (disk.watches(file) and set("wxa") & set(mode)):
            return real(file, mode, buffering, encoding, errors, newline, closefd, opener)
        raw = raw_file(file, mode.replace("b", "").replace("t", ""), closefd, opener)
        if "b" in mode and buffering == 0:
            return raw
        buffered: Any = io.BufferedRandom(raw) if "+" in mode else io.BufferedWriter(raw)
        return buffered if "b" in mode else io.TextIOWrapper(buffered, encoding, errors, newline)

    return opens
