import naive
import numpy as np
import pytest

from piccolo.geometry.points import pack_points
from piccolo.geometry.pose import Pose, exp_so3, yaw_rotation
from piccolo.views.zbuffer import nearest_depth, render_view, visible_points

TILTED = Pose(exp_so3(np.array([0.4, -1.1, 0.7])), np.array([0.2, -0.3, 0.1]))


def _random_points(count=20_000, seed=0):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3)) * [3, 2, 1]
    return points.astype(np.float32), rng.integers(0, 256, (count, 3), dtype=np.uint8)


def _two_walls():
    """A red wall at x = 2 and a blue one behind it at x = 4, points (N, 3), colours (N, 3)."""
    y, z = np.meshgrid(np.linspace(-1, 1, 201), np.linspace(-1, 1, 201))
    near = np.column_stack([np.full(y.size, 2.0), y.ravel(), z.ravel()])
    far = np.column_stack([np.full(y.size, 4.0), 2 * y.ravel(), 2 * z.ravel()])
    colors = np.repeat(np.array([[255, 0, 0], [0, 0, 255]], dtype=np.uint8), y.size, axis=0)
    return np.concatenate([near, far]).astype(np.float32), colors


def test_depth_equals_its_twin():
    points, colors = _random_points()
    depth = nearest_depth(pack_points(points, colors), TILTED, 64)
    expected = naive.nearest_depth(points, TILTED.R_cam_from_world, TILTED.center_world, 64)
    # float32 may put a point on the edge of a cell into the next one
    assert np.isclose(depth, expected, rtol=1e-5).mean() > 0.995


def test_range_noise_and_grazing_surfaces_hide_nothing():
    """Behind a point at 0.5 m or at 10 m, as far as a tenth of a metre and 8 % more, and beyond."""
    for distance, gap, is_seen in ((0.5, 0.13, 1), (0.5, 0.15, 0), (10.0, 0.89, 1), (10.0, 0.91, 0)):
        points = np.array([[distance, 0.01, 0.01], [distance + gap, 0.01, 0.01]], np.float32)
        visible = visible_points(pack_points(points, np.zeros((2, 3), np.uint8)), np.zeros(3))
        assert (len(visible) == 2) == is_seen


def test_view_shows_the_nearer_wall_in_its_colour():
    points, colors = _two_walls()
    view = render_view(pack_points(points, colors), Pose(np.eye(3), np.zeros(3)), 64)
    front = view.rgb[14:18, 30:34]
    np.testing.assert_allclose(front, np.broadcast_to([1.0, 0.0, 0.0], front.shape), atol=1e-6)
    assert not view.is_seen[:, :16].any()  # nothing is behind the camera
    assert (view.rgb[~view.is_seen] == 0).all()


def test_turning_the_camera_rolls_the_view():
    points, colors = _random_points()
    packed = pack_points(points, colors)
    straight = render_view(packed, Pose(np.eye(3), np.zeros(3)), 64)
    k = 9
    turned = render_view(packed, Pose(yaw_rotation(2 * np.pi * k / 64), np.zeros(3)), 64)
    rolled = np.roll(straight.depth, k, axis=1)
    assert np.isclose(turned.depth, rolled, rtol=1e-5).mean() > 0.99


@pytest.mark.parametrize("center", [(0, 0, 0), (1e6, 0, 0)])
def test_point_at_the_camera_and_far_camera_stay_in_the_image(center):
    points, colors = _random_points(1000)
    points[0] = 0
    depth = nearest_depth(pack_points(points, colors), Pose(np.eye(3), np.array(center, dtype=float)), 32)
    assert depth.shape == (16, 32)
    assert np.isfinite(depth).any()
