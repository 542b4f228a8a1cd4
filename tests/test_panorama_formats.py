"""Formats of pictures, and damage of them."""

import io
import struct
import sys
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from pictures import (
    TURNS,
    animation,
    crop_fields,
    encoded,
    png_chunk,
    saved,
    smooth_rgb,
    tiff,
    with_metadata,
    write,
    xmp_packet,
)
from PIL import Image
from pillow_heif import register_heif_opener
from refusals import assert_refused, mutated, read_or_refused

from piccolo.photo.panorama import read_panorama
from piccolo.photo.panorama.facts import read_photo_facts
from piccolo.photo.panorama.picture import read_picture
from piccolo.photo.photo import Photo

RGB = smooth_rgb()
RANDOM16 = np.random.default_rng(3).integers(0, 65536, (64, 128, 4), dtype=np.uint16)
LOSSLESS = [cv2.IMWRITE_WEBP_QUALITY, 101]
COMPRESSION = cv2.IMWRITE_TIFF_COMPRESSION
TINT = np.uint8([0, 85, 170])


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize(("samples", "dtype"), [(3, np.uint8), (4, np.uint8), (3, np.uint16), (4, np.uint16)])
def test_tiff_comes_back_exactly(tmp_path, order, samples, dtype):
    pixels = RANDOM16[..., :samples] if dtype == np.uint16 else np.uint8(RANDOM16[..., :samples] >> 8)
    panorama = read_panorama(write(tmp_path / "a.tif", tiff(pixels, order=order)))
    is_valid = RANDOM16[..., 3] >> 8 > 0 if samples == 4 else np.ones((64, 128), bool)
    np.testing.assert_array_equal(panorama.rgb, RANDOM16[..., :3] >> 8)
    np.testing.assert_array_equal(panorama.is_valid, is_valid)


@pytest.mark.parametrize(("dtype", "photometric"), [(np.uint8, 0), (np.uint8, 1), (np.uint16, 1)])
def test_grey_tiff_becomes_rgb(tmp_path, dtype, photometric):
    grey = (RGB[..., 0].astype(dtype) + 1) * (1 if dtype == np.uint8 else 255)
    content = tiff(grey, {262: (3, [photometric])})
    rgb = read_panorama(write(tmp_path / "a.tif", content)).rgb
    expected = grey if photometric else np.iinfo(dtype).max - grey
    np.testing.assert_array_equal(rgb, np.repeat((expected >> (8 * grey.itemsize - 8))[..., None], 3, axis=2))


@pytest.mark.process
@pytest.mark.parametrize("compression", [1, 5, 8, 32946, 32773])
@pytest.mark.parametrize("image", [RGB, np.dstack([RGB, RGB[..., :1]]), RANDOM16[..., :3]])
def test_packed_tiff_comes_back_exactly(tmp_path, compression, image):
    content = encoded(image, ".tif", [COMPRESSION, compression])
    rgb = read_panorama(write(tmp_path / "a", content)).rgb
    np.testing.assert_array_equal(rgb, image[..., :3] if image.dtype == np.uint8 else image >> 8)


@pytest.mark.parametrize("orientation", TURNS)
@pytest.mark.parametrize("image", [RGB, RANDOM16[..., :3]])
def test_tiff_is_turned_once(tmp_path, orientation, image):
    stored = image if orientation < 5 else np.ascontiguousarray(np.swapaxes(image, 0, 1))
    content = tiff(stored, {274: (3, [orientation])})
    expected = TURNS[orientation](stored if stored.dtype == np.uint8 else stored >> 8)
    np.testing.assert_array_equal(read_panorama(write(tmp_path / "a.tif", content)).rgb, expected)


RARE = "the TIFF is cut off, damaged or of an unsupported kind"
BAD_WEBP = "the WEBP is cut off, damaged or of an unsupported kind"
WEBP = with_metadata(encoded(RGB, ".webp", LOSSLESS), orientation=1)


@pytest.mark.process
def test_further_pages_are_left_with_a_warning(tmp_path):
    panorama = read_panorama(write(tmp_path / "a.tif", tiff(RGB, next_begin=8)))
    np.testing.assert_array_equal(panorama.rgb, RGB)
    assert panorama.warnings == ("found more than one picture in the TIFF, the first was read",)
    pages = cv2.imencodemulti(".tif", [RGB[..., ::-1], 255 - RGB])[1].tobytes()
    panorama = read_panorama(write(tmp_path / "b.tif", pages))
    np.testing.assert_array_equal(panorama.rgb, RGB)
    assert len(panorama.warnings) == 1


