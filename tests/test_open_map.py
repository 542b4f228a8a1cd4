"""Maps in the cache: made once; and what is known of files."""

import hashlib
import os
import resource
from dataclasses import replace

import numpy as np
import pytest
from refusals import assert_input_error, fill_disk
from rooms import scan_map

from piccolo.cloud.cloud_settings import BY_FILE
from piccolo.scan_map import map_file, open_map
from piccolo.scan_map.map_file import save_map
from piccolo.scan_map.open_map import CachePolicy
from piccolo.system.files import cache
from piccolo.system.jobs.threads import Stopwatch, Workers

TIER = "scene"


@pytest.fixture(scope="module")
def cloud(tmp_path_factory):
    path = tmp_path_factory.mktemp("cloud") / "a.npy"
    points = np.random.default_rng(1).random((500, 3))
    np.save(path, np.hstack([points, np.full((500, 3), 100.0)]))
    return path


def _open(cloud, folder, monkeypatch, num_made=1):
    """The map by `open_map`, and the warnings; `prepare_map` is called so many times."""
    made, heard = [], []

    def prepare(*_):
        made.append(1)
        return scan_map(1)

    monkeypatch.setattr(open_map, "prepare_map", prepare)
    workers = Workers(1, warn=heard.append)
    found = open_map.open_map([cloud], BY_FILE, CachePolicy(True, folder), workers, Stopwatch())
    np.testing.assert_array_equal(found.centers, scan_map(1).centers)
    assert found.scan_sha256 == hashlib.sha256(cloud.read_bytes()).hexdigest()
    assert len(made) == num_made
    assert found.warnings == (*scan_map(1).warnings, *heard)
    return heard


def test_maps_are_kept_in_a_folder_of_their_own(cloud, tmp_path, monkeypatch):
    """What lies in the user's folder is left, however old it is and whatever its name."""
    foreign = [tmp_path / f"{32 * 'a'}.piccolo-map", tmp_path / "notes.txt"]
    for path in foreign:
        path.touch()
        os.utime(path, (0, 0))
    assert _open(cloud, tmp_path, monkeypatch) == []
    assert _open(cloud, tmp_path, monkeypatch, 0) == []
    assert sorted(tmp_path.iterdir()) == sorted([*foreign, tmp_path / "piccolo-maps"])
    assert sorted(path.suffix for path in (tmp_path / "piccolo-maps").iterdir()) == [".TAG", ".piccolo-map"]


@pytest.mark.parametrize("how", ["flipped", "cut", "empty", "no directory", "another", "folder"])
def test_a_damaged_map_is_made_anew_with_one_warning(cloud, tmp_path, monkeypatch, how):
    assert _open(cloud, tmp_path, monkeypatch) == []
    (path,) = tmp_path.glob("*/*.piccolo-map")
    whole = path.read_bytes()
    middle = len(whole) // 2
    directory = whole.rindex(b"PK\x01\x02")
    path.write_bytes(
        {
            "flipped": whole[:middle] + bytes([whole[middle] ^ 4]) + whole[middle + 1 :],
            "cut": whole[:middle],
            "empty": b"",
            "no directory": whole[:directory] + bytes(20) + whole[directory + 20 :],
        }.get(how, whole)
    )
    if how == "another":
        save_map(replace(scan_map(1), scan_sha256=64 * "1"), path)
    if how == "folder":
        path.unlink()
        path.mkdir()
    (warning,) = _open(cloud, tmp_path, monkeypatch)
    assert str(path) in warning
    assert warning.endswith("the prepared map is not kept" if how == "folder" else "it is prepared again")
    assert how == "folder" or path.read_bytes() == whole
    assert how == "folder" or _open(cloud, tmp_path, monkeypatch, 0) == []


@pytest.mark.parametrize("how", ["a file", "its place is a file", "full disk", "link to nothing"])
def test_a_cache_that_can_not_be_used_is_a_warning(cloud, tmp_path, monkeypatch, how):
    folder = tmp_path / "cache"
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    if how == "a file":
        folder.touch()
    elif how == "its place is a file":
        folder.mkdir()
        (folder / "piccolo-maps").touch()
    elif how == "link to nothing":
        folder.mkdir()
        (folder / "piccolo-maps").symlink_to("nothing")
    else:
        monkeypatch.setattr("sys.dont_write_bytecode", True)  # it would be cut off too
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limit[1]))
    try:
        (warning,) = _open(cloud, folder, monkeypatch)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert str(folder) in warning
    assert warning.endswith("; the prepared map is not kept")
    assert [path.name for path in folder.rglob("*") if path.is_file()] in (
        [],
        ["CACHEDIR.TAG"],
        ["piccolo-maps"],
    )


@pytest.fixture
def facts(home_cache):
    """The folder of facts."""
    return cache.private_folder("facts", cache.FACT_NAME)


