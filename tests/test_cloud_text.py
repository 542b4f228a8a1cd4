import numpy as np
import pytest
from refusals import assert_refused
from test_cloud_morton import seeded_cloud, whole

from piccolo.cloud import read_cloud
from piccolo.cloud.readers.text import open_text
from piccolo.errors import InputError

RAW = seeded_cloud(1)


def lines_of(raw, separator=" ", color_format="d"):
    return [
        separator.join([*map("{:.6f}".format, point), *(f"{value:{color_format}}" for value in color)])
        for point, color in zip(raw.points_world, raw.colors, strict=True)
    ]


def write(path, lines, end="\n"):
    path.write_bytes((end.join(lines) + end).encode())
    return path


def assert_read_as_written(path, raw=RAW):
    read = whole(open_text, path)
    np.testing.assert_allclose(read.points_world, np.round(raw.points_world, 6), rtol=1e-15, atol=1e-15)
    np.testing.assert_array_equal(read.colors, raw.colors)


@pytest.mark.parametrize("separator", [" ", "\t", "   ", ",", ", ", ";"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_separators_and_line_ends(tmp_path, separator, end):
    assert_read_as_written(write(tmp_path / "a.txt", lines_of(RAW, separator), end))


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
    assert_read_as_written(write(tmp_path / "a.asc", header + lines_of(RAW)))


def test_comments_are_passed_over_and_headers_name_columns(tmp_path):
    lines = lines_of(RAW)
    assert_read_as_written(write(tmp_path / "a.xyz", [*lines[:700], "# half", "", "  ", "//", *lines[700:]]))
    lines = [f"{k},wall,{line}" for k, line in enumerate(lines_of(RAW, ","))]
    assert_read_as_written(write(tmp_path / "a.csv", ['index,"class",x,y,z,R,G,B', *lines]))
    assert_read_as_written(write(tmp_path / "a.txt", [line + " 0.5 label" for line in lines_of(RAW)]))
    lines = [" ".join([*f[:3], "0.25", *f[3:]]) for f in map(str.split, lines_of(RAW))]
    for header in ("//X Y Z Intensity R G B", "x y z i Red Green Blue", '"X" "Y" "Z" "I" r g b'):
        assert_read_as_written(write(tmp_path / "a.asc", [header, "1500", *lines]))
    assert_read_as_written(write(tmp_path / "a.txt", ["# x y z are metres", *lines_of(RAW)]))


@pytest.mark.parametrize("header", ["//X Y Z Classification Row Column", "x y z Rf Gf Bf"])
def test_columns_without_colors_are_refused(tmp_path, header):
    with pytest.raises(InputError, match=f"the columns are '{header}', wanted lines of numbers x y z r g b"):
        whole(open_text, write(tmp_path / "a.txt", [header, *lines_of(RAW)]))


def test_float_colors_and_nan_points_without_a_color_are_read(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("\n".join(lines_of(RAW, color_format=".2f")))
    assert_read_as_written(path)
    lines = ["nan nan nan nan nan nan", *lines_of(RAW), "inf 0 0 0 0 -1"]
    cloud = read_cloud(write(tmp_path / "a.txt", lines))
    assert cloud.num_dropped == 2
    assert len(cloud.points) == 1500


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        ("1.0 2.0 3.0 4 5", r"line 1001: 5 instead of 6 columns \('1.0 2.0 3.0 4 5'\), wanted lines"),
        ("1.0 2.\x100 3.0 4 5 6", r"line 1001: '2.\\x100' is not a number"),
        ("1 2 3 4 5 red", r"line 1001: 'red' is not a number"),
        ("1 2 3 4 5 1_0", r"line 1001: '1_0' is not a number"),
        ("1 2 3 4 --5 6", r"line 1001: '--5' is not a number"),
        ("1,0 2,0 3,0 4 5 6", r"line 1001: '1,0' is not a number"),
        ("1 2 3 4 5 256", r"line 1001 has the colour 4 5 256, wanted 0 to 255"),
        ("1 2 3 4 -5 6", r"line 1001 has the colour 4 -5 6"),
        ("1 2 3 4 nan 6", r"line 1001 has the colour 4 nan 6"),
    ],
)
def test_broken_lines_are_named(tmp_path, broken, message):
    lines = ["# a comment counts", *lines_of(RAW)]
    path = write(tmp_path / "a.txt", [*lines[:1000], broken, *lines[1000:]])
    with pytest.raises(InputError, match=message):
        whole(open_text, path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"1 2 3\n" * 2000, r"line 1 has 3 columns \(no colours\?\): '1 2 3', wanted lines of numbers"),
        (b"\x7fELF\x00\x00\x01 1 2 3 4 5 6\n" * 2000, "holds bytes that are no text"),
        (b"lorem ipsum\n" * 2000, "no line of numbers at its beginning"),
        (b"\xff\xfe" + "1 2 3 4 5 6\n".encode("utf-16-le") * 2000, "holds bytes that are no text"),
        (b"1,5;2,5;3,5;10;20;30\n" * 2000, "line 1: '1,5' is not a number .* with decimal points"),
        (b"1,5;2,5;3,5;0,1;0,2;0,3\n" * 2000, "no line of numbers at its beginning, .* with decimal points"),
        (b"1,5 2,5 3,5 10 20 30\n" * 2000, r"line 1 has 4 columns .* with decimal points"),
        (b"1 2 3 0.25 0.75 1\n" * 2000, "all points are black .* declared range are 0-255, not 0-1"),
        (b"1 2 3 4 5 6\n" * 999, "found 999 finite points"),
        (b"1 2 3 0 0 0\n" * 1000, "all points are black"),
        (b"", "the file is empty"),
    ],
)
def test_other_content_is_refused(tmp_path, content, message):
    path = tmp_path / "a.txt"
    path.write_bytes(content)
    assert_refused(message, read_cloud, path)
