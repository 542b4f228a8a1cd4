import numpy as np
import pytest
from e57_files import ScanToWrite, write
from refusals import assert_refused
from test_cloud_morton import read, seeded_cloud

from piccolo.cloud import open_source, read_cloud
from piccolo.cloud.readers import e57
from piccolo.errors import InputError
from piccolo.geometry.pose import exp_so3, quaternion_wxyz

RAW = seeded_cloud(3, num_points=1200)
R_WORLD = exp_so3(np.array([0.4, -1.1, 2.0]))
QUATERNION = tuple(quaternion_wxyz(R_WORLD))
CENTER = np.array([12.0, -7.5, 1.25])
XYZ = ("cartesianX", "cartesianY", "cartesianZ")
RGB = ("colorRed", "colorGreen", "colorBlue")
BYTES = dict.fromkeys(RGB, (0, 255))


def cartesian(raw=RAW, dtype=np.float64):
    return dict(zip(XYZ, raw.points_world.T.astype(dtype), strict=True))


def colored(colors=RAW.colors):
    return dict(zip(RGB, colors.T, strict=True))


def color_limits(low, high):
    return {name + end: value for name in RGB for end, value in (("Minimum", low), ("Maximum", high))}


def scan(extra=(), declared=(), **options):
    return ScanToWrite(cartesian() | colored() | dict(extra), BYTES | dict(declared), **options)


def placed(**options):
    return scan(rotation_wxyz=QUATERNION, center_world=tuple(CENTER), **options)


def test_scans_stand_at_their_poses_by_quaternions_of_any_length(tmp_path):
    path = write(tmp_path / "a.e57", [placed(), scan(center_world=(1.0, 2.0, 3.0)), scan()])
    source = open_source(path)
    points, colors = read(path)
    assert (source.num_points, source.warnings) == (3600, ())
    np.testing.assert_allclose(points[:1200], RAW.points_world @ R_WORLD.T + CENTER, atol=1e-12)
    np.testing.assert_allclose(points[1200:2400], RAW.points_world + np.array([1.0, 2.0, 3.0]), atol=1e-12)
    np.testing.assert_array_equal(points[2400:], RAW.points_world)
    np.testing.assert_array_equal(colors, np.tile(RAW.colors, (3, 1)))
    assert len(read_cloud(path).points) == 3600
    longer = scan(rotation_wxyz=tuple(-3.0 * quaternion_wxyz(R_WORLD)))
    points, _ = read(write(tmp_path / "a.e57", [longer]))
    np.testing.assert_allclose(points, RAW.points_world @ R_WORLD.T, atol=1e-12)


def test_scanners_with_a_pose_tell_their_z_axis(tmp_path):
    path = write(tmp_path / "a.e57", [placed(), scan(center_world=(1.0, 2.0, 3.0)), scan()])
    np.testing.assert_allclose(open_source(path).station_axes, [R_WORLD[:, 2], [0.0, 0.0, 1.0]], atol=1e-12)
    identity = scan(rotation_wxyz=(1.0, 0.0, 0.0, 0.0), center_world=(0.0, 0.0, 0.0))
    assert open_source(write(tmp_path / "b.e57", [identity])).station_axes == ()


def test_spherical_coordinates_single_precision_and_scaled_integers(tmp_path):
    distance = np.linalg.norm(RAW.points_world, axis=1)
    x, y, z = RAW.points_world.T
    azimuth, elevation = np.arctan2(y, x), np.arcsin(z / distance)
    spherical = {"sphericalRange": distance, "sphericalAzimuth": azimuth, "sphericalElevation": elevation}
    written = ScanToWrite(spherical | colored(), BYTES, None, QUATERNION)
    points, _ = read(write(tmp_path / "a.e57", [written]))
    np.testing.assert_allclose(points, RAW.points_world @ R_WORLD.T, atol=1e-12)
    single = ScanToWrite(cartesian(dtype=np.float32) | colored(), BYTES)
    millimetres = np.rint(RAW.points_world * 1000).astype(np.int64)
    columns = dict(zip(XYZ, millimetres.T, strict=True))
    whole = ScanToWrite(columns | colored(), BYTES | dict.fromkeys(columns, (-20_000, 20_000, 0.001)))
    points, _ = read(write(tmp_path / "a.e57", [single, whole]))
    np.testing.assert_array_equal(points[:1200], RAW.points_world.astype(np.float32))
    np.testing.assert_allclose(points[1200:], millimetres / 1000.0, atol=1e-12)


@pytest.mark.parametrize("chunk", [1, 7, 1199, 1200, 1201])
def test_chunks_hold_no_more_points_than_asked(tmp_path, monkeypatch, chunk):
    monkeypatch.setattr(e57, "CHUNK", chunk)
    num_points = 30 if chunk == 1 else 1200
    raw = type(RAW)(RAW.points_world[:num_points], RAW.colors[:num_points])
    written = ScanToWrite(cartesian(raw) | colored(raw.colors), BYTES)
    source = open_source(write(tmp_path / "a.e57", [written, written]))
    for _ in range(2):  # each call reads anew
        chunks = list(source.read_chunks())
        assert max(len(c.colors) for c in chunks) <= chunk
        points = np.concatenate([c.points_world for c in chunks])
        np.testing.assert_array_equal(points, np.tile(raw.points_world, (2, 1)))


