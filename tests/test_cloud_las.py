import struct
import sys

import numpy as np
import pytest
from clouds import read
from las_files import RAW, las_bytes, laz_bytes
from refusals import assert_refused

from piccolo.cloud.cloud_settings import IN_COLORS
from piccolo.cloud.readers import las
from piccolo.cloud.stream import open_source
from piccolo.system.errors import InputError

FORMATS = [2, 3, 5, 7, 8, 10]
EIGHT_BIT = RAW.colors.astype(np.uint16)
INTENSITY = np.where(np.arange(1200) == 1000, 7, 0).astype(np.uint16)  # of one point
COUNT, COUNT_1_4, POINTS_OFFSET, NUM_VLRS, FORMAT, RECORD_SIZE, SCALE_X = 107, 247, 96, 100, 104, 105, 131


def write(tmp_path, content, name="a.las"):
    path = tmp_path / name
    path.write_bytes(content)
    return path


def assert_read_as_written(path, is_kept=slice(None)):
    points, colors = read(path)
    assert (points.dtype, colors.dtype) == (np.float64, np.uint8)
    np.testing.assert_allclose(points, RAW.points_world[is_kept], rtol=0, atol=1e-9)
    np.testing.assert_array_equal(colors, RAW.colors[is_kept])


@pytest.mark.parametrize("point_format", FORMATS)
@pytest.mark.parametrize("extra_bytes", [0, 3])
def test_point_formats_with_colors(tmp_path, point_format, extra_bytes):
    content = las_bytes(RAW, point_format, extra_bytes=extra_bytes)
    path = write(tmp_path, content)
    assert open_source(path).num_points == 1200
    assert open_source(path).warnings == ()
    assert_read_as_written(path)
    assert_read_as_written(write(tmp_path, laz_bytes(content, 50_000), "a.laz"))
    assert_read_as_written(write(tmp_path, laz_bytes(content, 500), "b.laz"))
    assert_read_as_written(write(tmp_path, laz_bytes(content, 1200), "c.laz"))
    assert_read_as_written(write(tmp_path, laz_bytes(content, cuts=(1, 2, 700, 701)), "copc.laz"))


@pytest.mark.parametrize("chunk", [1, 7, 500, 1199, 1200, 1201])
@pytest.mark.parametrize("compressed", [None, 100, 450, "variable"])
def test_chunks_hold_no_more_points_than_asked(tmp_path, read_by, chunk, compressed):
    read_by(chunk)
    content = las_bytes(RAW, 7)
    if compressed is not None:
        options = {"cuts": (3, 600, 1100)} if compressed == "variable" else {"chunk": compressed}
        content = laz_bytes(content, **options)
    source = open_source(write(tmp_path, content))
    for _ in range(2):  # each call reads anew
        chunks = list(source.read_chunks())
        assert max(len(c.colors) for c in chunks) <= chunk
        np.testing.assert_array_equal(np.concatenate([c.colors for c in chunks]), RAW.colors)


@pytest.mark.parametrize("point_format", FORMATS)
def test_withheld_points_are_left_out(tmp_path, point_format):
    is_withheld = np.arange(1200) % 3 == 1
    content = las_bytes(RAW, point_format, withheld=is_withheld)
    assert_read_as_written(write(tmp_path, content), ~is_withheld)
    assert_read_as_written(write(tmp_path, laz_bytes(content, 500)), ~is_withheld)


def test_16_bit_colors_are_rounded_and_coordinates_that_overflow_are_infinite(tmp_path):
    colors = np.random.default_rng(5).integers(0, 1 << 16, (1200, 3)).astype(np.uint16)
    colors[0] = (0, 1, 65535)
    _, found = read(write(tmp_path, las_bytes(RAW, colors=colors)))
    np.testing.assert_array_equal(found, np.floor(colors / 257.0 + 0.5))
    points, _ = read(write(tmp_path, patched(las_bytes(RAW), SCALE_X, "<d", 1e308)))
    assert np.isinf(points[:, 0]).any()
    assert np.isfinite(points[:, 1:]).all()


