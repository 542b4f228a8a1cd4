"""Local features that are made when a photo first needs them, by whom, and what is kept of them."""

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import rooms

from piccolo.cloud.settings import IN_METRES
from piccolo.jobs.threads import Once, Stopwatch, Workers
from piccolo.opening import Cloud, open_scan
from piccolo.scan_map import open_map, scan_map
from piccolo.scan_map.map_file import load_map, save_map
from piccolo.scan_map.open_map import CachePolicy

WORKERS = Workers(2)


@pytest.fixture
def finding(monkeypatch):
    """Counts how often features are looked for; they are those of the room."""
    asked = []
    found = rooms.scan_map(1).local_features
    monkeypatch.setattr(scan_map, "find_local_features", lambda *_: asked.append(1) or found)
    return asked


@pytest.fixture(scope="module")
def cloud(tmp_path_factory):
    folder = rooms.write_room(tmp_path_factory.mktemp("room"), "--seed 3 --points 40000 --panoramas 1")
    return folder / "cloud.ply"


@pytest.fixture
def opened(tmp_path, cloud):
    cache = CachePolicy(folder=tmp_path / "cache")

    def open_it():
        return open_map.open_map([cloud], IN_METRES, cache, WORKERS, Stopwatch())

    return open_it


def test_they_are_made_once_and_threads_wait_for_them():
    made = []

    def make(workers):
        made.append(workers)
        time.sleep(0.2)
        return "features"

    late = Once(make)
    with ThreadPoolExecutor(3) as pool:
        assert list(pool.map(late, [WORKERS] * 3)) == ["features"] * 3
    assert made == [WORKERS]


def test_the_cache_keeps_them_for_the_next_process(opened, finding):
    first = opened()
    assert first.lacks_features
    first.features_now(WORKERS)
    assert finding == [1]
    other = opened()
    assert not other.lacks_features
    np.testing.assert_array_equal(other.features_now(WORKERS).points, first.features_now(WORKERS).points)
    assert finding == [1]


def test_what_another_process_has_made_meanwhile_is_taken(opened, finding):
    first, second = opened(), opened()
    first.features_now(WORKERS)
    second.features_now(WORKERS)
    assert finding == [1]


def test_where_they_can_not_be_kept_they_are_there_all_the_same(opened, finding, monkeypatch):
    found = opened()
    monkeypatch.setattr(open_map, "save_map", lambda *_: (_ for _ in ()).throw(OSError(28, "full")))
    assert len(found.features_now(WORKERS).points) > 1000
    assert opened().lacks_features


def test_a_map_file_without_them_makes_them_too(tmp_path, finding):
    """As it is sent to the workers of a cluster."""
    whole = rooms.scan_map(1)
    none = scan_map.make_feature_map(whole.octree, whole.centers[:0], WORKERS)
    save_map(replace(whole, local_features=none), tmp_path / "a.map")
    loaded = load_map(tmp_path / "a.map")
    assert loaded.lacks_features
    assert len(loaded.features_now(WORKERS).points) > 1000
    assert finding == [1]


def test_a_scan_of_arrays_is_opened_without_them(finding):
    cloud = rooms.room(1)[1]
    scan = open_scan(Cloud(cloud.points.astype(float), colors=cloud.colors), num_threads=2)
    assert scan._opened.prepared.lacks_features
    assert finding == []
    scan.localize(rooms.query(1).rgb, gravity="unknown")
    assert finding == [1]
