"""The photometric loss: its value by definition, its gradient against differences, and descents on it."""

import dataclasses
import functools
import math

import numpy as np
import pytest
import rooms
from rooms import as_panorama, errors, query, room

from piccolo.geometry.points import pack_points
from piccolo.geometry.pose import Pose, exp_so3, step
from piccolo.geometry.sphere import pixel_rays
from piccolo.localization.paper import localize_by_paper, prepare_by_paper
from piccolo.localization.paper_descent import refine_by_solver
from piccolo.photo.panorama.panorama import shrink
from piccolo.system.errors import InputError
from piccolo.system.jobs.threads import Stopwatch, Workers
from piccolo.views.zbuffer import View, render_view
from research.experiments.photometric import (
    PhotometricSettings,
    photometric_equations,
    photometric_loss,
    pixel_motion,
    view_gradient,
)

TIER = "scene"

HALF_SIZE = np.array([2.5, 2.0, 1.3])
WIDTH = 128
TURNED = Pose(exp_so3(np.array([0.3, -0.5, 2.0])), np.array([0.4, -0.3, 0.2]))


def _colors(points):
    """Smooth colours (N, 3) in levels of places (N, 3)."""
    x, y, z = points.T
    waves = [np.sin(1.7 * x + y), np.cos(1.3 * y - 0.9 * z + x), np.sin(1.1 * z - 1.5 * x + 0.4)]
    return np.round(127.5 + 110.0 * np.stack(waves, axis=1)).astype(np.uint8)


def _on_box(center, rays):
    """Where rays (N, 3) from inside a box meet it (N, 3)."""
    with np.errstate(divide="ignore"):
        reach = (np.sign(rays) * HALF_SIZE - center) / rays
    return center + np.nanmin(reach, axis=1, keepdims=True) * rays


@functools.cache
def _box():
    """A dense cloud of a smooth box."""
    rng = np.random.default_rng(1)
    rays = rng.normal(size=(250_000, 3))
    points = _on_box(np.zeros(3), rays / np.linalg.norm(rays, axis=1, keepdims=True))
    return pack_points(points.astype(np.float32), _colors(points))


