"""Prepared maps in files: round trips, damage and hostility; and the archives that hold their arrays."""

import dataclasses
import io
import zipfile

import naive
import numpy as np
import pytest
from refusals import assert_input_error
from rooms import make_map, map_path, scan_map

from piccolo.cloud.cloud_settings import CloudSettings
from piccolo.cloud.octree import build_octree
from piccolo.cloud.voxels import LEAF_SIZE, PHASE, QUANTA_PER_METRE, VoxelTable
from piccolo.geometry.pose import exp_so3
from piccolo.scan_map import map_file, open_map
from piccolo.scan_map.map_file import first_misplaced, is_map_file, load_map, save_map
from piccolo.scan_map.open_map import content_key
from piccolo.system.errors import InputError
from piccolo.system.files import array_archive
from piccolo.system.files.array_archive import ALIGNMENT, ArrayArchive, read_array_header, write_archive

TIER = "scene"


@pytest.fixture
def built():
    return map_path(1)


@pytest.fixture
def arrays(built):
    """Those of a map of two scans."""
    with np.load(built) as archive:
        arrays = dict(archive)
    scans = (np.arange(len(arrays["centers"])) % 2).astype(np.uint16)
    return arrays | {"scan_names": np.array(["A", "B"]), "scan_of_candidate": scans}


def _save(path, arrays):
    """Write arrays as they are, with right checksums."""
    with path.open("wb") as file:
        write_archive(file, arrays)


def test_round_trip_and_a_file_cut_short(tmp_path):
    made = make_map(1, 20_000)
    built = tmp_path / "a.map"
    save_map(made, built)
    back = load_map(built)
    for field in dataclasses.fields(back):
        if field.name not in ("octree", "views", "places"):
            np.testing.assert_array_equal(getattr(back, field.name), getattr(made, field.name))
    np.testing.assert_array_equal(back.places.positions, made.places.positions)
    assert len(back.places.positions) > 1
    np.testing.assert_array_equal(back.views.centers, back.centers)
    assert isinstance(back.scan_sha256, str)
    np.testing.assert_array_equal(back.octree.nodes, made.octree.nodes)
    (tmp_path / "b.map").write_bytes(built.read_bytes()[:-1000])
    assert_input_error(r"b\.map: ", load_map, tmp_path / "b.map")


def test_a_file_outlives_other_sources_but_the_cache_does_not(built, monkeypatch):
    """Its format alone says whether a file can be read; the cache also goes by what made it."""
    key = content_key("00", CloudSettings())
    assert content_key("00", CloudSettings()) == key != content_key("00", CloudSettings(scale=0.1))
    monkeypatch.setattr(open_map, "digest_of_sources", lambda _: "of other sources")
    assert content_key("00", CloudSettings()) != key
    assert len(load_map(built).centers) == len(scan_map(1).centers)


def test_another_format_is_refused_in_one_clear_line(tmp_path, monkeypatch):
    path = tmp_path / "a.map"
    with monkeypatch.context() as patched:
        patched.setattr(map_file, "FORMAT", "piccolo-map/1")
        save_map(scan_map(1), path)
    assert is_map_file(path)
    with pytest.raises(InputError) as refused:
        load_map(path)
    assert str(refused.value) == (
        f"{path}: a map of format 'piccolo-map/1', but this version reads {map_file.FORMAT}; prepare it again"
    )


def _changed(index, value):
    """A function that puts a value into an array."""

    def change(array):
        array[index] = value
        return array

    return change


