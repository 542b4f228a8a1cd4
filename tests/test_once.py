"""Values that are worked out once, and beside other work."""

import threading

import pytest

from piccolo.jobs.once import Once
from piccolo.jobs.threads import Workers


def test_a_value_is_worked_out_once_whoever_asks():
    asked, may_end = [], threading.Event()

    def work():
        asked.append(threading.current_thread())
        may_end.wait(10.0)
        return object()

    once, found = Once(work), []
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
    begun, may_end, by = threading.Event(), threading.Event(), []

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
