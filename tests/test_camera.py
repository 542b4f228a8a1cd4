"""Every camera model against OpenCV, COLMAP and itself."""

import functools
import math

import cv2
import numpy as np
import pycolmap
import pytest
from cameras import calibrated, four_sides
from pictures import encoded, write
from refusals import assert_input_error, assert_refused
from rooms import room

from piccolo.geometry.pose import OPTICAL_FROM_CAM, exp_so3
from piccolo.geometry.sphere import pixel_rays
from piccolo.photo.camera import Camera, Mount
from piccolo.photo.camera.foreign import MODEL_NUMBERS
from piccolo.photo.camera.model import MODELS, camera_of_fov, pinhole
from piccolo.photo.camera.resampling import MAX_REMAP_SIDE, CameraView, make_sphere, shrunk, sphere_width
from piccolo.photo.panorama import read_panorama
from piccolo.system.errors import InputError
from piccolo.system.jobs.threads import Workers
from research.synthetic.world import make_query, photograph, picture_of_all, pose_of_query, render_picture

SIZE = (1000, 800)
TOLERANCE = 1e-6  # px
CENTER = (512.0, 391.0)
PARAMS = {
    "SIMPLE_PINHOLE": (300, *CENTER),
    "PINHOLE": (900, 880, *CENTER),
    "SIMPLE_RADIAL": (900, *CENTER, -0.1),
    "RADIAL": (600, *CENTER, -0.2, 0.05),
    "OPENCV": (900, 880, *CENTER, -0.2, 0.05, 0.002, -0.001),
    "FULL_OPENCV": (500, 490, *CENTER, 0.3, -0.1, 0.002, -0.001, 0.02, 0.5, 0.02, 0.01),
    "FOV": (500, 490, *CENTER, 0.9),
    "SIMPLE_FISHEYE": (300, *CENTER),
    "FISHEYE": (300, 310, *CENTER),
    "SIMPLE_RADIAL_FISHEYE": (300, *CENTER, -0.02),
    "RADIAL_FISHEYE": (300, *CENTER, 0.02, -0.01),
    "OPENCV_FISHEYE": (300, 310, *CENTER, 0.02, -0.01, 0.004, -0.001),
    "THIN_PRISM_FISHEYE": (300, 310, *CENTER, 0.02, -0.01, 0.002, -0.001, 0.003, -0.001, 0.002, 0.001),
    "EQUIRECTANGULAR": SIZE,
    "PARTIAL_EQUIRECTANGULAR": (170, 280, *CENTER),
}
NOISE = np.random.default_rng(7)


def camera(model, **more):
    return Camera(model, *SIZE, tuple(map(float, PARAMS[model])), **more)


def points(count=5000):
    return NOISE.uniform(0.0, 1.0, (count, 2)) * SIZE


def optical(rays):
    return rays @ OPTICAL_FROM_CAM.T


@pytest.mark.parametrize("model", MODELS)
def test_pixel_to_ray_to_pixel(model):
    this = camera(model)
    pixels = points()
    rays, is_seen = this.rays(pixels)
    assert is_seen.mean() > 0.9
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0, atol=1e-12)
    back, is_in = this.pixels(7.0 * rays)
    assert is_in[is_seen].all()
    assert np.abs(back - pixels)[is_seen].max() < TOLERANCE


def test_models_have_the_numbers_of_colmap():
    theirs = pycolmap.CameraModelId.__members__
    assert {theirs[model].value: model for model in MODELS if model in theirs} == MODEL_NUMBERS