TILT = np.array([[1.0, 0.0, 0.0], [0.0, 0.8, -0.6], [0.0, 0.6, 0.8]])
DAMAGE = {  # member, what is done to it, the words of the refusal
    "no rotation": ("R_map_from_world", lambda a: a * 1.001, "R_map_from_world of the map is no rotation"),
    "another": ("R_map_from_world", lambda a: TILT, "octree whose node|origin_world"),
    "nowhere": ("origin_world", _changed(0, np.inf), "an origin_world of"),
    "off metres": ("origin_world", lambda a: a + 0.25, "an origin_world of"),
    "no variance": ("surface_variance", _changed((2, 2), -0.01), "a surface_variance of"),
    "variance of no number": ("surface_variance", _changed((0, 0), np.nan), "a surface_variance of"),
    "layers of no number": ("layers", _changed((1, 2), np.nan), "layers of "),
    "layers far apart": ("layers", _changed((2, 0), 5.0), "layers of "),
    "flat": ("wide_features", lambda a: a.reshape(-1), "wide_features of type int8 and shape"),
    "a node more": ("octree_nodes", lambda a: np.concatenate([a, a[-1:]]), "levels that begin at"),
    "a link less": ("octree_first_child", lambda a: a[:-1], "invalid child links"),
    "cycle": ("octree_first_child", _changed(3, 0), "invalid child links"),
    "empty level": ("octree_level_start", lambda a: np.sort(a[[0, 1, 1, *range(3, len(a))]]), "levels that"),
    "no leaf": ("octree_leaf_size", lambda a: np.array(0.0), "leaves of 0.0 m"),
    "leaf of no number": ("octree_leaf_size", lambda a: np.array(np.nan), "leaves of nan m"),
    "no place": ("octree_nodes", _changed((-1, 0), np.nan), "an octree whose node"),
    "far root": ("octree_nodes", _changed((0, 1), 1e30), "an octree whose node 0 is"),
    "too bright": ("octree_nodes", _changed((7, 3), 1.1), "an octree whose node 7 is"),
    "candidate nowhere": ("centers", _changed((0, 1), np.nan), "a candidate at no finite place"),
    "too low on wide cells": ("wide_features", _changed((0, 0), -128), "wide_features below -127"),
    "index too large": ("sparse", _changed(0, 10**9), "sparse candidates that are not"),
    "another scan": ("scan_of_candidate", _changed(3, 2), "a candidate in scan 2 of 2"),
    "no names": ("scan_names", lambda a: np.arange(2), "scan_names of type int64"),
    "many names": ("scan_names", lambda a: np.arange(1001).astype(str), "scan_names of type <U"),
    "a name of two lines": ("scan_names", lambda a: np.array(["A", "B\nC"]), "duplicate names"),
    "a name twice": ("scan_names", lambda a: np.array(["A", "A"]), "duplicate names"),
    "no text": ("scan_sha256", lambda a: np.full(64, 2**32 - 1, "u4").view("<U64")[0], "that is no digest"),
    "short digest": ("scan_sha256", lambda a: np.array("0"), "scan_sha256 of type <U1"),
    "numbers": ("warnings", lambda a: np.arange(3), "warnings of type int64"),
    "columns": ("octree_nodes", np.asfortranarray, "octree_nodes.npy of .* which promises"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_what_no_map_can_be_is_refused(arrays, tmp_path, damage):
    member, change, words = DAMAGE[damage]
    arrays[member] = change(arrays[member].copy())
    path = tmp_path / "a.map"
    _save(path, arrays)
    with pytest.raises(InputError, match=words) as refused:
        load_map(path)
    assert str(refused.value).startswith(f"{path}: ")
    assert "\n" not in str(refused.value)


def test_members_are_those_of_a_map_and_not_compressed(arrays, tmp_path):
    path = tmp_path / "a.map"
    np.savez_compressed(path.with_suffix(".npz"), **arrays)
    packed = path.with_suffix(".npz").read_bytes()
    path.write_bytes(packed)
    assert_input_error(r"damaged .'arrays of \d+ bytes'", load_map, path)
    path.write_bytes(bytes(10**7) + packed)  # what comes before an archive is no part of it
    assert_input_error(r"format.npy in another way than a prepared map has it", load_map, path)
    np.savez(path.with_suffix(".npz"), **arrays)
    path.write_bytes(path.with_suffix(".npz").read_bytes())
    assert_input_error(r"format.npy at byte \d+, no multiple of 64", load_map, path)
    _save(path, {**arrays, "more": np.zeros(3)})
    assert_input_error(r"damaged .*'more'", load_map, path)
    del arrays["sparse"]
    _save(path, arrays)
    assert_input_error(r"damaged .*sparse", load_map, path)


def test_no_objects_are_unpickled(arrays, tmp_path):
    path = tmp_path / "a.map"
    _save(path, arrays | {"warnings": np.array([7], np.uint64)})
    content = path.read_bytes()
    assert content.count(b"'<u8'") == 1
    path.write_bytes(content.replace(b"'<u8'", b"'|O' "))
    assert_input_error(r"warnings.npy of 8 bytes, which promises object of shape \(1,\)", load_map, path)


def test_warnings_are_lines_that_can_be_printed(arrays, tmp_path):
    arrays["warnings"] = np.array(["two\nlines \x1b[31m", "x" * 9000] * 600)
    _save(tmp_path / "a.map", arrays)
    warnings = load_map(tmp_path / "a.map").warnings
    assert warnings[0] == "two?lines ?[31m"
    assert (len(warnings), max(map(len, warnings))) == (1000, 5000)


@pytest.mark.parametrize("seed", range(12))
def test_no_octree_of_a_cloud_is_refused(arrays, tmp_path, seed):
    """Turned, far from zero, wide, of one point, and with points on the borders of voxels."""
    rng = np.random.default_rng(seed)
    R = exp_so3(rng.normal(size=3)) if seed % 3 else np.eye(3)
    table = VoxelTable("cloud")
    count = [1, 60, 4000][seed // 4]
    points = rng.random((count, 3)) * [0.01, 5.0, 300.0, 41_000.0][seed % 4]
    if seed % 2:
        points = np.round(points / LEAF_SIZE) * LEAF_SIZE
    table.add(points + rng.normal(size=3) * [0.0, 50.0, 5e6][seed % 3], np.full((count, 3), 200, np.uint8))
    voxels = table.finish()
    octree = build_octree(voxels)
    changed = {f"octree_{name}": np.asarray(value) for name, value in octree._asdict().items()}
    changed |= {"R_map_from_world": R, "origin_world": R.T @ voxels.origin}
    _save(tmp_path / "a.map", arrays | changed)
    np.testing.assert_array_equal(load_map(tmp_path / "a.map").octree.nodes, octree.nodes)


def test_nodes_are_in_their_parents_voxels():
    octree = scan_map(1).octree
    rng = np.random.default_rng(3)
    origin = scan_map(1).R_map_from_world @ scan_map(1).origin_world + PHASE / QUANTA_PER_METRE
    args = octree.first_child, octree.level_start, origin, LEAF_SIZE
    assert first_misplaced(octree.nodes, *args, 100.0) == -1
    assert first_misplaced(octree.nodes, *args, 0.5) == 0
    assert not naive.misplaced(octree.nodes, *args).any()
    num_found = 0
    for _ in range(40):
        nodes = octree.nodes.copy()
        node = rng.integers(octree.level_start[1], len(octree.nodes))
        nodes[node, rng.integers(3)] += rng.choice([0.003, -0.03, 0.2])
        misplaced = naive.misplaced(nodes, *args)
        assert (first_misplaced(nodes, *args, 100.0) >= 0) == misplaced.any()
        num_found += misplaced.any()
    assert 10 < num_found < 40


ARRAYS = {
    "a": np.arange(7, dtype=np.int8),
    "longer_name": np.linspace(0.0, 1.0, 300).reshape(100, 3),
    "none": np.zeros((0, 4), np.float32),
    "one": np.array("text"),
    "flags": np.array([True, False]),
}


@pytest.fixture
def path(tmp_path):
    with (tmp_path / "a.npz").open("wb") as file:
        write_archive(file, ARRAYS)
    return tmp_path / "a.npz"


@pytest.mark.parametrize("is_mapped", [False, True])
@pytest.mark.parametrize("limit", [zipfile.ZIP64_LIMIT, 2000])
def test_arrays_come_back_aligned_and_numpy_reads_them_too(tmp_path, monkeypatch, limit, is_mapped):
    """Large members have a longer header in the archive."""
    monkeypatch.setattr(zipfile, "ZIP64_LIMIT", limit)
    with (tmp_path / "a.npz").open("wb") as file:
        write_archive(file, ARRAYS)
    archive = ArrayArchive(tmp_path / "a.npz", is_mapped)
    assert list(archive.members) == list(ARRAYS)
    with np.load(tmp_path / "a.npz") as loaded:
        for name, array in ARRAYS.items():
            archive.check(name)
            found = archive.array(name)
            assert (found.dtype, found.shape) == (array.dtype, array.shape)
            np.testing.assert_array_equal(found, array)
            np.testing.assert_array_equal(loaded[name], array)
            assert found.ctypes.data % ALIGNMENT == 0 or found.size == 0


def test_what_is_written_to_an_array_changes_no_file(path):
    before = path.read_bytes()
    ArrayArchive(path, is_mapped=True).array("longer_name")[:] = -1.0
    assert path.read_bytes() == before
    assert ArrayArchive(path).array("longer_name").min() == 0.0


def test_each_changed_byte_of_an_array_is_noticed(path):
    content = path.read_bytes()
    first = content.index(ARRAYS["longer_name"].tobytes())
    for k in range(first, first + ARRAYS["longer_name"].nbytes, 97):
        path.write_bytes(content[:k] + bytes([content[k] ^ 1]) + content[k + 1 :])
        with pytest.raises(ValueError, match=r"longer_name.npy with a wrong checksum"):
            ArrayArchive(path).check("longer_name")


def test_no_array_reaches_beyond_the_file(path, monkeypatch):
    info = ArrayArchive(path).members["a"]
    for offset in (len(path.read_bytes()) - 40, len(path.read_bytes())):
        archive = ArrayArchive(path)
        archive.members["a"].header_offset = offset
        with pytest.raises((ValueError, array_archive.struct.error)):
            archive.array("a")
    archive = ArrayArchive(path)
    archive.members["a"].header_offset = info.header_offset
    archive.members["a"].file_size = 10**6
    archive.members["a"].compress_size = 10**6
    with pytest.raises(ValueError, match="in another way than a prepared map has it"):
        archive.array("a")


def test_a_header_that_numpy_would_have_to_mend_is_refused_without_a_warning():
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": (3, 6)})
    head = file.getvalue()
    assert read_array_header(head) == ((3, 6), False, np.dtype("<f8"), len(head))
    with pytest.raises(ValueError, match="a header of Python 2"):
        read_array_header(head.replace(b"(3, 6), }  ", b"(3L, 6L), }"))
    with pytest.raises(ValueError, match=r"version 3.0, wanted 1.0 or 2.0"):
        read_array_header(head.replace(b"NUMPY\x01", b"NUMPY\x03"))
