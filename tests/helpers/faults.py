"""Faults of a process, of the machine and of its disk, at one chosen file operation.

`helpers.injection` has Python's file operations pass through a `Disk`, which numbers those below
the watched folder across all processes of a command, brings about the fault at one of them, and
knows what a crash of the machine would lose. After such a crash, `revert` takes that back.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

#: What happens at the chosen operation.
KINDS = {
    "before": "the process ends before the operation",
    "after": "the process ends after it",
    "torn": "the process ends when half of the bytes are written",
    "lost": "the machine ends after it; names and bytes without fsync are lost",
    "reordered": "the machine ends after it; all names survive, bytes without fsync are lost",
    "halved": "the machine ends after it; all names survive, and half of the bytes without fsync",
    "newest": "the machine ends after it; of the names without fsync, only the newest survives",
    "EIO": "the operation fails once",
    "ENOSPC": "the disk is full from the operation on; of a write, half of the bytes fit",
}
#: Operations that a full disk refuses.
NEED_SPACE = ("create", "mkdir", "write", "fsync")
_OF_PROCESS = ("before", "after", "torn")
_LINE = 64  # bytes of an operation in the log
_WRITE = os.write  # also when `os.write` is replaced


@dataclass(frozen=True)
class Fault:
    """A fault at one operation.

    Attributes:
        control: a folder outside the watched one, for the log, the plan of what to revert, and
            former files.
        watched: the folder whose operations count.
        kind: one of `KINDS`; "" to only count.
        number: the operation, from 1.
    """

    control: Path
    watched: Path
    kind: str = ""
    number: int = 0


class Operation(NamedTuple):
    """An operation in the log, and whether a crash of the machine before it would lose something.

    Attributes:
        name: what was done.
        file: the name of the file or folder.
        loses_names: whether some name is not durable.
        loses_bytes: whether some file's bytes are not durable.
        loses_older_names: whether the newest name can survive others that are lost.
    """

    name: str
    file: str
    loses_names: bool
    loses_bytes: bool
    loses_older_names: bool


def operations(control: Path) -> list[Operation]:
    """The operations so far."""
    lines = (control / "log").read_text().splitlines()
    return [
        Operation(name, file, *(each == "1" for each in losing))
        for name, file, *losing in map(str.split, lines)
    ]


def revert(control: Path, folder: Path) -> None:
    """Take back what the crash of the machine lost; all processes have ended."""
    undo, contents = json.loads((control / "plan").read_text())
    for action, *paths in undo:
        _UNDO[action](*map(Path, paths))
    for path in folder.rglob("*"):
        if path.is_file() and (kept := contents.get(str(path.stat().st_ino))) is not None:
            path.write_bytes(bytes.fromhex(kept))


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


_UNDO: dict[str, Callable[..., object]] = {
    "remove": _remove,
    "make": lambda path: path.mkdir(),
    "move": lambda source, target: source.replace(target),
}


@dataclass(frozen=True)
class Change:
    """A change of names in a folder that is in memory only.

    Attributes:
        folder: the folder, whose fsync makes the change durable.
        paths: the names.
        undo: what takes it back: keys of `_UNDO` with their paths.
    """

    folder: Path
    paths: tuple[Path, ...]
    undo: list[tuple[str, ...]]


class Disk:
    """A disk that counts operations, brings about a fault, and knows what is durable.

    Attributes:
        durable: the bytes on disk of each file that has other bytes in memory, by inode.
    """

    def __init__(self, fault: Fault) -> None:
        self._fault = fault
        self._full = False
        self._changes: list[Change] = []
        self.durable: dict[int, bytes] = {}
        self._log = os.open(fault.control / "log", os.O_WRONLY | os.O_APPEND | os.O_CREAT)

    def watches(self, path: Any) -> bool:
        """Whether operations on a path count."""
        if not isinstance(path, str | os.PathLike):
            return False
        return Path(path).absolute().is_relative_to(self._fault.watched)

    def does(
        self, name: str, path: Path, act: Callable[[], Any], half: Callable[[], Any] | None = None
    ) -> Any:
        """Do an operation, or what the fault makes of it."""
        kind, number = self._fault.kind, self._number(name, path)
        is_chosen = number == self._fault.number
        if is_chosen and kind == "ENOSPC":
            self._full = True
        if self._full and name in NEED_SPACE:
            if half is not None:
                half()
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        if not is_chosen or kind in ("", "ENOSPC"):
            return act()
        if kind == "EIO":
            raise OSError(errno.EIO, os.strerror(errno.EIO), str(path))
        if kind == "torn" and half is not None:
            half()
        elif kind not in ("before", "torn"):
            act()
        if kind in _OF_PROCESS:
            os.kill(os.getpid(), signal.SIGKILL)
        self._end_machine()

    def changed(self, undo: list[tuple[str, ...]], *paths: Path) -> None:
        """Remember a change of names in one folder."""
        self._changes.append(Change(paths[0].parent, paths, undo))

    def synced(self, folder: Path) -> None:
        """Make the names in a folder durable."""
        self._changes = [each for each in self._changes if each.folder != folder]

    def kept(self, path: Path) -> list[tuple[str, ...]]:
        """Keep a file that is about to lose its name; return how to give the name back."""
        if not path.exists():
            return []
        control = self._fault.control
        kept = control / f"kept-{os.getpid()}-{sum(1 for _ in control.iterdir())}"
        kept.hardlink_to(path)
        return [("move", str(kept), str(path))]

    def _number(self, name: str, path: Path) -> int:
        losing = [bool(each) for each in (self._changes, self.durable, self._undo("newest"))]
        line = f"{name} {path.name} {' '.join('01'[each] for each in losing)}"
        _WRITE(self._log, f"{line:{_LINE - 1}}\n".encode())
        return os.lseek(self._log, 0, os.SEEK_CUR) // _LINE

    def _undo(self, kind: str) -> list[tuple[str, ...]]:
        """Return how to take back the names that a crash of this kind loses."""
        lost = self._changes if kind == "lost" else []
        if kind == "newest" and self._changes:
            *older, newest = self._changes
            # A file in a new folder, or a renamed new file, cannot outlive what it depends on.
            depends = any(
                path.is_relative_to(other)
                for path in newest.paths
                for each in older
                for other in each.paths
            )
            lost = [] if depends else older
        return [each for change in reversed(lost) for each in change.undo]

    def _end_machine(self) -> NoReturn:
        """Write down what is lost, and end all processes of the command."""
        kind = self._fault.kind
        contents = {inode: data.hex() for inode, data in self.durable.items()}
        if kind == "newest":
            contents = {}
        if kind == "halved":
            files = (path for path in self._fault.watched.rglob("*") if path.is_file())
            data = {path.stat().st_ino: path.read_bytes() for path in files}
            contents = {
                inode: data[inode][: len(data[inode]) // 2].hex()
                for inode in self.durable
                if inode in data
            }
        (self._fault.control / "plan").write_text(json.dumps([self._undo(kind), contents]))
        os.killpg(0, signal.SIGKILL)
        raise AssertionError("survived SIGKILL")
