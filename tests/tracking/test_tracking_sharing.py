"""Short tasks run in parallel by the calling thread and those of an executor."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from jawusd.tracking.contour import solver
from jawusd.tracking.contour.solver import ParallelMap

PATIENCE_S = 60


@pytest.fixture
def pool(monkeypatch):
    monkeypatch.setattr(solver.os, "cpu_count", lambda: 3)
    with ThreadPoolExecutor(2) as pool:
        yield pool


def test_results_come_in_the_order_of_the_items(pool):
    share = ParallelMap(pool)
    for count in (0, 1, 2, 100):
        assert list(share(lambda k: k * k, range(count))) == [k * k for k in range(count)]
    second = threading.Event()

    def first_last(k):
        return second.set() if k else second.wait(PATIENCE_S)

    assert list(share(first_last, range(2))) == [True, None]


def test_all_cores_work_at_once(pool):
    meeting = threading.Barrier(3)
    assert len(set(ParallelMap(pool)(lambda _: (meeting.wait(PATIENCE_S), threading.get_ident()), range(3)))) == 3


def test_a_single_task_wakes_no_thread(pool):
    own = threading.get_ident()
    assert list(ParallelMap(pool)(lambda _: threading.get_ident(), [0])) == [own]
    assert not pool._threads


def test_busy_threads_are_not_waited_for(pool):
    begin, end = threading.Barrier(3), threading.Event()
    busy = [pool.submit(lambda: (begin.wait(PATIENCE_S), end.wait(PATIENCE_S))) for _ in range(2)]
    begin.wait(PATIENCE_S)
    own = threading.get_ident()
    assert set(ParallelMap(pool)(lambda _: threading.get_ident(), range(5))) == {own}
    end.set()
    assert all(one.result()[1] for one in busy)


@pytest.mark.parametrize("elsewhere", [False, True])
def test_an_error_of_any_thread_is_raised_and_remaining_tasks_are_not_started(pool, elsewhere):
    own, meeting, done = threading.get_ident(), threading.Barrier(3), []

    def task(k):
        if k < 3:  # one for each thread
            meeting.wait(PATIENCE_S)
            if (threading.get_ident() != own) == elsewhere:
                raise ValueError(f"task {k}")
        else:
            time.sleep(0.01)  # ten seconds in all
        done.append(k)

    with pytest.raises(ValueError, match="task"):
        ParallelMap(pool)(task, range(1000))
    assert len(done) < 100
