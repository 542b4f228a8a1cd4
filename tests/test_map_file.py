"""Prepared maps on disk."""

import dataclasses

import numpy as np
import pytest
from refusals import assert_refused
from rooms import scan_map

from piccolo.cloud.settings import CloudSettings
from piccolo.coarse_to_fine import map_file, open_map
from piccolo.coarse_to_fine.map_file import is_map_file, load_map, save_map
from piccolo.coarse_to_fine.open_map import content_key
from piccolo.errors import InputError


def test_round_trip_and_a_file_cut_short(tmp_path):
    save_map(scan_map(1), tmp_path / "a.map")
    back = load_map(tmp_path / "a.map")
    for field in dataclasses.fields(back):
        if field.name not in ("octree", "warnings"):
            np.testing.assert_array_equal(getattr(back, field.name), getattr(scan_map(1), field.name))
    np.testing.assert_array_equal(back.octree.nodes, scan_map(1).octree.nodes)
    (tmp_path / "b.map").write_bytes((tmp_path / "a.map").read_bytes()[:-1000])
    assert_refused(r"b\.map: ", load_map, tmp_path / "b.map")


def test_a_file_outlives_other_sources_but_the_cache_does_not(tmp_path, monkeypatch):
    """Its format alone says whether a file can be read; the cache also goes by what made it."""
    cloud, built = tmp_path / "a.ply", tmp_path / "a.map"
    cloud.write_bytes(b"points")
    save_map(scan_map(1), built)
    key = content_key([cloud], CloudSettings())
    assert content_key([cloud], CloudSettings()) == key != content_key([cloud], CloudSettings(scale=0.1))
    monkeypatch.setattr(open_map, "sources_digest", lambda: "of other sources")
    assert content_key([cloud], CloudSettings()) != key
    assert len(load_map(built).centers) == len(scan_map(1).centers)


def test_another_format_is_refused_in_one_clear_line(tmp_path, monkeypatch):
    built = tmp_path / "a.map"
    with monkeypatch.context() as patched:
        patched.setattr(map_file, "FORMAT", "piccolo-map/1")
        save_map(scan_map(1), built)
    assert is_map_file(built)
    with pytest.raises(InputError) as refused:
        load_map(built)
    message = f"a map of format piccolo-map/1, but this version reads {map_file.FORMAT}; prepare it again"
    assert str(refused.value) == f"{built}: {message}"