@pytest.mark.parametrize("is_compressed", [False, True])
def test_8_bit_colors_in_16_bit_fields_are_told_of(tmp_path, is_compressed):
    content = las_bytes(RAW, colors=EIGHT_BIT)
    path = write(tmp_path, laz_bytes(content, 100) if is_compressed else content)
    assert open_source(path).warnings == (
        f"{path}: colours are read as 0 to 255 instead of 0 to 65535 (largest value {RAW.colors.max()}); "
        "`color_range` overrules it",
    )
    assert_read_as_written(path)


@pytest.mark.parametrize("is_compressed", [False, True])
def test_the_sample_is_spread_over_the_file(tmp_path, monkeypatch, is_compressed):
    """128 of 1200 points, in 8 runs or from 4 chunks of 30."""
    monkeypatch.setattr(las, "MAX_LAS_SAMPLES", 128)
    monkeypatch.setattr(las, "POINTS_A_SAMPLE", 16)
    monkeypatch.setattr(las, "POINTS_A_LAZ_CHUNK", 30)

    def written(index, value):
        colors = EIGHT_BIT.copy()
        colors[index] = value
        content = las_bytes(RAW, colors=colors)
        return write(tmp_path, laz_bytes(content, 30) if is_compressed else content)

    assert open_source(written(0, 2000)).warnings == ()
    assert open_source(written(1199, 2000)).warnings == ()
    path = written(25 if is_compressed else 20, 255)
    assert "read as 0 to 255 instead of 0 to 65535" in open_source(path).warnings[0]
    path = written(100, 40_000)  # outside of the sample
    assert "largest value" in open_source(path).warnings[0]
    assert_refused("point 101 has the colour 40000 .*, wanted 0 to 255", read, path)


@pytest.mark.parametrize("point_format", [1, 3, 6, 7])
def test_an_intensity_of_0_is_not_used(tmp_path, point_format):
    black = np.zeros((1200, 3), np.uint16)
    for intensity in (np.zeros(1200, np.uint16), INTENSITY):
        plain = las_bytes(RAW, point_format, colors=black, intensity=intensity)
        for content in (plain, laz_bytes(plain, 500)):
            with pytest.raises(InputError) as error:
                open_source(write(tmp_path, content), IN_COLORS)
            why = "point format" if point_format in (1, 6) else "red green blue are 0 in all 1200 points"
            assert why in str(error.value)
            source = open_source(write(tmp_path, content))
            assert source.channel == ("intensity" if intensity.any() else "shape")
            assert why in source.warnings[0]


def patched(content, position, form, value):
    changed = bytearray(content)
    struct.pack_into(form, changed, position, value)
    return bytes(changed)


CUT = "the file is cut off or broken"
BROKEN = "the compressed points are broken or cut off"


@pytest.mark.parametrize(
    ("position", "form", "value", "message"),
    [
        (0, "4s", b"LASX", "begins with b'LASX'"),
        (24, "B", 2, r"found LAS 2\.3, wanted LAS 1\.0 to 1\.5"),
        (94, "<H", 100, "a header of 100 bytes and points from byte"),
        (POINTS_OFFSET, "<I", 0xFFFFFFFF, "and points from byte 4294967295 on, wanted"),
        (FORMAT, "B", 11, "unknown point format 11, wanted LAS or LAZ"),
        (FORMAT, "B", 0x83, f"no chunk table within the file; {CUT}"),
        (RECORD_SIZE, "<H", 33, "records of 33 bytes, wanted 34 or more in point format 3"),
        (COUNT, "<I", 2401, f"promises 2401 points of 34 bytes, found room for 1200; {CUT}"),
        (COUNT, "<I", 0, "promises 0 points"),
        (SCALE_X, "<d", 0.0, r"scales \[.*\] and offsets .*, wanted finite ones and no scale 0"),
        (SCALE_X + 24, "<d", float("inf"), r"offsets \[ *inf"),
    ],
)
def test_damaged_headers_are_refused(tmp_path, position, form, value, message):
    path = write(tmp_path, patched(las_bytes(RAW), position, form, value))
    assert_refused(message, las.open_las, path)


