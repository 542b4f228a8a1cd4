import naive
import numpy as np
import pytest
import rooms
from piccolo.optimize.descent import correlate, descend, descend_shaken, descend_starts, take_step

from piccolo.cloud.octree import build_octree
from piccolo.coarse_to_fine.query import FINE_VIEW, as_levels
from piccolo.coarse_to_fine.scan_map import SEARCH_VIEW, prepare_map
from piccolo.coarse_to_fine.starts import shakes
from piccolo.coarse_to_fine.view import render_view
from piccolo.geometry.pose import Pose, exp_so3, step
from piccolo.geometry.sphere_grid import make_grid
from piccolo.optimize.normal_equations import normal_equations, solve_damped
from piccolo.panorama.channels import LEVELS_PER_UNIT
from piccolo.panorama.local_normalization import normalized_channels
from piccolo.panorama.resize import resize
from piccolo.panorama.texels import pack_texels
from piccolo.runtime.threads import Workers

TILTED = Pose(exp_so3(np.array([0.4, -1.1, 0.7])), np.array([0.2, -0.3, 0.1]))
SCALE = 60.0


def _problem(seed=0, count=900, width=128):
    """Points (3, N) about the tilted camera, their levels (3, N), weights (N,), and a smooth image."""
    rng = np.random.default_rng(seed)
    points = (rng.normal(size=(3, count)) * 2).astype(np.float32)
    levels = rng.uniform(60, 200, (3, count)).astype(np.float32)
    weights = rng.uniform(0.5, 1.5, count).astype(np.float32)
    v, u = np.mgrid[0 : width // 2, 0:width] / width * 2 * np.pi
    rgb = np.stack([127 + 100 * np.sin((k + 1) * u + v) for k in range(3)], axis=-1).astype(np.uint8)
    return points, levels, weights, rgb


def _loss(problem, pose):
    """Geman-McClure loss by NumPy."""
    points, levels, weights, rgb = problem
    pixels = naive.project(points.T, pose.R_cam_from_world, pose.center_world, rgb.shape[1])
    square = ((naive.sample(rgb, pixels) - levels.T) ** 2).sum(axis=1)
    return (weights * square / (1 + square / SCALE**2)).sum()


def _sums(problem, pose):
    points, levels, weights, rgb = problem
    sums = np.empty(28)
    texels = pack_texels(rgb)
    normal_equations(
        points,
        levels,
        weights,
        texels.rgbx,
        texels.width,
        pose.R_cam_from_world,
        pose.center_world,
        SCALE,
        sums,
    )
    return sums


def test_loss_equals_its_twin():
    problem = _problem()
    assert _sums(problem, TILTED)[27] == pytest.approx(_loss(problem, TILTED), rel=1e-5)


def test_gradient_against_central_differences():
    problem = _problem()
    gradient = 2.0 * _sums(problem, TILTED)[21:27]
    numbers = [
        (_loss(problem, step(TILTED, 1e-6 * e)) - _loss(problem, step(TILTED, -1e-6 * e))) / 2e-6
        for e in np.eye(6)
    ]
    np.testing.assert_allclose(gradient, numbers, atol=0.02 * np.abs(numbers).max())


def test_matrix_is_that_of_the_weighted_jacobian():
    problem = _problem(count=300)
    points, levels, weights, rgb = problem

    def residuals(delta):
        at = step(TILTED, delta)
        pixels = naive.project(points.T, at.R_cam_from_world, at.center_world, rgb.shape[1])
        return naive.sample(rgb, pixels) - levels.T

    J = np.stack([(residuals(1e-6 * e) - residuals(-1e-6 * e)) / 2e-6 for e in np.eye(6)], axis=-1)
    s = 1 / (1 + (residuals(np.zeros(6)) ** 2).sum(axis=1) / SCALE**2)
    expected = np.einsum("n,nci,ncj->ij", weights * s * s, J, J)[np.triu_indices(6)]
    np.testing.assert_allclose(_sums(problem, TILTED)[:21], expected, atol=3e-3 * np.abs(expected).max())


def test_solver_equals_numpy_and_refuses_a_singular_matrix():
    rng = np.random.default_rng(0)
    J = rng.normal(size=(20, 6))
    A, g = J.T @ J, rng.normal(size=6)
    delta = np.empty(6)
    assert solve_damped(np.concatenate([A[np.triu_indices(6)], g, [0.0]]), 0.1, delta)
    np.testing.assert_allclose(delta, np.linalg.solve(A + 0.1 * np.diag(np.diag(A)), -g), rtol=1e-6)
    assert not solve_damped(np.concatenate([-A[np.triu_indices(6)], g, [0.0]]), 0.0, delta)


def test_step_is_limited_and_otherwise_that_of_the_pose():
    R, t = np.empty((3, 3)), np.empty(3)
    small = np.array([0.01, -0.02, 0.03, 0.05, 0.02, -0.04])
    take_step(TILTED.R_cam_from_world, TILTED.center_world, small, R, t)
    expected = step(TILTED, small)
    np.testing.assert_allclose(R, expected.R_cam_from_world, atol=1e-9)
    np.testing.assert_allclose(t, expected.center_world, atol=1e-12)
    take_step(TILTED.R_cam_from_world, TILTED.center_world, 100 * small, R, t)
    assert np.linalg.norm(t - TILTED.center_world) <= 0.3 + 1e-9
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-6)