@pytest.mark.process
@pytest.mark.parametrize(
    ("content", "message"),
    [
        (tiff(RGB.astype(np.float32)), RARE),
        (tiff(RGB[..., 0].astype(np.float32)), "the TIFF's numbers are signed, inverted or of 32 bits"),
        (tiff(RGB[..., 0], {339: (3, [2])}), "the TIFF's numbers are signed, inverted or of 32 bits"),
        (tiff(RANDOM16[..., 0], {262: (3, [0])}), "the TIFF's numbers are signed, inverted or of 32 bits"),
        (tiff(RGB, {258: (3, [8, 8, 16])}), RARE),
        (tiff(RGB, {257: (4, [2_000_000])}), "found 128 x 2000000, wanted at most"),
        (tiff(RGB, {256: (4, [0])}), RARE),
        (tiff(RGB, {273: (4, [999_999])}), RARE),
        (tiff(RGB, {259: (3, [8])}), RARE),
        (tiff(RGB)[:9000], RARE),
        (WEBP[:-9], BAD_WEBP),
        (animation("WEBP"), "the WEBP is animated, wanted a still picture"),
        (b"RIFF\x04\0\0\0WEBP", BAD_WEBP),
        (b"RIFF\x16\0\0\0WEBPVP8X\x0a\0\0\0" + bytes(10), BAD_WEBP),
        (WEBP[:24] + b"\x0f\x0f\0" + WEBP[27:], BAD_WEBP),
        (WEBP[:60] + bytes(40) + WEBP[100:], BAD_WEBP),
    ],
)
def test_other_files_are_refused_by_name(tmp_path, content, message, capfd):
    path = write(tmp_path / "a", content)
    assert_refused(message, read_panorama, path)
    assert capfd.readouterr().err == ""


@pytest.mark.process
@pytest.mark.parametrize("compression", [5, 8, 32773])
def test_tiff_with_damaged_strips_is_refused(tmp_path, compression, capfd):
    noise = np.random.default_rng(1).integers(0, 256, (64, 128, 3), dtype=np.uint8)
    content = bytearray(encoded(noise, ".tif", [COMPRESSION, compression]))
    content[5000:15000] = bytes(10000)
    assert_refused(RARE, read_panorama, write(tmp_path / "a.tif", bytes(content)))
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("image", [RGB, np.dstack([RGB, np.uint8(np.where(RGB[..., 1] < 99, 0, 255))])])
def test_webp_comes_back_exactly(tmp_path, image):
    content = encoded(image, ".webp", LOSSLESS)
    for stored in (content, with_metadata(content, orientation=1)):
        panorama = read_panorama(write(tmp_path / "a.webp", stored))
        np.testing.assert_array_equal(panorama.rgb[panorama.is_valid], image[panorama.is_valid][:, :3])
        is_valid = image[..., 3] > 0 if image.shape[2] == 4 else np.ones((64, 128), bool)
        np.testing.assert_array_equal(panorama.is_valid, is_valid)


def test_cmyk_jpeg_becomes_rgb(tmp_path):
    inks = np.uint8([[[0, 200, 200, 30], [200, 100, 0, 0]]]).repeat(64, axis=1).repeat(64, axis=0)
    content = saved(inks, "JPEG", "CMYK")
    rgb = read_panorama(write(tmp_path / "a.jpg", content)).rgb
    expected = (255 - inks[..., :3].astype(int)) * (255 - inks[..., 3:].astype(int)) / 255
    assert np.abs(rgb - expected)[:, np.r_[:56, 72:128]].max() <= 4


