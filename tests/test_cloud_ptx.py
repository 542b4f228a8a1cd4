import numpy as np
import pytest
from clouds import read
from refusals import assert_input_error, assert_refused
from scans import read_cloud
from text_files import RAW, THERE, TWO_SCANS, pts, scan, write_lines

from piccolo.cloud.readers import text
from piccolo.cloud.readers.text import line_blocks, open_ptx, open_text
from piccolo.cloud.stream import open_source
from piccolo.system.errors import InputError


def assert_read_as_written(path, raw_cloud=RAW, atol=1e-12):
    points_world, colors = read(path)
    np.testing.assert_allclose(points_world, raw_cloud.points_world, rtol=0, atol=atol)
    np.testing.assert_array_equal(colors, raw_cloud.colors)


def test_scanners_with_a_place_tell_their_z_axis(tmp_path):
    lines = [*scan(RAW.points_world, RAW.colors, THERE), *scan(RAW.points_world, RAW.colors, np.eye(4))]
    (axis,) = open_ptx(write_lines(tmp_path / "a.ptx", lines)).station_axes
    np.testing.assert_allclose(axis, THERE[2, :3], atol=1e-12)
    doubled = THERE * np.array([[2.0], [2.0], [2.0], [1.0]])  # a matrix that scales
    (axis,) = open_ptx(
        write_lines(tmp_path / "a.ptx", scan(RAW.points_world, RAW.colors, doubled))
    ).station_axes
    np.testing.assert_allclose(axis, THERE[2, :3], atol=1e-12)


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_scans_are_put_in_the_world(tmp_path, end):
    path = write_lines(tmp_path / "a.ptx", TWO_SCANS, end)
    assert_read_as_written(path, atol=1e-8)
    assert open_source(path).num_points == 1200
    assert open_source(path).warnings == ()


def test_large_coordinates_keep_their_digits_without_points_that_did_not_return(tmp_path):
    far = type(RAW)(RAW.points_world + THERE[3, :3], RAW.colors)
    assert_read_as_written(
        write_lines(tmp_path / "a.ptx", scan(far.points_world, far.colors, THERE)), far, 2e-9
    )
    lines = scan(RAW.points_world, RAW.colors, count=1202)
    path = write_lines(
        tmp_path / "a.ptx", [*lines[:100], "0 0 0 0.5 9 9 9", *lines[100:], "0.0 -0.0 0 0 0 0 0"]
    )
    assert_read_as_written(path)
    assert_read_as_written(write_lines(tmp_path / "a.txt", TWO_SCANS), atol=1e-8)


