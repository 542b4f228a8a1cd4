"""Photos of phones in HEIC, and of cameras with a JPEG under another name."""

import io
import sys

import cv2
import numpy as np
import pytest
from pictures import smooth_rgb
from PIL import Image
from pillow_heif import register_heif_opener
from refusals import assert_refused

from piccolo.panorama import ReadOptions, read_panorama
from piccolo.panorama.photo import photo_of
from piccolo.panorama.picture import read_picture

register_heif_opener()
RGB = smooth_rgb()
FOCAL_35MM, ORIENTATION, TIME = 0xA405, 0x0112, 0x9003


def heic(rgb, orientation=1):
    """A HEIC as a phone writes it: a box says how the picture is turned, and EXIF says so too."""
    image, exif = Image.fromarray(rgb), Image.Exif()
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
    assert photo_of(path).capture_time == "2026-03-01T10:00:00"


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
        assert_refused("the HEIF is cut off, damaged or of a rare kind", read_panorama, path)
    path.write_bytes(content)
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    assert_refused(r"a\.heic: needs pillow_heif, .*-r requirements-formats\.txt", read_panorama, path)


def test_insp_is_a_jpeg_of_two_fisheyes(tmp_path):
    circles = np.zeros((256, 512, 3), np.uint8)
    for x in (128, 384):
        cv2.circle(circles, (x, 128), 120, (200, 150, 100), -1)
    path = tmp_path / "a.insp"
    path.write_bytes(cv2.imencode(".jpg", circles)[1].tobytes() + b"trailer of the camera" * 9)
    assert_refused("two fisheye pictures side by side, wanted their calibration", read_panorama, path)
    assert read_panorama(path, ReadOptions(fov_deg=360.0)).rgb.shape[1] == 512
