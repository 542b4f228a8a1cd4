"""What is known of a file's content for as long as it stays as it is: digests of scans, checks of maps."""

import errno
import hashlib
import os

import numpy as np
import pytest
from rooms import scan_map

from piccolo.errors import InputError
from piccolo.files import cache
from piccolo.scan_map import map_file
from piccolo.scan_map.map_file import save_map


def _full(*_):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.fixture
def facts(tmp_path, monkeypatch):
    folder = tmp_path / "facts"
    for each in (folder, tmp_path / "maps"):
        each.mkdir(mode=0o700)
    monkeypatch.setattr(cache, "private_folder", lambda *_: folder)
    monkeypatch.setattr(map_file, "private_folder", lambda *_: tmp_path / "maps")
    return folder


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
    (kept,) = facts.iterdir()
    kept.write_bytes(b"\xff\xff")
    assert cache.recall("what", status) is None
    monkeypatch.setattr(cache, "write_atomically", _full)
    cache.remember("other", status, "a fact")
    monkeypatch.setattr(cache, "private_folder", lambda *_: None)
    cache.remember("more", status, "a fact")
    assert cache.recall("more", status) is None
    assert [entry.name for entry in facts.iterdir()] == [kept.name]


def test_facts_are_kept_where_nobody_else_can_write(tmp_path, monkeypatch):
    monkeypatch.setattr(cache, "cache_root", lambda: tmp_path)
    kept = cache.private_folder.__wrapped__
    assert kept("facts", cache.FACT_NAME) == tmp_path / "facts"
    assert (tmp_path / "facts").stat().st_mode & 0o777 == 0o700
    (tmp_path / "facts").chmod(0o777)
    assert kept("facts", cache.FACT_NAME) is None
    (tmp_path / "file").touch()
    assert kept("file", cache.FACT_NAME) is None


def test_a_digest_is_taken_once_and_anew_when_the_file_changes(facts, tmp_path, monkeypatch):
    path, read = tmp_path / "a.ply", []
    path.write_bytes(b"one")
    of_file = hashlib.file_digest
    monkeypatch.setattr(hashlib, "file_digest", lambda *args: read.append(args) or of_file(*args))
    monkeypatch.setattr(cache, "TICK_NS", 10**15)
    assert cache.sha256_of_files([path], True) == hashlib.sha256(b"one").hexdigest()
    assert list(facts.iterdir()) == []  # it has changed just now, and may once more
    monkeypatch.setattr(cache, "TICK_NS", -(10**15))
    for _ in range(2):
        assert cache.sha256_of_files([path], True) == hashlib.sha256(b"one").hexdigest()
    assert len(read) == 2
    assert cache.sha256_of_files([path]) == hashlib.sha256(b"one").hexdigest()
    assert len(read) == 3
    path.write_bytes(b"two!")
    assert cache.sha256_of_files([path], True) == hashlib.sha256(b"two!").hexdigest()


def test_a_map_is_checked_once_by_who_remembers_it(facts, tmp_path, monkeypatch):
    path, checked = tmp_path / "a.map", []
    save_map(scan_map(1), path)
    check = map_file.check_arrays
    monkeypatch.setattr(map_file, "check_arrays", lambda *args: checked.append(args) or check(*args))
    for remembers, count in ((False, 1), (True, 2), (True, 2), (False, 3)):
        assert len(map_file.load_map(path, remembers).centers) == len(scan_map(1).centers)
        assert len(checked) == count
    content = bytearray(path.read_bytes())
    content[-5000] ^= 1
    path.write_bytes(content)
    with pytest.raises(InputError, match="damaged"):
        map_file.load_map(path, remembers=True)


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
    with pytest.raises(InputError, match="damaged"):
        map_file.load_map(path, remembers=True)
    assert not list((facts.parent / "maps").glob("*.piccolo-map"))