@functools.cache
def _photo():
    rays = pixel_rays(WIDTH).reshape(-1, 3) @ TURNED.R_cam_from_world
    return as_panorama(_colors(_on_box(TURNED.center_world, rays)).reshape(WIDTH // 2, WIDTH, 3))


def test_value_is_the_mean_over_pixels_that_show_and_count():
    points = _box()
    photo = _photo()
    masked = dataclasses.replace(photo, is_valid=np.random.default_rng(2).random(photo.is_valid.shape) < 0.7)
    view = render_view(points, TURNED, WIDTH)
    norms = np.sqrt(((view.rgb - masked.rgb / 255.0) ** 2).sum(axis=2))
    expected = norms[np.isfinite(view.depth) & masked.is_valid].mean()
    assert photometric_loss(points, masked, TURNED) == pytest.approx(expected, rel=1e-5)
    assert photometric_equations(points, masked, TURNED)[0] == pytest.approx(expected, rel=1e-5)
    assert photometric_loss(points, photo, TURNED) < 0.03
    assert photometric_loss(points, photo, step(TURNED, np.full(6, 0.1))) > 0.06


def test_pixels_move_as_the_points_that_they_show():
    rng = np.random.default_rng(3)
    depth = rng.uniform(0.5, 6.0, (WIDTH // 2, WIDTH)).astype(np.float32)
    rows_u, rows_v = pixel_motion(depth, np.ones(depth.shape, dtype=bool))
    points = (pixel_rays(WIDTH) * depth[..., None]).reshape(-1, 3)

    def pixels(delta):  # of the points after a step of the camera that saw them
        moved = points @ exp_so3(delta[:3]).T - delta[3:]
        azimuth = np.arctan2(moved[:, 1], moved[:, 0])
        elevation = np.arcsin(moved[:, 2] / np.linalg.norm(moved, axis=1))
        return WIDTH * (0.5 - azimuth / math.tau), WIDTH * (0.25 - elevation / math.tau)

    for k, unit in enumerate(np.eye(6)):
        (u1, v1), (u0, v0) = pixels(1e-5 * unit), pixels(-1e-5 * unit)
        by_u = ((u1 - u0 + WIDTH / 2) % WIDTH - WIDTH / 2) / 2e-5
        np.testing.assert_allclose(rows_u[:, k], by_u, rtol=1e-4, atol=1e-2)
        np.testing.assert_allclose(rows_v[:, k], (v1 - v0) / 2e-5, rtol=1e-4, atol=1e-2)


def test_gradient_goes_the_way_of_differences():
    points = _box()
    photo = _photo()
    rng = np.random.default_rng(4)
    cosines, ratios = [], []
    for _ in range(12):
        at = step(TURNED, rng.normal(0.0, 0.1, 6))
        _, gradient, _ = photometric_equations(points, photo, at)
        loss = [[photometric_loss(points, photo, step(at, s * h)) for s in (1, -1)] for h in 0.05 * np.eye(6)]
        differences = np.diff(np.array(loss)[:, ::-1], axis=1)[:, 0] / 0.1
        lengths = np.linalg.norm(gradient), np.linalg.norm(differences)
        cosines.append(gradient @ differences / np.prod(lengths))
        ratios.append(lengths[0] / lengths[1])
    assert min(cosines) > 0.95
    assert np.median(cosines) > 0.99
    assert 0.7 < np.median(ratios) < 1.3


def test_view_gradient_beside_holes_at_the_seam_and_at_the_poles():
    u, v = np.meshgrid(np.arange(8.0), np.arange(4.0))
    rgb = np.stack([3.0 * u, 5.0 * v, 0.0 * u], axis=2).astype(np.float32)
    depth = np.ones((4, 8), np.float32)
    depth[1, 3] = np.inf
    rgb[1, 3] = 99.0  # must not be looked at
    by_u, by_v = view_gradient(View(depth, rgb))
    assert by_u[2, 4, 0] == by_u[1, 2, 0] == by_u[1, 4, 0] == 3.0
    assert by_u[2, 0, 0] == (3.0 - 21.0) / 2  # the seam: columns 1 and 7
    depth[0, 3] = np.inf  # between a hole and the pole: no neighbour, no derivative
    assert by_v[0, 3, 1] == 0.0
    assert (by_v[depth == 1.0][:, 1] == 5.0).all()  # the rows of the poles and those beside the hole too


@pytest.mark.parametrize("solver", ["adam", "lbfgs", "gauss-newton"])
def test_descent_recovers_the_true_pose(solver):
    points, panorama, true_pose = rooms.scene(1)
    settings = PhotometricSettings(photometric_width=128, solver=solver)
    start = step(true_pose, np.array([0.06, -0.04, 0.08, 0.1, -0.12, 0.05]))
    refined = refine_by_solver(points, settings.make_loss(panorama), start, settings)
    rooms.assert_near(refined.pose, true_pose, 0.03, 0.5)
    assert refined.loss < photometric_loss(points, shrink(panorama, settings.photometric_width), start)


@pytest.mark.parametrize("initialization", ["two-stage", "loss-only"])
def test_camera_is_found_with_the_same_bits_for_any_number_of_threads(initialization):
    quick = {"num_translations": 20, "max_points": 30_000, "num_iterations": 40, "num_by_histogram": 3}
    settings = PhotometricSettings(photometric_width=128, initialization=initialization, **quick)
    paper_map = prepare_by_paper(room(1)[1].pack(), settings)
    panorama = as_panorama(query(1).rgb)
    one, two = (localize_by_paper(paper_map, panorama, settings, Workers(n), Stopwatch()) for n in (1, 2))
    assert errors(one.pose, query(1).pose)[0] < 0.1
    np.testing.assert_array_equal(one.pose.center_world, two.pose.center_world)
    assert (one.loss, one.evidence) == (two.loss, two.evidence)


def test_masked_or_empty_views_have_no_loss():
    points = _box()
    photo = _photo()
    half = dataclasses.replace(photo, is_valid=photo.is_valid & (np.arange(WIDTH) < WIDTH // 2))
    far = Pose(TURNED.R_cam_from_world, np.array([40.0, 0.0, 0.0]))
    nothing = dataclasses.replace(photo, is_valid=np.zeros_like(photo.is_valid))
    assert np.isfinite(photometric_loss(points, half, TURNED))
    for panorama, pose in ((photo, far), (nothing, TURNED)):
        assert photometric_loss(points, panorama, pose) == math.inf
        loss, gradient, matrix = photometric_equations(points, panorama, pose)
        assert loss == math.inf
        assert not gradient.any()
        np.linalg.solve(matrix, gradient)


def test_width_that_means_nothing_is_refused():
    for width in (0, 31, 129, 8192):
        with pytest.raises(InputError, match=f"photometric_width: found {width}, wanted an even number of"):
            PhotometricSettings(photometric_width=width)
