"""Standard output and error that cannot end a run, be they closed, full or of few characters."""

from __future__ import annotations

import codecs
import io
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO, cast

#: What stands for a character that an encoding lacks; others are escaped, such as \u2192.
_PLAIN = {"±": "+-", "…": "...", "−": "-", "·": "*", "×": "x", "§": "Section "}
_STREAMS = ("stdout", "stderr")


def open_streams() -> None:
    """Give the process both output streams, and have them write every character.

    Without this, the first file that is opened in a process without standard output would be what
    libraries take for it.
    """
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            opened = os.open(os.devnull, os.O_RDWR)
            os.dup2(opened, number)  # the copy is inherited by processes that this one starts
            if opened != number:
                os.close(opened)
            else:
                os.set_inheritable(number, True)
    for name in _STREAMS:
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_WRONLY), "w", encoding="utf-8"))
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="ril.plain")


def _plainly(error: UnicodeError) -> tuple[str | bytes, int]:
    """Replace a character that the encoding lacks; the bytes of a file's name stay as they are."""
    assert isinstance(error, UnicodeEncodeError)
    character = error.object[error.start]
    if 0xDC80 <= ord(character) <= 0xDCFF:  # a byte that is not UTF-8, as Python reads it
        return bytes([ord(character) - 0xDC00]), error.start + 1
    escaped = character.encode("ascii", "backslashreplace").decode()
    return _PLAIN.get(character, escaped), error.start + 1


codecs.register_error("ril.plain", _plainly)


@contextmanager
def written(command: str) -> Iterator[None]:
    """Exit with status 1 if the output of the block, which is a whole command, cannot be written.

    Args:
        command: the command's name, for the message.

    Raises:
        SystemExit: the output cannot be written; without a message if its reader has ended, such
            as `head`.
    """
    open_streams()
    failed: OSError | None = None
    try:
        yield
    except BrokenPipeError:
        discard(sys.stdout)
        sys.exit(1)
    finally:
        try:
            sys.stdout.flush()
        except OSError as error:
            failed = error
            discard(sys.stdout)
    if failed is not None:  # and the command itself has ended well
        is_unread = isinstance(failed, BrokenPipeError)
        why = f"{command}: the output cannot be written ({failed.strerror})"
        sys.exit(1 if is_unread else why)


@contextmanager
def unfailing(command: str) -> Iterator[None]:
    """Drop what cannot be written to standard output and error in the block, and continue.

    A line on standard error says so, if that can be written.

    Args:
        command: the command's name, for that line.
    """
    open_streams()
    before = {name: getattr(sys, name) for name in _STREAMS}
    streams = {name: _Unfailing(stream, name, command) for name, stream in before.items()}
    for name, stream in streams.items():
        setattr(sys, name, stream)
    try:
        yield
    finally:
        for name, stream in streams.items():
            if getattr(sys, name) is stream:
                setattr(sys, name, before[name])
            stream.flush()
            if stream.failed:
                discard(before[name])


def discard(stream: TextIO) -> None:
    """Send what a stream has not written, and whatever follows, to nowhere.

    Otherwise the interpreter would fail at its end, when it writes the rest.
    """
    with suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


class _Unfailing:
    """A text stream whose `write` and `flush` raise no error.

    Attributes:
        failed: whether something could not be written.
    """

    def __init__(self, stream: TextIO, name: str, command: str) -> None:
        self._stream, self._name, self._command = stream, name, command
        self.failed = False

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write a text if possible."""
        try:
            return self._stream.write(text)
        except (OSError, ValueError) as error:  # ValueError: it is closed
            self._fail(error)
            return len(text)

    def flush(self) -> None:
        """Flush the stream if possible."""
        try:
            self._stream.flush()
        except (OSError, ValueError) as error:
            self._fail(error)

    def _fail(self, error: Exception) -> None:
        if self.failed:
            return
        self.failed = True
        if self._name == "stdout":
            why = getattr(error, "strerror", None) or error
            line = f"{self._command}: the output cannot be written ({why}); continuing without it"
            print(line, file=cast(TextIO, sys.stderr), flush=True)
