import json
import sys

import numpy as np
import pytest
from clouds import read, seeded_cloud
from e57_files import ImageToWrite, ScanToWrite, sealed, with_xml, write
from hypothesis import given, settings, strategies as st
from refusals import assert_refused, mutated, read_or_refused
from scans import read_cloud

from piccolo.apps import e57_images
from piccolo.cloud.cloud_settings import IN_COLORS
from piccolo.cloud.readers import e57_file
from piccolo.cloud.readers.e57 import list_images, read_image
from piccolo.cloud.stream import open_source
from piccolo.geometry.pose import exp_so3, quaternion_wxyz
from piccolo.photo.camera.photo_cameras import find_calibration
from piccolo.system.errors import InputError

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
    azimuth = np.arctan2(y, x)
    elevation = np.arcsin(z / distance)
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
def test_chunks_hold_no_more_points_than_asked(tmp_path, read_by, chunk):
    read_by(chunk)
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
        open_source(write(tmp_path / "b.e57", [plain]), IN_COLORS)


def test_points_that_are_not_finite_are_handed_on_and_foreign_fields_change_nothing(tmp_path, read_by):
    raw = type(RAW)(RAW.points_world.copy(), RAW.colors)
    raw.points_world[:3] = [[np.inf, 0.0, 0.0], [np.nan, 1.0, 1.0], [1.7e308, 1.7e308, 1.7e308]]
    written = ScanToWrite(cartesian(raw) | colored(), BYTES, rotation_wxyz=QUATERNION)
    path = write(tmp_path / "a.e57", [written])
    assert len(read_cloud(path).points) == 1197
    assert "3 points with NaN" in read_cloud(path).warnings[0]
    read_by(100)
    chunks = open_source(write(tmp_path / "a.e57", [scan(), scan()])).read_chunks()
    np.testing.assert_array_equal(next(chunks).points_world, RAW.points_world[:100])
    chunks.close()
    normals = dict.fromkeys(("nor:normalX", "nor:normalY", "nor:normalZ"), np.full(1200, 0.5, np.float32))
    extra = normals | {"intensity": np.linspace(0.0, 1.0, 1200), "rowIndex": np.arange(1200)}
    points, colors = read(write(tmp_path / "a.e57", [scan(extra, {"rowIndex": (0, 1199)})]))
    np.testing.assert_array_equal(points, RAW.points_world)
    np.testing.assert_array_equal(colors, RAW.colors)


def with_header(content, position, value):
    return sealed(content[:position] + value.to_bytes(8, "little") + content[position + 8 :])


CUT = "the file is cut off or broken"
LONG = 1 << 40


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda content: content[:30], "and 30 bytes, wanted 'ASTM-E57'"),
        (lambda content: b"ASTM-E58" + content[8:], "unknown format|begins with b'ASTM-E58'"),
        (lambda content: with_header(content, 24, LONG), "bytes of XML from byte 1099511627776 on, wanted"),
        (lambda content: with_header(content, 40, 4096), "in pages of 4096 bytes, wanted 1 and 1024"),
        (lambda content: content[:300] + bytes([content[300] ^ 1]) + content[301:], "checksum mismatch"),
    ],
)
def test_damaged_files_are_refused(tmp_path, change, message):
    path = write(tmp_path / "a.e57", [scan()])
    path.write_bytes(change(path.read_bytes()))
    assert_refused(message, read, path)


