"""Cameras of single photos: by a folder of files, or by a model that says which camera took which."""

import json
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from refusals import assert_refused

from piccolo import Photo
from piccolo.photo.camera.photo_cameras import find_calibration, open_calibration
from piccolo.photo.panorama import read_panorama
from piccolo.photo.panorama.cube import is_cube

NAMES = ["left/a.jpg", "left/b.jpg", "right/a.jpg", "right/b.jpg"]
FOCALS = [500.0, 501.0, 502.0, 503.0]


@pytest.fixture
def model(tmp_path):
    """A model of COLMAP, each of whose photos has a camera, and one more has no photo."""
    made = pycolmap.Reconstruction()
    for k, focal in enumerate([*FOCALS, 700.0], 11):
        params = [focal, 320, 240, 0.01]
        camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=640, height=480, params=params, camera_id=k)
        made.add_camera_with_trivial_rig(camera)
    for k, name in enumerate(NAMES):
        image = pycolmap.Image(name, keypoints=np.ones((2, 2)), camera_id=11 + k, image_id=k + 1)
        made.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    made.write(tmp_path)
    made.write_text(tmp_path)
    return tmp_path


def _focal(given, pano):
    (mount,) = find_calibration(given, pano).for_picture(640, 480)
    return mount.camera.focal[0]


@pytest.mark.parametrize("file", ["cameras.bin", "cameras.txt"])
def test_a_photo_takes_the_camera_that_its_model_names(model, file):
    given = open_calibration(model / file)
    assert [_focal(given, model / "photos" / name) for name in NAMES] == FOCALS
    (model / "images.bin").unlink()
    assert _focal(open_calibration(model / file), model / NAMES[2]) == FOCALS[2]


def test_what_a_model_does_not_tell_is_refused(model):
    path = model / "cameras.bin"

    def read(_path, pano):
        return _focal(open_calibration(path), pano)

    assert_refused("found 2 cameras of a.jpg, wanted one of each photo", read, path, Path("a.jpg"))
    message = "found 5 cameras, 5 of them for 640 x 480, wanted one"
    assert_refused(f"whose images do not name the photo: {message}", read, path, model / "c.jpg")
    for name in ("images.bin", "images.txt"):
        (model / name).unlink()
    assert_refused(message, read, path, model / NAMES[0])


def test_equal_cameras_are_one(tmp_path):
    rows = [f"{k} PINHOLE 640 480 500 500 320 240\n" for k in range(3)]
    (tmp_path / "cameras.txt").write_text("".join(rows))
    assert _focal(open_calibration(tmp_path / "cameras.txt"), tmp_path / "a.jpg") == 500.0


def test_shots_of_opensfm_name_their_cameras(tmp_path):
    sizes = {"width": 640, "height": 480}
    cameras = {f"c{k}": {"projection_type": "perspective", "focal": 0.5 + k, **sizes} for k in range(2)}
    shots = {
        f"{k}.jpg": {"camera": f"c{k}", "rotation": [0, 0, 0], "translation": [0, 0, 0]} for k in range(2)
    }
    path = tmp_path / "reconstruction.json"
    path.write_text(json.dumps([{"cameras": cameras, "shots": shots, "points": {}}]))
    given = open_calibration(path)
    assert [_focal(given, tmp_path / f"{k}.jpg") for k in range(2)] == [320.0, 960.0]


def test_spheres_and_cubes_need_no_file_in_a_folder_of_cameras(tmp_path):
    rng = np.random.default_rng(0)
    cv2.imwrite(str(tmp_path / "sphere.png"), rng.integers(1, 255, (100, 200, 3)))
    cv2.imwrite(str(tmp_path / "photo.png"), rng.integers(1, 255, (100, 150, 3)))
    cube = tmp_path / "cube"
    cube.mkdir()
    for face in ("px", "nx", "py", "ny", "pz", "nz"):
        cv2.imwrite(str(cube / f"{face}.png"), rng.integers(1, 255, (64, 64, 3)))
    assert is_cube(cube)
    cameras = tmp_path / "cameras"
    cameras.mkdir()
    for whole in ("sphere.png", "cube"):
        panorama = read_panorama(Photo(tmp_path / whole, camera=cameras))
        assert (panorama.cameras, panorama.is_valid.all()) == ((), True)
    message = f"found no calibration of it in {cameras}, wanted photo.camera.json or photo.json"
    assert_refused(message, read_panorama, Photo(tmp_path / "photo.png", camera=cameras))
