"""Views from a grid of places: what a pose that hardly moves need not draw again."""

import numpy as np
import pytest
import rooms

from piccolo.geometry.pose import Pose, yaw_rotation
from piccolo.geometry.sphere import make_grid
from piccolo.jobs.threads import Workers
from piccolo.localization.query import prepare_query
from piccolo.localization.settings import METHOD, CoarseToFineSettings
from piccolo.views import points_around
from piccolo.views.points_around import visible_points

FINE, FULL = METHOD.fine_view, METHOD.full_view
FINE_CELLS = np.ones(len(make_grid(FINE.num_rings)), bool)


def _pose(*center):
    return Pose(yaw_rotation(0.3), np.array(center))


def _query():
    return prepare_query(rooms.scene(1)[1], rooms.scan_map(1), CoarseToFineSettings(), Workers(1))


def test_poses_near_one_place_share_what_is_drawn_and_no_others(monkeypatch):
    query, drawn = _query(), []
    octree = query.scan_map.octree

    def average_view(octree, place, config):
        drawn.append((place, config))
        return original(octree, place, config)

    original = points_around.average_view
    monkeypatch.setattr(points_around, "average_view", average_view)
    views = points_around.RecentViews(octree)
    here, near, far = _pose(0.296, 0.2, 0.3), _pose(0.304, 0.197, 0.304), _pose(0.306, 0.2, 0.3)
    places = [points_around.place_of(pose) for pose in (here, near, far)]
    assert places[0] == places[1] != places[2]
    sums = [views.averages(place, FINE) for place in places]
    assert sums[0] is sums[1]
    assert len(drawn) == 2
    np.testing.assert_array_equal(sums[0], original(octree, places[0], FINE))
    for k in range(points_around.NUM_VIEWS):
        views.averages((0.01 * k, 0.5, 0.3), FINE)
    assert views.averages(places[0], FINE) is not sums[0]  # only the last are kept


def test_views_and_points_count_from_their_place():
    query, pose = _query(), _pose(0.307, 0.191, 0.304)
    place = points_around.place_of(pose)
    expected = rooms.view(query.scan_map.octree, place, FINE, FINE_CELLS)
    points = visible_points(query.scan_map.octree, place, FULL, FINE_CELLS.tobytes(), 30_000)
    for found, wanted in ((query.view_at(pose, FINE), expected), (query.points_at(pose), points)):
        for values, others in zip(found, wanted, strict=True):
            np.testing.assert_array_equal(values, others)
    assert query.points_at(pose) is query.points_at(_pose(0.3135, 0.1875, 0.302))
    moved = expected.around(pose.center_world)
    at, there = (cells.center_map[:, None] + cells.offsets for cells in (expected, moved))
    np.testing.assert_allclose(at, there, atol=1e-6)
    np.testing.assert_array_equal(moved.center_map, pose.center_world)


@pytest.mark.parametrize("shift", [0.0, 0.008])
def test_points_depend_on_what_the_photo_shows(shift):
    query, pose = _query(), _pose(0.3 + shift, 0.2, 0.3)
    height, width = query.photo.panorama.is_valid.shape
    half = query.without(np.arange(width)[None] < np.full((height, 1), width // 2))
    assert half.cache.views is query.cache.views
    assert 0.3 < len(half.points_at(pose).weights) / len(query.points_at(pose).weights) <= 1.01
    azimuth = np.arctan2(*(pose.R_cam_from_world @ half.points_at(pose).offsets)[1::-1])
    assert (azimuth < 0.1).mean() > 0.98
