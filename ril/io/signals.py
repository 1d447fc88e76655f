"""Ctrl-C, SIGTERM and SIGHUP, deferred to a moment at which no work is lost."""

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
    """A signal stopped a run.

    Args:
        message: where the run stopped and how to resume it, in one line.
        number: the signal's number.

    Attributes:
        number: the signal's number.
        exit_status: exit status of the command: 128 + the signal's number, as shells count.
    """

    def __init__(self, message: str, number: int) -> None:
        super().__init__(message)
        self.number = number
        self.exit_status = 128 + number


class StopRequest:
    """Whether a signal has asked the run to stop.

    Attributes:
        number: number of the first signal; None before it.
        immediate: whether a signal raises `Stopped` at once; set it while there is no work to lose.
    """

    def __init__(self) -> None:
        self.number: int | None = None
        self.immediate = False

    def on_signal(self, number: int, _: object) -> None:
        """Record the first signal; raise at the second one, or at once if `immediate`.

        Args:
            number: the signal's number.

        Raises:
            Stopped: the run must stop now.
        """
        if self.immediate or self.number is not None:
            raise Stopped("stopped immediately", number)
        self.number = number


@contextmanager
def stop_on_signals() -> Iterator[StopRequest]:
    """Record signals in the block instead of stopping at them; a second signal stops at once.

    Signals that the process ignores stay ignored, such as SIGHUP under nohup. Outside the main
    thread, which alone can handle signals, this does nothing.

    Returns:
        The request, for the block to check wherever it can stop without losing work.
    """
    request = StopRequest()
    if threading.current_thread() is not threading.main_thread():
        yield request
        return
    handled = [number for number in SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, request.on_signal) for number in handled}
    try:
        yield request
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
