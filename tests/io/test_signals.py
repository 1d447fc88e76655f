from __future__ import annotations

import os
import signal
import threading

import pytest

from ril.io.signals import SIGNALS, Stopped, stop_on_signals


@pytest.mark.parametrize("number", SIGNALS)
def test_a_first_signal_is_recorded(number: int) -> None:
    with stop_on_signals() as stop:
        assert stop.number is None
        signal.raise_signal(number)
        assert stop.number == number


@pytest.mark.parametrize("first", SIGNALS)
@pytest.mark.parametrize("second", SIGNALS)
def test_a_second_signal_stops_immediately(first: int, second: int) -> None:
    with stop_on_signals():
        signal.raise_signal(first)
        with pytest.raises(Stopped, match=r"^stopped immediately$") as stopped:
            signal.raise_signal(second)
    assert stopped.value.number == second


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_stops_immediately_if_no_work_is_lost(number: int) -> None:
    with stop_on_signals() as stop:
        stop.immediate = True
        with pytest.raises(Stopped) as stopped:
            signal.raise_signal(number)
    assert stopped.value.exit_status == 128 + number


@pytest.mark.parametrize("number", SIGNALS)
def test_after_the_block_signals_are_handled_as_before(number: int) -> None:
    before = signal.getsignal(number)
    with stop_on_signals():
        assert signal.getsignal(number) is not before
    assert signal.getsignal(number) is before


def test_an_ignored_signal_stays_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    try:
        with stop_on_signals() as stop:
            os.kill(os.getpid(), signal.SIGHUP)
            assert stop.number is None
    finally:
        signal.signal(signal.SIGHUP, before)


def test_outside_the_main_thread_signals_are_left_alone() -> None:
    handlers = []

    def watch() -> None:
        with stop_on_signals():
            handlers.extend(signal.getsignal(number) for number in SIGNALS)

    before = [signal.getsignal(number) for number in SIGNALS]
    thread = threading.Thread(target=watch)
    thread.start()
    thread.join()
    assert handlers == before
