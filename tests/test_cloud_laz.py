import struct
import sys

import pytest
from las_files import las_bytes, laz_bytes
from refusals import assert_refused, read_or_refused
from test_cloud_las import POINTS_OFFSET, RAW, RECORD_SIZE, assert_read_as_written, patched, read, write

from piccolo.cloud import open_source
from piccolo.cloud.readers import las
from piccolo.errors import InputError


@pytest.mark.parametrize(
    ("position", "form", "value", "message"),
    [
        (0, "<H", 1, "LASzip's record is not that of point format 3 in 34 bytes"),
        (0, "<H", 3, "LASzip's record is not that of point format 3"),
        (12, "<I", 0, "chunk 1 of 0 points|the compressed points are broken"),
        (12, "<I", 400, "promises 1200 points, the chunk table has 800|chunk table promises"),
        (32, "<H", 2, "LASzip's record is not"),
        (32, "<H", 65535, "LASzip's record is not"),
        (34, "<H", 10, "LASzip's record is not"),
        (36, "<H", 21, "LASzip's record is not"),
        (38, "<H", 9, "the compressed points are broken"),  # an item's version
    ],
)
def test_damaged_laszip_records_are_refused(tmp_path, position, form, value, message):
    content = laz_bytes(las_bytes(RAW), 600)
    begin = content.index(b"laszip encoded") + 52
    assert_refused(message, open_source, write(tmp_path, patched(content, begin + position, form, value)))


def test_damaged_chunk_tables_are_refused(tmp_path):
    content = laz_bytes(las_bytes(RAW), 600)
    (begin,) = struct.unpack_from("<I", content, POINTS_OFFSET)
    (table,) = struct.unpack_from("<q", content, begin)
    for changed, message in [
        (patched(content, table + 4, "<I", 0xFFFFFFFF), r"promises 4294967295 chunks, wanted 1 to \d+"),
        (patched(content, table + 4, "<I", 0), r"promises 0 chunks, wanted 1 to"),
        (patched(content, table + 4, "<I", 1), "promises 1200 points, the chunk table has 600"),
        (patched(content, begin, "<q", 1 << 60), "no chunk table within the file; it is cut off or broken"),
        (patched(content, begin, "<q", -1), "no chunk table within the file; it is cut off or broken"),
        (content[: table + 9], "the compressed points are broken"),
        (patched(content, table + 8, "4s", b"\xff" * 4), "the chunk table is broken"),
    ]:
        assert_refused(message, open_source, write(tmp_path, changed))


def test_a_chunk_table_may_be_named_at_the_end_and_fill_no_memory(tmp_path, monkeypatch):
    """As writers do that can't go back."""
    content = laz_bytes(las_bytes(RAW), 600)
    (begin,) = struct.unpack_from("<I", content, POINTS_OFFSET)
    assert_read_as_written(write(tmp_path, patched(content, begin, "<q", -1) + content[begin : begin + 8]))
    path = write(tmp_path, laz_bytes(las_bytes(RAW), 600))
    monkeypatch.setattr(las, "MAX_CHUNK_SIZE", 34 * 600 - 1)
    assert_refused(r"chunk 1 of 600 points in \d+ bytes, wanted 1 to 599 points", open_source, path)


@pytest.mark.parametrize("point_format", [7, 8, 10])
def test_layers_larger_than_their_chunk_are_refused(tmp_path, point_format):
    content = laz_bytes(las_bytes(RAW, point_format, extra_bytes=2), 600)
    (begin,) = struct.unpack_from("<I", content, POINTS_OFFSET)
    (record_size,) = struct.unpack_from("<H", content, RECORD_SIZE)
    num_layers = {7: 10, 8: 11, 10: 12}[point_format] + 2
    for layer in (0, num_layers - 1):
        position = begin + las.OFFSET_SIZE + record_size + 4 + 4 * layer
        with pytest.raises(InputError, match=r"a chunk of 600 points with layers of \d+ bytes, wanted 600"):
            open_source(write(tmp_path, patched(content, position, "<I", 0xFFFFFFFF)))


def test_broken_points_are_refused(tmp_path):
    content = laz_bytes(las_bytes(RAW, 3), 600)
    (begin,) = struct.unpack_from("<I", content, POINTS_OFFSET)
    (table,) = struct.unpack_from("<q", content, begin)
    path = write(tmp_path, content[: begin + 100] + bytes(table - begin - 100) + content[table:])
    result, message = read_or_refused(read, path)
    assert result is not None or "the compressed points are broken" in message


def test_panics_of_lazrs_are_refused(tmp_path, monkeypatch):
    class PanicException(BaseException): ...

    def panic(*_):
        raise PanicException

    path = write(tmp_path, laz_bytes(las_bytes(RAW), 600))
    monkeypatch.setattr("lazrs.decompress_points_with_chunk_table", panic)
    assert_refused("the compressed points are broken", open_source, path)
    monkeypatch.setattr("lazrs.decompress_points_with_chunk_table", lambda *_: sys.exit(7))
    with pytest.raises(SystemExit):
        open_source(path)
