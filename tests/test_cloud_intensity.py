"""Intensity taken for a gray."""

from pathlib import Path

import numpy as np
import pytest
from clouds import seeded_cloud, whole
from e57_files import ScanToWrite, write as write_e57
from las_files import OFFSETS, las_bytes, laz_bytes
from pcd_files import content_of
from refusals import assert_refused
from scans import write_scalars

from piccolo.cloud.cloud_settings import BY_FILE, IN_COLORS, WITHOUT_COLORS, CloudSettings
from piccolo.cloud.readers.e57 import open_e57
from piccolo.cloud.readers.las import open_las
from piccolo.cloud.readers.pcd import open_pcd
from piccolo.cloud.readers.ply import open_ply
from piccolo.cloud.readers.reader import MissingChannelError, RawCloud, as_gray, make_source
from piccolo.cloud.readers.text import open_ptx, open_text
from piccolo.cloud.stream import open_cloud, open_source
from piccolo.geometry.pose import exp_so3

POINTS = seeded_cloud(1, num_points=3000).points_world


def _measured(seed, kind):
    rng = np.random.default_rng(seed)
    return {
        "bytes": rng.integers(0, 256, 3000).astype(float),
        "16 bits": rng.integers(0, 60_000, 3000).astype(float),
        "decibels": rng.normal(-30.0, 9.0, 3000),
        "mirrors": np.where(np.arange(3000) % 300 == 0, 1e6, rng.random(3000)),
    }[kind]


def _in_gray(intensity, points=POINTS, chunk=701):
    def read():
        for lo in range(0, len(points), chunk):
            yield points[lo : lo + chunk], intensity[lo : lo + chunk]

    return np.concatenate([raw.colors for raw in make_source(Path("a"), read, "intensity").read_chunks()])


def assert_gray(open_file, path, intensity, points_world=POINTS, atol=1e-9):
    read = whole(open_file, path, BY_FILE, "intensity")
    np.testing.assert_array_equal(read.colors, _in_gray(intensity))
    np.testing.assert_allclose(read.points_world, points_world, atol=atol)
    source = open_source(path)
    assert source.channel == "intensity"
    assert source.warnings[-1].startswith(str(path))
    with pytest.raises(MissingChannelError):
        open_source(path, IN_COLORS)


@pytest.mark.parametrize("kind", ["bytes", "16 bits", "decibels", "mirrors"])
def test_percentiles_become_black_and_white(kind):
    intensity = _measured(1, kind)
    low, high = np.percentile(intensity, [1, 99], method="inverted_cdf")
    expected = np.clip((intensity - low) / (high - low), 0.0, 1.0) * 255.0
    gray = _in_gray(intensity)
    assert (gray == gray[:, :1]).all()
    assert np.abs(gray[:, 0] - expected).max() <= (0.5 if kind == "bytes" else 5.0)
    assert (gray.min(), gray.max()) == (0, 255)


def test_order_and_chunks_change_no_bit():
    intensity = _measured(2, "decibels")
    shuffle = np.random.default_rng(3).permutation(3000)
    shuffled = _in_gray(intensity[shuffle], POINTS[shuffle], 47)
    np.testing.assert_array_equal(_in_gray(intensity)[shuffle], shuffled)


def test_what_has_no_position_or_no_intensity_does_not_count():
    intensity = _measured(4, "bytes")
    points = POINTS.copy()
    expected = _in_gray(intensity[:2000], points[:2000])
    intensity[2000:2500] = np.nan
    intensity[2500:] = 1e30
    points[2500:, 1] = np.nan
    np.testing.assert_array_equal(_in_gray(intensity, points)[:2000], expected)


def test_one_intensity_for_all_is_none_and_what_is_not_finite_is_black():
    gray = as_gray(np.array([np.nan, -np.inf, np.inf, 0.5]), 0.0, 1.0)
    assert gray[:, 0].tolist() == [0, 0, 255, 128]
    assert (_in_gray(np.full(3000, 7.0)) == 128).all()


def _ply(path, name, kind="f4", text=False):
    return write_scalars(path, POINTS, name, _measured(5, "16 bits"), kind, text)


@pytest.mark.parametrize("name", ["intensity", "scalar_Intensity", "reflectance"])
@pytest.mark.parametrize(("kind", "text"), [("u2", False), ("f4", False), ("f8", True)])
def test_ply(tmp_path, name, kind, text):
    path = _ply(tmp_path / "a.ply", name, kind, text)
    assert_gray(open_ply, path, _measured(5, "16 bits"))


LAYOUTS = {
    "a.xyz": lambda rows: [f"{x} {y} {z} {i}" for x, y, z, i in rows],
    "a.pts": lambda rows: ["3000", *(f"{x} {y} {z} {i}" for x, y, z, i in rows)],
    "a.csv": lambda rows: ["id,Intensity,x,y,z,ring,a", *(f"9,{i},{x},{y},{z},3,1" for x, y, z, i in rows)],
}


@pytest.mark.parametrize("name", list(LAYOUTS))
def test_text(tmp_path, name):
    path = tmp_path / name
    intensity = _measured(6, "decibels")
    path.write_text("\n".join(LAYOUTS[name](np.column_stack([POINTS, intensity]).tolist())))
    assert_gray(open_text, path, intensity)


