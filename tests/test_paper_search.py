"""The paper's starts: positions in free space, rotations, histograms, losses."""

import numpy as np
import pytest
import rooms

from piccolo.cloud.soa import pack_points
from piccolo.geometry.pose import Pose
from piccolo.geometry.rotations import uniform_rotations
from piccolo.panorama.model import shrink
from piccolo.paper.search import MIN_CLEARANCE, PROBE_WIDTH, color_histogram, free_grid, histogram_similarity
from piccolo.views.zbuffer import is_free_space

AT = np.array([1.0, 2.0, 1.5])


def _hollow_box(seed=0, count=40_000):
    """Points on the walls of a 6 x 4 x 3 m box around (10, 20, 1.5), and of a pillar in it."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.5, 0.5, (count, 3))
    axis = rng.integers(0, 3, count)
    points[np.arange(count), axis] = rng.choice([-0.5, 0.5], count)
    walls = points * [6, 4, 3]
    pillar = points[: count // 4] * [1, 1, 3]
    return pack_points(
        (np.concatenate([walls, pillar]) + np.array([10, 20, 1.5])).astype(np.float32),
        np.full((count + count // 4, 3), 128, dtype=np.uint8),
    )


def _is_free(points, center):
    return is_free_space(points, center, PROBE_WIDTH, MIN_CLEARANCE)


def test_free_is_inside_and_clear_of_surfaces():
    points = _hollow_box()
    assert _is_free(points, np.array([8.5, 20.0, 1.5]))
    assert not _is_free(points, np.array([8.5, 21.9, 1.5]))  # 0.1 m from a wall
    assert not _is_free(points, np.array([20.0, 20.0, 1.5]))  # outside
    rng = np.random.default_rng(0)
    solid = pack_points(rng.uniform(0, 1, (20_000, 3)).astype(np.float32), np.zeros((20_000, 3), np.uint8))
    assert len(free_grid(solid, 5, 0.0)) == 0


@pytest.mark.parametrize("num_translations", [1, 5, 50])
def test_free_grid_gives_the_number_asked_for_all_free(num_translations):
    points = _hollow_box()
    grid = free_grid(points, num_translations, margin=0.0)
    assert len(grid) == num_translations
    assert all(_is_free(points, position) for position in grid)
    assert len(np.unique(grid, axis=0)) == num_translations


@pytest.mark.parametrize("count", [32, 500])
def test_rotations_cover_so3_evenly(count):
    rotations = uniform_rotations(count)
    products = rotations @ rotations.transpose(0, 2, 1)
    np.testing.assert_allclose(products, np.tile(np.eye(3), (count, 1, 1)), atol=1e-12)
    traces = np.einsum("aij,bij->ab", rotations, rotations)
    np.fill_diagonal(traces, -1.0)
    nearest = np.arccos(np.clip((traces.max(axis=1) - 1.0) / 2.0, -1.0, 1.0))
    # the volume of SO(3) shared evenly gives each rotation a ball of this radius
    ideal = 2.0 * (6.0 * np.pi / (8.0 * count)) ** (1.0 / 3.0)
    assert nearest.min() > 0.5 * ideal
    assert nearest.max() < 2.0 * ideal


def test_histogram_counts_solid_angle():
    rgb = np.zeros((64, 128, 3), dtype=np.float32)
    rgb[:16] = 1.0  # a quarter of the rows, about the zenith: (1 - cos 45 deg) / 2 of the sphere
    histogram = color_histogram(rgb, np.ones((64, 128), dtype=bool), 4)
    assert histogram.sum() == pytest.approx(1.0)
    assert histogram[-1] == pytest.approx((1 - np.cos(np.pi / 4)) / 2, rel=1e-6)
    histogram = color_histogram(np.ones((16, 32, 3), np.float32), np.zeros((16, 32), bool), 8)
    assert histogram.sum() == 0.0


def test_histograms_agree_best_at_the_true_place():
    points, panorama, true_pose = rooms.scene(1)
    small = shrink(panorama, 128)
    elsewhere = Pose(true_pose.R_cam_from_world, -true_pose.center_world)
    here, there = (histogram_similarity(points, small, pose, 8) for pose in (true_pose, elsewhere))
    assert here > max(0.75, there)