@pytest.mark.parametrize("model", MODEL_NUMBERS.values())
def test_pixels_are_those_of_colmap(model):
    theirs = pycolmap.Camera(model=model, width=SIZE[0], height=SIZE[1], params=PARAMS[model])
    this = camera(model)
    pixels = points()
    rays, is_seen = this.rays(pixels)
    is_ahead = is_seen & ((rays[:, 0] > 0.0) | (model == "EQUIRECTANGULAR"))
    found = theirs.img_from_cam(optical(rays[is_ahead]))
    assert is_ahead.mean() > 0.5
    assert np.abs(found - pixels[is_ahead]).max() < TOLERANCE
    if model != "EQUIRECTANGULAR":  # whose rays COLMAP gives whole
        plane = theirs.cam_from_img(pixels[is_ahead])
        ahead = optical(rays[is_ahead])
        is_wide = ahead[:, 2] < 0.3  # a plane far out
        assert np.abs(plane - ahead[:, :2] / ahead[:, 2:])[~is_wide].max() < TOLERANCE


@pytest.mark.parametrize("model", ["OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"])
def test_pixels_are_those_of_opencv_up_to_half_a_pixel(model):
    fx, fy, cx, cy, *more = map(float, PARAMS[model])
    matrix = np.array([[fx, 0.0, cx - 0.5], [0.0, fy, cy - 0.5], [0.0, 0.0, 1.0]])
    this = camera(model)
    pixels = points()
    rays, is_seen = this.rays(pixels)
    chosen = is_seen & (rays[:, 0] > 0.02)
    project = cv2.fisheye.projectPoints if model == "OPENCV_FISHEYE" else cv2.projectPoints
    ahead = optical(rays[chosen]).reshape(-1, 1, 3)
    found, _ = project(ahead, np.zeros(3), np.zeros(3), matrix, np.array(more))
    assert np.abs(found.reshape(-1, 2) + 0.5 - pixels[chosen]).max() < TOLERANCE


def test_a_fisheye_sees_behind_itself_as_its_formula_says():
    this = camera("OPENCV_FISHEYE")
    fx, fy, cx, cy, k1, k2, k3, k4 = PARAMS["OPENCV_FISHEYE"]
    theta = np.radians(105.0)
    phi = 0.7
    ray = [np.cos(theta), -np.sin(theta) * np.cos(phi), -np.sin(theta) * np.sin(phi)]
    r = theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8)
    found, _ = this.pixels(np.array(ray))
    np.testing.assert_allclose(found, [cx + fx * r * np.cos(phi), cy + fy * r * np.sin(phi)], atol=1e-9)


@pytest.mark.parametrize(("model", "limit_deg"), [("SIMPLE_RADIAL", 61.29), ("RADIAL_FISHEYE", 129.55)])
def test_rays_beyond_the_turning_point_of_the_polynomial_are_not_in_the_picture(model, limit_deg):
    """There the radius falls again: without the limit a ray far outside would land inside."""
    this = camera(model)
    assert np.degrees(this.max_angle) == pytest.approx(limit_deg, abs=0.01)
    angles = np.radians(limit_deg + np.array([-1.0, 1.0, 20.0]))
    rays = np.stack([np.cos(angles), np.zeros(3), -np.sin(angles)], axis=1)
    large = Camera(model, 4000, 4000, (this.params[0], 2000.0, 2000.0, *this.params[3:]))
    assert large.pixels(rays)[1].tolist() == [True, False, False]
    corner, is_seen = large.rays(np.array([[3999.0, 3999.0]]))
    assert not is_seen.any()
    assert np.isfinite(corner).all()


def test_strong_distortion_converges_all_over_the_picture():
    strong = Camera("OPENCV", 4000, 3000, (1200.0, 1210.0, 1990.0, 1510.0, -0.28, 0.07, 1e-3, -2e-3))
    pixels = NOISE.uniform(0.0, 1.0, (20000, 2)) * (4000, 3000)
    rays, is_seen = strong.rays(pixels)
    back, _ = strong.pixels(rays)
    assert is_seen.mean() > 0.99
    assert np.abs(back - pixels)[is_seen].max() < TOLERANCE


