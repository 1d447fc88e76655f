"""Objects that work side by side in processes of their own, such as agents of different seeds."""

from __future__ import annotations

import atexit
import multiprocessing
import pickle
import signal
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any, Concatenate, Generic, TypeVar

import joblib

from ril.io.errors import UserError
from ril.io.signals import SIGNALS

T = TypeVar("T")
R = TypeVar("R")

#: Arguments of a call besides the object, a row per object.
Rows = Sequence[tuple[Any, ...]]


def usable_processes(wanted: int | None) -> int:
    """How many processes a run may use; None wants one per core.

    A run that is part of a sweep is itself one of several processes, and uses no other.
    """
    if multiprocessing.parent_process() is not None:
        return 1
    return wanted or int(joblib.cpu_count())


class Spread(Generic[T]):
    """Objects that live in worker processes, each always in the same one.

    Ctrl-C, SIGTERM and SIGHUP are left to the process that made them; the workers end with that,
    or with this object. What goes to them and comes back is copied.

    Args:
        builders: make the objects, there where they are to live.
        processes: workers at most; with 1 there are none, and the objects live here.

    Raises:
        Exception: what a builder raised.
    """

    def __init__(self, builders: Sequence[Callable[[], T]], processes: int) -> None:
        count = min(processes, len(builders))
        self._here: list[T] = []
        self._workers = [_start_worker() for _ in range(count)] if count > 1 else []
        self._ask(_build, [(builders[index::count],) for index in range(count)])
        self._objects = len(builders)

    def each(
        self, function: Callable[Concatenate[T, ...], R], *arguments: Sequence[Any]
    ) -> list[R]:
        """Call a function with each object, where that lives.

        Args:
            function: of a module or a class; takes the object first.
            *arguments: what else it takes; of each an entry per object.

        Returns:
            What it returned, in the order of the objects.

        Raises:
            UserError: a worker was killed.
            Exception: what the function raised.
        """
        rows = list(zip(*arguments, strict=True)) if arguments else [()] * self._objects
        count = max(1, len(self._workers))
        answers = self._ask(_call, [(function, rows[index::count]) for index in range(count)])
        return [answers[index % count][index // count] for index in range(self._objects)]

    def _ask(self, work: Callable[..., Any], requests: Rows) -> list[Any]:
        """Have the workers work on a request each, all at once."""
        if not self._workers:
            return [work(self._here, *request) for request in requests]
        # Pickled here, since a Connection would share a tensor's memory instead of copying it.
        try:
            for worker, request in zip(self._workers, requests, strict=True):
                worker.send_bytes(pickle.dumps((work, request)))
            answers = [pickle.loads(worker.recv_bytes()) for worker in self._workers]
        except (EOFError, ConnectionError):
            raise UserError(
                "a worker process was killed; with processes=1 there are none"
            ) from None
        for answer in answers:
            if isinstance(answer, Exception):
                raise answer
        return answers


def _build(objects: list[T], builders: Sequence[Callable[[], T]]) -> None:
    objects += [build() for build in builders]


def _call(objects: list[T], function: Callable[Concatenate[T, ...], R], rows: Rows) -> list[R]:
    return [function(each, *row) for each, row in zip(objects, rows, strict=True)]


def _start_worker() -> Connection:
    """A new process that works as `_ask` says, until the other end of its pipe is gone."""
    context = multiprocessing.get_context("spawn")  # a fork of torch's threads may hang
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(theirs,))
    process.start()
    theirs.close()
    # Python's exit waits for its processes; one that is stopped at once is not to.
    atexit.register(process.kill)
    return ours


def _work(connection: Connection) -> None:
    """What a worker does."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    import torch  # takes seconds, in which signals are to be ignored already

    torch.set_num_threads(1)
    objects: list[Any] = []
    with suppress(EOFError, ConnectionError):
        while True:
            request = connection.recv_bytes()
            try:
                work, arguments = pickle.loads(request)
                answer = pickle.dumps(work(objects, *arguments))
            except Exception as error:
                error.add_note(f"In a worker process:\n{traceback.format_exc()}")
                answer = pickle.dumps(error)
            connection.send_bytes(answer)
