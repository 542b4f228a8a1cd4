"""BLAS gives its threads to the kernels while a photo is localized, and has them again afterwards."""

import threading

import numpy as np
import pytest
import rooms
from threadpoolctl import threadpool_info, threadpool_limits

from piccolo.jobs.threads import Stopwatch, Workers, one_blas_thread
from piccolo.localization import localize as method
from piccolo.localization.settings import CoarseToFineSettings


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


def test_a_photo_is_localized_with_one(three_threads, monkeypatch):
    seen = []
    monkeypatch.setattr(method, "judge", lambda *_: seen.append(_threads()))
    settings = CoarseToFineSettings(gravity="known")
    method.localize(rooms.scan_map(1), rooms.scene(1)[1], settings, Workers(2), Stopwatch())
    assert seen == [{1}]
