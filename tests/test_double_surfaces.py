"""Two layers of the same surfaces: their motion is found; what has one layer, and things, give none."""

import re
from dataclasses import replace

import numpy as np
import pytest
import rooms

from piccolo.cloud import layers
from piccolo.cloud.octree import build_octree
from piccolo.evidence import covariance
from piccolo.evidence.blocks import sort_by_block
from piccolo.evidence.examine import examine
from piccolo.evidence.scan_errors import gap_variance
from piccolo.geometry.pose import exp_so3
from piccolo.scan_map.scan_map import prepare_map
from piccolo.system.jobs.threads import Workers
from piccolo.views.view import Cells

TIER = "scene"

SIZE = np.array([6.0, 5.0, 2.6])  # [m] of a room turned by 20 degrees, so that no wall is along an axis
TURN = exp_so3(np.array([0.0, 0.0, 0.35]))
WORKERS = Workers(2)


def _room(count=300_000, seed=0, noise=0.002):
    rng = np.random.default_rng(seed)
    points = rng.random((count, 3)) * SIZE
    axis = rng.integers(0, 3, count)
    points[np.arange(count), axis] = rng.integers(0, 2, count) * SIZE[axis]
    return (points - SIZE / 2.0) @ TURN.T + rng.normal(0.0, noise, points.shape)


def _things(centers, normals, thickness, sides, seed=1):
    """Boards of 1 by 1 m, of which one face or both were scanned."""
    rng = np.random.default_rng(seed)
    found = []
    for center, normal in zip(centers, normals, strict=True):
        flat = rng.uniform(-0.5, 0.5, (4000, 3))
        flat[:, normal] = rng.choice(sides, len(flat)) * thickness
        found.append((flat + center - SIZE / 2.0) @ TURN.T)
    return np.concatenate(found)


def _moved(points, turn, move):
    """Points turned about their middle and moved."""
    middle = points.mean(axis=0)
    return (points - middle) @ exp_so3(np.array(turn)).T + middle + move


def _octree(points):
    """The octree of points; its zero is at theirs, as their middle is less than half a metre away."""
    voxels = rooms.voxels(points)
    assert not voxels.origin.any()
    return build_octree(voxels)


def _distance(motion, places):
    middle, turn, move = motion
    return np.linalg.norm(move + np.cross(turn, places - middle), axis=1)


@pytest.mark.parametrize("count", [300_000, 15_000])
@pytest.mark.parametrize(
    ("turn", "move"),
    [
        ((0.0, 0.0, 0.0035), (0.02, -0.01, 0.0)),
        ((0.0, 0.0, -0.009), (0.03, 0.04, 0.015)),
        ((0.0, 0.0, 0.017), (0.08, -0.06, 0.02)),
        ((0.0, 0.0, 0.0), (0.03, 0.045, 0.0)),
    ],
)
def test_the_motion_between_two_layers_is_found(count, turn, move):
    points = _room(count)
    middle = points.mean(axis=0)
    points[::2] = (points[::2] - middle) @ exp_so3(np.array(turn)).T + middle + move
    found = layers.find_layers(_octree(points), WORKERS)
    assert found.share > 0.85
    truth = _distance(np.stack([np.zeros(3), turn, move]), points - middle)
    np.testing.assert_allclose(_distance(found.motion, points), truth, atol=0.012)
    again = layers.find_layers(_octree(points), Workers())
    assert np.array_equal(again.motion, found.motion)


def test_layers_in_half_of_a_scan_are_found_there():
    points = _room()
    there = np.flatnonzero(points[:, 0] > np.median(points[:, 0]))[::2]
    points[there] = _moved(points[there], (0.0, 0.0, 0.01), (0.03, 0.04, 0.0))
    found = layers.find_layers(_octree(points), WORKERS)
    assert 0.3 < found.share < 0.8
    assert found.place[0] > np.median(points[:, 0])


@pytest.mark.parametrize("noise", [0.002, 0.01, 0.02, 0.04])
def test_a_single_surface_has_no_layers_whatever_its_noise(noise):
    assert layers.find_layers(_octree(_room(noise=noise)), WORKERS) is None


def test_boards_and_doors_are_no_layers():
    rng = np.random.default_rng(5)
    centers = rng.uniform(0.8, 1.8, (24, 3)) * np.array([2.5, 2.0, 0.8])
    normals = rng.integers(0, 2, 24)
    doors = _things(centers, normals, 0.02, (-1, 1))
    assert layers.find_layers(_octree(np.concatenate([_room(), doors])), WORKERS) is None
    on_walls = centers.copy()
    on_walls[np.arange(24), normals] = 0.0
    boards = _things(on_walls, normals, 0.03, (1,))
    assert layers.find_layers(_octree(np.concatenate([_room(), boards])), WORKERS) is None


