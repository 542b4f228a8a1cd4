"""Files are read in blocks and chunks: small ones here, so that every border is met."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plyfile import PlyElement
from test_cloud_morton import seeded_cloud, whole
from test_cloud_ply import vertices, write
from test_cloud_text import lines_of

from piccolo.cloud.readers import reader as raw
from piccolo.cloud.readers import text
from piccolo.cloud.readers.ply import open_ply
from piccolo.cloud.readers.text import is_number, line_blocks, open_text
from piccolo.errors import InputError

RAW = seeded_cloud(1, num_points=1200)


@pytest.fixture
def small(monkeypatch):
    """Blocks of two or three lines, chunks of a few blocks."""
    monkeypatch.setattr(text, "BLOCK", 101)
    monkeypatch.setattr(raw, "CHUNK", 13)


@settings(deadline=None)
@given(
    parts=st.lists(st.sampled_from([b"\n", b"\r", b"\r\n", b"1", b"22"]), max_size=30), size=st.integers(4, 9)
)
def test_blocks_hold_all_lines(parts, size, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "blocks.txt"
    content = b"".join(parts)
    path.write_bytes(b"head" + content)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(text, "BLOCK", size)
        try:
            found = [line for block in line_blocks(path, 4) for line in block]
        except InputError:
            assert max(map(len, content.splitlines())) >= size
            return
    assert found == content.splitlines()


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
    path = write(tmp_path / "a.ply", cameras, vertices(RAW), **encoding)
    source = open_ply(path)
    assert source.num_points == 1200
    chunks = list(source.read_chunks())
    assert [len(chunk.colors) for chunk in chunks] == [13] * 92 + [4]
    read = whole(open_ply, path)
    np.testing.assert_allclose(read.points_world, RAW.points_world.astype("f4").astype(float), rtol=1e-15)
    np.testing.assert_array_equal(read.colors, RAW.colors)


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize(("broken", "message"), [("1 2 x 4 5 6", ": 'x' is"), ("1 2 3 4 5 256", "has the")])
def test_line_numbers_count_across_blocks(tmp_path, small, end, broken, message):
    path = tmp_path / "a.txt"
    path.write_bytes(end.join(["# one", "", *lines_of(RAW)[:700], "", broken, *lines_of(RAW)[:9]]).encode())
    with pytest.raises(InputError, match=f"line 704 ?{message}"):
        whole(open_text, path)


def test_line_numbers_of_ply_count_across_blocks(tmp_path, small):
    path = write(tmp_path / "a.ply", vertices(RAW), text=True)
    content = path.read_bytes().split(b"\n")
    header = content.index(b"end_header") + 1
    content[header + 600] = b"1 2 3"
    path.write_bytes(b"\n".join(content))
    with pytest.raises(InputError, match=f"line {header + 601}: 3 instead of 6 columns"):
        whole(open_ply, path)


def test_endless_lines_take_no_memory(tmp_path, small):
    path = tmp_path / "a.txt"
    path.write_bytes("\n".join(lines_of(RAW)[:50]).encode() + b"\n1 2 3 4 5 6" + b" " * 500)
    with pytest.raises(InputError, match=r"a\.txt: a line of more than 101 bytes, wanted lines of a few num"):
        whole(open_text, path)


@pytest.mark.parametrize("encoding", [{"byte_order": "<"}, {"text": True}])
def test_files_that_shrink_while_they_are_read_are_refused(tmp_path, small, encoding):
    path = write(tmp_path / "a.ply", vertices(RAW), **encoding)
    chunks = open_ply(path).read_chunks()
    next(chunks)
    with path.open("r+b") as file:
        file.truncate(path.stat().st_size // 2)
    with pytest.raises(InputError, match=r"the file was cut while it was read|instead of 6 columns"):
        list(chunks)


def test_each_reading_begins_anew(tmp_path, small):
    (tmp_path / "a.txt").write_text("\n".join(lines_of(RAW)))
    source = open_text(tmp_path / "a.txt")
    first, again = (next(source.read_chunks()) for _ in range(2))
    np.testing.assert_array_equal(first.points_world, again.points_world)
