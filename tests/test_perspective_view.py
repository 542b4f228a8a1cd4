"""Views around what a photo shows: they hold all of it, look along its middle, and know their pixels."""

import numpy as np
import pytest

from piccolo.geometry.pose import exp_so3
from piccolo.geometry.sphere import pixel_rays
from piccolo.local_features.perspective_view import MULTIPLE, cover_sphere, view_around

WIDTH = 512
FOCAL = 120.0
RAYS = pixel_rays(WIDTH)
STRAIGHT_UP = np.array([0.0, -np.pi / 2.0, 0.0])


def _shown(turn, half_width=0.7, half_height=0.5):
    """The mask of a pinhole picture whose axes are turned by a rotation vector."""
    x, y, z = np.moveaxis(RAYS @ exp_so3(np.asarray(turn)), -1, 0)
    return (x > 0.0) & (np.abs(y) < half_width * x) & (np.abs(z) < half_height * x)


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.0, 0.0, np.pi), (0.0, 0.4, -2.0), STRAIGHT_UP])
def test_a_view_holds_all_that_a_photo_shows(turn):
    is_valid = _shown(turn)
    view = view_around(is_valid, FOCAL, WIDTH)
    assert view.focal == FOCAL
    height, width = view.is_own.shape
    assert height % MULTIPLE == width % MULTIPLE == 0
    np.testing.assert_allclose(view.R_sphere_from_view @ view.R_sphere_from_view.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(view.R_sphere_from_view) == pytest.approx(1.0)
    np.testing.assert_allclose(view.R_sphere_from_view[:, 0], exp_so3(np.asarray(turn))[:, 0], atol=0.02)
    rows, columns = view.project(RAYS[is_valid])
    assert 3 < rows.min() < rows.max() < height - 4
    assert 3 < columns.min() < columns.max() < width - 4
    assert (view.cut_mask(is_valid)[rows, columns] == 255).mean() > 0.97
    assert not view.cut_mask(is_valid)[[0, 0, -1, -1], [0, -1, 0, -1]].any()


def test_a_level_photo_is_not_turned_about_its_axis():
    """A side of the sphere's picture is a side of the view; its shape is that of the photo."""
    view = view_around(_shown((0.0, 0.0, 1.0), half_width=0.8, half_height=0.3), FOCAL, WIDTH)
    np.testing.assert_allclose(view.R_sphere_from_view[:, 2], [0.0, 0.0, 1.0], atol=1e-3)
    height, width = view.is_own.shape
    assert width > 2 * height
    np.testing.assert_allclose(
        np.abs(np.diff(view.columns[height // 2])), WIDTH / (2.0 * np.pi * FOCAL), rtol=0.5
    )


def test_what_is_too_wide_for_one_picture_has_no_view_around_it():
    assert view_around(_shown((0, 0, 0), half_width=1.0, half_height=0.5), FOCAL, WIDTH) is not None
    assert view_around(_shown((0, 0, 0), half_width=1.3, half_height=0.5), FOCAL, WIDTH) is None
    assert view_around(np.ones((WIDTH // 2, WIDTH), bool), FOCAL, WIDTH) is None
    assert view_around(np.zeros((WIDTH // 2, WIDTH), bool), FOCAL, WIDTH) is None


def test_pixels_of_a_view_show_what_they_are_cut_from():
    """A picture of the azimuth, across the seam: each pixel has that of its ray."""
    ramp = np.abs(np.arange(WIDTH) - WIDTH // 2).astype(np.float32) / (WIDTH // 2) * 255.0
    picture = np.repeat(ramp[None].astype(np.uint8), WIDTH // 2, axis=0)
    for view in (view_around(_shown((0.0, 0.1, 3.0)), FOCAL, WIDTH), cover_sphere(WIDTH)[4]):
        image = view.cut(picture)
        rows, columns = np.mgrid[5 : image.shape[0] : 20, 5 : image.shape[1] : 20].reshape(2, -1)
        height, width = image.shape
        across = (0.5 * width - 0.5 - columns) / view.focal
        up = (0.5 * height - 0.5 - rows) / view.focal
        rays = np.stack([np.ones(len(up)), across, up], axis=1) @ view.R_sphere_from_view.T
        azimuth = np.abs(np.arctan2(rays[:, 1], rays[:, 0]))
        np.testing.assert_allclose(image[rows, columns], azimuth / np.pi * 255.0, atol=2.5)
        np.testing.assert_array_equal(view.project(rays), (rows, columns))


def test_each_direction_is_one_views_own():
    owners = sum(
        np.isin(np.arange(RAYS[..., 0].size), view.find_own(RAYS.reshape(-1, 3))).astype(int)
        for view in cover_sphere(WIDTH)
    )
    np.testing.assert_array_equal(owners, 1)
