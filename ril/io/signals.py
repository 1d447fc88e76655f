"""Ctrl-C, SIGTERM and SIGHUP, made to wait for a moment at which nothing is lost."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

#: A terminal that closes sends SIGHUP, which Windows does not have.
SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)


class Stopped(KeyboardInterrupt):
    """A signal ended a run.

    Args:
        said: in one line, where it ended and how it goes on.
        number: of the signal.

    Attributes:
        status: to exit with, as a shell would say it: 128 and the signal's number.
    """

    def __init__(self, said: str, number: int) -> None:
        super().__init__(said)
        self.number = number
        self.status = 128 + number


class Stop:
    """Whether a run is asked to stop.

    Attributes:
        number: of the signal that asked; None before.
        at_once: whether a signal does not wait, since nothing would be lost.
    """

    def __init__(self) -> None:
        self.number: int | None = None
        self.at_once = False

    def on_signal(self, number: int, _: object) -> None:
        """Remember a first signal; raise `Stopped` at a second, or if none is to wait."""
        if self.at_once or self.number is not None:
            raise Stopped("stopped at once", number)
        self.number = number


@contextmanager
def stop_on_signals() -> Iterator[Stop]:
    """Have signals wait until they are asked for; a second one does not wait.

    Those that are ignored stay so, as nohup has SIGHUP.
    """
    stop = Stop()
    if threading.current_thread() is not threading.main_thread():
        yield stop  # signals are not ours to handle
        return
    heeded = [number for number in SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, stop.on_signal) for number in heeded}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