def test_rays_behind_and_outside_are_not_in_the_picture():
    this = pinhole(*SIZE, 500.0)
    rays = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [1.0, 1.1, 0.0], [1.0, 0.9, 0.0], [0.0, 0.0, 1.0]])
    pixels, is_in = this.pixels(rays)
    assert is_in.tolist() == [True, False, False, True, False]
    np.testing.assert_allclose(pixels[3], [50.0, 400.0])  # left of the axis
    is_in = camera("SIMPLE_FISHEYE", max_angle_deg=50.0).pixels(rays)[1]
    assert is_in.tolist() == [True, False, True, True, False]


def test_rows_beyond_the_poles_and_columns_beyond_the_seam_show_nothing():
    part = Camera("PARTIAL_EQUIRECTANGULAR", 64, 48, (8.0, 12.0, 32.0, 24.0))
    _, is_seen = part.rays(np.array([[32.0, 24.0], [6.0, 24.0], [8.0, 24.0], [32.0, 4.0], [32.0, 6.0]]))
    assert is_seen.tolist() == [True, False, True, False, True]


def test_scaled_keeps_rays():
    for model in MODELS:
        this = camera(model)
        half = this.scale_to_size(500, 400)
        rays, is_seen = this.rays(points())
        halved = half.pixels(rays)[0][is_seen]
        np.testing.assert_allclose(halved, this.pixels(rays)[0][is_seen] / 2.0, atol=1e-9)
    with pytest.raises(InputError, match="found a picture of 500 x 300 and a calibration for 1000 x 800"):
        camera("PINHOLE").scale_to_size(500, 300)


@pytest.mark.parametrize(("lens", "fov_deg"), [("pinhole", 90.0), ("pinhole", 170.0), ("fisheye", 220.0)])
def test_the_field_of_view_is_that_of_the_width(lens, fov_deg):
    rays, _ = camera_of_fov(lens, fov_deg, *SIZE).rays(np.array([[0.0, 400.0], [1000.0, 400.0]]))
    azimuth = np.degrees(np.arctan2(rays[:, 1], rays[:, 0]))
    np.testing.assert_allclose(azimuth, [fov_deg / 2.0, -fov_deg / 2.0], atol=1e-9)


def test_resolution_is_the_focal_length():
    for model in ("SIMPLE_PINHOLE", "OPENCV_FISHEYE", "SIMPLE_RADIAL"):
        assert camera(model).resolution == pytest.approx(np.sqrt(np.prod(camera(model).focal)), rel=1e-6)
    assert camera("FOV").resolution == pytest.approx(500 * 0.9899 * 2 * np.tan(0.45) / 0.9, rel=1e-3)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (("KODAK", 10, 10, ()), "found the camera model 'KODAK', wanted one of SIMPLE_PINHOLE"),
        (("PINHOLE", 10, 10, (1.0, 2.0)), r"wanted 4 finite numbers \(fx fy cx cy\)"),
        (("SIMPLE_PINHOLE", 10, 10, (-5.0, 2.0, 3.0)), "found a focal length of -5 px, wanted at least 1"),
        (("SIMPLE_PINHOLE", 0, 10, (5.0, 2.0, 3.0)), "found a camera of 0 x 10"),
        (("FOV", 10, 10, (5.0, 5.0, 2.0, 3.0, 0.0)), "found omega 0 of the model FOV"),
        (
            ("OPENCV", 10, 10, (5.0, 5.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1001.0)),
            "found p2 1001 of the model OPENCV",
        ),
        (("SIMPLE_PINHOLE", 10, 10, (5.0, 2.0, 3.0), 190.0), "found max_angle_deg 190, wanted above 0"),
    ],
)
def test_what_is_no_camera_is_refused(values, message):
    assert_input_error(message, Camera, *values)


