import numpy as np
import pytest
from clouds import read, seeded_cloud, whole
from hypothesis import given, strategies as st
from ply_files import vertices, write as write_ply
from plyfile import PlyElement
from refusals import assert_refused
from scans import read_cloud
from text_files import lines_of, write_lines

from piccolo.cloud.cloud_settings import IN_COLORS
from piccolo.cloud.readers.ply import open_ply
from piccolo.cloud.readers.text import open_text
from piccolo.system.errors import InputError
from piccolo.system.files.json_file import is_number

RAW = seeded_cloud(1)


def assert_read_as_written(path, raw=RAW):
    read = whole(open_text, path)
    np.testing.assert_allclose(read.points_world, np.round(raw.points_world, 6), rtol=1e-15, atol=1e-15)
    np.testing.assert_array_equal(read.colors, raw.colors)


@pytest.mark.parametrize("separator", [" ", "\t", "   ", ",", ", ", ";"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_separators_and_line_ends(tmp_path, separator, end):
    assert_read_as_written(write_lines(tmp_path / "a.txt", lines_of(RAW, separator), end))


@pytest.mark.parametrize(
    "header",
    [
        ["# made by hand", "", "// another"],
        ["//X Y Z R G B"],
        ["X Y Z Red Green Blue", "1500"],
        ["\ufeffx y z r g b"],
        ["name of the scan"],
        ["1500"],
    ],
)
def test_headers_are_passed_over(tmp_path, header):
    assert_read_as_written(write_lines(tmp_path / "a.asc", header + lines_of(RAW)))


def test_comments_are_passed_over_and_headers_name_columns(tmp_path):
    lines = lines_of(RAW)
    assert_read_as_written(
        write_lines(tmp_path / "a.xyz", [*lines[:700], "# half", "", "  ", "//", *lines[700:]])
    )
    lines = [f"{k},wall,{line}" for k, line in enumerate(lines_of(RAW, ","))]
    assert_read_as_written(write_lines(tmp_path / "a.csv", ['index,"class",x,y,z,R,G,B', *lines]))
    assert_read_as_written(write_lines(tmp_path / "a.txt", [line + " 0.5 label" for line in lines_of(RAW)]))
    lines = [" ".join([*f[:3], "0.25", *f[3:]]) for f in map(str.split, lines_of(RAW))]
    for header in (
        "//X Y Z Intensity R G B",
        "X[m] Y[m] Z[m] I[-] R[-] G[-] B[-]",
        "x y z i Red Green Blue",
        '"X" "Y" "Z" "I" r g b',
    ):
        assert_read_as_written(write_lines(tmp_path / "a.asc", [header, "1500", *lines]))
    assert_read_as_written(write_lines(tmp_path / "a.txt", ["# x y z are metres", *lines_of(RAW)]))


@pytest.mark.parametrize("header", ["//X Y Z Classification Row Column"])
def test_columns_without_colors_are_refused(tmp_path, header):
    with pytest.raises(InputError, match=f"the columns are '{header}', wanted lines of numbers x y z r g b"):
        whole(open_text, write_lines(tmp_path / "a.txt", [header, *lines_of(RAW)]))


def test_float_colors_and_nan_points_without_a_color_are_read(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("\n".join(lines_of(RAW, color_format=".2f")))
    assert_read_as_written(path)
    lines = ["nan nan nan nan nan nan", *lines_of(RAW), "inf 0 0 0 0 -1"]
    cloud = read_cloud(write_lines(tmp_path / "a.txt", lines))
    assert "2 points with NaN" in cloud.warnings[0]
    assert len(cloud.points) == 1500


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        ("1.0 2.0 3.0 4 5", r"line 1001: 5 instead of 6 columns \('1.0 2.0 3.0 4 5'\), wanted lines"),
        ("1.0 2.\x100 3.0 4 5 6", r"line 1001: '2.\\x100' is not a number"),
        ("1 2 3 4 5 red", r"line 1001: 'red' is not a number"),
        ("1,0 2,0 3,0 4 5 6", r"line 1001: '1,0' is not a number"),
        ("1 2 3 4 5 256", r"line 1001 has the colour 4 5 256, wanted 0 to 255"),
    ],
)
def test_broken_lines_are_named(tmp_path, broken, message):
    lines = ["# a comment counts", *lines_of(RAW)]
    path = write_lines(tmp_path / "a.txt", [*lines[:1000], broken, *lines[1000:]])
    assert_refused(message, read, path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"1 2 3\n" * 2000, r"line 1 has 3 columns \(no colors\?\): '1 2 3', wanted lines of numbers"),
        (b"\x7fELF\x00\x00\x01 1 2 3 4 5 6\n" * 2000, "holds bytes that are no text"),
        (b"lorem ipsum\n" * 2000, "no line of numbers at its beginning"),
        (b"1 2 3 0 0 0\n" * 2000, r"all points are black .* `color_range` sets their range"),
        (b"", "the file is empty"),
    ],
)
def test_other_content_is_refused(tmp_path, content, message):
    path = tmp_path / "a.txt"
    path.write_bytes(content)
    assert_refused(message, read_cloud, path, IN_COLORS)