@pytest.fixture(scope="module")
def fine():
    """Fine cells about the true camera of a room, in levels, and the panorama to match."""
    cloud = rooms.room(1)[1]
    _, panorama, true_pose = rooms.scene(1)
    offsets, features, weights = render_view(
        build_octree(cloud.voxels(np.eye(3))), true_pose.center_world, FINE_VIEW
    )
    image = normalized_channels(resize(panorama, 256), 0.0, FINE_VIEW.sigma_deg)
    return offsets, as_levels(features), weights, image, true_pose.R_cam_from_world


def test_descent_finds_the_true_pose_again(fine):
    offsets, levels, weights, image, R_true = fine
    pose = step(Pose(R_true, np.zeros(3)), np.array([0.03, -0.02, 0.04, 0.06, -0.05, 0.04]))
    R, t = pose.R_cam_from_world.copy(), pose.center_world.copy()
    before = correlate(offsets, levels, weights, image.rgbx, image.width, R, t)[0]
    descend(offsets, levels, weights, image.rgbx, image.width, 1.0 * LEVELS_PER_UNIT, 30, 1e-5, R, t)
    after, shared = correlate(offsets, levels, weights, image.rgbx, image.width, R, t)
    assert np.linalg.norm(t) < 0.01
    assert after > before
    assert after > 0.6
    assert shared == pytest.approx(weights.sum(), rel=1e-5)


def test_shaken_descents_lead_out_of_a_place_a_quarter_of_a_metre_off(fine):
    offsets, levels, weights, _, R_true = fine
    image = normalized_channels(resize(rooms.scene(1)[1], 128), 7.5, 22.0)
    off = step(Pose(R_true, np.zeros(3)), shakes(1.0)[1])
    n = len(shakes(1.0))
    R = np.repeat(off.R_cam_from_world[None], n, axis=0)
    t, scores = np.tile(off.center_world, (n, 1)), np.empty(n)
    args = offsets, levels, weights, image.rgbx, image.width, image.rgbx, image.width, 1.2 * LEVELS_PER_UNIT
    descend_shaken(*args, shakes(1.0), R, t, scores)
    assert np.linalg.norm(off.center_world) > 0.2
    assert np.linalg.norm(t[np.argmax(scores)]) < 0.06


def test_starts_descend_on_their_candidates_views_as_one_does_alone():
    scan_map = prepare_map(rooms.room(1)[1], Workers(2))
    _, panorama, true_pose = rooms.scene(1)
    image = normalized_channels(resize(panorama, 128), 7.5, SEARCH_VIEW.sigma_deg)
    k = int(np.argmin(np.linalg.norm(scan_map.centers - true_pose.center_world, axis=1)))
    area, scale = make_grid(24).solid_angle, 1.2 * LEVELS_PER_UNIT
    R, t, scores = true_pose.R_cam_from_world[None].copy(), scan_map.centers[k][None].copy(), np.empty(1)
    m = scan_map
    views = m.offsets, m.offset_unit, m.features, m.is_seen, area, m.centers
    descend_starts(*views, image.rgbx, image.width, scale, 12, np.array([k]), R, t, scores)
    offsets = (scan_map.offsets[k] * scan_map.offset_unit[k]).astype(np.float32)
    levels = scan_map.features[k].astype(np.float32) + np.float32(127.5)
    weights = (scan_map.is_seen[k] * area).astype(np.float32)
    R_alone, t_alone = true_pose.R_cam_from_world.copy(), np.zeros(3)
    descend(offsets, levels, weights, image.rgbx, image.width, scale, 12, 2e-3, R_alone, t_alone)
    np.testing.assert_allclose(t[0], scan_map.centers[k] + t_alone, atol=1e-4)
    np.testing.assert_allclose(R[0], R_alone, atol=1e-4)
    assert np.linalg.norm(t[0] - true_pose.center_world) < 0.1
    assert scores[0] > 0.4
