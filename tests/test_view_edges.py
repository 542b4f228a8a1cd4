import math

import numpy as np
import pytest

from piccolo.geometry.sphere import make_grid
from piccolo.views.drawn_edges import replace_by_edges

RINGS = 48
DIRECTIONS = make_grid(RINGS).directions.astype(np.float64)
AZIMUTH = np.arctan2(DIRECTIONS[:, 1], DIRECTIONS[:, 0])
IS_LEVEL = np.abs(DIRECTIONS[:, 2]) < 0.5


def _draw(ranges):
    """Strength and vertical part (N,) of the edges of grey surfaces at ranges (N,) [m]."""
    sums = np.column_stack([DIRECTIONS * ranges[:, None], np.full((len(ranges), 3), 0.5), ranges > 0, ranges])
    sums = sums.astype(np.float32)
    replace_by_edges(sums, RINGS)
    r, g, b = sums[:, 3:6].T
    strength = (2.0 * g - r - b) / 1.2 + 0.5
    return np.where(ranges > 0, [strength, ((r - b) / 0.3 + strength) / 2.0], 0.0)


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
