"""Maps in the cache: made once, made anew where damaged, and where none can be kept one warning."""

import hashlib
import os
import resource
from dataclasses import replace

import numpy as np
import pytest
from rooms import scan_map

from piccolo.cloud.settings import IN_METRES
from piccolo.jobs.threads import Stopwatch, Workers
from piccolo.scan_map import open_map
from piccolo.scan_map.map_file import save_map
from piccolo.scan_map.open_map import CachePolicy


@pytest.fixture(scope="module")
def cloud(tmp_path_factory):
    path, points = tmp_path_factory.mktemp("cloud") / "a.npy", np.random.default_rng(1).random((500, 3))
    np.save(path, np.hstack([points, np.full((500, 3), 100.0)]))
    return path


def _open(cloud, folder, monkeypatch, num_made=1):
    """The map by `open_map`, and the warnings; `prepare_map` is called so many times."""
    made, heard = [], []

    def prepare(*_, prior, has_features):
        made.append(1)
        return scan_map(1)

    monkeypatch.setattr(open_map, "prepare_map", prepare)
    workers = Workers(1, warn=heard.append)
    found = open_map.open_map([cloud], IN_METRES, CachePolicy(True, folder), workers, Stopwatch())
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
    middle, directory = len(whole) // 2, whole.rindex(b"PK\x01\x02")
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
    folder, limit = tmp_path / "cache", resource.getrlimit(resource.RLIMIT_FSIZE)
    if how == "a file":
        folder.touch()
    elif how == "its place is a file":
        folder.mkdir()
        (folder / "piccolo-maps").touch()
    elif how == "link to nothing":
        folder.mkdir()
        (folder / "piccolo-maps").symlink_to("nothing")
    else:
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
