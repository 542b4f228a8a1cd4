import naive
import numpy as np
import pytest
import rooms

from piccolo.engine.candidates import (
    MIN_CLEARANCE,
    candidate_centers,
    coverage,
    heights_above_floor,
    supported_cells,
    top_surfaces,
)
from piccolo.engine.octree import build_octree
from piccolo.engine.scan_map import SEARCH_VIEW, prepare_map, render_candidates
from piccolo.engine.tiling import cell_of, make_tiling
from piccolo.engine.view import ViewKind, render_view, seen_points
from piccolo.synthetic.world import World
from piccolo.threads import Workers

KIND = ViewKind(num_rings=24, stats_rings=16, sigma_deg=22.0, voxel_per_range=1e-6)  # the leaves themselves


@pytest.fixture(scope="module")
def octree():
    cloud = rooms.room(1)[1]
    return build_octree(cloud.points, cloud.colors)


@pytest.fixture(scope="module")
def scan_map():
    return prepare_map(rooms.room(1)[1], Workers(2))


def test_view_of_the_leaves_equals_its_twin(octree):
    center = rooms.scene(1)[2].center_world
    offsets, features, weights = render_view(octree, center, KIND)
    leaves = octree.level(octree.leaf_size).astype(np.float64)
    twin = naive.cells_view(leaves, center, cell_of(leaves[:, :3] - center, 24), len(make_tiling(24)))
    seen = twin[2] > 0
    # float32 may put a voxel on the edge of a cell into the next one
    assert (seen == (weights > 0)).mean() > 0.995
    both = seen & (weights > 0)
    assert np.isclose(offsets[:, both], twin[0][both].T, atol=1e-3).all(axis=0).mean() > 0.97
    channels = naive.normalized_cells(twin[1], seen, 24, 16, 22.0)
    assert np.abs(features[:, both] - channels[both].T).mean() < 0.01


def test_coarser_voxels_far_away_change_a_view_little(octree):
    center = rooms.scene(1)[2].center_world
    exact, coarse = (render_view(octree, center, kind) for kind in (KIND, SEARCH_VIEW))
    both = (exact[2] > 0) & (coarse[2] > 0)
    product = (exact[1] * coarse[1])[:, both].sum()
    assert product / np.sqrt((exact[1][:, both] ** 2).sum() * (coarse[1][:, both] ** 2).sum()) > 0.8


def test_points_that_are_seen_lie_at_the_front_and_are_bounded(octree):
    center = rooms.scene(1)[2].center_world
    offsets, _, weights = seen_points(octree, center, KIND, 3000)
    assert 1000 < len(weights) <= 3000
    ranges = np.linalg.norm(offsets, axis=0)
    nearest = np.full(len(make_tiling(24)), np.inf)
    leaves = octree.level(octree.leaf_size)[:, :3] - center
    np.minimum.at(nearest, cell_of(leaves, 24), np.linalg.norm(leaves, axis=1))
    assert (ranges <= nearest[cell_of(offsets.T, 24)] * 1.09 + 0.11).mean() > 0.99


def test_candidates_are_free_inside_and_at_a_cameras_height(octree):
    world: World = rooms.room(1)[0]
    room, origin = world.rooms[0], rooms.room(1)[1].origin_world
    centers = candidate_centers(octree, Workers(2)) + origin
    assert len(centers) > 50
    inside = ((centers > room.corner) & (centers < room.corner + room.size)).all(axis=1)
    assert inside.all()
    clearance = np.array([room.clearance(c) for c in centers])
    assert (np.abs(clearance) > MIN_CLEARANCE - 0.1).mean() > 0.97
    heights = heights_above_floor(octree, centers - origin)
    assert heights.min() > 0.2
    assert heights.max() < 2.6


def test_top_surfaces_have_nothing_right_above(octree):
    surfaces = top_surfaces(octree)
    cells = supported_cells(surfaces)
    assert len(np.unique(cells, axis=0)) == len(cells)
    assert surfaces[:, 2].min() < -1.0  # the floor is among them


def test_coverage_is_all_inside_and_little_outside(octree):
    share = coverage(octree, np.array([[0.3, 0.2, 0.3], [30.0, 0.0, 0.0]]), Workers(1))
    assert share[0] > 0.9
    assert share[1] < 0.2


def test_candidates_views_are_views_in_few_bits(octree, scan_map):
    k = len(scan_map.centers) // 2
    offsets, features, weights = render_view(octree, scan_map.centers[k], SEARCH_VIEW)
    np.testing.assert_array_equal(scan_map.is_seen[k], weights > 0)
    np.testing.assert_allclose(
        scan_map.offsets[k] * scan_map.offset_unit[k], offsets, atol=2 * scan_map.offset_unit[k]
    )
    np.testing.assert_allclose(scan_map.features[k] / (127.5 / 2.0), features, atol=0.01)


def test_map_has_the_same_bits_for_any_number_of_threads(octree, scan_map):
    one, two = (render_candidates(octree, scan_map.centers[:200], Workers(n)) for n in (1, 2))
    for a, b in zip(one, two, strict=True):
        np.testing.assert_array_equal(a, b)
