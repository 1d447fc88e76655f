from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from functools import partial

import pytest
import torch
from joblib import Parallel, delayed

from ril.io.errors import UserError
from ril.vectorized.processes import WorkerPool, usable_processes


class Counter:
    """Something with a state."""

    def __init__(self, start: int) -> None:
        if start < 0:
            raise UserError(f"start={start}: must be 0 or more")
        self.count = start

    def add(self, amount: int) -> int:
        if amount < 0:
            raise UserError(f"amount={amount}: must be 0 or more")
        self.count += amount
        return self.count


def process_of(counter: Counter) -> int:
    return os.getpid()


def threads_of(counter: Counter) -> int:
    return torch.get_num_threads()


def signalled(counter: Counter, number: int) -> int:
    """What a worker answers after a signal."""
    os.kill(os.getpid(), number)
    return counter.count


def killed(counter: Counter) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def spread(starts: list[int], processes: int) -> WorkerPool[Counter]:
    return WorkerPool([partial(Counter, start) for start in starts], processes)


@pytest.fixture(scope="module")
def two() -> WorkerPool[Counter]:
    """Three counters in two workers, which take seconds to start."""
    return spread([10, 20, 30], 2)


def runs(process: int) -> bool:
    """Whether it does; of one that ended, its parent may not have noticed."""
    state = subprocess.run(
        ["ps", "-o", "stat=", "-p", str(process)], capture_output=True, text=True
    )
    return state.stdout.strip()[:1] not in ("", "Z")


def ends(process: int) -> bool:
    """Whether a process ends within ten seconds."""
    for _ in range(100):
        if not runs(process):
            return True
        time.sleep(0.1)
    return False


def test_objects_are_spread_evenly_and_stay_where_they_are(two: WorkerPool[Counter]) -> None:
    first, second, third = two.each(process_of)
    assert first == third != second
    assert os.getpid() not in (first, second)
    assert two.each(process_of) == [first, second, third]


@pytest.mark.parametrize("processes", [1, 3])
def test_what_lives_alone_or_in_one_process_lives_here(processes: int) -> None:
    starts = [10, 20, 30] if processes == 1 else [10]
    assert set(spread(starts, processes).each(process_of)) == {os.getpid()}


def test_objects_keep_their_state_and_their_order(two: WorkerPool[Counter]) -> None:
    here = spread([10, 20, 30], 1)
    before = [0, 0, 0]
    for amounts in ([1, 2, 3], [10, 20, 30]):
        assert here.each(Counter.add, amounts) == [
            start + given + amount
            for start, given, amount in zip([10, 20, 30], before, amounts, strict=True)
        ]
        before = [given + amount for given, amount in zip(before, amounts, strict=True)]
    there = [two.each(Counter.add, amounts) for amounts in ([1, 2, 3], [10, 20, 30])]
    assert there == [[11, 22, 33], [21, 42, 63]]


def test_a_worker_uses_one_thread(two: WorkerPool[Counter]) -> None:
    assert two.each(threads_of) == [1, 1, 1]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_worker_leaves_signals_to_its_parent(two: WorkerPool[Counter], number: int) -> None:
    before = two.each(process_of)
    assert two.each(signalled, [number] * 3) == two.each(Counter.add, [0, 0, 0])
    assert two.each(process_of) == before


def test_an_error_arrives_as_itself_and_the_others_keep_working(two: WorkerPool[Counter]) -> None:
    counts = two.each(Counter.add, [0, 0, 0])
    with pytest.raises(UserError) as raised:
        two.each(Counter.add, [0, -1, 0])
    assert str(raised.value) == "amount=-1: must be 0 or more"
    assert "in add" in raised.value.__notes__[0]  # where it was raised
    assert two.each(Counter.add, [0, 0, 0]) == counts


def test_an_error_while_an_object_is_made_arrives() -> None:
    with pytest.raises(UserError, match=r"^start=-2: must be 0 or more"):
        spread([1, -2], 2)


def test_a_worker_that_is_killed_is_one_clear_mistake_and_the_other_ends() -> None:
    pool = spread([1, 2], 2)
    workers = pool.each(process_of)
    with pytest.raises(UserError, match=r"a worker process was killed.*processes=1"):
        pool.each(killed)
    del pool
    assert all(ends(worker) for worker in workers)


def test_workers_end_with_what_they_work_for() -> None:
    pool = spread([1, 2], 2)
    workers = pool.each(process_of)
    assert all(runs(worker) for worker in workers)
    del pool
    assert all(ends(worker) for worker in workers)


PARENT = """
import signal, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job ignores it
from test_processes import process_of, spread, wait_long
kept = spread([1, 2], 2)
print(*kept.each(process_of), flush=True)
{then}
"""


def wait_long(counter: Counter) -> None:
    """Work on which nobody should have to wait."""
    time.sleep(60)


@pytest.mark.parametrize(
    ("then", "number"),
    [
        ("time.sleep(60)", signal.SIGKILL),
        ("raise ValueError", None),
        ("kept.each(wait_long)", signal.SIGINT),
    ],
    ids=["killed", "raises", "interrupted while they work"],
)
def test_workers_end_with_their_parent(then: str, number: int | None) -> None:
    folder = os.path.dirname(__file__)  # noqa: PTH120
    parent = subprocess.Popen(
        [sys.executable, "-c", PARENT.format(then=then)],
        env=os.environ | {"PYTHONPATH": os.pathsep.join([folder, *sys.path])},
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    try:
        assert parent.stdout is not None
        workers = [int(process) for process in parent.stdout.readline().split()]
        assert len(workers) == 2
        time.sleep(0.2)
        if number is not None:
            parent.send_signal(number)
        parent.wait(timeout=20)
    finally:
        parent.kill()
        parent.communicate()
    assert all(ends(worker) for worker in workers)


def test_a_run_may_use_every_core_or_as_many_as_asked() -> None:
    assert usable_processes(3) == 3
    assert usable_processes(None) >= 1


def test_a_run_of_a_sweep_uses_its_own_process_only() -> None:
    assert Parallel(n_jobs=2)(delayed(usable_processes)(wanted) for wanted in (3, None)) == [1, 1]
