"""Kinds of pictures that are told apart: raw files, pictures for two eyes, cylinders, several XMP packets."""

import math
import struct

import cv2
import numpy as np
import pytest
from pictures import crop_fields, encoded, saved, tiff, with_metadata, write, xmp_packet
from refusals import assert_refused

from piccolo.photo.panorama import read_panorama
from piccolo.photo.panorama.masks import find_mask, shows_twice
from piccolo.photo.photo import Photo
from piccolo.system.errors import InputError

WIDTH, HEIGHT = 512, 256


def textured(height=HEIGHT, width=WIDTH, seed=0):
    """A picture of smooth spots."""
    noise = np.random.default_rng(seed).integers(0, 256, (height // 16, width // 16, 3), np.uint8)
    return cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)


@pytest.mark.parametrize("tags", [{254: (4, [1])}, {50706: (4, [1])}])
def test_thumbnails_of_raw_files_are_refused(tmp_path, tags):
    content = tiff(textured(), tags)
    path = write(tmp_path / "a.dng", content)
    assert_refused("a raw file, or a thumbnail, wanted the developed picture", read_panorama, path)


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_the_packet_with_a_sphere_counts_wherever_it_is(tmp_path, order):
    plain = b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="r"/></x:xmpmeta>'
    packets = [xmp_packet(crop_fields(100, 50, 200, 100)), plain]
    content = encoded(textured(100, 200), ".jpg")
    for k in order:
        body = b"http://ns.adobe.com/xap/1.0/\0" + packets[k]
        content = content[:2] + struct.pack(">BBH", 0xFF, 0xE1, len(body) + 2) + body + content[2:]
    panorama = read_panorama(write(tmp_path / "a.jpg", content))
    assert panorama.rgb.shape == (200, 400, 3)
    assert panorama.is_valid.sum() == 200 * 100


def test_pictures_for_two_eyes_are_refused(tmp_path):
    half = textured(256, 256)
    half[:, :, 0] //= 2
    half[:, :128] //= 4
    path = write(tmp_path / "a.png", encoded(np.hstack([half, np.roll(half, 1, axis=1)]), ".png"))
    assert_refused(r"two half spheres side by side, one for each eye \(VR180\)", read_panorama, path)
    path = write(tmp_path / "b.png", encoded(np.vstack([textured(), textured()]), ".png"))
    assert_refused("two panoramas above each other, one for each eye", read_panorama, path)
    path = write(tmp_path / "c.png", encoded(textured(), ".png"))
    assert read_panorama(path).is_valid.all()
    floor_and_sky = np.repeat(np.linspace(20, 230, HEIGHT, dtype=np.uint8)[:, None, None], WIDTH, axis=1)
    assert not shows_twice(np.repeat(floor_and_sky, 3, axis=2), 1)


def test_a_cylinder_becomes_a_strip_of_the_sphere(tmp_path):
    """Rows of a cylinder are at the tangent of their elevation."""
    radius = 300 / math.radians(200)
    elevation = np.arctan((100.0 - np.arange(200) - 0.5) / radius)
    levels = np.rint(120.0 + 100.0 * elevation).astype(np.uint8)
    picture = np.repeat(np.repeat(levels[:, None], 300, axis=1)[..., None], 3, axis=2)
    path = write(tmp_path / "a.png", encoded(picture, ".png"))
    panorama = read_panorama(Photo(path, projection="cylindrical", fov_deg=200.0))
    rows = np.flatnonzero(panorama.is_valid.any(axis=1))
    height = len(panorama.rgb)
    expected = 120.0 + 100.0 * (0.5 - (rows + 0.5) / height) * math.pi
    found = panorama.rgb[rows, panorama.rgb.shape[1] // 2, 0]
    assert np.abs(found - expected).max() < 2.5
    assert len(rows) == pytest.approx(2 * math.atan(100 / radius) / math.pi * height, abs=2)
    with pytest.raises(InputError, match="`projection` cylindrical: found no `fov_deg`"):
        Photo(path, projection="cylindrical")


def test_a_very_long_photo_brings_a_hint(tmp_path):
    content = saved(textured(160, 480), "JPEG", exif=b"Exif\0\0" + _exif_of_film(26))
    panorama = read_panorama(write(tmp_path / "a.jpg", content))
    assert any("no photo is that long: `projection` cylindrical" in warning for warning in panorama.warnings)


def _exif_of_film(millimetres):
    """EXIF with FocalLengthIn35mmFilm alone."""
    head = b"II*\0" + struct.pack("<I", 8) + struct.pack("<HHHIII", 1, 0x8769, 4, 1, 26, 0)
    return head + struct.pack("<HHHIHHI", 1, 0xA405, 3, 1, millimetres, 0, 0)


def test_avif_is_read(tmp_path):
    path = write(tmp_path / "a.avif", saved(textured(), "AVIF", quality=90))
    assert np.abs(read_panorama(path).rgb.astype(int) - textured()).mean() < 8


@pytest.mark.parametrize("name", ["a.png", "a.jpg.png", "a_mask.png", "a.JPG", "b.png"])
def test_masks_as_others_name_them(tmp_path, name):
    (tmp_path / name).touch()
    found = find_mask(tmp_path, tmp_path / "x" / "a.jpg")
    assert found == (tmp_path / name if name in ("a.png", "a.jpg.png", "a_mask.png") else None)


def test_a_cylinder_by_its_metadata_asks_for_its_angle(tmp_path):
    fields = {**crop_fields(0, 0, 200, 100), "ProjectionType": "cylindrical"}
    content = with_metadata(encoded(textured(100, 200), ".jpg"), xmp=xmp_packet(fields))
    path = write(tmp_path / "a.jpg", content)
    assert_refused("of a cylinder `projection` cylindrical and `fov_deg`", read_panorama, path)


@pytest.mark.parametrize(("name", "is_upper_left"), [("a.png", 0), ("a.jpg.png", 1), ("a_mask.png", 1)])
def test_black_is_ignored_in_masks_that_are_named_as_colmap_does(tmp_path, name, is_upper_left):
    folder = tmp_path / "masks"
    folder.mkdir()
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[HEIGHT // 2 :] = 0
    write(folder / name, encoded(mask, ".png"))
    panorama = read_panorama(Photo(write(tmp_path / "a.jpg", encoded(textured(), ".jpg")), mask=folder))
    assert (panorama.is_valid[: HEIGHT // 2] == is_upper_left).all()
    assert (panorama.is_valid[HEIGHT // 2 :] != is_upper_left).all()
    assert any("black is ignored" in warning for warning in panorama.warnings) == is_upper_left
