"""What tells the upper from the lower side of sheets, and what made-up scanners see of things."""

import numpy as np
import pytest

from piccolo.geometry.pose import exp_so3
from piccolo.gravity.planes import PointNormals
from piccolo.gravity.sheet_features import sheet_features, sides_of
from piccolo.gravity.up_features import WEIGHTS, up_features
from piccolo.scenes.synthetic.buildings import BUILDINGS
from piccolo.scenes.synthetic.surfaces import SurfaceSampler, with_station_holes

TURN = exp_so3(np.array([0.9, -1.7, 0.4]))


def cloud_of(parts):
    """Surfaces, points (N, 3) and a normal (3,) each, all turned."""
    points = np.concatenate([points for points, _ in parts])
    normals = np.concatenate([np.tile(normal, (len(points), 1)) for points, normal in parts])
    return PointNormals(points @ TURN.T, normals @ TURN.T, np.ones(len(points), np.bool_), 0.2)


def features(parts, levels, sense=1.0):
    """The features of their sheets along z."""
    cloud = cloud_of(parts)
    is_level = np.abs(cloud.normals @ TURN[:, 2]) > 0.99
    levels = np.sort(sense * np.array(levels))
    return sheet_features(cloud, sides_of(cloud), sense * TURN[:, 2], is_level, levels)


def whole_features(parts):
    """The features of surfaces along z and upside down."""
    cloud = cloud_of(parts)
    return [up_features(cloud, sides_of(cloud), sense * TURN[:, 2]) for sense in (1.0, -1.0)]


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


def test_a_hole_with_jambs_behind_it_is_a_window():
    floor = room(0.0)
    t = np.linspace(0.0, 2.0 * np.pi, 60)
    jamb = np.column_stack([3.0 + 0.85 * np.cos(t), 2.5 + 0.85 * np.sin(t), np.full(60, -0.2)])
    assert features([*floor, (jamb, np.array([1.0, 0.0, 0.0]))], [0.0, 2.6]).hole_log_ratio == 0.0


def test_furniture_has_many_heights_and_beams_have_one():
    tables = [rectangle([k, 2, 0.45 + 0.13 * k], [0.6, 0, 0], [0, 0.6, 0], 200.0) for k in range(5)]
    beams = [rectangle([k, 0, 2.03], [0.4, 0, 0], [0, 5, 0]) for k in range(5)]
    assert sum(len(points) for points, _ in tables) < 0.7 * sum(len(points) for points, _ in beams)
    up, down = whole_features([*room(), *tables, *beams])
    assert up.furniture_log_ratio > 0.3
    assert down.furniture_log_ratio == pytest.approx(-up.furniture_log_ratio, abs=0.3)
    above, below = whole_features([*room(), *beams])
    assert above.furniture_log_ratio < -0.5 < 0.5 < below.furniture_log_ratio


def test_what_stands_on_the_floor_is_clutter_and_what_hangs_is_none():
    crates = [rectangle([k, 2, 0.3], [0.5, 0, 0], [0, 0.3, 0.6], 200.0) for k in range(5)]
    up, down = whole_features([*room(), *crates])
    assert up.clutter_log_ratio > 1.0
    assert down.clutter_log_ratio == pytest.approx(-up.clutter_log_ratio)


def test_rooms_are_joined_by_doors_below_and_parted_by_walls_above():
    wall = [rectangle([3, 0, 0], [0, 2, 0], [0, 0, 2.6]), rectangle([3, 3, 0], [0, 2, 0], [0, 0, 2.6])]
    lintel = rectangle([3, 2, 2.1], [0, 1, 0], [0, 0, 0.5], 200.0)
    up, down = (features([*room(), *wall, lintel], [0.0, 2.6], s).passage_log_ratio for s in (1.0, -1.0))
    assert up == pytest.approx(np.log(2.0), abs=0.15)  # two rooms of the same size
    assert down == pytest.approx(-up, abs=1e-9)
    assert features([*room(), *wall], [0.0, 2.6]).passage_log_ratio == pytest.approx(0.0, abs=0.05)


def test_every_cue_has_weight():
    assert min(WEIGHTS) > 0.1


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


def test_of_boxes_tops_are_seen_below_the_eye_and_undersides_above_it():
    s = SurfaceSampler(np.random.default_rng(2), density=1000.0)
    for x, z in ((0.0, 0.7), (2.0, 2.3)):
        s.box([x, 0.0, z], [1.0, 0.8, 0.5])
    points = s.points()
    is_inner = (np.abs(points[:, 1]) < 0.3) & (np.abs((points[:, 0] + 0.5) % 2.0 - 0.5) < 0.4)
    heights = points[is_inner, 2]
    counts = [np.count_nonzero(np.abs(heights - z) < 0.02) for z in (0.7, 1.2, 2.3, 2.8)]
    assert counts[0] == counts[3] == 0
    assert 50 < counts[1] < counts[2] < 480  # of 480, nearer to the eye and farther from it


def test_a_drone_sees_tops_and_no_undersides():
    s = SurfaceSampler(np.random.default_rng(2), is_from_above=True)
    s.box([0.0, 0.0, 2.3], [1.0, 0.8, 0.5])
    assert np.count_nonzero(s.points()[:, 2] > 2.78) > 150
    assert np.count_nonzero(np.abs(s.points()[:, :2] @ [1.0, 0.0]) < 0.4) > 0
    inner = s.points()[np.all(np.abs(s.points()[:, :2]) < 0.3, axis=1), 2]
    assert inner.min() > 2.7


def test_openings_have_lintels_and_sills_behind_the_wall():
    s = SurfaceSampler(np.random.default_rng(2), density=1000.0)
    s.pierced_wall([0, 0, 0], [4, 0, 0], 2.6, np.array([0.0, 1.0, 0.0]), [(1.0, 2.0, 0.6, 2.2)])
    behind = s.points()[s.points()[:, 1] > 0.03]
    heights = behind[np.abs(behind[:, 0] - 1.5) < 0.4, 2]
    sill, lintel = (np.count_nonzero(np.abs(heights - z) < 0.02) for z in (0.6, 2.2))
    assert min(sill, lintel) > 20
    assert sill + lintel == len(heights)
    assert behind[:, 0].min() == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("kind", BUILDINGS)
def test_a_place_of_each_kind_is_the_same_for_its_seed(kind):
    points = BUILDINGS[kind](1)
    assert points.shape[1] == 3
    assert len(points) > 10_000
    assert np.isfinite(points).all()
    np.testing.assert_array_equal(points, BUILDINGS[kind](1))
