import naive
import numpy as np
import pytest
import rooms
from scipy.spatial import cKDTree

from piccolo.cloud.octree import build_octree
from piccolo.geometry.colors import unpack_rgb
from piccolo.geometry.cone import EVERYWHERE
from piccolo.geometry.sphere import find_cell, make_grid
from piccolo.scan_map import camera_positions
from piccolo.system.jobs.threads import Workers
from piccolo.views import view
from piccolo.views.candidate_views import SEARCH_VIEW
from piccolo.views.points_around import points_around, sample_visible_points, take_children
from piccolo.views.view import ViewConfig

LEAVES = ViewConfig(
    num_rings=24, stats_rings=16, sigma_deg=22.0, voxel_per_range=1e-6
)  # the leaves themselves


ALL = np.ones(len(make_grid(24)), bool)


@pytest.fixture(scope="module")
def octree():
    return build_octree(rooms.stream(rooms.room(1)[1]).voxels(np.eye(3)))


def _cells(positions):
    return find_cell(positions / np.linalg.norm(positions, axis=1, keepdims=True), 24)


def test_view_of_the_leaves_equals_its_twin(octree):
    center = rooms.scene(1)[2].center_world
    offsets, features, weights, _ = rooms.view(octree, center, LEAVES, ALL)
    leaves = octree.level(octree.leaf_size).astype(np.float64)
    twin = naive.cells_view(leaves, center, _cells(leaves[:, :3] - center), len(make_grid(24)))
    seen = twin[2] > 0
    # float32 may put a voxel on the edge of a cell into the next one
    assert (seen == (weights > 0)).mean() > 0.995
    both = seen & (weights > 0)
    assert np.isclose(offsets[:, both], twin[0][both].T, atol=1e-3).all(axis=0).mean() > 0.97
    channels = naive.normalized_cells(twin[1], seen, 24, 16, 22.0)
    assert np.abs(features[:, both] - channels[both].T).mean() < 0.01


def test_cells_that_are_not_shown_change_nothing_elsewhere(octree):
    """They have no weight, and the local means and deviations are those of what is shown."""
    center = rooms.scene(1)[2].center_world
    shown = make_grid(24).directions[:, 0] > 0.0
    whole, part = (rooms.view(octree, center, LEAVES, some) for some in (ALL, shown))
    assert (part.weights[~shown] == 0).all()
    np.testing.assert_array_equal(part.weights[shown], whole.weights[shown])
    leaves = octree.level(octree.leaf_size).astype(np.float64)
    twin = naive.cells_view(leaves, center, _cells(leaves[:, :3] - center), len(make_grid(24)))
    channels = naive.normalized_cells(twin[1], (twin[2] > 0) & shown, 24, 16, 22.0)
    both = part.weights > 0
    assert np.abs(part.channels[:, both] - channels[both].T).mean() < 0.01
    points = sample_visible_points(octree, center, LEAVES, shown.tobytes(), EVERYWHERE, 3000)
    assert shown[_cells(points.offsets.T)].mean() > 0.99


def test_points_that_are_seen_lie_at_the_front_and_are_bounded(octree):
    center = rooms.scene(1)[2].center_world
    offsets, _, weights, _ = sample_visible_points(octree, center, LEAVES, ALL.tobytes(), EVERYWHERE, 3000)
    assert 1000 < len(weights) <= 3000
    ranges = np.linalg.norm(offsets, axis=0)
    nearest = np.full(len(make_grid(24)), np.inf)
    leaves = octree.level(octree.leaf_size)[:, :3] - center
    np.minimum.at(nearest, _cells(leaves), np.linalg.norm(leaves, axis=1))
    assert (ranges <= nearest[_cells(offsets.T)] * 1.09 + 0.11).mean() > 0.99