@pytest.mark.process
@pytest.mark.parametrize("kind", ["PNG", "TIFF"])
def test_palettes_become_rgb(tmp_path, kind):
    image = Image.frombytes("P", (128, 64), (RGB[..., 0] // 8).tobytes())
    image.putpalette((np.arange(256, dtype=np.uint8)[:, None] ^ TINT).tobytes())
    image.info["transparency"] = 3  # TIFF has none
    path = tmp_path / "a"
    image.save(path, kind, compression="tiff_lzw")
    panorama = read_panorama(path)
    np.testing.assert_array_equal(panorama.rgb, RGB[..., :1] // 8 ^ TINT)
    np.testing.assert_array_equal(panorama.is_valid, (RGB[..., 0] // 8 != 3) | (kind == "TIFF"))


@pytest.mark.process
@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif"])  # the largest panorama in a WebP is below it
@pytest.mark.parametrize("compression", [1, 5])
def test_the_limit_of_pillow_is_not_ours(tmp_path, monkeypatch, suffix, compression):
    path = write(tmp_path / "a", encoded(RGB, suffix, [COMPRESSION, compression]))
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 100)
    assert read_panorama(path).rgb.shape == RGB.shape


register_heif_opener()
FOCAL_35MM, ORIENTATION, TIME = 0xA405, 0x0112, 0x9003


def heic(rgb, orientation=1):
    """A HEIC as a phone writes it: a box says how the picture is turned, and EXIF says so too."""
    image = Image.fromarray(rgb)
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    exif.get_ifd(0x8769)[FOCAL_35MM] = 26
    exif.get_ifd(0x8769)[TIME] = "2026:03:01 10:00:00"
    image.info["exif"] = exif.tobytes()
    file = io.BytesIO()
    image.save(file, "HEIF", quality=95)
    return file.getvalue()


def test_heic_is_read(tmp_path):
    path = tmp_path / "a.heic"
    path.write_bytes(heic(RGB))
    panorama = read_panorama(path)
    assert np.abs(panorama.rgb.astype(int) - RGB).mean() < 3.0
    assert panorama.is_valid.all()
    assert read_photo_facts(path).capture_time == "2026-03-01T10:00:00"


def test_a_phone_s_heic_is_turned_once_and_has_a_focal_length(tmp_path):
    path = tmp_path / "a.heic"
    stored = cv2.resize(RGB, (256, 192))
    turns = {1: lambda a: a, 6: lambda a: np.rot90(a, -1), 3: lambda a: np.rot90(a, 2)}
    for orientation, turn in turns.items():
        path.write_bytes(heic(stored, orientation))
        panorama = read_panorama(path)
        (camera,) = (mount.camera for mount in panorama.cameras)
        expected = turn(stored)
        assert (camera.height, camera.width) == expected.shape[:2]
        assert camera.params[0] == pytest.approx(26 / np.hypot(36, 24) * np.hypot(*stored.shape[:2]))
        assert np.abs(read_picture(path).rgb.astype(int) - expected).mean() < 3.0


def test_a_damaged_heic_and_a_missing_library_are_one_line(tmp_path, monkeypatch):
    path = tmp_path / "a.heic"
    content = heic(RGB)
    for size in (20, 200, len(content) // 2, len(content) - 9):
        path.write_bytes(content[:size])
        assert_refused("the HEIF is cut off, damaged or of an unsupported kind", read_panorama, path)
    path.write_bytes(content)
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    assert_refused(r"a\.heic: needs pillow_heif, .*in a checkout '\.\[formats\]'", read_panorama, path)


def test_insp_is_a_jpeg_of_two_fisheyes(tmp_path):
    circles = np.zeros((256, 512, 3), np.uint8)
    for x in (128, 384):
        cv2.circle(circles, (x, 128), 120, (200, 150, 100), -1)
    path = tmp_path / "a.insp"
    path.write_bytes(cv2.imencode(".jpg", circles)[1].tobytes() + b"trailer of the camera" * 9)
    assert_refused("two fisheye pictures side by side, wanted their calibration", read_panorama, path)
    assert read_panorama(Photo(path, fov_deg=360.0)).rgb.shape[1] == 512


RGBA = np.dstack([RGB, np.full((64, 128), 255, np.uint8)])
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


@pytest.mark.process
@pytest.mark.parametrize("content", FILES.values(), ids=FILES)
def test_the_files_are_read_as_they_are(tmp_path, content):
    assert read_panorama(write(tmp_path / "a", content)).rgb.shape[2] == 3


def check(path):
    panorama, message = read_or_refused(read_panorama, path)
    assert (panorama is None) == bool(message)
    if panorama is not None:
        assert panorama.rgb.shape == (*panorama.is_valid.shape, 3)
        assert panorama.rgb.shape[1] == 2 * panorama.rgb.shape[0]


@pytest.mark.process
@pytest.mark.parametrize("content", FILES.values(), ids=FILES)
@settings(max_examples=40)
@given(data=st.data())
def test_mutated_files_are_read_or_refused(content, data, tmp_path_factory):
    begin = data.draw(st.integers(0, len(content) // 2))
    path = tmp_path_factory.getbasetemp() / "mutated"
    check(write(path, content[:begin] + mutated(data.draw, st.integers, content[begin:])))


@pytest.mark.process
@pytest.mark.parametrize("name", ["tiff", "tiff, 16 bits, big end", "tiff, packed by 5", "tiff, packed by 8"])
@settings(max_examples=30)
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


@settings(max_examples=50)
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


@settings(max_examples=40)
@given(data=st.data())
def test_mutated_masks_are_read_or_refused(data, tmp_path_factory):
    folder = tmp_path_factory.getbasetemp()
    mask = write(folder / "mask.png", mutated(data.draw, st.integers, FILES["webp"]))
    path = write(folder / "a.png", FILES["png"])
    panorama, message = read_or_refused(lambda _: read_panorama(Photo(path, mask=mask)), mask)
    assert (panorama is None) == bool(message)


def test_a_radiance_picture_is_exposed_by_its_mean_and_a_broken_one_refused(tmp_path):
    light = np.full((64, 128, 3), 0.02, np.float32)
    light[:, 64:] = 2.0
    light[0, 0] = 0.0
    path = tmp_path / "a.hdr"
    cv2.imwrite(str(path), light)
    picture = read_picture(path)
    low = picture.rgb[1, 0]  # 0.018 of white
    high = picture.rgb[1, 127]  # 1.8
    assert (np.abs(low.astype(int) - 36) <= 1).all()
    assert (high == 255).all()
    assert "exposed so that the geometric mean" in picture.warnings[0]
    path.write_bytes(path.read_bytes()[:-99])
    assert_refused("the HDR is cut off, damaged", read_picture, path)
    assert_refused(
        "no line '-Y height", read_picture, write(tmp_path / "b.hdr", b"#?RADIANCE\n\n+X 4 -Y 4\n")
    )
