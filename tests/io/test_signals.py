from __future__ import annotations

import os
import signal
import threading

import pytest

from ril.io.signals import SIGNALS, Stopped, stop_on_signals


@pytest.mark.parametrize("number", SIGNALS)
def test_a_first_signal_waits(number: int) -> None:
    with stop_on_signals() as stop:
        assert stop.number is None
        signal.raise_signal(number)
        assert stop.number == number


@pytest.mark.parametrize("first", SIGNALS)
@pytest.mark.parametrize("second", SIGNALS)
def test_a_second_one_does_not(first: int, second: int) -> None:
    with stop_on_signals():
        signal.raise_signal(first)
        with pytest.raises(Stopped, match=r"^stopped at once$") as stopped:
            signal.raise_signal(second)
    assert stopped.value.number == second


@pytest.mark.parametrize("number", SIGNALS)
def test_where_nothing_is_to_be_lost_none_waits(number: int) -> None:
    with stop_on_signals() as stop:
        stop.at_once = True
        with pytest.raises(Stopped) as stopped:
            signal.raise_signal(number)
    assert stopped.value.status == 128 + number


@pytest.mark.parametrize("number", SIGNALS)
def test_afterwards_signals_are_handled_as_before(number: int) -> None:
    before = signal.getsignal(number)
    with stop_on_signals():
        assert signal.getsignal(number) is not before
    assert signal.getsignal(number) is before


def test_a_signal_that_is_ignored_stays_so() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    try:
        with stop_on_signals() as stop:
            os.kill(os.getpid(), signal.SIGHUP)
            assert stop.number is None
    finally:
        signal.signal(signal.SIGHUP, before)


def test_beside_the_main_thread_signals_are_left_alone() -> None:
    handlers = []

    def watch() -> None:
        with stop_on_signals():
            handlers.extend(signal.getsignal(number) for number in SIGNALS)

    before = [signal.getsignal(number) for number in SIGNALS]
    thread = threading.Thread(target=watch)
    thread.start()
    thread.join()
    assert handlers == before
