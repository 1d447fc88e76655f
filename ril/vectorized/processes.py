"""A pool of worker processes, each of which holds some objects, such as agents of some seeds."""

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

#: Further arguments of a call, a row per object.
Rows = Sequence[tuple[Any, ...]]


def usable_processes(wanted: int | None) -> int:
    """Decide how many processes a run may use.

    A run of a sweep is itself one of several processes, so it uses no others.

    Args:
        wanted: number of processes; None is one per core.
    """
    if multiprocessing.parent_process() is not None:
        return 1
    return wanted or int(joblib.cpu_count())


class WorkerPool(Generic[T]):
    """Objects that live in worker processes, each always in the same one.

    The workers ignore Ctrl-C, SIGTERM and SIGHUP, which the main process handles; they end with
    it, or with this object. Arguments and results are copied.

    Args:
        builders: functions that make the objects; each is called in its worker.
        processes: the most workers to start; 1 starts none and keeps the objects in this process.

    Raises:
        Exception: a builder raised it.
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
        """Call a function with each object, in the worker that holds it.

        Args:
            function: a function of a module or class, whose first argument is the object.
            *arguments: its further arguments, each with an entry per object.

        Returns:
            The results, in the order of the objects.

        Raises:
            UserError: a worker was killed.
            Exception: the function raised it.
        """
        rows = list(zip(*arguments, strict=True)) if arguments else [()] * self._objects
        count = max(1, len(self._workers))
        answers = self._ask(_call, [(function, rows[index::count]) for index in range(count)])
        return [answers[index % count][index // count] for index in range(self._objects)]

    def _ask(self, work: Callable[..., Any], requests: Rows) -> list[Any]:
        """Send each worker one request, and wait for all answers."""
        if not self._workers:
            return [work(self._here, *request) for request in requests]
        # Pickled here, because a Connection would share a tensor's memory instead of copying it.
        try:
            for worker, request in zip(self._workers, requests, strict=True):
                worker.send_bytes(pickle.dumps((work, request)))
            answers = [pickle.loads(worker.recv_bytes()) for worker in self._workers]
        except (EOFError, ConnectionError):
            raise UserError(
                "a worker process was killed, perhaps for lack of memory; processes=1 uses none"
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
    """Start a process that answers requests of `_ask` until the other end of its pipe closes."""
    context = multiprocessing.get_context("spawn")  # forking a process with threads may hang
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(theirs,))
    process.start()
    theirs.close()
    # Python waits for its child processes at exit; an interrupted run must not wait.
    atexit.register(process.kill)
    return ours


def _work(connection: Connection) -> None:
    """Answer requests from a connection until it closes."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    import torch  # after the above, because it takes seconds, in which signals may arrive

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
