import struct

import numpy as np
import pytest
from clouds import read
from pcd_files import COLORS, ENCODINGS, PACKED, RAW, XYZ, content_of, separate
from refusals import assert_refused
from scans import read_cloud

from piccolo.cloud.cloud_settings import IN_COLORS
from piccolo.cloud.readers import reader as raw
from piccolo.cloud.stream import open_source
from piccolo.system.errors import InputError


def write(path, fields, encoding="binary", **options):
    path.write_bytes(content_of(fields, encoding, **options))
    return path


def assert_read_as_written(path, type_="f4"):
    points_world, colors = read(path)
    expected = RAW.points_world.astype(type_).astype(np.float64)
    np.testing.assert_allclose(points_world, expected, rtol=1e-15)
    np.testing.assert_array_equal(colors, RAW.colors)


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("kind", COLORS)
def test_encodings_and_colors(tmp_path, encoding, kind, read_by):
    assert_read_as_written(write(tmp_path / "a.pcd", COLORS[kind], encoding))
    read_by(500)
    chunks = list(open_source(tmp_path / "a.pcd").read_chunks())
    assert [len(chunk.colors) for chunk in chunks] == [500, 500, 200]
    assert_read_as_written(tmp_path / "a.pcd")


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_padding_counts_and_other_fields_are_passed_over_and_doubles_stay(tmp_path, encoding):
    noise = np.random.default_rng(2).integers(0, 256, (1200, 3))
    fields = [("_", "u1", 3, noise), ("label", "u4", 1, noise[:, 0]), ("fpfh", "f4", 3, noise), *XYZ]
    fields += [("_", "u1", 3, noise), ("rgb", "u4", 1, PACKED), ("rgbs", "i2", 3, noise)]
    assert_read_as_written(write(tmp_path / "a.pcd", fields, encoding))
    xyz = [(name, "f8", 1, values) for name, _, _, values in XYZ]
    assert_read_as_written(write(tmp_path / "a.pcd", [*xyz, ("rgb", "u4", 1, PACKED)], encoding), "f8")


@pytest.mark.parametrize("lines", [{"COUNT": None}, {"WIDTH": None, "HEIGHT": None}, {"POINTS": None}])
def test_lines_that_old_files_leave_out(tmp_path, lines):
    fields = [*XYZ, ("rgb", "f4", 1, PACKED.view(np.float32))]
    assert_read_as_written(write(tmp_path / "a.pcd", fields, VERSION="0.5", VIEWPOINT=None, **lines))


def test_old_names_and_line_ends(tmp_path):
    fields = [*XYZ, ("rgb", "f4", 1, PACKED.view(np.float32))]
    content = content_of(fields, "ascii", SIZE=None, TYPE=None, COUNT=None).replace(b"FIELDS", b"COLUMNS")
    (tmp_path / "a.txt").write_bytes(b"# scan\n\n" + content.split(b"\n", 1)[1].replace(b"\n", b"\r\n"))
    assert_read_as_written(tmp_path / "a.txt")


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("kind", COLORS)
def test_nan_points_of_a_grid_need_no_color(tmp_path, encoding, kind):
    fields = [list(field) for field in COLORS[kind]]
    for field in fields:
        if field[1].startswith("f"):
            field[3] = field[3].copy()
            field[3][:30] = np.nan
    cloud = read_cloud(write(tmp_path / "a.pcd", fields, encoding))
    assert len(cloud.points) == 1170
    assert "30 points with NaN" in cloud.warnings[0]


@pytest.mark.parametrize(
    ("fields", "lines", "message"),
    [
        (XYZ, {}, "the fields are 'x y z', wanted a PCD file with the fields x y z and rgb"),
        ([*XYZ, *XYZ[:1], ("rgb", "u4", 1, PACKED)], {}, "the fields are 'x y z x rgb'"),
        ([*XYZ, ("rgb", "f8", 1, PACKED)], {}, "'rgb' is of type f8, wanted uint32, int32 or float32"),
        ([("x", "i2", 1, PACKED), *XYZ[1:], ("rgb", "u4", 1, PACKED)], {}, "'x' is of type i2, wanted float"),
        (None, {"SIZE": "4 4 4"}, "4 FIELDS, 3 of SIZE, 4 of TYPE"),
        (None, {"SIZE": "4 4 4 3"}, "'rgb 3 U 1', wanted SIZE 1 2 4 or 8"),
        (None, {"COUNT": "1 1 1 \u00b2"}, "COUNT 'rgb 4 U"),
        (None, {"COUNT": "1 1 1 999999"}, "promises 4000008 bytes a point"),
        (None, {"POINTS": "-5"}, "counts the points by 'WIDTH 600 HEIGHT 2 POINTS -5'"),
        (None, {"POINTS": "1201"}, "promises 1201 points in a grid of 1200"),
        (None, {"POINTS": "1201", "WIDTH": "1201", "HEIGHT": "1"}, "promises 1201 points in 19216 bytes"),
        (None, {"DATA": "zip"}, "DATA is 'zip', wanted ascii, binary, binary_compressed"),
        (None, {"DATA": None}, "no lines FIELDS and DATA"),
    ],
)
def test_broken_headers_are_refused(tmp_path, fields, lines, message):
    path = tmp_path / "a.pcd"
    path.write_bytes(content_of(fields or [*XYZ, ("rgb", "u4", 1, PACKED)], "binary", **lines))
    assert_refused(message, open_source, path, IN_COLORS)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"", b" 1", "line 12: 5 instead of 4 columns"),
        (b"4294967296", None, "point 1 has the colour 4.29497e.09, wanted 32 bits of type u4"),
        (b"nan", None, "point 1 has the colour nan, wanted 32 bits"),
        (b"red", None, "line 12: 'red' is not a number"),
    ],
)
def test_broken_lines_are_named(tmp_path, old, new, message):
    head, first, rest = content_of([*XYZ, ("rgb", "u4", 1, PACKED)], "ascii").partition(b"DATA ascii\n")
    line, _, rest = rest.partition(b"\n")
    line = line + new if new else line.rsplit(b" ", 1)[0] + b" " + old
    path = tmp_path / "a.pcd"
    path.write_bytes(head + first + line + b"\n" + rest)
    assert_refused(message, read, path)