def test_a_fact_holds_until_its_file_changes_in_any_way(facts, tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"one")
    before = path.stat()
    assert cache.recall("what", before) is None
    cache.remember("what", before, "a fact")
    assert cache.recall("what", path.stat()) == "a fact"
    assert cache.recall("another", path.stat()) is None
    path.write_bytes(b"two")
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))  # its time is put back, by who changed it
    assert path.stat().st_mtime_ns == before.st_mtime_ns
    assert cache.recall("what", path.stat()) is None


def test_facts_that_can_not_be_kept_or_read_are_lost(facts, tmp_path, monkeypatch):
    status = tmp_path.stat()
    cache.remember("what", status, "a fact")
    (kept,) = facts.glob("*.fact")
    kept.write_bytes(b"\xff\xff")
    assert cache.recall("what", status) is None
    monkeypatch.setattr(cache, "write_atomically", fill_disk)
    cache.remember("other", status, "a fact")
    facts.chmod(0o777)
    cache.private_folder.cache_clear()
    cache.remember("more", status, "a fact")
    assert cache.recall("more", status) is None
    assert list(facts.glob("*.fact")) == [kept]


def test_facts_are_kept_where_nobody_else_can_write(home_cache):
    kept = cache.private_folder.__wrapped__
    assert kept("facts", cache.FACT_NAME) == home_cache / "facts"
    assert (home_cache / "facts").stat().st_mode & 0o777 == 0o700
    (home_cache / "facts").chmod(0o777)
    assert kept("facts", cache.FACT_NAME) is None
    (home_cache / "file").touch()
    assert kept("file", cache.FACT_NAME) is None


def test_a_digest_is_taken_once_and_anew_when_the_file_changes(facts, tmp_path, monkeypatch):
    path = tmp_path / "a.ply"
    read = []
    path.write_bytes(b"one")
    of_file = hashlib.file_digest
    monkeypatch.setattr(hashlib, "file_digest", lambda *args: read.append(args) or of_file(*args))
    for tick, num_kept in ((10**15, 0), (-(10**15), 1)):  # at first it may change once more
        monkeypatch.setattr(cache, "TICK_NS", tick)
        assert cache.sha256_of_files([path], True) == hashlib.sha256(b"one").hexdigest()
        assert len(list(facts.glob("*.fact"))) == num_kept
    assert cache.sha256_of_files([path], True) == hashlib.sha256(b"one").hexdigest()
    assert len(read) == 2
    assert cache.sha256_of_files([path]) == hashlib.sha256(b"one").hexdigest()
    assert len(read) == 3
    path.write_bytes(b"two!")
    assert cache.sha256_of_files([path], True) == hashlib.sha256(b"two!").hexdigest()


def test_a_map_is_checked_once_by_who_remembers_it(facts, tmp_path, monkeypatch):
    path = tmp_path / "a.map"
    checked = []
    save_map(scan_map(1), path)
    check = map_file.check_arrays
    monkeypatch.setattr(map_file, "check_arrays", lambda *args: checked.append(args) or check(*args))
    for remembers, count in ((False, 1), (True, 2), (True, 2), (False, 3)):
        assert len(map_file.load_map(path, remembers).centers) == len(scan_map(1).centers)
        assert len(checked) == count
    content = bytearray(path.read_bytes())
    content[-5000] ^= 1
    path.write_bytes(content)
    assert_input_error("damaged", map_file.load_map, path, remembers=True)


@pytest.mark.parametrize("how", ["cut off", "overwritten", "removed"])
@pytest.mark.parametrize("is_kept", [False, True])
def test_a_map_in_memory_stays_as_it_was_whatever_becomes_of_its_file(facts, tmp_path, is_kept, how):
    """Mapped as it is, a file cut off would kill this process."""
    path = tmp_path / "a.map"
    save_map(scan_map(1), path)
    loaded = map_file.load_map(path, remembers=is_kept)
    if how == "cut off":
        os.truncate(path, 4096)
    elif how == "overwritten":
        path.write_bytes(np.random.default_rng(0).bytes(path.stat().st_size))
    else:
        path.unlink()
    np.testing.assert_array_equal(loaded.octree.nodes, scan_map(1).octree.nodes)
    np.testing.assert_array_equal(loaded.wide_features, scan_map(1).wide_features)
    assert len(list((facts.parent / "maps").glob("*.piccolo-map"))) == is_kept


def test_a_damaged_map_leaves_no_copy(facts, tmp_path):
    path = tmp_path / "a.map"
    save_map(scan_map(1), path)
    os.truncate(path, path.stat().st_size - 1)
    assert_input_error("damaged", map_file.load_map, path, remembers=True)
    assert not list((facts.parent / "maps").glob("*.piccolo-map"))