BOMB = b'<?xml version="1.0"?><!DOCTYPE e [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;">]><e57Root'


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b'recordCount="1200"', b'recordCount="1201"', "promises 1201 points, found 1200|broken E57 file"),
        (b'recordCount="1200"', b'recordCount="9999999999999"', "promises 9999999999999 points of 216 bits"),
        (b'recordCount="1200"', b'recordCount="many"', "found 'many' in the XML section, wanted an integer"),
        (b'recordCount="1200"', b'recordCount="-5"', r"scan 1 of 1 \('a scan'\) has -5 points"),
        (b'maximum="255"', b'maximum="0"', "colours without a range: colorRed is declared 0 to 0"),
        (b'<?xml version="1.0" encoding="UTF-8"?>\n<e57Root', BOMB, "a document type definition"),
        (
            b"<e57Root",
            b'<e57Root xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance" '
            b'xsi:noNamespaceSchemaLocation="/etc/x"',
            "a schema in another file",
        ),
        (b"2010-e57-v1.0", b"2010-e57-v9.0", "no element e57Root of E57 1.0"),
        (b"</data3D>", b"", "the XML section is broken"),
        (b"</data3D>", b"<x>" * 40 + b"</x>" * 40 + b"</data3D>", "or 32 levels"),
        (b"</data3D>", b"<x/>" * 20_001 + b"</data3D>", "more than 500 elements .* or 20000 in a vector"),
        (b"</e57Root>", b"<x/>" * 500 + b"</e57Root>", "more than 500 elements in a structure"),
        (b">2.5e-01</w>", b">nan</w>", "found 'nan' in the XML section, wanted a finite number"),
        (b">2.5e-01</w>", b">0</w>", r"rotation is \[0.0, 0.0, 0.0, 0.0\], wanted a quaternion"),
        (b'"UTF-8"', b'"UTF-99"', "XML section is broken"),
    ],
)
def test_damaged_xml_is_refused(tmp_path, old, new, message):
    path = write(tmp_path / "a.e57", [scan(rotation_wxyz=(0.25, 0.0, 0.0, 0.0))])
    path.write_bytes(with_xml(path.read_bytes(), old, new))
    assert_refused(message, read, path)


def test_limits_of_the_xml_section(tmp_path, monkeypatch):
    path = write(tmp_path / "a.e57", [scan()])
    monkeypatch.setattr(e57_file, "MAX_ELEMENTS", 10)
    assert_refused("more than 10 elements", read, path)
    monkeypatch.setattr(e57_file, "MAX_XML_SIZE", 500)
    assert_refused(r"promises \d+ bytes of XML from byte \d+ on, wanted 500 at most", read, path)


def test_a_missing_library_is_named(tmp_path, monkeypatch):
    path = write(tmp_path / "a.e57", [scan()])
    monkeypatch.setitem(sys.modules, "pye57.libe57", None)
    assert_refused(r"needs pye57\.libe57, .*in a checkout '\.\[formats\]'", open_source, path)


def read_all(path):
    for index, _ in enumerate(list_images(path)):
        read_or_refused(lambda p, k=index: read_image(p, k), path)
    return read(path)


@settings(max_examples=50)
@given(data=st.data(), is_sealed=st.booleans())
def test_mutated_files_raise_nothing_but_input_error(tmp_path_factory, data, is_sealed):
    folder = tmp_path_factory.getbasetemp()
    path = folder / "mutated.e57"
    if not (folder / "whole.e57").exists():
        columns = {name: column[:60] for name, column in (cartesian() | colored()).items()}
        columns["cartesianInvalidState"] = np.zeros(60, dtype=np.int64)
        write(
            folder / "whole.e57",
            [ScanToWrite(columns, BYTES | {"cartesianInvalidState": (0, 2)}, None, (0.5, 0.5, 0.5, 0.5))],
            [ImageToWrite(b"\xff\xd8\xff and a picture", numbers={"imageWidth": 4, "imageHeight": 2})],
        )
    content = mutated(data.draw, st.integers, (folder / "whole.e57").read_bytes())
    path.write_bytes(sealed(content) if is_sealed else content)
    result, _ = read_or_refused(read_all, path)
    if result is not None:
        assert result[0].shape == result[1].shape


SPHERE = {"imageWidth": 400, "imageHeight": 200, "pixelWidth": np.pi / 200, "pixelHeight": np.pi / 200}
SMALL = {"imageWidth": 30, "imageHeight": 20}
JPEG = b"\xff\xd8\xff and a picture" * 90
PNG = b"\x89PNG\r\n\x1a\n and a picture"
IMAGES = [
    ImageToWrite(JPEG, "sphericalRepresentation", "jpegImage", SPHERE, name="pano", scan_guid="{scan}"),
    ImageToWrite(PNG, "pinholeRepresentation", "pngImage", SMALL, QUATERNION, tuple(CENTER)),
    ImageToWrite(PNG, "cylindricalRepresentation", "pngImage", SMALL),
    ImageToWrite(JPEG, "visualReferenceRepresentation", "jpegImage", SMALL),
]


