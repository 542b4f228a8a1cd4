import math
from dataclasses import replace

import numpy as np
import pytest
import rooms

from piccolo.cloud.octree import build_octree
from piccolo.geometry.sphere import make_grid
from piccolo.localization.settings import DRAWN_VIEW
from piccolo.views.edges import draw_edges
from piccolo.views.view import average_view

RINGS = 48
DIRECTIONS = make_grid(RINGS).directions.astype(np.float64)
AZIMUTH = np.arctan2(DIRECTIONS[:, 1], DIRECTIONS[:, 0])
IS_LEVEL = np.abs(DIRECTIONS[:, 2]) < 0.5


def _draw(ranges):
    """Strength and vertical part (N,) of the edges of grey surfaces at ranges (N,) [m]."""
    sums = np.column_stack([DIRECTIONS * ranges[:, None], np.full((len(ranges), 3), 0.5), ranges > 0, ranges])
    sums = sums.astype(np.float32)
    draw_edges(sums, RINGS)
    r, g, b = sums[:, 3:6].T
    strength = (2.0 * g - r - b) / 1.2 + 0.5
    return np.where(ranges > 0, [strength, ((r - b) / 0.3 + strength) / 2.0], 0.0)


def test_a_room_in_grey_keeps_its_grey_and_its_places():
    octree = build_octree(rooms.stream(rooms.room(1)[1]).voxels(np.eye(3)))
    center = rooms.scene(1)[2].center_world
    drawn, plain = (average_view(octree, center, replace(DRAWN_VIEW, draws_edges=on)) for on in (True, False))
    np.testing.assert_array_equal(drawn[:, [0, 1, 2, 6, 7]], plain[:, [0, 1, 2, 6, 7]])
    counts = np.maximum(plain[:, 6], 1.0)
    change = (drawn - plain)[:, 3:6].mean(axis=1) / counts
    assert np.abs(change).max() < 0.25  # where the painted grey leaves no room for edges
    assert np.abs(change).mean() < 0.01


def test_a_plane_has_no_edge():
    ahead = DIRECTIONS @ np.array([0.8, 0.6, 0.0])
    strength, _ = _draw(np.where(ahead > 0.3, 2.0 / np.maximum(ahead, 0.3), 0.0))
    assert strength[IS_LEVEL & (ahead > 0.5)].max() < 0.3


@pytest.mark.parametrize("depth", [0.5, 1.0, 5.0])
def test_an_outline_is_drawn_where_what_is_in_front_ends(depth):
    is_front = (np.abs(AZIMUTH) < 0.3) & IS_LEVEL
    strength, vertical = _draw(np.where(is_front, 3.0, 3.0 + depth))
    beside = math.pi / RINGS
    at_side = IS_LEVEL & (np.abs(DIRECTIONS[:, 2]) < 0.4)
    is_edge = at_side & (np.abs(np.abs(AZIMUTH) - 0.3) < 0.5 * beside)
    assert strength[is_edge].min() > 0.5
    assert vertical[is_edge & (np.abs(DIRECTIONS[:, 2]) < 0.3)].min() > 0.2
    assert strength[at_side & (np.abs(np.abs(AZIMUTH) - 0.3) > 3.0 * beside)].max() < 0.01


def test_nothing_is_drawn_beside_what_was_not_scanned():
    strength, _ = _draw(np.where(np.abs(AZIMUTH) < 0.3, 3.0, 0.0))
    assert strength.max() < 0.01
