"""Ctrl-C and SIGTERM, made to wait for a moment at which nothing is lost."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from signal import SIGINT, SIGTERM


@contextmanager
def stop_between_epochs() -> Iterator[threading.Event]:
    """Have Ctrl-C and SIGTERM wait for the end of the epoch; a second one does not wait."""
    stop = threading.Event()

    def on_signal(*_: object) -> None:
        if stop.is_set():
            raise KeyboardInterrupt("stopped at once")
        stop.set()

    if threading.current_thread() is not threading.main_thread():
        yield stop  # signals are not ours to handle
        return
    before = {number: signal.signal(number, on_signal) for number in (SIGINT, SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
