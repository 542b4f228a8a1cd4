"""Descents of narrow photos leave out cells, but none that the photo may show on the way."""

import math

import naive
import numpy as np
import pytest

from piccolo.geometry.cone import EVERYWHERE, Cone, cone_about
from piccolo.geometry.pose import exp_so3, rotate_points, yaw_rotation
from piccolo.geometry.sphere import pixel_rays
from piccolo.photo.panorama.texels import find_valid, pack_texels
from piccolo.problem.photo_cone import CONE_MARGIN, find_cone, select_cells
from research.synthetic.world import mask_outside_field

WIDTH = 128
UNIT = np.float32(0.001)  # [m]
PIXEL = math.tau / WIDTH
ROLLED = yaw_rotation(0.7) @ exp_so3(np.array([0.5, 0.0, 0.0]))
TILTED = exp_so3(np.array([0.4, -1.1, 0.7]))


def _image(is_valid):
    rgb = np.random.default_rng(0).integers(0, 256, (*is_valid.shape, 3), dtype=np.uint8)
    return pack_texels(rgb, is_valid)


def _narrow(turn):
    """An image of which a turned frustum of 70 degrees is valid."""
    outside = mask_outside_field(2 * WIDTH, 70.0, 0.0)
    rays = pixel_rays(WIDTH) @ turn
    pixels = naive.project(rays.reshape(-1, 3), np.eye(3), np.zeros(3), 2 * WIDTH).astype(int)
    rows = np.minimum(pixels[:, 1], WIDTH - 1)
    columns = pixels[:, 0] % (2 * WIDTH)
    return _image(~outside[rows, columns].reshape(WIDTH // 2, WIDTH))


def _select(offsets, cone, R_cam_from_map, center):
    kept = np.empty(offsets.shape[1], np.int64)
    return kept[: select_cells(offsets, UNIT, cone, R_cam_from_map, center, kept)]


def _shows(image, points, R_cam_from_map, center):
    """Mask (N,) of the points (N, 3) in the map that an image shows."""
    pixels = naive.project(points, R_cam_from_map, center, image.width).astype(int)
    return find_valid(image)[np.minimum(pixels[:, 1], image.width // 2 - 1), pixels[:, 0] % image.width]


def _cells(rng, count=4000):
    """Offsets (3, N) of cells all around, 0.5 m to 20 m away."""
    rays = rng.normal(size=(3, count))
    rays *= np.exp(rng.uniform(math.log(0.5), math.log(20.0), count)) / np.linalg.norm(rays, axis=0)
    return np.rint(rays / UNIT).astype(np.int16)


@pytest.mark.parametrize("turn", [ROLLED, TILTED])
@pytest.mark.parametrize("seed", [0, 1])
def test_no_cell_is_left_out_that_the_photo_shows_after_a_move_within_the_margin(seed, turn):
    """The camera turns, and moves so far that no kept or lost cell turns more than the rest of the margin."""
    rng = np.random.default_rng(seed)
    image = _narrow(turn)
    cone = find_cone(image)
    R = exp_so3(rng.normal(size=3))
    center = rng.normal(0.0, 0.1, 3)
    offsets = _cells(rng)
    points = offsets.T * float(UNIT)
    kept = _select(offsets, cone, R, center)
    np.testing.assert_array_equal(kept, np.unique(kept))
    assert set(np.flatnonzero(_shows(image, points, R, center))) <= set(kept)
    num_new = 0
    for _ in range(20):
        axis, way = rng.normal(size=(2, 3))
        angle = rng.uniform(0.0, CONE_MARGIN - PIXEL)  # a pixel's corner lies beyond its middle
        moved_center = center + rng.uniform(0.0, 0.3) * way / np.linalg.norm(way)
        turned = exp_so3(angle * axis / np.linalg.norm(axis)) @ R
        before = points - center
        after = points - moved_center
        cosines = (before * after).sum(axis=1)
        cosines /= np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
        is_within = np.arccos(np.clip(cosines, -1, 1)) + angle < CONE_MARGIN - PIXEL
        shown = np.flatnonzero(_shows(image, points, turned, moved_center) & is_within)
        assert set(shown) <= set(kept)
        num_new += len(set(shown) - set(np.flatnonzero(_shows(image, points, R, center))))
    assert num_new > 100


def test_the_cells_are_those_within_the_margin_of_the_cone_around_the_photo():
    """Its half angle is that of a photo's corners, 70 degrees wide and three quarters as high."""
    rng = np.random.default_rng(7)
    image = _narrow(ROLLED)
    cone = find_cone(image)
    np.testing.assert_allclose(cone.axis, ROLLED[:, 0], atol=0.02)
    corner = math.atan(math.hypot(1.0, 0.75) * math.tan(math.radians(35.0)))
    assert math.acos(cone.cos_angle) - CONE_MARGIN == pytest.approx(corner, abs=PIXEL)
    R = exp_so3(rng.normal(size=3))
    center = rng.normal(0.0, 0.1, 3)
    offsets = _cells(rng)
    rays_cam = rotate_points(offsets.T * float(UNIT) - center, R)
    angle = np.arccos(rays_cam @ cone.axis / np.linalg.norm(rays_cam, axis=1))
    off = np.abs(angle - math.acos(cone.cos_angle))
    is_kept = np.isin(np.arange(offsets.shape[1]), _select(offsets, cone, R, center))
    is_plain = off > 1e-4
    np.testing.assert_array_equal(is_kept[is_plain], (angle < math.acos(cone.cos_angle))[is_plain])
    assert 0.2 < is_kept.mean() < 0.4


@pytest.mark.parametrize("num_hidden", [0, 6])
def test_of_a_whole_sphere_all_cells_are_kept(num_hidden):
    """Even if a tripod is hidden: what it hides lies within the margin around the rest."""
    is_valid = np.ones((WIDTH // 2, WIDTH), bool)
    is_valid[WIDTH // 2 - num_hidden :] = False
    cone = find_cone(_image(is_valid))
    offsets = np.concatenate([_cells(np.random.default_rng(3)), np.zeros((3, 1), np.int16)], axis=1)
    for center in (np.zeros(3), np.array([0.3, -0.2, 0.1])):
        np.testing.assert_array_equal(_select(offsets, cone, TILTED, center), np.arange(offsets.shape[1]))


def test_of_a_photo_that_shows_nothing_no_cell_is_kept():
    cone = find_cone(_image(np.zeros((WIDTH // 2, WIDTH), bool)))
    assert isinstance(cone, Cone)
    assert len(_select(_cells(np.random.default_rng(1)), cone, TILTED, np.zeros(3))) == 0


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_cone_contains_the_rays_within_its_angle(dtype):
    axis = np.array([0.6, -0.48, 0.64])
    across = np.cross(axis, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    angles = np.radians([0.0, 29.9, 30.1, 90.0, 180.0])
    rays = (np.outer(np.cos(angles), axis) + np.outer(np.sin(angles), across)).astype(dtype)
    cone = cone_about(axis, math.cos(math.radians(30.0)))
    assert cone.contains(rays).tolist() == [True, True, False, False, False]
    assert EVERYWHERE.contains(rays).all()
