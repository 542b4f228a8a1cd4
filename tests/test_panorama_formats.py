import base64

import cv2
import numpy as np
import pytest
from pictures import TURNS, animation, encoded, smooth_rgb, tiff, with_metadata, write

from piccolo.errors import InputError
from piccolo.panorama import read_panorama

RGB = smooth_rgb()
RANDOM16 = np.random.default_rng(3).integers(0, 65536, (64, 128, 4), dtype=np.uint16)
LOSSLESS = [cv2.IMWRITE_WEBP_QUALITY, 101]
COMPRESSION = cv2.IMWRITE_TIFF_COMPRESSION
# 128 x 64, the left half C, M, Y, K = 0, 200, 200, 30, the right half 200, 100, 0, 0; by Pillow, quality 50
CMYK_JPEG = base64.b64decode(
    "/9j/7gAOQWRvYmUAZAAAAAAA/9sAQwAQCwwODAoQDg0OEhEQExgoGhgWFhgxIyUdKDozPTw5Mzg3QEhcTkBEV0U3OFBtUVdfYmdo"
    "Zz5NcXlwZHhcZWdj/8AAFAgAQACABEMRAE0RAFkRAEsRAP/EABcAAQEBAQAAAAAAAAAAAAAAAAAHBgT/xAAUEAEAAAAAAAAAAAAA"
    "AAAAAAAA/9oADgRDAE0AWQBLAAA/AKAzTNNiAAAAAAAAAI02ayu8AAAAAAAAAWVjEacAAAAAAAAAAjTZrK7wAAAAAAAABZWMRpwA"
    "AAAAAAAACNNmsrvAAAAAAAAAFlYxGnAAAAAAAAAAI02ayu8AAAAAAAAAWVjEacAAAAAAAAAAjTZrK7wAAAAAAAABZWMRpwAAAAAA"
    "AAACNNmsrvAAAAAAAAAFlYxGnAAAAAAAAAAI02ayu8AAAAAAAAAWVjEacAAAAAAAAAAjTZrK7wAAAAAAAAB//9k="
)


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize(("samples", "dtype"), [(3, np.uint8), (4, np.uint8), (3, np.uint16), (4, np.uint16)])
def test_tiff_comes_back_exactly(tmp_path, order, samples, dtype):
    pixels = (
        RANDOM16[..., :samples] if dtype == np.uint16 else (RANDOM16[..., :samples] >> 8).astype(np.uint8)
    )
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


RARE = "the TIFF is cut off, damaged or of a rare kind"


def test_further_pages_are_left_with_a_warning(tmp_path):
    panorama = read_panorama(write(tmp_path / "a.tif", tiff(RGB, next_begin=8)))
    np.testing.assert_array_equal(panorama.rgb, RGB)
    assert panorama.warnings == ("found more than one picture in the TIFF, the first was read",)
    pages = cv2.imencodemulti(".tif", [RGB[..., ::-1], 255 - RGB])[1].tobytes()
    panorama = read_panorama(write(tmp_path / "b.tif", pages))
    np.testing.assert_array_equal(panorama.rgb, RGB)
    assert len(panorama.warnings) == 1


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (tiff(RGB.astype(np.float32)), RARE),
        (tiff(RGB[..., 0].astype(np.float32)), "the TIFF's numbers are signed, inverted or of 32 bits"),
        (tiff(RGB[..., 0].astype(np.uint32)), "the TIFF's numbers are signed, inverted or of 32 bits"),
        (tiff(RGB[..., 0], {339: (3, [2])}), "the TIFF's numbers are signed, inverted or of 32 bits"),
        (tiff(RANDOM16[..., 0], {262: (3, [0])}), "the TIFF's numbers are signed, inverted or of 32 bits"),
        (tiff(RGB, {258: (3, [8, 8, 16])}), RARE),
        (tiff(RGB, {339: (3, [2, 2, 2])}), RARE),
        (tiff(RANDOM16, {262: (3, [4711])}), RARE),
        (tiff(RGB, {257: (4, [2_000_000])}), "found 128 x 2000000, wanted at most"),
        (tiff(RGB, {256: (4, [0])}), RARE),
        (tiff(RGB, {273: (4, [999_999])}), RARE),
        (tiff(RGB, {278: (4, [0])}), RARE),
        (tiff(RGB, {259: (3, [8])}), RARE),
        (tiff(RGB, {259: (3, [4711])}), RARE),
        (tiff(RGB)[:9000], RARE),
        (tiff(RGB)[:-40], RARE),
    ],
)
def test_tiffs_are_refused_by_name(tmp_path, content, message, capfd):
    path = write(tmp_path / "a.tif", content)
    with pytest.raises(InputError, match=message) as error:
        read_panorama(path)
    assert str(path) in str(error.value)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("compression", [5, 8, 32773])