def test_images_are_listed_and_read(tmp_path):
    path = write(tmp_path / "a.e57", [scan()], IMAGES)
    images = list_images(path)
    assert [image.kind for image in images] == ["spherical", "pinhole", "cylindrical", "visual-reference"]
    first = images[0]
    assert (first.name, first.width, first.height, first.size) == ("pano", 400, 200, len(JPEG))
    assert images[0].fov_deg == pytest.approx((360.0, 180.0))
    assert (images[0].scan_guid, images[0].pose, images[1].fov_deg) == ("{scan}", None, None)
    np.testing.assert_allclose(images[1].pose.R_cam_from_world.T, R_WORLD, atol=1e-12)
    np.testing.assert_array_equal(images[1].pose.center_world, CENTER)
    assert [read_image(path, k) for k in range(4)] == [JPEG, PNG, PNG, JPEG]
    assert list_images(write(tmp_path / "b.e57", [scan()])) == []


def test_images_are_written_as_files(tmp_path, capsys):
    path = write(tmp_path / "a scan.e57", [], [*IMAGES, ImageToWrite(b"GIF", numbers=SMALL)])
    assert e57_images.main([str(path)]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [row["is_usable"] for row in rows] == [True, False, False, False, True]
    assert rows[1]["pose"]["quaternion_wxyz_world_from_image"] == pytest.approx(quaternion_wxyz(R_WORLD))
    assert "file" not in rows[0]
    folder = tmp_path / "photos"
    assert e57_images.main([str(path), "--extract", str(folder)]) == 3  # the last is broken
    captured = capsys.readouterr()
    rows = [json.loads(line) for line in captured.out.splitlines()]
    assert "image 4 begins with b'GIF', wanted a jpeg file" in captured.err
    names = sorted(p.name for p in folder.iterdir())
    assert names == ["a_scan_0.jpg", "a_scan_1.png", "a_scan_2.png", "a_scan_3.jpg"]
    assert (folder / "a_scan_0.jpg").read_bytes() == JPEG
    assert rows[0]["file"] == str(folder / "a_scan_0.jpg")


def test_pinholes_are_written_with_their_calibration(tmp_path, capsys):
    lengths = {"focalLength": 0.012, "pixelWidth": 1e-5, "pixelHeight": 1.25e-5}
    whole = SMALL | lengths | {"principalPointX": 14.5, "principalPointY": 9.75}
    kind = "pinholeRepresentation", "pngImage"
    images = [ImageToWrite(PNG, *kind, whole), ImageToWrite(PNG, *kind, SMALL)]
    path = write(tmp_path / "a.e57", [], images)
    assert e57_images.main([str(path), "--extract", str(tmp_path)]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [row["is_usable"] for row in rows] == [True, False]
    (mount,) = find_calibration(tmp_path, tmp_path / "a_0.png").mounts
    assert (mount.camera.width, mount.camera.height) == (30, 20)
    assert (*mount.camera.focal, *mount.camera.center) == pytest.approx((1200.0, 960.0, 14.5, 9.75))
    assert not (tmp_path / "a_1.camera.json").exists()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b'length="25"', b'length="99999999"', "image 0 promises 99999999 bytes, found"),
        (b'length="25"', 'length="²"'.encode(), "wanted an integer"),
        (b">30</imageWidth>", b">0</imageWidth>", "an image's imageWidth is 0, wanted 1 to"),
        (b">30</imageWidth>", b">1e999</imageWidth>", "found '1e999' in the XML section"),
    ],
)
def test_damaged_images_are_refused(tmp_path, old, new, message):
    path = write(tmp_path / "a.e57", [], [ImageToWrite(JPEG[:25], numbers=SMALL)])
    path.write_bytes(with_xml(path.read_bytes(), old, new))
    assert_refused(message, list_images, path)
