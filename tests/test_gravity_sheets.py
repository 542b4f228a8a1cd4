"""What tells the upper from the lower side of sheets, and the holes that made-up scanners leave."""

import numpy as np
import pytest

from piccolo.geometry.pose import exp_so3
from piccolo.gravity.planes import PointNormals
from piccolo.gravity.sheet_features import sheet_features, sides_of
from piccolo.scenes.synthetic.buildings import BUILDINGS
from piccolo.scenes.synthetic.surfaces import SurfaceSampler, with_station_holes

TURN = exp_so3(np.array([0.9, -1.7, 0.4]))


def features(parts, levels, sense=1.0):
    """The features along z of surfaces: points (N, 3) and a normal (3,) each, all turned."""
    points = np.concatenate([points for points, _ in parts])
    normals = np.concatenate([np.tile(normal, (len(points), 1)) for points, normal in parts])
    cloud = PointNormals(points @ TURN.T, normals @ TURN.T, np.ones(len(points), np.bool_), 0.2)
    is_level = np.abs(normals[:, 2]) > 0.99
    levels = np.sort(sense * np.array(levels))
    return sheet_features(cloud, sides_of(cloud), sense * TURN[:, 2], is_level, levels)


def rectangle(corner, a, b, density=60.0):
    rng = np.random.default_rng(1)
    edges = np.array([a, b], float)
    area = np.linalg.norm(np.cross(*edges))
    normal = np.cross(*edges) / area
    return np.asarray(corner) + rng.uniform(0.0, 1.0, (int(density * area), 2)) @ edges, normal


def room(hole_level=None, radius=0.85):
    """Floor, ceiling and walls; with a round hole in one of the two."""
    parts = [rectangle([0, 0, 0], [6, 0, 0], [0, 5, 0]), rectangle([0, 0, 2.6], [6, 0, 0], [0, 5, 0])]
    parts += [rectangle([0, y, 0], [6, 0, 0], [0, 0, 2.6]) for y in (0, 5)]
    for k, level in enumerate((0.0, 2.6)):
        points, normal = parts[k]
        is_hole = np.linalg.norm(points[:, :2] - [3.0, 2.5], axis=1) < radius
        parts[k] = (points[~is_hole] if level == hole_level else points), normal
    return parts


@pytest.mark.parametrize(("hole_level", "sign"), [(0.0, 1.0), (2.6, -1.0), (None, 0.0)])
def test_a_round_hole_with_headroom_is_where_a_scanner_stood(hole_level, sign):
    ratio, flipped = (features(room(hole_level), [0.0, 2.6], sense).hole_log_ratio for sense in (1.0, -1.0))
    assert np.sign(ratio) == sign
    assert flipped == pytest.approx(-ratio)


def test_what_stands_in_a_hole_or_makes_it_small_is_no_tripod():
    pillar = [rectangle([2.8, 2.5, 0.0], [0.4, 0, 0], [0, 0, 2.6])]
    assert features([*room(0.0), *pillar], [0.0, 2.6]).hole_log_ratio == 0.0
    assert features(room(0.0, radius=0.4), [0.0, 2.6]).hole_log_ratio == 0.0


def test_a_table_is_a_top_and_a_beam_is_none():
    sides = [([2, 2, 0], [1, 0, 0]), ([2, 3, 0], [1, 0, 0]), ([2, 2, 0], [0, 1, 0]), ([3, 2, 0], [0, 1, 0])]
    box = [rectangle(corner, along, [0, 0, 0.8], 200.0) for corner, along in sides]
    table = [*box, rectangle([2, 2, 0.8], [1, 0, 0], [0, 1, 0], 200.0)]
    assert features([*room(), *table], [0.0, 2.6]).top_log_ratio > 0.2
    hanging = [(points * [1, 1, -1] + [0, 0, 2.6], normal) for points, normal in table]
    assert features([*room(), *hanging], [0.0, 2.6]).top_log_ratio < -0.2


def test_a_roof_has_the_cloud_below():
    slopes = [
        rectangle([0, 0, 2.6], [6, 0, 0], [0, 2.5, 2.0]),
        rectangle([0, 5, 2.6], [6, 0, 0], [0, -2.5, 2.0]),
    ]
    up, down = (features([*room(), *slopes], [0.0], sense).roof_log_ratio for sense in (1.0, -1.0))
    assert up > 1.0
    assert down == pytest.approx(-up)


def test_stairs_repeat_at_their_rise():
    treads = [rectangle([0.28 * k, 0, 0.17 * k], [0.28, 0, 0], [0, 1.2, 0], 400.0) for k in range(14)]
    assert features(treads, [0.0, 2.21]).steps > 0.3
    assert features(room(), [0.0, 2.6]).steps < 0.15


def test_a_scanner_position_leaves_a_hole_in_the_ground_only():
    s = SurfaceSampler(np.random.default_rng(2))
    s.shell(6.0, 5.0, 2.6)
    before = s.points()
    after = with_station_holes(before, np.random.default_rng(3))
    lost = before[~np.isin(before[:, 0], after[:, 0])]
    assert len(lost) > 200
    assert lost[:, 2].max() < 1.5
    reach = np.linalg.norm(lost[:, :2] - lost[:, :2].mean(axis=0), axis=1).max()
    assert 0.6 < reach < 1.2


def test_a_box_hides_the_floor_below_and_has_no_bottom():
    s = SurfaceSampler(np.random.default_rng(2))
    s.parallelogram([0, 0, 0], [4, 0, 0], [0, 4, 0])
    s.box([2.0, 2.0, 0.0], [1.0, 0.8, 0.7], yaw=0.5)
    points = s.points()
    is_near = np.linalg.norm(points[:, :2] - 2.0, axis=1) < 0.35
    np.testing.assert_allclose(points[is_near, 2], 0.7, atol=0.05)


@pytest.mark.parametrize("kind", BUILDINGS)
def test_a_place_of_each_kind_is_the_same_for_its_seed(kind):
    points = BUILDINGS[kind](1)
    assert points.shape[1] == 3
    assert len(points) > 10_000
    assert np.isfinite(points).all()
    np.testing.assert_array_equal(points, BUILDINGS[kind](1))
