import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from pictures import PNG_HEADER_SIZE, TURNS, animation, encoded, png_chunk, smooth_rgb, with_metadata, write
from refusals import assert_refused, mutated, read_or_refused

from piccolo.photo.panorama import read_panorama
from piccolo.system.errors import InputError

RGB = smooth_rgb()


def png_header(width, height, depth=8, color_type=2):
    fields = struct.pack(">IIBBBBB", width, height, depth, color_type, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + png_chunk(b"IHDR", fields)


def test_png_comes_back_exactly_and_grey_and_sixteen_bits_become_rgb_of_eight(tmp_path):
    panorama = read_panorama(write(tmp_path / "a.png", encoded(RGB, ".png")))
    np.testing.assert_array_equal(panorama.rgb, RGB)
    assert panorama.rgb.dtype == np.uint8
    assert panorama.is_valid.shape == (64, 128)
    assert panorama.is_valid.dtype == np.bool_
    assert panorama.is_valid.all()
    for image in (RGB, RGB[:, :, 0], np.dstack([RGB, np.full((64, 128), 9, dtype=np.uint8)])):
        rgb = read_panorama(write(tmp_path / "a.png", encoded(image.astype(np.uint16) * 257, ".png"))).rgb
        expected = image[:, :, :3] if image.ndim == 3 else image[:, :, None]
        np.testing.assert_array_equal(rgb, np.broadcast_to(expected, rgb.shape))
    grey = RGB[:, :, 0]
    for suffix in (".png", ".jpg"):
        rgb = read_panorama(write(tmp_path / "a", encoded(grey, suffix, [cv2.IMWRITE_JPEG_QUALITY, 100]))).rgb
        assert rgb.shape == (64, 128, 3)
        assert np.abs(rgb.astype(int) - grey[:, :, None]).max() <= 2


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_alpha_zero_is_not_valid(tmp_path, dtype):
    alpha = np.full((64, 128), np.iinfo(dtype).max, dtype=dtype)
    alpha[50:], alpha[0, 0] = 0, alpha[0, 0] // 255  # of 16 bits the upper 8 count
    rgba = np.dstack([RGB.astype(dtype) * (np.iinfo(dtype).max // 255), alpha])
    panorama = read_panorama(write(tmp_path / "a.png", encoded(rgba, ".png")))
    np.testing.assert_array_equal(panorama.is_valid, alpha > 0)


def test_transparent_color_is_not_valid(tmp_path):
    content = encoded(RGB, ".png")
    transparent = png_chunk(b"tRNS", struct.pack(">HHH", *map(int, RGB[5, 7])))
    path = write(tmp_path / "a.png", content[:PNG_HEADER_SIZE] + transparent + content[PNG_HEADER_SIZE:])
    np.testing.assert_array_equal(read_panorama(path).is_valid, (RGB[5, 7] != RGB).any(axis=2))


@pytest.mark.parametrize("orientation", TURNS)
@pytest.mark.parametrize("suffix", [".png", ".jpg", ".webp"])
def test_exif_orientation_is_applied(tmp_path, suffix, orientation):
    stored = RGB if orientation < 5 else smooth_rgb(128, 64)
    best = [cv2.IMWRITE_WEBP_QUALITY, 101] if suffix == ".webp" else [cv2.IMWRITE_JPEG_QUALITY, 98]
    content = encoded(stored, suffix, best)
    rgb = read_panorama(write(tmp_path / "a", with_metadata(content, orientation))).rgb
    assert np.abs(rgb.astype(int) - TURNS[orientation](stored)).max() <= (8 if suffix == ".jpg" else 0)


@pytest.mark.parametrize("orientation", TURNS)
def test_alpha_is_turned_with_the_colors(tmp_path, orientation):
    stored = RGB if orientation < 5 else smooth_rgb(128, 64)
    alpha = np.where(stored[:, :, 0] + stored[:, :, 1] // 2 < 90, 0, 200).astype(np.uint8)
    content = with_metadata(encoded(np.dstack([stored, alpha]), ".png"), orientation)
    panorama = read_panorama(write(tmp_path / "a.png", content))
    np.testing.assert_array_equal(panorama.rgb, TURNS[orientation](stored))
    np.testing.assert_array_equal(panorama.is_valid, TURNS[orientation](alpha) > 0)


@pytest.mark.parametrize(
    ("width", "height", "expected"),
    [(1000, 500, (500, 1000)), (1001, 501, (500, 1000)), (999, 501, (499, 998)), (990, 500, (495, 990))],
)
def test_nearly_two_to_one_is_shrunk(tmp_path, width, height, expected):
    stored = np.dstack([smooth_rgb(height, width), np.full((height, width), 255, dtype=np.uint8)])
    stored[height // 2 :, :, 3] = 0
    panorama = read_panorama(write(tmp_path / "a.png", encoded(stored, ".png")))
    assert panorama.rgb.shape == (*expected, 3)
    np.testing.assert_allclose(panorama.rgb[:, 400].mean(axis=0), stored[:, 400, :3].mean(axis=0), atol=1.5)
    assert panorama.is_valid[: height // 2 - 4].all()
    assert not panorama.is_valid[height // 2 :].any()


@pytest.mark.parametrize(("width", "height"), [(1000, 700), (400, 195), (64, 128), (126, 63)])
def test_other_shapes_are_refused(tmp_path, width, height):
    path = write(tmp_path / "a.png", encoded(smooth_rgb(height, width), ".png"))
    message = f"found a picture of {width} x {height}, which is no full panorama"
    if width == 2 * height:
        message = f"found {width} x {height}, wanted at least 128 x 64"
    assert_refused(message, read_panorama, path)


def resized_jpeg(width, height):
    content = encoded(RGB, ".jpg")
    place = content.index(b"\xff\xc0") + 5
    return content[:place] + struct.pack(">HH", height, width) + content[place + 4 :]


@pytest.mark.parametrize("make", [png_header, resized_jpeg])
def test_huge_claims_are_refused_before_memory_is_taken(tmp_path, make):
    ending = png_chunk(b"IDAT", zlib.compress(bytes(100))) + png_chunk(b"IEND", b"")
    path = write(tmp_path / "a", make(60000, 30000) + ending)
    assert_refused("found 60000 x 30000, wanted at most 32768 x 16384", read_panorama, path)
    path = write(tmp_path / "a", make(32768, 16384) + ending)
    assert_refused("found 32768 x 16384 in a file too small for it", read_panorama, path)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("part", [0.02, 0.5, 0.9, 0.999])
def test_cut_files_are_refused(tmp_path, suffix, part, capfd):
    content = encoded(RGB, suffix)
    for padding in (0, len(content)):
        path = write(tmp_path / "a", content[: max(int(part * len(content)), 12)] + bytes(padding))
        assert_refused("cut off", read_panorama, path)
    assert capfd.readouterr().err == ""


def test_jpeg_cut_and_ended_is_refused_and_one_that_ends_in_grey_or_padding_is_not(tmp_path, capfd):
    noise = np.random.default_rng(1).integers(0, 256, RGB.shape, dtype=np.uint8)
    noise[-20:] = 128
    content = encoded(noise, ".jpg")
    np.testing.assert_array_equal(read_panorama(write(tmp_path / "a.jpg", content)).rgb[-8:], 128)
    for part in (0.2, 0.5, 0.8):
        cut = content[: int(part * len(content))] + b"\xff\xd9"
        with pytest.raises(InputError, match=r"the JPEG ends before its picture does \(cut off.\)"):
            read_panorama(write(tmp_path / "a.jpg", cut))
    noise = np.random.default_rng(2).integers(0, 256, RGB.shape, dtype=np.uint8)
    content = encoded(noise, ".jpg")
    whole = read_panorama(write(tmp_path / "a.jpg", content)).rgb
    path = write(tmp_path / "b.jpg", content[:-2] + bytes(20) + b"\xff\xd9" + b"film" * 99)
    padded = read_panorama(path).rgb
    np.testing.assert_array_equal(whole, padded)
    assert capfd.readouterr().err == ""


PNG = encoded(RGB, ".png")


def png_of(packed):
    return PNG[:PNG_HEADER_SIZE] + png_chunk(b"IDAT", packed) + png_chunk(b"IEND", b"")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "the file is empty"),
        (b"GIF89a" + bytes(99), "begins with b'GIF89a.*', wanted a whole JPEG, PNG, TIFF, WebP, HEIC"),
        (b"\xff\xd8", "the JPEG is cut off"),
        (PNG[:60] + b"\x01\x02\x03" + PNG[63:], "the PNG is cut off, damaged .* .broken PNG file"),
        (png_of(zlib.compress(bytes(9000))), "the PNG is cut off, damaged .*truncated"),
        (PNG[:PNG_HEADER_SIZE] + png_chunk(b"IEND", b""), "the PNG is cut off, damaged"),
        (animation("PNG"), "the PNG is animated, wanted a still picture"),
    ],
)
def test_other_content_is_refused(tmp_path, content, message, capfd):
    path = write(tmp_path / "a b.jpg", content)
    assert_refused(message, read_panorama, path)
    assert capfd.readouterr().err == ""


def test_paths_that_are_no_picture_are_refused(tmp_path, monkeypatch):
    with pytest.raises(InputError, match=r"none.jpg: cannot be read \(No such file or directory\)"):
        read_panorama(tmp_path / "none.jpg")
    assert_refused("not a file but a folder", read_panorama, tmp_path)

    def refuse(_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "read_bytes", refuse)
    assert_refused(r"cannot be read \(Permission denied\)", read_panorama, write(tmp_path / "a.png", PNG))


@settings(max_examples=40)
@given(data=st.data())
def test_mutated_png_with_right_checksums_is_read_or_refused(data, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "mutated.png"
    rows = np.concatenate([np.zeros((64, 1), dtype=np.uint8), RGB.reshape(64, -1)], axis=1)
    packed = mutated(data.draw, st.integers, zlib.compress(rows.tobytes()))
    panorama, message = read_or_refused(read_panorama, write(path, png_of(packed)))
    assert (panorama is None) == bool(message)
