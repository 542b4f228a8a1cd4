"""Seeded damage to files of each format: refused in one line or read, in bounded time, and nothing else."""

import struct
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pictures import crop_fields, encoded, png_chunk, smooth_rgb, tiff, with_metadata, write, xmp_packet
from refusals import mutated, read_or_refused

from piccolo.panorama import read_panorama
from piccolo.photo import Photo

RGB = smooth_rgb()
RGBA = np.dstack([RGB, np.full((64, 128), 255, np.uint8)])
LOSSLESS = [cv2.IMWRITE_WEBP_QUALITY, 101]
XMP = xmp_packet(crop_fields(10, 20, 128, 64, (300, 150)))
FILES = {
    "png": encoded(RGB, ".png"),
    "jpeg": with_metadata(encoded(RGB, ".jpg"), 3, XMP),
    "webp": encoded(RGB, ".webp"),
    "webp with metadata": with_metadata(encoded(RGBA, ".webp", LOSSLESS), 3, XMP),
    "tiff": tiff(RGBA, {274: (3, [4]), 700: (1, list(XMP))}),
    "tiff, 16 bits, big end": tiff(RGB.astype(np.uint16) * 257, order=">"),
    **{
        f"tiff, packed by {k}": encoded(RGB, ".tif", [cv2.IMWRITE_TIFF_COMPRESSION, k]) for k in (5, 8, 32773)
    },
}


@pytest.mark.parametrize("content", FILES.values(), ids=FILES)
def test_the_files_are_read_as_they_are(tmp_path, content):
    assert read_panorama(write(tmp_path / "a", content)).rgb.shape[2] == 3


def check(path):
    panorama, message = read_or_refused(read_panorama, path)
    assert (panorama is None) == bool(message)
    if panorama is not None:
        assert panorama.rgb.shape == (*panorama.is_valid.shape, 3)
        assert panorama.rgb.shape[1] == 2 * panorama.rgb.shape[0]


@pytest.mark.parametrize("content", FILES.values(), ids=FILES)
@settings(deadline=None, max_examples=40)
@given(data=st.data())
def test_mutated_files_are_read_or_refused(content, data, tmp_path_factory):
    begin = data.draw(st.integers(0, len(content) // 2))
    path = tmp_path_factory.getbasetemp() / "mutated"
    check(write(path, content[:begin] + mutated(data.draw, st.integers, content[begin:])))


@pytest.mark.parametrize("name", ["tiff", "tiff, 16 bits, big end", "tiff, packed by 5", "tiff, packed by 8"])
@settings(deadline=None, max_examples=30)
@given(data=st.data())
def test_tiffs_with_mutated_tags_are_read_or_refused(name, data, tmp_path_factory):
    content = bytearray(FILES[name])
    order = "<" if content[:2] == b"II" else ">"
    (begin,) = struct.unpack_from(order + "I", content, 4)
    (num_tags,) = struct.unpack_from(order + "H", content, begin)
    values = st.integers(0, 40) | st.integers(0, 2**32 - 1) | st.sampled_from([2**31, 2**32 - 1, 65536])
    for _ in range(data.draw(st.integers(1, 3))):
        place = begin + 2 + 12 * data.draw(st.integers(0, num_tags - 1))
        field = data.draw(st.sampled_from(["kind", "count", "value"]))
        value = data.draw(values)
        if field == "kind":
            struct.pack_into(order + "H", content, place + 2, value % 65536)
        else:
            struct.pack_into(order + "I", content, place + (4 if field == "count" else 8), value)
    check(write(tmp_path_factory.getbasetemp() / "mutated.tif", bytes(content)))


@settings(deadline=None, max_examples=50)
@given(data=st.data())
def test_mutated_metadata_is_read_or_refused(data, tmp_path_factory):
    """Over checksums, which would else refuse nearly all."""
    packed = mutated(data.draw, st.integers, zlib.compress(XMP))
    chunk = png_chunk(b"iTXt", b"XML:com.adobe.xmp\0\1\0\0\0" + packed)
    png = FILES["png"]
    check(write(tmp_path_factory.getbasetemp() / "a", png[:33] + chunk + png[33:]))
    xmp = mutated(data.draw, st.integers, XMP, num_flips=12)
    jpeg = with_metadata(encoded(RGB, ".jpg"), data.draw(st.integers(0, 65535)), xmp)
    check(write(tmp_path_factory.getbasetemp() / "a", jpeg))


@settings(deadline=None, max_examples=40)
@given(data=st.data())
def test_mutated_masks_are_read_or_refused(data, tmp_path_factory):
    folder = tmp_path_factory.getbasetemp()
    mask = write(folder / "mask.png", mutated(data.draw, st.integers, FILES["webp"]))
    path = write(folder / "a.png", FILES["png"])
    panorama, message = read_or_refused(lambda _: read_panorama(Photo(path, mask=mask)), mask)
    assert (panorama is None) == bool(message)
