"""Every camera model against OpenCV, COLMAP and itself."""

import cv2
import numpy as np
import pycolmap
import pytest

from piccolo.camera import Camera
from piccolo.camera.model import MODELS, camera_of_fov, pinhole
from piccolo.errors import InputError
from piccolo.geometry.rotations import OPTICAL_FROM_CAM

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
}
NOISE = np.random.default_rng(7)


def camera(model, **more):
    return Camera(model, *SIZE, tuple(map(float, PARAMS[model])), **more)


def points(count=5000):
    """Pixels (count, 2) all over the picture."""
    return NOISE.uniform(0.0, 1.0, (count, 2)) * SIZE


def optical(rays):
    return rays @ OPTICAL_FROM_CAM.T


def test_every_model_is_tried():
    assert PARAMS.keys() == MODELS.keys()


@pytest.mark.parametrize("model", MODELS)
def test_pixel_to_ray_to_pixel(model):
    this, pixels = camera(model), points()
    rays, is_seen = this.rays(pixels)
    assert is_seen.mean() > 0.9
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0, atol=1e-12)
    back, is_in = this.pixels(7.0 * rays)
    assert is_in[is_seen].all()
    assert np.abs(back - pixels)[is_seen].max() < TOLERANCE


@pytest.mark.parametrize("model", MODELS)
def test_pixels_are_those_of_colmap(model):
    theirs = pycolmap.Camera(model=model, width=SIZE[0], height=SIZE[1], params=PARAMS[model])
    this, pixels = camera(model), points()
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
    this, pixels = camera(model), points()
    rays, is_seen = this.rays(pixels)
    chosen = is_seen & (rays[:, 0] > 0.02)
    project = cv2.fisheye.projectPoints if model == "OPENCV_FISHEYE" else cv2.projectPoints
    ahead = optical(rays[chosen]).reshape(-1, 1, 3)
    found, _ = project(ahead, np.zeros(3), np.zeros(3), matrix, np.array(more))
    assert np.abs(found.reshape(-1, 2) + 0.5 - pixels[chosen]).max() < TOLERANCE


def test_a_fisheye_sees_behind_itself_as_its_formula_says():
    this = camera("OPENCV_FISHEYE")
    fx, fy, cx, cy, k1, k2, k3, k4 = PARAMS["OPENCV_FISHEYE"]
    theta, phi = np.radians(105.0), 0.7
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
    assert camera("SIMPLE_FISHEYE", max_angle_deg=50.0).pixels(rays)[1].tolist() == [
        True,
        False,
        True,
        True,
        False,
    ]


def test_axes():
    """+y left and +z up are less in u and in v."""
    for model in MODELS:
        this = camera(model)
        (ahead, left, up), is_in = this.pixels(np.array([[1.0, 0.0, 0.0], [1.0, 0.1, 0.0], [1.0, 0.0, 0.1]]))
        assert is_in.all()
        assert left[0] < ahead[0] - 10.0
        assert up[1] < ahead[1] - 10.0


def test_scaled_keeps_rays():
    for model in MODELS:
        this = camera(model)
        half = this.scaled(500, 400)
        rays, is_seen = this.rays(points())
        np.testing.assert_allclose(
            half.pixels(rays)[0][is_seen], this.pixels(rays)[0][is_seen] / 2.0, atol=1e-9
        )
    with pytest.raises(InputError, match="found a picture of 500 x 300 and a calibration for 1000 x 800"):
        camera("PINHOLE").scaled(500, 300)


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
        (("SIMPLE_PINHOLE", 10, 10, (float("nan"), 2.0, 3.0)), "wanted 3 finite numbers"),
        (("SIMPLE_PINHOLE", 10, 10, (-5.0, 2.0, 3.0)), "found a focal length of -5 px, wanted at least 1"),
        (("SIMPLE_PINHOLE", 0, 10, (5.0, 2.0, 3.0)), "found a camera of 0 x 10"),
        (("FOV", 10, 10, (5.0, 5.0, 2.0, 3.0, 0.0)), "found omega 0 of the model FOV"),
        (("SIMPLE_PINHOLE", 10, 10, (5.0, 2.0, 3.0), 190.0), "found max_angle_deg 190, wanted above 0"),
    ],
)
def test_what_is_no_camera_is_refused(values, message):
    with pytest.raises(InputError, match=message):
        Camera(*values)
