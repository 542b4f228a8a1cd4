import math

import naive
import numpy as np
import pytest

from piccolo.geometry.points import pack_points
from piccolo.geometry.pose import Pose, exp_so3, step, yaw_rotation
from piccolo.optimize.sampling_loss import POINTS_A_SUM, sampling_equations, sampling_loss
from piccolo.photo.panorama.texels import pack_texels

WIDTH = 256
CENTER = np.array([0.2, -0.3, 0.1])
POSES = {
    "upright": Pose(yaw_rotation(2.0), CENTER),
    "tilted": Pose(exp_so3(np.array([0.4, -1.1, 0.7])), CENTER),
    "upside down": Pose(exp_so3(np.array([3.0, 0.2, 0.1])), CENTER),
}


def _smooth_image(seed=0, width=WIDTH):
    """An 8-bit image (H, W, 3) that is smooth over the seam, so that differences have a meaning."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[0 : width // 2, 0:width] / width * 2 * np.pi
    image = np.zeros((width // 2, width, 3))
    for channel in range(3):
        for k in range(1, 5):
            a, b = rng.normal(size=2)
            phase = rng.uniform(0, 6, size=2)
            image[..., channel] += a * np.sin(k * u + phase[0]) + b * np.cos(2 * k * v + phase[1])
    image -= image.min()
    return np.round(image / image.max() * 255).astype(np.uint8)


def _points(where, count=6000, seed=1):
    """Points (N, 3) around CENTER in a part of the sphere of the tilted camera, and their colours (N, 3)."""
    rng = np.random.default_rng(seed)
    axis = {"anywhere": None, "seam": (-1, 0, 0), "zenith": (0, 0, 1), "nadir": (0, 0, -1)}[where]
    x_cam = rng.normal(size=(count, 3))
    if axis is not None:
        x_cam = np.array(axis) * 2.0 + 0.3 * x_cam
    x_cam *= rng.uniform(0.8, 2.0, size=(count, 1)) / np.linalg.norm(x_cam, axis=1, keepdims=True)
    points = (x_cam @ POSES["tilted"].R_cam_from_world + CENTER).astype(np.float32)
    return points, rng.integers(0, 256, size=(count, 3), dtype=np.uint8)


CASES = [
    *((name, "anywhere", False) for name in POSES),
    *(("tilted", where, False) for where in ("seam", "zenith", "nadir")),
    ("tilted", "anywhere", True),
]


@pytest.mark.parametrize(("name", "where", "is_masked"), CASES)
def test_loss_equals_its_twin(name, where, is_masked):
    """Over the seam and the poles too; masked pixels are left out of sum and count."""
    points, colors = _points(where, 3 * POINTS_A_SUM + 17)
    image = _smooth_image()
    pose = POSES[name]
    is_valid = np.ones(image.shape[:2], dtype=bool)
    if is_masked:
        is_valid[90:] = False
        image[90:] = 0
    expected = naive.sampling_loss(points, colors, image, is_valid, pose.R_cam_from_world, pose.center_world)
    packed = pack_points(points, colors)
    texels = pack_texels(image, is_valid)
    assert sampling_loss(packed, texels, pose) == pytest.approx(expected, rel=1e-5)
    assert sampling_equations(packed, texels, pose)[0] == pytest.approx(expected, rel=1e-5)


def test_pose_that_hides_half_of_the_cloud_behind_the_mask_has_no_loss():
    points, colors = _points("zenith")
    is_valid = np.ones((WIDTH // 2, WIDTH), dtype=bool)
    is_valid[: WIDTH // 4] = False
    texels = pack_texels(_smooth_image(), is_valid)
    assert sampling_loss(pack_points(points, colors), texels, POSES["tilted"]) == math.inf
    assert sampling_equations(pack_points(points, colors), texels, POSES["tilted"])[0] == math.inf


def test_a_crop_has_a_loss_where_it_shows_a_quarter_of_the_points_that_a_full_panorama_must():
    """Half of the sphere valid: an eighth of the points must show."""
    points, colors = _points("anywhere")
    is_valid = np.ones((WIDTH // 2, WIDTH), dtype=bool)
    is_valid[:, : WIDTH // 2] = False
    texels = pack_texels(_smooth_image(), is_valid)
    assert texels.valid_share == pytest.approx(0.5)
    yaw = POSES["tilted"]
    losses = [sampling_loss(pack_points(points[:n], colors[:n]), texels, yaw) for n in (50, 500, len(points))]
    assert all(math.isfinite(loss) for loss in losses)


@pytest.mark.parametrize("where", ["anywhere", "seam", "zenith", "nadir"])
def test_gradient_against_central_differences(where):
    points, colors = _points(where)
    image = _smooth_image()
    pose = POSES["tilted"]
    is_valid = np.ones(image.shape[:2], dtype=bool)
    _, gradient, _ = sampling_equations(pack_points(points, colors), pack_texels(image), pose)

    def loss(delta):
        at = step(pose, delta)
        return naive.sampling_loss(points, colors, image, is_valid, at.R_cam_from_world, at.center_world)

    numbers = np.array([(loss(1e-6 * e) - loss(-1e-6 * e)) / 2e-6 for e in np.eye(6)])
    np.testing.assert_allclose(gradient, numbers, atol=0.02 * np.abs(numbers).max())


def test_normal_matrix_equals_jacobians_stacked():
    points, colors = _points("anywhere", 500)
    image = _smooth_image()
    pose = POSES["tilted"]
    _, _, matrix = sampling_equations(pack_points(points, colors), pack_texels(image), pose)

    def residuals(delta):
        at = step(pose, delta)
        pixels = naive.project(points, at.R_cam_from_world, at.center_world, WIDTH)
        return (naive.sample(image, pixels) - colors) / 255.0

    J = np.stack([(residuals(1e-6 * e) - residuals(-1e-6 * e)) / 2e-6 for e in np.eye(6)], axis=-1)
    weights = 1.0 / np.linalg.norm(residuals(np.zeros(6)), axis=1)
    expected = np.einsum("n,nci,ncj->ij", weights, J, J) / len(points)
    np.testing.assert_allclose(matrix, expected, rtol=2e-3, atol=2e-3 * np.abs(expected).max())


def test_turning_rolls_the_image_and_moving_world_and_camera_together_changes_nothing():
    points, colors = _points("anywhere")
    packed = pack_points(points, colors)
    image = _smooth_image()
    k = 37
    turned = Pose(yaw_rotation(2.0 * math.pi * k / WIDTH) @ POSES["tilted"].R_cam_from_world, CENTER)
    rolled = pack_texels(np.roll(image, k, axis=1))
    expected = sampling_loss(packed, pack_texels(image), POSES["tilted"])
    assert sampling_loss(packed, rolled, turned) == pytest.approx(expected, rel=1e-5)
    points, colors = _points("anywhere")
    texels = pack_texels(_smooth_image())
    pose = POSES["tilted"]
    turn = exp_so3(np.array([0.5, 0.2, -0.9]))
    shift = np.array([3.0, -2.0, 1.0])
    moved = Pose(pose.R_cam_from_world @ turn.T, turn @ pose.center_world + shift)
    expected = sampling_loss(pack_points(points, colors), texels, pose)
    moved_points = (points.astype(np.float64) @ turn.T + shift).astype(np.float32)
    found = sampling_loss(pack_points(moved_points, colors), texels, moved)
    assert found == pytest.approx(expected, rel=1e-4)


def test_point_at_the_camera_and_pose_out_of_range_are_harmless():
    points, colors = _points("anywhere")
    points[0] = CENTER.astype(np.float32)
    pose = Pose(np.eye(3), points[0].astype(np.float64))
    texels = pack_texels(_smooth_image())
    loss, gradient, matrix = sampling_equations(pack_points(points, colors), texels, pose)
    assert np.isfinite(loss)
    assert np.isfinite(gradient).all()
    assert np.isfinite(matrix).all()
    for center in ([1e9, 0, 0], [np.nan, 0, 0]):
        far = Pose(np.eye(3), np.array(center))
        assert sampling_loss(pack_points(points, colors), pack_texels(_smooth_image()), far) == math.inf
