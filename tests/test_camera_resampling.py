"""Photos of any camera, and rigs of them, as spheres: where each pixel comes to, and how fine they are."""

import functools

import cv2
import numpy as np
import pytest
from cameras import calibrated, four_sides
from pictures import encoded, write
from refusals import assert_refused
from rooms import room

from piccolo.camera import Camera, Mount
from piccolo.camera.model import pinhole
from piccolo.camera.resampling import View, sphere_of, sphere_width
from piccolo.geometry.pose import exp_so3
from piccolo.geometry.sphere import pixel_rays
from piccolo.jobs.threads import Workers
from piccolo.panorama import read_panorama
from piccolo.scenes.synthetic.world import make_query, photograph, picture_by, picture_of_all, pose_of_query

BACK = ((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0))
TILT = tuple(map(tuple, exp_so3(np.array([0.3, -0.2, 2.0])).tolist()))
FISHEYE = Camera("OPENCV_FISHEYE", 400, 400, (118.0, 119.0, 201.0, 199.0, 0.01, -0.003, 0.0, 0.0), 96.0)
LENSES = {
    "pinhole": (Mount(pinhole(480, 360, 300.0)),),
    "wide": (Mount(Camera("OPENCV", 500, 400, (150.0, 152.0, 255.0, 190.0, -0.02, 0.001, 1e-3, -1e-3))),),
    "fisheye": (Mount(FISHEYE),),
    "dual fisheye": (Mount(FISHEYE, TILT), Mount(FISHEYE, BACK, offset=(400, 0))),
}


@functools.lru_cache
def place():
    """A room, a pose in it, and its panorama there."""
    world, workers = room(5)[0], Workers(2)
    pose = make_query(world, 0, "tilt", 128, workers).pose
    this, _, _ = pose_of_query(world, 0, "tilt")
    return this, pose, photograph(this, pose, 2048, workers)


@pytest.mark.parametrize("lens", LENSES)
def test_a_photo_becomes_the_part_of_the_sphere_that_it_shows(tmp_path, lens):
    """Cast along the camera's own rays, and resampled: the same as cast along the sphere's."""
    this, pose, full = place()
    mounts = LENSES[lens]
    rgb = picture_of_all(mounts, this, pose, Workers(2))
    panorama = read_panorama(write(tmp_path / "a.png", encoded(rgb, ".png")), calibrated(mounts))
    width = panorama.rgb.shape[1]
    assert panorama.cameras == mounts
    assert width == sphere_width(mounts)
    wanted = cv2.resize(full, (width, width // 2), interpolation=cv2.INTER_AREA).astype(int)
    difference = np.abs(panorama.rgb.astype(int) - wanted).max(axis=2)[panorama.is_valid]
    assert np.median(difference) <= 2
    assert np.mean(difference) < 4
    rays = pixel_rays(width)
    is_shown = np.any([m.camera.pixels(rays @ m.rotation.T)[1] for m in mounts], axis=0)
    assert (is_shown & ~panorama.is_valid).mean() < 0.01
    assert not (panorama.is_valid & ~is_shown).any()


def test_nothing_aliases_where_the_picture_is_finer_than_the_sphere():
    """Stripes of two pixels come out grey, also at a wide picture's rim, which is finer than its middle."""
    camera = pinhole(3000, 2400, 1000.0)
    stripes = np.zeros((2400, 3000, 4), np.uint8)
    stripes[:, ::2] = 255
    stripes[..., 3] = 255
    rgb, is_valid = sphere_of([View(Mount(camera), stripes)], 512)
    assert is_valid.mean() > 0.15
    assert np.abs(rgb[is_valid].astype(int) - 127).max() <= 6


def test_where_cameras_overlap_the_nearer_axis_counts():
    white = np.full((400, 400, 4), 255, np.uint8)
    black = white * np.uint8([0, 0, 0, 1])
    views = [View(Mount(FISHEYE), white), View(Mount(FISHEYE, BACK), black)]
    for order in (views, views[::-1]):
        rgb, is_valid = sphere_of(order, 512)
        assert is_valid.all()
        is_front = pixel_rays(512)[..., 0] > 0.002
        np.testing.assert_array_equal(rgb[..., 0][is_front], 255)
        np.testing.assert_array_equal(rgb[..., 0][pixel_rays(512)[..., 0] < -0.002], 0)


def test_the_sphere_is_as_fine_as_the_camera_and_bounded():
    assert sphere_width([Mount(pinhole(640, 480, 2048 / (2 * np.pi)))]) == 2048
    assert sphere_width([Mount(pinhole(640, 480, 330.0)), Mount(pinhole(640, 480, 100.0))]) == 2304
    assert sphere_width([Mount(pinhole(9000, 6000, 9000.0))]) == 4096
    assert sphere_width([Mount(pinhole(64, 48, 10.0))]) == 256


def write_instant(folder, mounts, this, pose):
    folder.mkdir(parents=True)
    for mount in mounts:
        write(folder / mount.image, encoded(picture_by(mount, this, pose, Workers(2)), ".png"))
    return folder


def test_a_rig_is_one_sphere(tmp_path):
    this, pose, full = place()
    folder = write_instant(tmp_path / "1", four_sides(), this, pose)
    panorama = read_panorama(folder, calibrated(four_sides()))
    assert panorama.cameras == four_sides()
    assert panorama.warnings == ()
    width = panorama.rgb.shape[1]
    is_round = np.abs(pixel_rays(width)[:, 0, 2]) < np.sin(np.radians(35.0))  # all four reach that high
    assert panorama.is_valid[is_round].all()
    wanted = cv2.resize(full, (width, width // 2), interpolation=cv2.INTER_AREA).astype(int)
    assert np.abs(panorama.rgb.astype(int) - wanted)[panorama.is_valid].mean() < 4


def test_a_rig_says_how_far_apart_its_cameras_are(tmp_path):
    this, pose, _ = place()
    far = [Mount(m.camera, m.R_lens_from_cam, (0.0, 0.2, 0.0), image=m.image) for m in four_sides()[:2]]
    folder = write_instant(tmp_path / "1", far, this, pose)
    (note,) = read_panorama(folder, calibrated(far)).warnings
    assert note == "the rig's cameras are up to 0.20 m from its origin: near things come out displaced"
    (folder / "1.png").unlink()
    assert_refused("found 0 pictures for the camera '1.png' of made", read_panorama, folder, calibrated(far))