def test_colours_come_first_and_the_map_is_gray(tmp_path):
    lines = ["x y z intensity r g b", *(f"{x} {y} {z} 5 10 20 30" for x, y, z in POINTS.tolist())]
    (tmp_path / "a.txt").write_text("\n".join(lines))
    assert (whole(open_source, tmp_path / "a.txt", BY_FILE).colors == [10, 20, 30]).all()
    in_gray = whole(open_source, tmp_path / "a.txt", CloudSettings(channels=WITHOUT_COLORS))
    assert (in_gray.colors == 128).all()
    nodes = open_cloud([_ply(tmp_path / "b.ply", "intensity")]).voxels(np.eye(3)).nodes
    assert (nodes[:, 3] == nodes[:, 5]).all()
    assert np.ptp(nodes[:, 4]) == 1.0


@pytest.mark.parametrize("point_format", [0, 1, 3, 4, 6, 7, 9])
@pytest.mark.parametrize("is_compressed", [False, True])
def test_las(tmp_path, point_format, is_compressed):
    intensity = _measured(7, "16 bits")
    raw = RawCloud(np.round(POINTS, 2) + OFFSETS, np.zeros((3000, 3), np.uint8))
    content = las_bytes(raw, point_format, intensity=intensity.astype(np.uint16))
    path = tmp_path / "a.las"
    path.write_bytes(laz_bytes(content, chunk=700) if is_compressed else content)
    assert_gray(open_las, path, intensity, raw.points_world, atol=0.002)


def test_ptx_at_its_pose_without_beams_that_did_not_return(tmp_path):
    intensity = _measured(8, "decibels")
    R = exp_so3(np.array([0.2, -0.4, 1.0]))
    header = ["3001", "1", "0 0 0", "1 0 0", "0 1 0", "0 0 1"]
    matrix = [" ".join(map(repr, [*map(float, row), 0.0])) for row in R.T] + ["5.0 6.0 7.0 1.0"]
    rows = np.column_stack([POINTS, intensity]).tolist()
    lines = [*header, *matrix, "0 0 0 0.5", *(" ".join(map(repr, row)) for row in rows)]
    path = tmp_path / "a.ptx"
    path.write_text("\n".join(lines) + "\n")
    assert_gray(open_ptx, path, intensity, POINTS @ R.T + [5.0, 6.0, 7.0])


def _e57_scan(points, **more):
    columns = {f"cartesian{axis}": points[:, k] for k, axis in enumerate("XYZ")}
    return ScanToWrite({**columns, **more}, rotation_wxyz=(0.0, 0.0, 0.0, 1.0), center_world=(1.0, 2.0, 3.0))


def test_e57_scans_have_one_gray_for_all(tmp_path):
    intensity = _measured(9, "decibels")
    halves = [_e57_scan(POINTS[part], intensity=intensity[part]) for part in (slice(1000), slice(1000, None))]
    path = write_e57(tmp_path / "a.e57", halves)
    assert_gray(open_e57, path, intensity, POINTS * [-1, -1, 1] + [1.0, 2.0, 3.0])
    bare = write_e57(tmp_path / "b.e57", [_e57_scan(POINTS)])
    assert_refused("has no colours, wanted scans with", open_e57, bare)
    assert_refused("has no intensity, wanted scans with", open_e57, bare, BY_FILE, "intensity")


def test_e57_scans_without_intensity_are_named(tmp_path):
    intensity = _measured(9, "decibels")
    scans = [_e57_scan(POINTS[:1000]), _e57_scan(POINTS[1000:], intensity=intensity[1000:])]
    path = write_e57(tmp_path / "a.e57", scans)
    source = open_source(path)
    assert len(source.warnings) == 2
    assert "scan 1 of 2 ('a scan') has no intensity; left out" in source.warnings[0]
    assert sum(len(chunk.colors) for chunk in source.read_chunks()) == 2000


def test_ptx_scans_without_colors_are_left_out_beside_others(tmp_path):
    header = ["1", "1", "0 0 0", "1 0 0", "0 1 0", "0 0 1", "1 0 0 0", "0 1 0 0", "0 0 1 0", "0 0 0 1"]
    path = tmp_path / "a.ptx"
    path.write_text("\n".join([*header, "1 2 3 0.5", *header, "1 2 3 0.5 10 20 30"]) + "\n")
    read = whole(open_source, path, BY_FILE)
    np.testing.assert_array_equal(read.points_world, [[1.0, 2.0, 3.0]])
    np.testing.assert_array_equal(read.colors, [[10, 20, 30]])
    assert "1 of 2 scans without colours left out" in open_source(path).warnings[0]


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_pcd(tmp_path, encoding):
    intensity = _measured(11, "decibels").astype(np.float32)
    table = np.column_stack([POINTS, intensity]).astype("<f4")
    names = ("x", "y", "z", "intensity")
    fields = [(name, "f4", 1, column) for name, column in zip(names, table.T, strict=True)]
    path = tmp_path / "a.pcd"
    path.write_bytes(content_of(fields, encoding, 3000))
    assert_gray(open_pcd, path, intensity.astype(float), table[:, :3])