def test_ground_without_walls_has_layers_where_it_is_tilted():
    points = _room()
    points = points[points[:, 2] < 0.05 - SIZE[2] / 2.0] + np.array([0.0, 0.0, SIZE[2] / 2.0])
    assert layers.find_layers(_octree(points), WORKERS) is None
    points[::2] = _moved(points[::2], (0.004, 0.0, 0.0), (0.0, 0.0, 0.035))
    found = layers.find_layers(_octree(points), WORKERS)
    assert found.distance == pytest.approx(0.035, abs=0.004)


def test_few_points_have_no_layers():
    assert layers.find_layers(_octree(_room(300)), WORKERS) is None


def test_a_position_between_two_layers_is_within_their_deviation():
    motion = np.array([[1.0, 2.0, 3.0], [0.0, 0.0, 0.01], [0.06, 0.0, 0.0]])
    assert gap_variance(motion, motion[0], 0.0) == pytest.approx(0.06**2 / 12.0)
    aside = motion[0] + np.array([0.0, 6.0, 1.0])  # where the layers meet
    assert gap_variance(motion, aside, 0.0) == pytest.approx(0.0)
    assert gap_variance(motion, aside, 3.0) == pytest.approx(0.03**2 / 12.0)


def test_the_map_warns_of_layers_once_and_says_where_they_are():
    points = _room()
    points[::2] = _moved(points[::2], (0.0, 0.0, 0.009), (0.03, 0.04, 0.0))
    told = []
    cloud = rooms.stream(
        rooms.CloudPoints(
            points.astype(np.float32), np.full(points.shape, 99, np.uint8), np.array([70.0, 7.0, 0.7])
        )
    )
    prepared = prepare_map(cloud, replace(WORKERS, warn=told.append))
    (text,) = [warning for warning in prepared.warnings if "layers" in warning]
    assert told.count(text) == 1
    wanted = (
        r"the scan has two layers of the same surfaces, about 6 cm and 0\.[56] deg apart, in \d+ % of the "
    )
    assert re.match(wanted, text)
    assert prepared.layers.any()


def test_layers_are_an_error_that_photos_have_in_common():
    query = rooms.query(1)
    prepared = rooms.scan_map(1)
    assert not prepared.layers.any()
    pose = prepared.from_world(query.pose)
    asked = rooms.ask(rooms.as_panorama(query.rgb), prepared, rooms.KNOWN)
    candidate = examine(asked, pose)
    single = covariance.estimate_covariance(asked, candidate, WORKERS)
    motion = np.stack([pose.center_world, [0.0, 0.0, 0.0], [0.06, 0.0, 0.0]])
    double = replace(asked, scan_map=replace(prepared, layers=motion))
    found = covariance.estimate_covariance(double, candidate, WORKERS)
    added = found.gaussian.common - single.gaussian.common
    np.testing.assert_allclose(added[3:, 3:], np.eye(3) * 0.06**2 / 12.0, atol=1e-12)
    assert np.array_equal(found.gaussian.own, single.gaussian.own)
    assert found.std_of_fit == single.std_of_fit
    split = covariance.split_errors(double, pose, found.gaussian.covariance)
    np.testing.assert_allclose(split.common, found.gaussian.common, rtol=0.05, atol=1e-9)


def test_planes_split_a_place_into_parts_of_a_quarter_and_more():
    points = Cells(rng_offsets(), rng_offsets(), np.ones(3000, np.float32), np.zeros(3))
    points, begins = sort_by_block(points)
    is_beyond = covariance.split_by_planes(points, begins)
    assert is_beyond.shape == (24, len(begins) - 1)
    shares = (is_beyond @ np.diff(begins) / 3000).reshape(3, 8)
    np.testing.assert_allclose(shares, np.repeat([[0.75], [0.5], [0.25]], 8, axis=1), atol=0.08)
    ahead = np.add.reduceat(points.offsets[0], begins[:-1]) / np.diff(begins)
    assert ahead[is_beyond[8]].min() > ahead[~is_beyond[8]].max()


def rng_offsets():
    return np.random.default_rng(8).normal(0.0, 2.0, (3, 3000)).astype(np.float32)


def test_a_scan_whose_end_was_moved_widens_the_covariance_in_all_directions(monkeypatch):
    """Between its parts the surfaces are single: what tells are blocks beyond a plane."""
    taken = rooms.query(1)
    cloud = rooms.room(1)[1]
    points = cloud.points.copy()
    points[points[:, 0] > np.quantile(points[:, 0], 0.6)] += np.float32([0.02, -0.05, 0.01])
    moved = rooms.CloudPoints(points, cloud.colors, cloud.origin_world)
    scan_map = prepare_map(rooms.stream(moved), WORKERS)
    assert not scan_map.layers.any()
    asked = rooms.as_panorama(taken.rgb)
    found = rooms.locate(asked, scan_map, rooms.KNOWN)
    monkeypatch.setattr(covariance, "SEAM_SCORE", np.inf)
    without = rooms.locate(asked, scan_map, rooms.KNOWN)
    added = found.covariance.matrix - without.covariance.matrix
    assert np.ptp(np.diag(added)[3:]) < 1e-9
    assert 0.002**2 < added[3, 3] < 0.03**2
    np.testing.assert_array_equal(found.pose.center_world, without.pose.center_world)
