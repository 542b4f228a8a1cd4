"""Threads, and those of BLAS."""

import multiprocessing
import sys
import threading
import warnings
from contextlib import ExitStack

import numpy as np
import pytest
import rooms
from threadpoolctl import threadpool_info, threadpool_limits

from piccolo.localization import run as method
from piccolo.problem.settings import CoarseToFineSettings
from piccolo.system.jobs import threads
from piccolo.system.jobs.threads import Once, Workers, one_blas_thread

TIER = "scene"


@pytest.mark.parametrize("num_threads", [1, 3])
def test_results_come_in_order_and_an_error_ends_the_display_before_it_is_raised(num_threads):
    seen = []

    def show(values, total, label):
        yield from values
        seen.append((total, label))

    workers = Workers(num_threads, show)
    assert workers.map(lambda i: i * i, range(20), "squares") == [i * i for i in range(20)]
    with pytest.raises(ZeroDivisionError):
        workers.map(lambda i: 1 // i, [2, 1, 0, 3], "work")
    assert seen == [(20, "squares"), (4, "work")]


def test_an_error_drops_what_has_not_begun():
    begun = []
    gate = threading.Event()

    def work(i):
        begun.append(i)
        if i == 0:
            raise ValueError("first")
        gate.wait(0.5)

    with pytest.raises(ValueError, match="first"):
        list(Workers(2).map(work, range(1000), "work"))
    assert len(begun) < 10  # what the two threads had begun


def test_threads_are_kept_and_work_within_work_is_done_by_the_same_one():
    workers = Workers(2)
    both = threading.Barrier(2, timeout=60)

    def within(_):
        both.wait()
        inner = set(workers.map(lambda _: threading.get_ident(), range(4), "within"))
        assert inner == {threading.get_ident()}
        return threading.get_ident()

    first, second = (set(workers.map(within, range(2), "work")) for _ in range(2))
    assert first == second
    assert len(first) == 2
    assert threading.get_ident() not in first


def test_one_callers_work_may_wait_for_anothers():
    is_done = threading.Event()
    workers = Workers(2)

    def other():
        list(workers.map(lambda _: None, range(4), "other"))
        is_done.set()

    def wait_for_other(k):
        if k == 0:
            caller.start()
        return is_done.wait(60)

    caller = threading.Thread(target=other)
    assert all(workers.map(wait_for_other, range(2), "work"))
    caller.join()


@pytest.mark.process
def test_a_forked_process_has_threads_of_its_own():
    workers = Workers(2)
    list(workers.map(abs, range(4), "before"))
    child = multiprocessing.get_context("fork").Process(
        target=lambda: sys.exit(sum(workers.map(abs, range(4), "in the child")))
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a fork beside threads, which is what is tried
        child.start()
    child.join(60)
    assert child.exitcode == 6


def test_a_burst_of_callers_leaves_no_more_threads_than_the_cores_have_use_for():
    most = max(threads.num_cores(), 2)
    with ExitStack() as stack:
        pools = [stack.enter_context(threads.get_pool(2)) for _ in range(most + 3)]
        assert [pool.submit(abs, -1).result() for pool in pools] == [1] * len(pools)
    assert len(threads._idle[2]) == most
    with threads.get_pool(2) as pool:
        assert pool.submit(abs, -1).result() == 1


def test_a_value_is_worked_out_once_whoever_asks():
    asked = []
    may_end = threading.Event()

    def work():
        asked.append(threading.current_thread())
        may_end.wait(10.0)
        return object()

    once = Once(work)
    found = []
    threads = [threading.Thread(target=lambda: found.append(once())) for _ in range(8)]
    for thread in threads:
        thread.start()
    may_end.set()
    for thread in threads:
        thread.join()
    assert len(asked) == 1
    assert len(found) == 8
    assert all(value is found[0] for value in [*found, once()])


def test_what_is_raised_is_raised_and_asked_again():
    left = [ValueError("no"), None]

    def work():
        if error := left.pop(0):
            raise error
        return 7

    once = Once(work)
    with pytest.raises(ValueError, match="no"):
        once()
    assert once() == once() == 7


def test_values_are_worked_out_beside_other_work_and_none_is_left_running():
    begun = threading.Event()
    may_end = threading.Event()
    by = []

    def first():
        begun.set()
        may_end.wait(10.0)
        by.append(threading.current_thread())

    values = Once(first), Once(lambda: by.append("second"))
    with Workers(2).beside(*values):
        assert begun.wait(10.0)
        may_end.set()
        values[1]()  # whoever comes first
    assert by.count("second") == 1
    assert [each for each in by if each != "second"] != [threading.current_thread()]
    assert len(by) == 2


def test_one_thread_works_out_nothing_that_nobody_asks_for():
    asked = []
    with Workers(1).beside(Once(lambda: asked.append(1))):
        pass
    list(Workers(2).map(lambda k: _inside(asked), range(2), "nested"))
    assert asked == []


def _inside(asked):
    with Workers(2).beside(Once(lambda: asked.append(2))):
        pass


def test_an_error_beside_other_work_reaches_who_asks_alone():
    def fail():
        raise ValueError("beside")

    once = Once(fail)
    with Workers(2).beside(once):
        pass
    with pytest.raises(ValueError, match="beside"):
        once()


def _threads():
    np.ones((8, 8)) @ np.ones((8, 8))
    return {info["num_threads"] for info in threadpool_info() if info["user_api"] == "blas"}


@pytest.fixture
def three_threads():
    """As a user may have asked for, whatever the machine has."""
    with threadpool_limits(3, user_api="blas"):
        before = _threads()
        yield before
        assert _threads() == before


def test_within_is_one_thread_until_the_last_is_out(three_threads):
    inside, go_on = threading.Event(), threading.Event()

    def stay():
        with one_blas_thread():
            inside.set()
            assert go_on.wait(60)

    other = threading.Thread(target=stay)
    with one_blas_thread():
        other.start()
        assert inside.wait(60)
        assert _threads() == {1}
    assert _threads() == {1}
    go_on.set()
    other.join()
    assert _threads() == three_threads


def test_an_error_gives_them_back(three_threads):
    with pytest.raises(ValueError, match="broken"), one_blas_thread():
        raise ValueError("broken")
    assert _threads() == three_threads


def test_a_photo_is_localized_with_one(three_threads):
    seen = set()

    def show(values, total, label):
        seen.add((label, *_threads()))
        yield from values

    settings = CoarseToFineSettings(gravity="known")
    method.localize(rooms.scan_map(1), rooms.scene(1)[1], settings, rooms.means(settings, Workers(2, show)))
    assert {("search", 1), ("evaluate", 1)} <= seen
    assert all(counts == [1] for _, *counts in seen)