BACK = ((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0))
TILT = tuple(map(tuple, exp_so3(np.array([0.3, -0.2, 2.0])).tolist()))
FISHEYE = Camera("OPENCV_FISHEYE", 240, 240, (71.0, 71.5, 121.0, 119.0, 0.01, -0.003, 0.0, 0.0), 96.0)
LENSES = {
    "pinhole": (Mount(pinhole(320, 240, 200.0)),),
    "wide": (Mount(Camera("OPENCV", 350, 280, (105.0, 106.0, 178.0, 133.0, -0.02, 0.001, 1e-3, -1e-3))),),
    "dual fisheye": (Mount(FISHEYE, TILT), Mount(FISHEYE, BACK, offset=(240, 0))),
}


@functools.lru_cache
def place():
    world = room(5)[0]
    workers = Workers(2)
    pose = make_query(world, 0, "tilt", 128, workers).pose
    this, _, _ = pose_of_query(world, 0, "tilt")
    return this, pose, photograph(this, pose, 1536, workers)


@pytest.mark.parametrize("lens", LENSES)
def test_a_photo_becomes_the_part_of_the_sphere_that_it_shows(tmp_path, lens):
    """Cast along the camera's own rays, and resampled: the same as cast along the sphere's."""
    this, pose, full = place()
    mounts = LENSES[lens]
    rgb = picture_of_all(mounts, this, pose, Workers(2))
    panorama = read_panorama(calibrated(write(tmp_path / "a.png", encoded(rgb, ".png")), mounts))
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
    rgb, is_valid = make_sphere([CameraView(Mount(camera), stripes)], 512)
    assert is_valid.mean() > 0.15
    assert np.abs(rgb[is_valid].astype(int) - 127).max() <= 6


def test_where_cameras_overlap_the_nearer_axis_counts():
    white = np.full((400, 400, 4), 255, np.uint8)
    black = white * np.uint8([0, 0, 0, 1])
    views = [CameraView(Mount(FISHEYE), white), CameraView(Mount(FISHEYE, BACK), black)]
    for order in (views, views[::-1]):
        rgb, is_valid = make_sphere(order, 512)
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
        write(folder / mount.image, encoded(render_picture(mount, this, pose, Workers(2)), ".png"))
    return folder


def test_a_rig_is_one_sphere(tmp_path):
    this, pose, full = place()
    folder = write_instant(tmp_path / "1", four_sides(), this, pose)
    panorama = read_panorama(calibrated(folder, four_sides()))
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
    (note,) = read_panorama(calibrated(folder, far)).warnings
    assert note == "the rig's cameras are up to 0.20 m from its origin: near objects appear displaced"
    (folder / "1.png").unlink()
    assert_refused("found 0 pictures for the camera '1.png' of made", read_panorama, calibrated(folder, far))


@pytest.mark.parametrize(("finer", "is_shrunk"), [(0.5, False), (1.2, False), (1.3, True), (3.0, True)])
def test_a_picture_that_is_hardly_finer_than_the_sphere_is_not_blurred(finer, is_shrunk):
    camera = pinhole(400, 300, finer * 1024 / math.tau)
    view = CameraView(Mount(camera), np.zeros((300, 400, 4), np.uint8))
    found = shrunk(view, 1024)
    assert (found is not view) == is_shrunk
    assert found.pixels.shape[1] == (round(400 / finer) if is_shrunk else 400)


@pytest.mark.parametrize("change", [-0.1, 0.1])
def test_a_picture_is_made_smaller_once_for_calibrations_that_differ_a_little(change):
    camera = pinhole(400, 300, 3.0 * 1024 / math.tau)
    found = shrunk(CameraView(Mount(camera), np.zeros((300, 400, 4), np.uint8)), 1024)
    beside = found._replace(mount=Mount(camera.change(change)))
    assert shrunk(beside, 1024) is beside


def test_a_picture_too_long_to_be_sampled_is_always_made_smaller():
    camera = pinhole(MAX_REMAP_SIDE + 100, 10, 100.0)
    view = CameraView(Mount(camera), np.zeros((10, MAX_REMAP_SIDE + 100, 4), np.uint8))
    assert shrunk(view).pixels.shape[1] == MAX_REMAP_SIDE