def test_tiff_with_damaged_strips_is_refused(tmp_path, compression, capfd):
    noise = np.random.default_rng(1).integers(0, 256, (64, 128, 3), dtype=np.uint8)
    content = bytearray(encoded(noise, ".tif", [COMPRESSION, compression]))
    content[5000:15000] = bytes(10000)
    with pytest.raises(InputError, match=RARE):
        read_panorama(write(tmp_path / "a.tif", bytes(content)))
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    "image", [RGB, np.dstack([RGB, np.where(RGB[..., 1] < 99, 0, 255).astype(np.uint8)])]
)
def test_webp_comes_back_exactly(tmp_path, image):
    content = encoded(image, ".webp", LOSSLESS)
    for stored in (content, with_metadata(content, orientation=1)):
        panorama = read_panorama(write(tmp_path / "a.webp", stored))
        np.testing.assert_array_equal(panorama.rgb[panorama.is_valid], image[panorama.is_valid][:, :3])
        is_valid = image[..., 3] > 0 if image.shape[2] == 4 else np.ones((64, 128), bool)
        np.testing.assert_array_equal(panorama.is_valid, is_valid)


def test_lossy_webp_comes_back_nearly(tmp_path):
    rgb = read_panorama(write(tmp_path / "a", encoded(RGB, ".webp", [cv2.IMWRITE_WEBP_QUALITY, 98]))).rgb
    assert np.abs(rgb.astype(int) - RGB).mean() < 4


@pytest.mark.parametrize("orientation", TURNS)
def test_webp_is_turned(tmp_path, orientation):
    stored = RGB if orientation < 5 else smooth_rgb(128, 64)
    content = with_metadata(encoded(stored, ".webp", LOSSLESS), orientation)
    np.testing.assert_array_equal(
        read_panorama(write(tmp_path / "a", content)).rgb, TURNS[orientation](stored)
    )


WEBP = with_metadata(encoded(RGB, ".webp", LOSSLESS), orientation=1)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (WEBP[:-9], "the WEBP is cut off, damaged"),
        (WEBP[:30], "the WEBP is cut off, damaged"),
        (WEBP[:12], "the WEBP is cut off, damaged"),
        (animation("WEBP"), "the WEBP is animated, wanted a still picture"),
        (b"RIFF\x04\0\0\0WEBP", "the WEBP is cut off, damaged"),
        (b"RIFF\x16\0\0\0WEBPVP8X\x0a\0\0\0" + bytes(10), "the WEBP is cut off, damaged"),
        (WEBP[:24] + b"\x0f\x0f\0" + WEBP[27:], "the WEBP is cut off, damaged"),
        (WEBP[:60] + bytes(40) + WEBP[100:], "the WEBP is cut off, damaged"),
    ],
)
def test_webps_are_refused_by_name(tmp_path, content, message, capfd):
    with pytest.raises(InputError, match=message):
        read_panorama(write(tmp_path / "a.webp", content))
    assert capfd.readouterr().err == ""


def test_cmyk_jpeg_becomes_rgb(tmp_path):
    rgb = read_panorama(write(tmp_path / "a.jpg", CMYK_JPEG)).rgb
    for half, (c, m, y, k) in ((rgb[:, :56], (0, 200, 200, 30)), (rgb[:, 72:], (200, 100, 0, 0))):
        expected = [(255 - ink) * (255 - k) / 255 for ink in (c, m, y)]
        np.testing.assert_allclose(half.reshape(-1, 3).mean(axis=0), expected, atol=4)