@pytest.mark.parametrize("point_format", [3, 7])
def test_a_file_that_is_cut_off_is_read_to_its_end(tmp_path, point_format):
    content = las_bytes(RAW, point_format)
    expected = read(write(tmp_path, content))
    source = las.open_las(write(tmp_path, content[:-1000]))
    parts = list(source.read_chunks())
    num_left = sum(len(part.colors) for part in parts)
    assert 1150 < num_left < 1200
    np.testing.assert_array_equal(np.vstack([part.colors for part in parts]), expected[1][:num_left])
    assert f"found room for {num_left}; read up to there" in source.warnings[0]


@pytest.mark.parametrize("count", [2401, 10**15, 2**64 - 1])
def test_counts_of_las_1_4_are_refused_before_memory_is_taken(tmp_path, count):
    content = las_bytes(RAW, 7)
    with pytest.raises(InputError, match=f"promises {count} points of 36 bytes, found room for 1200"):
        open_source(write(tmp_path, patched(content, COUNT_1_4, "<Q", count)))
    with pytest.raises(InputError, match=BROKEN):
        open_source(write(tmp_path, patched(laz_bytes(content, 500), COUNT_1_4, "<Q", count)))


def test_a_wrong_number_of_vlrs_does_no_harm(tmp_path):
    content = las_bytes(RAW)
    assert_read_as_written(write(tmp_path, patched(content, NUM_VLRS, "<I", 0xFFFFFFFF)))
    compressed = laz_bytes(content, 500)
    with pytest.raises(InputError, match="promises 4294967295 records before the points, found room for 1"):
        open_source(write(tmp_path, patched(compressed, NUM_VLRS, "<I", 0xFFFFFFFF)))
    with pytest.raises(InputError, match=BROKEN):
        open_source(write(tmp_path, patched(compressed, NUM_VLRS, "<I", 0)))


def test_a_missing_library_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "lazrs", None)
    assert_read_as_written(write(tmp_path, las_bytes(RAW)))
    with pytest.raises(InputError, match=r"needs lazrs, .*in a checkout '\.\[formats\]'"):
        open_source(write(tmp_path, laz_bytes(las_bytes(RAW), 600)))


@pytest.mark.parametrize(
    ("position", "form", "value"),
    [
        (0, "<H", 1),  # the compressor
        (12, "<I", 0),  # points a chunk
        (12, "<I", 400),
        (32, "<H", 2),  # number of items
        (36, "<H", 21),  # an item's size
        (38, "<H", 9),  # an item's version
    ],
)
def test_damaged_laszip_records_are_refused(tmp_path, position, form, value):
    content = laz_bytes(las_bytes(RAW), 600)
    begin = content.index(b"laszip encoded") + 52
    assert_refused(BROKEN, open_source, write(tmp_path, patched(content, begin + position, form, value)))


def test_damaged_chunk_tables_are_refused(tmp_path):
    content = laz_bytes(las_bytes(RAW), 600)
    (begin,) = struct.unpack_from("<I", content, POINTS_OFFSET)
    (table,) = struct.unpack_from("<q", content, begin)
    for changed, message in [
        (patched(content, table + 4, "<I", 0xFFFFFFFF), r"promises 4294967295 chunks, wanted 1 to \d+"),
        (patched(content, table + 4, "<I", 0), r"promises 0 chunks, wanted 1 to"),
        (patched(content, table + 4, "<I", 1), BROKEN),
        (patched(content, begin, "<q", 1 << 60), f"no chunk table within the file; {CUT}"),
        (content[: table + 9], BROKEN),
        (patched(content, table + 8, "4s", b"\xff" * 4), BROKEN),
    ]:
        assert_refused(message, open_source, write(tmp_path, changed))


def test_a_chunk_table_may_be_named_at_the_end(tmp_path):
    content = laz_bytes(las_bytes(RAW), 600)
    (begin,) = struct.unpack_from("<I", content, POINTS_OFFSET)
    assert_read_as_written(write(tmp_path, patched(content, begin, "<q", -1) + content[begin : begin + 8]))


def test_panics_of_lazrs_are_refused(tmp_path, monkeypatch):
    class PanicException(BaseException): ...

    def end(*_):
        raise ending

    path = write(tmp_path, laz_bytes(las_bytes(RAW), 600))
    monkeypatch.setattr("laspy.LasReader.read_points", end)
    ending = PanicException()
    assert_refused(BROKEN, open_source, path)
    ending = SystemExit(7)
    with pytest.raises(SystemExit):
        open_source(path)
