"""What is seen from a map's candidates, and near a pose: made when it is asked for, and kept."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import rooms

from piccolo.geometry.cone import EVERYWHERE
from piccolo.geometry.pose import Pose, yaw_rotation
from piccolo.geometry.sphere import make_grid, whole_areas, wider_cells
from piccolo.photo.panorama.local_normalization import LEVELS_PER_UNIT
from piccolo.problem.profile import VIEWS
from piccolo.system.jobs.threads import Workers
from piccolo.views import points_around
from piccolo.views.candidate_views import SEARCH_VIEW, CandidateViews, render_views, render_wide
from piccolo.views.points_around import sample_visible_points
from piccolo.views.view import average_view

TIER = "scene"

ALL = np.ones(len(make_grid(24)), bool)


def _views():
    m = rooms.scan_map(1)
    return m, CandidateViews(m.octree, m.centers)


def test_views_are_views_in_few_bits():
    m, kept = _views()
    k = len(m.centers) // 2
    offsets, features, weights, _ = rooms.view(m.octree, m.centers[k], SEARCH_VIEW, ALL)
    (row,), views = kept.at(np.array([k]), Workers(1))
    np.testing.assert_array_equal(views.centers[row], m.centers[k])
    np.testing.assert_array_equal(views.is_seen[row], weights > 0)
    unit = views.offset_unit[row]
    np.testing.assert_allclose(views.offsets[row] * unit, offsets, atol=2 * unit)
    np.testing.assert_allclose(views.features[row] / LEVELS_PER_UNIT, features, atol=0.01)


def test_views_are_made_once_whatever_is_asked_for():
    m, kept = _views()
    rng = np.random.default_rng(0)
    for _ in range(20):
        candidates = rng.integers(len(m.centers), size=30)
        rows, views = kept.at(candidates, Workers(2))
        np.testing.assert_array_equal(views.centers[rows], m.centers[candidates])
    assert kept.num_made == len(np.unique(kept.made.centers[: kept.num_made], axis=0))
    rows, views = kept.at(np.arange(len(m.centers)), Workers(2))
    for found, expected in zip(
        views, render_views(m.octree, m.centers, SEARCH_VIEW, Workers(1)), strict=True
    ):
        np.testing.assert_array_equal(found[rows], expected)


def test_no_more_than_so_many_are_kept_and_those_given_out_stay():
    m, _ = _views()
    kept = CandidateViews(m.octree, m.centers, most_kept=40)
    rng = np.random.default_rng(0)
    given = []
    for count in (30, 30, 5, 60, 60, 10):
        candidates = rng.choice(len(m.centers), count, replace=False)
        given.append((candidates, *kept.at(candidates, Workers(1))))
        assert len(kept.made.centers) <= max(40, count)
    for candidates, rows, views in given:
        expected = render_views(m.octree, m.centers[candidates], SEARCH_VIEW, Workers(1))
        for found, wanted in zip(views, expected, strict=True):
            np.testing.assert_array_equal(found[rows], wanted)


def test_threads_may_ask_at_once():
    m, kept = _views()

    def ask(seed):
        candidates = np.random.default_rng(seed).permutation(len(m.centers))[:200]
        for part in np.split(candidates, 20):
            rows, views = kept.at(part, Workers(1))
            np.testing.assert_array_equal(views.centers[rows], m.centers[part])
        return candidates

    with ThreadPoolExecutor(4) as pool:
        asked = list(pool.map(ask, range(4)))
    assert kept.num_made == len(np.unique(asked))


def test_wide_views_are_averages_of_fine_ones():
    m, _ = _views()
    centers = m.centers[m.sparse]
    fine = render_views(m.octree, centers, SEARCH_VIEW, Workers(2))
    (cells, areas) = wider_cells(12)
    matrix = np.eye(len(areas))[cells] * whole_areas(24)[:, None]
    expected = fine.features.astype(np.float64) @ matrix / matrix.sum(axis=0)
    found = m.wide_features.reshape(expected.shape).astype(np.float64)
    correlation = (found * expected).sum() / np.sqrt((found**2).sum() * (expected**2).sum())
    assert correlation > 0.9
    seen = fine.is_seen @ matrix / matrix.sum(axis=0)
    assert np.abs(m.wide_seen / 255.0 - seen).mean() < 0.06
    assert m.wide_seen.max() == 255


@pytest.mark.parametrize("render", [render_views, render_wide])
@pytest.mark.parametrize("count", [0, 200])
def test_views_have_the_same_bits_for_any_number_of_threads(render, count):
    m, _ = _views()
    one, two = (render(m.octree, m.centers[:count], SEARCH_VIEW, Workers(n)) for n in (1, 2))
    for a, b in zip(one, two, strict=True):
        assert len(a) == count
        np.testing.assert_array_equal(a, b)


FINE = VIEWS["fine"]
FULL = VIEWS["points"]
FINE_CELLS = np.ones(len(make_grid(FINE.num_rings)), bool)


def _pose(*center):
    return Pose(yaw_rotation(0.3), np.array(center))


def _problem():
    return rooms.ask(rooms.scene(1)[1], rooms.scan_map(1))


def test_poses_near_one_place_share_what_is_drawn_and_no_others():
    octree = rooms.scan_map(1).octree
    views = points_around.RecentViews(octree)
    here, near, far = _pose(0.296, 0.2, 0.3), _pose(0.304, 0.197, 0.304), _pose(0.306, 0.2, 0.3)
    places = [points_around.round_position(pose) for pose in (here, near, far)]
    assert places[0] == places[1] != places[2]
    sums = [views.averages(place, FINE) for place in places]
    assert sums[0] is sums[1]
    assert views.averages.cache_info().misses == 2
    np.testing.assert_array_equal(sums[0], average_view(octree, places[0], FINE))
    for k in range(points_around.NUM_KEPT_VIEWS):
        views.averages((0.01 * k, 0.5, 0.3), FINE)
    assert views.averages(places[0], FINE) is not sums[0]  # only the last are kept


def test_views_and_points_count_from_their_place():
    problem = _problem()
    pose = _pose(0.307, 0.191, 0.304)
    place = points_around.round_position(pose)
    expected = rooms.view(problem.scan_map.octree, place, FINE, FINE_CELLS)
    points = sample_visible_points(
        problem.scan_map.octree, place, FULL, FINE_CELLS.tobytes(), EVERYWHERE, 30_000
    )
    for found, wanted in (
        (problem.view_at(pose, "fine"), expected),
        (problem.view_at(pose, "points"), points),
    ):
        for values, others in zip(found, wanted, strict=True):
            np.testing.assert_array_equal(values, others)
    assert problem.view_at(pose, "points") is problem.view_at(_pose(0.3135, 0.1875, 0.302), "points")
    moved = expected.around(pose.center_world)
    at, there = (cells.center_map[:, None] + cells.offsets for cells in (expected, moved))
    np.testing.assert_allclose(at, there, atol=1e-6)
    np.testing.assert_array_equal(moved.center_map, pose.center_world)


@pytest.mark.parametrize("shift", [0.0, 0.008])
def test_points_depend_on_what_the_photo_shows(shift):
    problem = _problem()
    pose = _pose(0.3 + shift, 0.2, 0.3)
    height, width = problem.photo.panorama.is_valid.shape
    half = problem.show(problem.photo.mask(np.arange(width)[None] < np.full((height, 1), width // 2)))
    assert half.views is problem.views
    some, every = (asked.view_at(pose, "points") for asked in (half, problem))
    assert 0.3 < len(some.weights) / len(every.weights) <= 1.01
    azimuth = np.arctan2(*(pose.R_cam_from_world @ some.offsets)[1::-1])
    assert (azimuth < 0.1).mean() > 0.98
