"""Clouds that stream into voxels: the same bits whatever the order, the chunks and the files."""

import dataclasses
import hashlib
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rooms
from clouds import LEVEL, TURN, part, seeded_cloud, stream
from plyfile import PlyData, PlyElement
from refusals import assert_input_error
from rooms import room

from piccolo.api.opening import open_files
from piccolo.cloud.cloud_settings import METRES, WITHOUT_COLORS, CloudSettings
from piccolo.cloud.readers.reader import PointSource, RawCloud
from piccolo.cloud.stream import CloudStream, open_cloud, stream_of_arrays
from piccolo.cloud.voxels import Voxels
from piccolo.geometry.pose import exp_so3, rotation_to_z
from piccolo.localization.paper import PaperSettings
from piccolo.scan_map.open_map import CachePolicy, content_key, open_map
from piccolo.scan_map.scan_map import prepare_map
from piccolo.system.errors import InputError
from piccolo.system.jobs.threads import Stopwatch, Workers

TIER = "scene"

ROOT = Path(__file__).resolve().parents[1]


FAR = np.array([500_000.0, 5_400_000.0, 100.0])  # UTM


@pytest.mark.parametrize("suffix", [".ply", ".npy", ".pcd"])
@pytest.mark.parametrize(
    ("dtype", "offset", "units", "step"),
    [
        ("f4", FAR, "m", "0.5 m"),
        (">f4", FAR, "m", "0.5 m"),
        ("f4", 1000.0 * FAR, "mm", "0.51 m"),
        ("f4", 0.02 * FAR, "m", None),
        ("f8", FAR, "m", None),
    ],
)
def test_a_file_in_float32_far_from_the_origin_has_a_warning(tmp_path, suffix, dtype, offset, units, step):
    raw = seeded_cloud(2, 3000)
    points = (raw.points_world / METRES[units] + offset).astype(dtype)
    if suffix == ".pcd" and dtype != ">f4":
        path = _write_pcd(tmp_path / "a.pcd", points)
    elif suffix == ".npy":
        path = tmp_path / "a.npy"
        np.save(path, points)
    else:
        path = tmp_path / "a.ply"
        fields = [(axis, dtype) for axis in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")]
        rows = np.array([(*p, *c) for p, c in zip(points, raw.colors, strict=True)], fields)
        PlyData([PlyElement.describe(rows, "vertex")], byte_order=">" if dtype == ">f4" else "<").write(path)
    settings = CloudSettings(METRES[units], channels=("colors", "intensity", "shape"))
    cloud = open_cloud([path], settings)
    for warnings in (cloud.read().warnings, cloud.voxels(LEVEL).warnings):
        found = [line for line in warnings if "its float32 coordinates" in line]
        assert len(found) == (step is not None)
        assert all(line.startswith(f"{path}: ") and f"are rounded to {step}: " in line for line in found)


def test_arrays_in_float32_far_from_the_origin_have_a_warning():
    raw = seeded_cloud(2, 3000)
    single = stream_of_arrays((raw.points_world + FAR).astype(np.float32), raw.colors).read()
    double = stream_of_arrays(raw.points_world + FAR, raw.colors).read()
    assert [len(cloud.warnings) for cloud in (single, double)] == [1, 0]


def _write_pcd(path, points):
    size = points.itemsize
    head = (
        f"VERSION .7\nFIELDS x y z\nSIZE {size} {size} {size}\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {len(points)}\n"
    )
    head += f"HEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(points)}\nDATA binary\n"
    path.write_bytes(head.encode() + points.tobytes())
    return path


def same_voxels(a, b):
    return all(getattr(a, name).tobytes() == getattr(b, name).tobytes() for name in ARRAYS)


ARRAYS = [name for name in Voxels._fields if name != "warnings"]


@pytest.mark.parametrize("turn", [LEVEL, TURN])
def test_same_bits_for_any_order_chunks_and_files(turn):
    raw = seeded_cloud(2, 60_000, size=(2.0, 3.0, 2.5))
    raw.points_world[::77] = np.nan
    whole = stream(raw).voxels(turn)
    shuffle = np.random.default_rng(3).permutation(60_000)
    first, second = part(raw, slice(0, 20_000)), part(raw, slice(20_000, None))
    again = stream(part(raw, shuffle)), stream(raw, chunk=997)
    for other in (*again, stream(first, second), stream(second, first, chunk=5000)):
        assert same_voxels(other.voxels(turn), whole)


def test_units_scale_the_voxels():
    assert METRES["ft"] == 0.3048
    assert METRES["us-ft"] == pytest.approx(0.3048006096, abs=1e-10)
    feet = stream(seeded_cloud(15), scale=METRES["ft"]).voxels(LEVEL)
    assert np.ptp(feet.nodes[:, 0]) == pytest.approx(6.0 * 0.3048, abs=0.02)


BROKEN = {
    "found 999 finite points": lambda p, c: (np.where(np.arange(len(p))[:, None] < 999, p, np.nan), c),
    "all points are black": lambda p, c: (p, c // 255),
    "a coordinate of 1e+20 m": lambda p, c: (np.where(np.arange(len(p))[:, None] == 3, 1e20, p), c),
}


@pytest.mark.parametrize("message", list(BROKEN))
@pytest.mark.parametrize("what", ["read", "voxels"])
def test_both_ways_refuse_the_same(what, message):
    raw = seeded_cloud(10)
    broken = stream(raw, RawCloud(*BROKEN[message](raw.points_world, raw.colors)), chunk=600)
    with pytest.raises(InputError) as error:
        broken.read() if what == "read" else broken.voxels(LEVEL)
    assert str(error.value).startswith(f"1.ply: {message}")


@pytest.mark.parametrize("scale", [1.0, 0.001])
def test_both_ways_warn_of_the_same(scale):
    raw = seeded_cloud(11, size=(6000.0, 5000.0, 2500.0))
    raw.points_world[:4] = np.inf
    (source,) = stream(raw, scale=scale).sources
    cloud = CloudStream([source._replace(warnings=("a word",))])
    warnings = cloud.read().warnings
    assert cloud.voxels(LEVEL).warnings == warnings
    assert warnings[:2] == ("a word", "0.ply: 4 points with NaN or infinite coordinates left out")
    assert [("`units` to mm" in line) for line in warnings[2:]] == ([True] if scale == 1.0 else [])


def test_several_files_are_named_together_and_progress_knows_each():
    raw = seeded_cloud(12, size=(6000.0, 5000.0, 2500.0))
    (warning,) = stream(raw, raw, raw).voxels(LEVEL).warnings
    assert warning.startswith("0.ply and 2 more: the cloud spans")
    seen = []

    def show(values, total, label):
        seen.append((total, label))
        return values

    raw = seeded_cloud(13)
    dataclasses.replace(stream(raw), show=show).read()
    assert seen == [(1, "read 0.ply")]


def test_a_broken_disk_is_one_line():
    def read_chunks():
        yield seeded_cloud(14)
        raise OSError(5, "Input/output error")

    cloud = CloudStream([PointSource(Path("a.xyz"), read_chunks)])
    assert_input_error(r"^a\.xyz: cannot be read \(Input/output error\), wanted", cloud.voxels, LEVEL)


def _lying(turn):
    """The cloud of room 1, turned, as a file."""
    cloud = room(1)[1]
    points = (cloud.points @ turn.T).astype(np.float64) + cloud.origin_world
    return stream(RawCloud(points, cloud.colors), chunk=9999)


def test_up_axis_is_believed():
    axis = np.array([-1.0, 0.0, 0.0])
    yaw = exp_so3(np.array([0.0, 0.0, 0.4]))
    cloud = _lying(rotation_to_z(axis).T @ yaw)
    scan_map = prepare_map(cloud, Workers(2), "-x")
    np.testing.assert_array_equal(scan_map.R_map_from_world @ axis, [0.0, 0.0, 1.0])
    np.testing.assert_array_equal(np.abs(scan_map.R_map_from_world).sum(axis=0), 1.0)
    assert np.linalg.det(scan_map.R_map_from_world) == 1.0
    assert scan_map.warnings == ()


@pytest.mark.parametrize("up", ["auto", "z", "-y"])
def test_floors_on_edge_are_told_and_nothing_is_turned_but_by_word(up):
    lying = _lying(exp_so3(np.array([0.5 * np.pi, 0.0, 0.0])))
    scan_map = prepare_map(lying, Workers(2), up)
    assert np.array_equal(scan_map.R_map_from_world, LEVEL) == (up != "-y")
    if up == "auto":
        (warning,) = scan_map.warnings
        assert warning.startswith("the floors face 90 deg away from z, which is used as up (furniture +")
        assert warning.endswith("; set `up` to -y, or rotate the scan with tools/align_gravity.py")
    else:
        assert scan_map.warnings == ()


def test_the_files_own_axis_is_up_unless_they_disagree():
    lying = _lying(rotation_to_z(np.array([0.0, 1.0, 0.0])).T)
    (source,) = lying.sources
    y_up = dataclasses.replace(lying, sources=[source._replace(up="y")])
    scan_map = prepare_map(y_up, Workers(2))
    np.testing.assert_array_equal(scan_map.R_map_from_world @ [0.0, 1.0, 0.0], [0.0, 0.0, 1.0])
    assert scan_map.warnings == ()
    assert (y_up.up, y_up.read().up) == ("y", "y")
    assert dataclasses.replace(lying, sources=[source, source._replace(up="y")]).up == "z"


def _write_text(path, raw, decimals=6):
    np.savetxt(path, np.column_stack([raw.points_world, raw.colors]), fmt=[f"%.{decimals}f"] * 3 + ["%d"] * 3)
    return path


def test_order_of_files_changes_no_bit_of_a_map(tmp_path):
    cloud = room(2)[1]
    raw = RawCloud(cloud.points.astype(np.float64), cloud.colors)
    half = len(raw.colors) // 2
    a = _write_text(tmp_path / "a.txt", part(raw, slice(0, half)))
    b = _write_text(tmp_path / "b.txt", part(raw, slice(half, None)))
    settings = CloudSettings()
    others = [dataclasses.replace(settings, up="z"), dataclasses.replace(settings, scale=2.0)]
    others.append(dataclasses.replace(settings, channels=WITHOUT_COLORS))
    keys = {content_key(digest, s) for s in (settings, *others) for digest in ("00", "01")}
    assert len(keys) == 8
    maps = [
        open_map(paths, settings, CachePolicy(is_used=False), Workers(n), Stopwatch())
        for paths, n in (([a, b], 1), ([b, a], 2))
    ]
    for f in dataclasses.fields(maps[0]):
        if isinstance(getattr(maps[0], f.name), np.ndarray):
            assert getattr(maps[0], f.name).tobytes() == getattr(maps[1], f.name).tobytes(), f.name
    assert maps[0].octree.nodes.tobytes() == maps[1].octree.nodes.tobytes()
    digests = sorted(hashlib.sha256(path.read_bytes()).hexdigest() for path in (a, b))
    of_both = hashlib.sha256("\n".join(digests).encode()).hexdigest()
    assert [m.scan_sha256 for m in maps] == [of_both, of_both]


MEASURE = """
import resource
from pathlib import Path
import numpy as np
from piccolo.cloud.stream import CloudStream
from piccolo.cloud.readers.reader import PointSource, RawCloud

def read_chunks():
    rng = np.random.default_rng(0)
    for _ in range({num_chunks}):
        points = rng.random((250_000, 3)) * [4.0, 4.0, 0.005]
        yield RawCloud(points, rng.integers(199, 201, (250_000, 3), np.uint8))

found = CloudStream([PointSource(Path("a"), read_chunks)]).voxels(np.eye(3))
assert 40_000 < len(found.nodes) < 41_000, len(found.nodes)
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024)
"""


@pytest.mark.process
def test_memory_grows_with_the_scene_and_not_with_the_points():
    peaks_mb = []
    for num_chunks in (2, 20):  # 0.5 and 5 million points, which would take 135 MB at once
        command = [sys.executable, "-c", MEASURE.format(num_chunks=num_chunks)]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
        peaks_mb.append(int(done.stdout))
    assert peaks_mb[1] - peaks_mb[0] < 30


@pytest.mark.parametrize("preset", [rooms.AUTO, PaperSettings()])
def test_a_wrong_unit_is_told_before_the_long_work_begins(tmp_path, preset):
    heard = []
    done = []

    def warn(warning):
        heard.append(warning)
        raise InterruptedError

    def show(values, total, label):
        done.append(label)
        yield from values

    path = tmp_path / "mm.xyz"
    raw = seeded_cloud(1, 1500, size=(6000.0, 5000.0, 2500.0))
    np.savetxt(path, np.hstack([raw.points_world, raw.colors]), fmt="%.3f")
    no_cache = CachePolicy(is_used=False)
    workers = Workers(1, show, warn)
    with pytest.raises(InterruptedError):
        open_files([path], CloudSettings(), preset, no_cache, workers)
    (warning,) = heard
    assert warning.startswith(f"{path}: the cloud spans")
    assert warning.endswith("set `units` to mm")
    assert done == ["read mm.xyz"]