def test_invalid_points_of_any_color_and_invalid_colors_are_left_out(tmp_path):
    state = np.arange(1200) % 3  # 0 whole, 1 direction only, 2 nothing
    is_gray = np.arange(1200) % 5 == 0
    extra = {"cartesianInvalidState": state, "isColorInvalid": is_gray.astype(np.int64)}
    declared = {"cartesianInvalidState": (0, 2), "isColorInvalid": (0, 1)}
    points, colors = read(write(tmp_path / "a.e57", [scan(extra, declared)]))
    is_whole = (state == 0) & ~is_gray
    np.testing.assert_array_equal(points, RAW.points_world[is_whole])
    np.testing.assert_array_equal(colors, RAW.colors[is_whole])
    red = np.where(np.arange(1200) < 5, 999, RAW.colors[:, 0])
    extra = {"colorRed": red, "cartesianInvalidState": (np.arange(1200) < 5).astype(np.int64)}
    declared = {"colorRed": (0, 999), "cartesianInvalidState": (0, 1)}
    _, colors = read(write(tmp_path / "a.e57", [scan(extra, declared, limits=color_limits(0, 255))]))
    np.testing.assert_array_equal(colors, RAW.colors[5:])


@pytest.mark.parametrize(
    ("dtype", "low", "high", "limits"),
    [
        (np.int64, 0, 65535, None),
        (np.int64, -100, 900, None),
        (np.float32, 0.0, 1.0, None),
        (np.float64, 0.25, 0.75, None),
        (np.int64, 0, 1000, (0, 1000)),
        (np.float32, None, None, (0.0, 1.0)),
        (np.float64, 0.0, 4.0, (0.0, 1.0)),  # colorLimits go before the declaration
        (np.int64, 0, 255, (7, 7)),  # limits that are no range don't
    ],
)
def test_color_ranges_are_those_that_the_file_declares(tmp_path, dtype, low, high, limits):
    first, last = limits if limits and limits[0] < limits[1] else (low, high)
    values = (RAW.colors * ((last - first) / 255) + first).astype(np.float64)
    values = values.astype(dtype) if np.issubdtype(dtype, np.floating) else np.rint(values).astype(dtype)
    declared = dict.fromkeys(RGB, () if low is None else (low, high))
    named = limits and color_limits(*limits)
    written = ScanToWrite(cartesian() | colored(values), declared, named)
    _, colors = read(write(tmp_path / "a.e57", [written]))
    expected = np.rint((values - first) / (last - first) * 255)
    assert abs(colors - expected).max() <= (1 if dtype == np.float32 else 0)
    tolerance = 0 if last - first >= 255 or dtype != np.int64 else 1
    assert abs(colors - RAW.colors.astype(float)).max() <= tolerance


def test_colors_without_or_outside_of_their_range_and_files_without_points_are_refused(tmp_path):
    path = write(tmp_path / "a.e57", [scan(limits=color_limits(0, 100))])
    assert_refused(r"scan 1 of 1 \('a scan'\) has a colour of \d+, wanted 0 to 100", read, path)
    written = ScanToWrite(cartesian() | colored(RAW.colors / 255.0))
    with pytest.raises(InputError, match="colours without a range: neither colorLimits nor a declared"):
        open_source(write(tmp_path / "a.e57", [written]))
    empty = ScanToWrite({name: column[:0] for name, column in (cartesian() | colored()).items()}, BYTES)
    assert_refused(r"scan 1 of 1 \('a scan'\) has 0 points", open_source, write(tmp_path / "a.e57", [empty]))
    assert_refused("no scans, wanted scans with", open_source, write(tmp_path / "b.e57"))


def test_scans_without_colors_are_left_out_beside_others(tmp_path):
    plain = ScanToWrite(cartesian(), name="gray")
    path = write(tmp_path / "a.e57", [plain, placed(), ScanToWrite(colored(), BYTES)])
    source = open_source(path)
    assert source.num_points == 1200
    assert source.warnings == (
        f"{path}: scan 1 of 3 ('gray') has no colours; left out",
        f"{path}: scan 3 of 3 ('a scan') has neither cartesian nor spherical coordinates; left out",
    )
    np.testing.assert_allclose(read(path)[0], RAW.points_world @ R_WORLD.T + CENTER, atol=1e-12)
    with pytest.raises(InputError, match=r"scan 1 of 1 \('gray'\) has no colours, wanted scans"):
        open_source(write(tmp_path / "b.e57", [plain]))


def test_points_that_are_not_finite_are_handed_on_and_foreign_fields_change_nothing(tmp_path, monkeypatch):
    raw = type(RAW)(RAW.points_world.copy(), RAW.colors)
    raw.points_world[:3] = [[np.inf, 0.0, 0.0], [np.nan, 1.0, 1.0], [1.7e308, 1.7e308, 1.7e308]]
    written = ScanToWrite(cartesian(raw) | colored(), BYTES, rotation_wxyz=QUATERNION)
    path = write(tmp_path / "a.e57", [written])
    assert (read_cloud(path).num_dropped, len(read_cloud(path).points)) == (3, 1197)
    monkeypatch.setattr(e57, "CHUNK", 100)
    chunks = open_source(write(tmp_path / "a.e57", [scan(), scan()])).read_chunks()
    np.testing.assert_array_equal(next(chunks).points_world, RAW.points_world[:100])
    chunks.close()
    normals = dict.fromkeys(("nor:normalX", "nor:normalY", "nor:normalZ"), np.full(1200, 0.5, np.float32))
    extra = normals | {"intensity": np.linspace(0.0, 1.0, 1200), "rowIndex": np.arange(1200)}
    points, colors = read(write(tmp_path / "a.e57", [scan(extra, {"rowIndex": (0, 1199)})]))
    np.testing.assert_array_equal(points, RAW.points_world)
    np.testing.assert_array_equal(colors, RAW.colors)