def test_cut_text_and_a_colour_that_it_has_lost_are_refused(tmp_path):
    fields = [*XYZ, ("rgb", "f4", 1, (PACKED | np.uint32(0xFF800000)).view(np.float32))]
    with pytest.raises(InputError, match="point 1 has the colour nan, wanted 32 bits of type f4"):
        read(write(tmp_path / "a.pcd", fields, "ascii"))
    _, colors = read(write(tmp_path / "b.pcd", fields))
    np.testing.assert_array_equal(colors, RAW.colors | [128, 0, 0])
    path = write(tmp_path / "a.pcd", [*XYZ, ("rgb", "u4", 1, PACKED)], "ascii")
    path.write_bytes(b"\n".join(path.read_bytes().split(b"\n")[:-3]))
    assert_refused("found 1197 of 1200 points; the file is cut off", read, path)


@pytest.mark.parametrize(
    ("packed_size", "size"), [(2**32 - 1, 19200), (1, 19200), (100, 19200), (None, 2**32 - 1), (None, 0)]
)
def test_compressed_sizes_are_checked_before_memory_is_taken(tmp_path, packed_size, size):
    content = content_of([*XYZ, ("rgb", "u4", 1, PACKED)], "binary_compressed")
    at = content.index(b"binary_compressed\n") + 18
    sizes = struct.unpack("<II", content[at : at + 8])
    path = tmp_path / "a.pcd"
    path.write_bytes(content[:at] + struct.pack("<II", packed_size or sizes[0], size) + content[at + 8 :])
    assert_refused(r"wanted 19200 for 1200 points|compressed data are broken", read, path)


def test_what_packs_best_is_read_and_broken_data_are_refused(tmp_path):
    fields = [(name, type_, 1, np.zeros(1200)) for name, type_, *_ in COLORS["float r g b"]]
    path = write(tmp_path / "a.pcd", fields, "binary_compressed")
    assert not read(path)[1].any()
    head, line, packed = path.read_bytes().partition(b"binary_compressed\n")
    path.write_bytes(head + line + packed[:8] + b"\xff" * (len(packed) - 8))  # copies of what is not there
    assert_refused("the compressed data are broken", read, path)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_file_cut_while_it_is_read_is_refused(tmp_path, read_by, encoding):
    read_by(50, 2048)
    path = write(tmp_path / "a.pcd", COLORS["r g b"], encoding)
    source = open_source(path)
    chunks = source.read_chunks()
    next(chunks)
    content = path.read_bytes()
    size = len(content) // 2
    with path.open("r+b") as file:
        file.truncate(content.rindex(b"\n", 0, size) + 1 if encoding == "ascii" else size)
    if encoding == "binary_compressed":  # it was in memory; the next reading tells
        assert sum(len(chunk.colors) for chunk in chunks) == 1150
        chunks = source.read_chunks()
    with pytest.raises(InputError, match=r"the file was cut while it was read|the file is cut off") as error:
        list(chunks)
    assert str(error.value).startswith(f"{path}: ")


def test_long_records_come_in_smaller_chunks(tmp_path, monkeypatch):
    monkeypatch.setattr(raw, "MAX_BLOCK_SIZE", 1000)
    path = write(tmp_path / "a.pcd", separate("f4", 1))
    assert [len(chunk.colors) for chunk in open_source(path).read_chunks()] == [41] * 29 + [11]
    assert_read_as_written(path)
    fields = separate("f4", 1)
    fields[4][3][107] = 1.5
    assert_refused("point 108 has the colour", read, write(path, fields))


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_whole_numbers_in_a_field_declared_a_float_are_colors(tmp_path, encoding):
    fields = [*XYZ, ("rgb", "f4", 1, (PACKED & np.uint32(0xFFFFFF)).astype(np.float32))]
    assert_read_as_written(write(tmp_path / "a.pcd", fields, encoding))
