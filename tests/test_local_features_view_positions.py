"""From where features are taken: as few positions as see what the others see."""

import naive
import numpy as np

from piccolo.geometry.sphere import make_grid
from piccolo.local_features import feature_map
from piccolo.local_features.feature_map import cell_table, view_positions

RINGS = 24
CELLS = len(make_grid(RINGS))


def _open(count, distance=50.0):
    return np.full((count, CELLS), distance, np.float32)


def _positions(centers, ranges, num_known=0):
    """Positions, of which each is looked from but once."""
    looked = []
    found = view_positions(centers, lambda k: looked.append(k) or ranges[k], RINGS, num_known)
    assert len(looked) == len(set(looked)) <= len(centers)
    return found


def test_positions_equal_their_twin():
    rng = np.random.default_rng(4)
    centers = rng.uniform([0, 0, 0], [9, 7, 3], (120, 3))
    ranges = rng.choice([0.0, 0.3, 1.0, 2.0], (120, CELLS)).astype(np.float32)
    found = _positions(centers, ranges)
    assert 5 < len(found) < 120
    assert found.tolist() == naive.view_positions(centers, ranges, RINGS)


def test_what_is_near_and_seen_needs_no_position():
    centers = np.array([[0.0, 0, 1], [2.0, 0, 1], [2.6, 0, 1], [0.0, 0, 3.3], [0.0, 0, 3.5]])
    assert _positions(centers, _open(5)).tolist() == [0, 2, 4]
    behind_a_wall = _open(5)
    behind_a_wall[0, cell_table(RINGS)[24]] = 0.5  # level, all around
    assert _positions(centers[:2], behind_a_wall[:2]).tolist() == [0, 1]
    thin = _open(5)
    thin[0, cell_table(RINGS)[24]] = 1.1  # what is hardly behind is seen
    assert _positions(centers[:2], thin[:2]).tolist() == [0]
    assert len(_positions(np.empty((0, 3)), _open(0))) == 0


def test_known_positions_spare_others_and_are_not_named_again():
    rng = np.random.default_rng(4)
    centers = rng.uniform([0, 0, 0], [9, 7, 3], (120, 3))
    alone = _positions(centers, _open(120))
    known = np.concatenate([centers[alone[:4]], centers])
    more = _positions(known, _open(124), 4)
    assert more.min() >= 4
    assert (more - 4).tolist() == alone[4:].tolist()
    assert len(_positions(np.concatenate([centers[alone], centers]), _open(200), len(alone))) == 0


def test_positions_are_bounded(monkeypatch):
    centers = np.stack(np.meshgrid(np.arange(30) * 3.0, np.arange(30) * 3.0, [1.5]), axis=-1).reshape(-1, 3)
    ranges = _open(len(centers))
    assert len(_positions(centers, ranges)) == 900
    monkeypatch.setattr(feature_map, "MAX_VIEWS", 300)
    assert 50 < len(_positions(centers, ranges)) <= 300
