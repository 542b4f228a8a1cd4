"""Items worked on in processes, some of which are killed."""

import os
import queue
import signal
import subprocess
import sys
from contextlib import closing
from functools import partial

import pytest
from batches import ROOT

from piccolo.system.errors import InputError
from piccolo.system.jobs.processes import IN_FLIGHT, LIBRARIES, Here, Processes, WorkerLostError

TIER = "process"


def _die():
    os.kill(os.getpid(), signal.SIGKILL)


def _square(folder, item):
    """The square; 5 kills its process always, 7 once, and 9 is an error."""
    if item == 5 or (item == 7 and not (folder / "seven").exists()):
        (folder / "seven").touch()
        _die()
    if item == 9:
        raise InputError("nine")
    return item * item


def _squares(folder):
    return partial(_square, folder)


def _told():
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, [])
    return lambda item: (os.environ[item], signal.SIGINT in blocked, signal.SIGTERM in blocked)


def _refused():
    raise InputError("no scan")


class _OddError(Exception):
    """Can be pickled, but not made again."""

    def __init__(self, first, second):
        super().__init__(first + second)


def _odd():
    raise _OddError("no ", "scan")


def _outcome(wait):
    try:
        return wait()
    except (InputError, WorkerLostError) as error:
        return f"{type(error).__name__}: {error}"


def test_values_come_in_order_and_a_killed_process_costs_one_at_most(tmp_path):
    lost = "WorkerLostError: each of 2 processes at work on it was killed by SIGKILL"
    expected = [k * k for k in range(12)]
    expected[5] = lost
    expected[9] = "InputError: nine"
    with closing(Processes(partial(_squares, tmp_path), 2)) as processes:
        pairs = [(item, _outcome(wait)) for item, wait in processes.values(iter(range(12)))]
    assert pairs == list(enumerate(expected))
    here = Here(_squares(tmp_path)).values(iter([1, 9, 2]))
    assert [_outcome(wait) for _, wait in here] == [1, "InputError: nine", 4]
    assert list(here.take_finished()) == []


def test_an_error_brings_its_traceback(tmp_path):
    with closing(Processes(partial(_squares, tmp_path), 1)) as processes:
        ((_, wait),) = processes.values(iter([9]))
        with pytest.raises(InputError, match="nine") as error:
            wait()
    assert "in _square" in str(error.value.__cause__)


def test_few_items_are_under_way_and_one_awaited_keeps_nobody(tmp_path):
    names = queue.SimpleQueue()
    taken = []

    def items():
        while (item := names.get()) is not None:
            taken.append(item)
            yield item

    with closing(Processes(partial(_squares, tmp_path), 1)) as processes:
        values = processes.values(items())
        pairs = iter(values)
        for item in (2, 3):  # each is answered before the next is there
            names.put(item)
            found, wait = next(pairs)
            assert (found, wait()) == (item, item * item)
        for item in range(10, 110):
            names.put(item)
        names.put(None)
        _, wait = next(pairs)
        assert wait() == 100
        assert len(taken) <= 2 + IN_FLIGHT + 2
        assert [wait() for _, wait in pairs] == [k * k for k in range(11, 110)]


def test_what_is_done_behind_the_last_value_taken_can_be_had(tmp_path):
    with closing(Processes(partial(_squares, tmp_path), 1)) as processes:
        values = processes.values(iter([1, 2, 3, 4]))
        next(iter(values))
        values._pairs[2][1].result()  # the last; a process works in order
        assert [(item, wait()) for item, wait in values.take_finished()] == [(2, 4), (3, 9), (4, 16)]


def check_threads_and_signals():
    """Processes have their threads, and leave signals to their parent."""
    with closing(Processes(_told, 1, num_threads=3)) as processes:
        names = ["OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"]
        found = [wait() for _, wait in processes.values(iter(names))]
    assert found == [(os.environ.get(name, "3"), True, True) for name in names]


def test_processes_leave_signals_to_their_parent_from_the_first_of_all_on():
    code = "import test_processes as t; t.check_threads_and_signals()"
    own = {name: value for name, value in os.environ.items() if name not in LIBRARIES}
    environment = {**own, "PYTHONPATH": f"{ROOT}:{ROOT / 'tests'}"}
    subprocess.run([sys.executable, "-c", code], env=environment, check=True)


@pytest.mark.parametrize(
    ("opening", "message"),
    [
        (_refused, "no scan"),
        (_die, "a process was killed by SIGKILL while it opened the scan"),
        (_odd, "_OddError.*no scan"),
    ],
)
def test_what_cannot_be_opened_is_an_error(opening, message):
    with closing(Processes(opening, 1)) as processes:
        ((_, wait),) = processes.values(iter([1]))
        with pytest.raises((InputError, RuntimeError), match=message):
            wait()