@pytest.mark.parametrize("chunk", [1, 3, 499, 500, 501])
def test_chunk_size_changes_nothing(tmp_path, read_by, chunk):
    path = write_lines(tmp_path / "a.ptx", TWO_SCANS)
    whole = read(path)
    read_by(chunk)
    assert max(len(part.colors) for part in open_source(path).read_chunks()) == chunk
    for a, b in zip(whole, read(path), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_header_that_promises_too_much(tmp_path):
    lines = scan(RAW.points_world, RAW.colors, count=999_999_999)
    lines[1] = "999999999"
    path = write_lines(tmp_path / "a.ptx", lines)
    assert_read_as_written(path)
    source = open_source(path)
    assert source.num_points == 1200
    assert "line 10 ends a header that promises 999999998000000001 points, found 1200" in str(source.warnings)


def test_a_line_that_may_be_cut_off_is_not_read_and_infinite_points_are(tmp_path):
    path = write_lines(
        tmp_path / "a.ptx", [*TWO_SCANS, *scan(RAW.points_world[:9], RAW.colors[:9], count=10)]
    )
    path.write_bytes(path.read_bytes()[:-2])
    assert len(read(path)[1]) == 1208
    assert "promises 10 points, found 8" in open_source(path).warnings[0]
    lines = [*scan(RAW.points_world, RAW.colors, count=1202), "nan 1 2 0 1 2 3", "inf 1e308 1e308 0 1 2 3"]
    assert "2 points with NaN" in read_cloud(write_lines(tmp_path / "a.ptx", lines)).warnings[0]


@pytest.mark.parametrize(
    ("number", "line", "message"),
    [
        (1, "12.5", r"line 1 is '12.5', wanted a count of a scan's header"),
        (2, "-4", r"line 2 is '-4', wanted a count"),
        (3, "1 2", r"line 3 is '1 2', wanted 3 numbers of a scan's header"),
        (8, "0 1 0 5", r"line 10 ends a matrix with the last column .*, wanted 0 0 0 1"),
        (12, "1 2 3 0.5", r"line 12: 4 instead of 7 columns \('1 2 3 0.5'\)"),
        (14, "1 2 3 0.5 4 5 256", r"line 14 has the colour 4 5 256, wanted 0 to 255"),
        (1210, None, r"line 1212 is '12.5 -3.0 1.75', wanted a count"),
        (1210, "1 2 3 4 5 6 7\n1 2 3 4 5 6 7", r"line 1211 is '1 2 3 4 5 6 7', wanted a count"),
    ],
)
def test_broken_lines_are_named(tmp_path, read_by, number, line, message):
    read_by(64)
    lines = [*scan(RAW.points_world, RAW.colors), *scan(RAW.points_world[:5], RAW.colors[:5])]
    lines[number - 1 : number] = [] if line is None else [line]
    path = write_lines(tmp_path / "a.ptx", lines)
    assert_refused(message, read, path)


@pytest.mark.parametrize("intensity", ["", "-1613 ", "0.25 "])
def test_columns_of_pts(tmp_path, intensity):
    assert_read_as_written(write_lines(tmp_path / "a.pts", ["1200", *pts(intensity)]))
    assert_read_as_written(write_lines(tmp_path / "b.pts", pts(intensity)))


def test_further_columns_of_pts_are_passed_over(tmp_path):
    assert_read_as_written(write_lines(tmp_path / "a.pts", [line + " 0 0 1" for line in pts()]))


@pytest.mark.parametrize("chunk", [1, 7, 400, 1 << 20])
def test_counts_stand_between_scans_of_pts(tmp_path, read_by, chunk):
    read_by(chunk)
    lines = pts()
    lines = ["", "400", *lines[:400], "0", "800", *lines[400:], "", "0"]
    assert_read_as_written(write_lines(tmp_path / "a.pts", lines))


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (
            ["1200", *["1 2 3 4"] * 1200],
            r"line 2 has 4 columns \(no colors\?\): .*, wanted lines x y",
        ),
        (["1 2 3"] * 1200, r"line 1 has 3 columns \(no colors\?\)"),
        (["400", *pts()[:400], "800", *pts("")[400:]], r"line 403: 6 instead of 7 columns"),
        ([*pts()[:900], "12.5", *pts()[900:]], r"line 901: 1 instead of 7 columns"),
        (["400", *pts()[:400], "5", "", "1 2 3 4 5 6 777"], r"line 404 has the colour 5 6 777"),
        (["lorem ipsum dolor sit amet consectetur"], "no line of numbers at its beginning"),
    ],
)
def test_broken_pts_are_refused(tmp_path, lines, message):
    path = write_lines(tmp_path / "a.pts", lines)
    assert_refused(message, read, path)


def test_empty_files_and_scans_that_have_gone_between_two_readings_are_refused(tmp_path):
    (tmp_path / "a").touch()
    for reader in (open_ptx, open_text):
        assert_refused("no line of numbers.*, wanted", reader, tmp_path / "a")
    path = write_lines(tmp_path / "a.ptx", TWO_SCANS)
    source = open_source(path)
    write_lines(path, TWO_SCANS[:300])
    assert_input_error("found 290 of 500 points; the file is cut off", lambda: list(source.read_chunks()))


@pytest.mark.parametrize("name", ["a.ptx", "a.pts"])
@pytest.mark.parametrize("gray", [False, True])
def test_a_file_cut_while_it_is_read_is_refused(tmp_path, read_by, name, gray):
    """At a line's end, where no line is broken, and by all that had not been read yet."""
    read_by(50, 4096)
    lines = TWO_SCANS if name == "a.ptx" else ["1200", *pts()]
    if gray:
        fields = [line.split() for line in lines]
        lines = [" ".join([*f[:3], str(k)] if len(f) == 7 else f) for k, f in enumerate(fields)]
    path = write_lines(tmp_path / name, lines)
    chunks = open_source(path).read_chunks()
    next(chunks)
    content = path.read_bytes()
    with path.open("r+b") as file:
        file.truncate(content.rindex(b"\n", 0, len(content) // 2) + 1)
    with pytest.raises(InputError, match="the file was cut while it was read, wanted a whole file") as error:
        list(chunks)
    assert str(error.value).startswith(f"{path}: ")


def test_many_small_scans_are_read_once(tmp_path, monkeypatch):
    """A block is read once, however many scans begin in it."""
    blocks = []

    def counted(path, start):
        for block in line_blocks(path, start):
            blocks.append(len(block))
            yield block

    monkeypatch.setattr(text, "line_blocks", counted)
    small = [scan(RAW.points_world[k : k + 3], RAW.colors[k : k + 3]) for k in range(0, 1200, 3)]
    path = write_lines(tmp_path / "a.ptx", [line for lines in small for line in lines])
    assert_read_as_written(path)
    counts = [line for k in range(0, 1200, 3) for line in ("3", *pts()[k : k + 3])]
    assert_read_as_written(write_lines(tmp_path / "a.pts", counts))
    assert len(blocks) == 4  # each file when it is opened and when it is read