@pytest.fixture
def small(read_by):
    read_by(13, 101)


@given(field=st.text("0123456789.+-eEinfatyNAx_j\xa0", max_size=6).filter(str.strip))
def test_a_number_is_what_loadtxt_takes_for_one(field):
    try:
        np.loadtxt([field.encode("latin-1")], comments=None, delimiter=",")
    except ValueError:
        assert not is_number(field)
    else:
        assert is_number(field)


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("last", ["", "\n"])
def test_text_in_small_blocks_is_the_same(tmp_path, small, end, last):
    path = tmp_path / "a.txt"
    path.write_bytes((end.join(["\ufeff// x y z r g b", *lines_of(RAW), "", "# end"]) + last).encode())
    read = whole(open_text, path)
    np.testing.assert_allclose(read.points_world, np.round(RAW.points_world, 6), rtol=1e-15, atol=1e-15)
    np.testing.assert_array_equal(read.colors, RAW.colors)
    assert max(len(chunk.colors) for chunk in open_text(path).read_chunks()) <= 13


@pytest.mark.parametrize("encoding", [{"byte_order": "<"}, {"byte_order": ">"}, {"text": True}])
def test_ply_in_small_chunks_is_the_same(tmp_path, small, encoding):
    cameras = PlyElement.describe(vertices(seeded_cloud(2, num_points=40)).data, "camera")
    path = write_ply(tmp_path / "a.ply", cameras, vertices(RAW), **encoding)
    source = open_ply(path)
    assert source.num_points == 1500
    chunks = list(source.read_chunks())
    assert [len(chunk.colors) for chunk in chunks] == [13] * 115 + [5]
    read = whole(open_ply, path)
    np.testing.assert_allclose(read.points_world, RAW.points_world.astype("f4").astype(float), rtol=1e-15)
    np.testing.assert_array_equal(read.colors, RAW.colors)


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize(("broken", "message"), [("1 2 x 4 5 6", ": 'x' is"), ("1 2 3 4 5 256", "has the")])
def test_line_numbers_count_across_blocks(tmp_path, small, end, broken, message):
    path = tmp_path / "a.txt"
    path.write_bytes(end.join(["# one", "", *lines_of(RAW)[:700], "", broken, *lines_of(RAW)[:9]]).encode())
    assert_refused(f"line 704 ?{message}", read, path)


def test_line_numbers_of_ply_count_across_blocks(tmp_path, small):
    path = write_ply(tmp_path / "a.ply", vertices(RAW), text=True)
    content = path.read_bytes().split(b"\n")
    header = content.index(b"end_header") + 1
    content[header + 600] = b"1 2 3"
    path.write_bytes(b"\n".join(content))
    assert_refused(f"line {header + 601}: 3 instead of 6 columns", read, path)


def test_endless_lines_take_no_memory(tmp_path, small):
    path = tmp_path / "a.txt"
    path.write_bytes("\n".join(lines_of(RAW)[:50]).encode() + b"\n1 2 3 4 5 6" + b" " * 500)
    assert_refused(r"a\.txt: a line of more than 101 bytes, wanted lines of a few num", read, path)