def test_candidates_are_near_every_free_place_and_keep_their_distance(octree):
    room = rooms.room(1)[0].rooms[0]
    origin = rooms.room(1)[1].origin_world
    centers = camera_positions.candidate_centers(octree, Workers(2)) + origin
    rng = np.random.default_rng(0)
    places = room.corner + rng.uniform([0.4, 0.4, 0.8], [*(room.size[:2] - 0.4), 2.0], (300, 3))
    places = [p for p in places if room.clearance(p) > 0.4]
    assert len(places) > 50
    gaps = np.array([np.linalg.norm(centers - p, axis=1).min() for p in places])
    assert gaps.max() < 0.7
    heights = camera_positions.heights_above_floor(octree, centers - origin)
    assert heights.min() > 0.2
    assert np.median(heights) < 2.0
    tree = cKDTree(octree.level(octree.leaf_size)[:, :3])
    clearance, _ = tree.query(camera_positions.candidate_centers(octree, Workers(2)))
    assert clearance.min() > 0.25 - 0.08  # the width of the voxels that are asked


def test_more_must_be_seen_around_a_candidate_than_on_open_land():
    """Flat ground fills about half of the sphere: enough only where no place is closed in."""
    x, y = np.arange(-6.0, 6.0, 0.05), np.arange(0.0, 3.0, 0.05)
    ground = np.stack([*np.meshgrid(x, x), np.zeros((len(x), len(x)))], axis=-1).reshape(-1, 3)
    walls = [
        np.column_stack([np.repeat(x, len(y)), np.full(len(x) * len(y), s), np.tile(y, len(x))])
        for s in (-6, 6)
    ]
    hall = np.concatenate([ground, ground + np.array([0, 0, 3]), *walls, *(w[:, [1, 0, 2]] for w in walls)])
    for points, least, most in ((ground, 0.3, 0.55), (hall, 0.55, 1.01)):
        octree = build_octree(rooms.voxels(points))
        centers = camera_positions.candidate_centers(octree, Workers(2))
        fractions = camera_positions.coverage(octree, centers, Workers(2))
        assert len(fractions) > 50
        assert least < fractions.min() < most


def test_every_other_centre_is_seen_by_the_kernel_that_sees_all(octree):
    """A kernel of its own would be compiled while the time of a sample is taken."""
    centers = rooms.scene(1)[2].center_world + np.linspace(0.0, 0.3, 15).reshape(5, 3)
    ranges = view.ranges_around(octree, centers, SEARCH_VIEW)
    compiled = list(view.nearest_node_ranges.signatures)
    np.testing.assert_array_equal(view.ranges_around(octree, centers[::2], SEARCH_VIEW), ranges[::2])
    assert view.nearest_node_ranges.signatures == compiled


def test_points_around_are_all_near_ones_and_fewer_far_ones(octree):
    """The leaves where these are as large as asked, and means of theirs that grow with the distance."""
    center = rooms.scene(1)[2].center_world
    leaves = octree.level(octree.leaf_size)
    found = points_around(octree, center, 1e-9)
    order = np.lexsort((found.z, found.y, found.x))
    expected = leaves[np.lexsort(leaves.T[2::-1])]
    np.testing.assert_array_equal(np.stack([found.x, found.y, found.z], axis=1)[order], expected[:, :3])
    colors = unpack_rgb(found.rgbx)[order]
    np.testing.assert_allclose(colors / 255.0, expected[:, 3:], atol=0.51 / 255.0)
    coarse = points_around(octree, center, 1 / 20)
    assert len(coarse) < 0.5 * len(leaves)
    gap, _ = cKDTree(leaves[:, :3]).query(np.stack([coarse.x, coarse.y, coarse.z], axis=1))
    ranges = np.linalg.norm(np.stack([coarse.x, coarse.y, coarse.z], axis=1) - center, axis=1)
    assert (gap < np.maximum(ranges / 20, 2.0 * octree.leaf_size)).all()


@pytest.mark.parametrize(("one", "other"), [(0.2499, 0.2501), (0.1249, 0.1251), (0.1, 0.101), (0.9, 0.91)])
def test_a_little_more_room_for_points_changes_few_of_them(octree, one, other):
    nodes = np.arange(octree.level_start[-3], octree.level_start[-2], dtype=np.int32)
    taken = []
    for kept in (one, other):
        found = np.empty(len(octree.nodes), np.int32)
        taken.append(set(found[: take_children(octree, nodes, np.float32(kept), found)].tolist()))
    num_children = octree.level_start[-1] - octree.level_start[-2]
    assert len(taken[0]) == pytest.approx(one * num_children, rel=0.1)
    assert len(taken[0] & taken[1]) > 0.93 * len(taken[1])
