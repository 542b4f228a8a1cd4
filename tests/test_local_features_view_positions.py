"""From where features are taken: as few positions as see what the others see."""

import naive
import numpy as np
import rooms

from piccolo.geometry.sphere import make_grid
from piccolo.local_features import view_positions as view_positions_module
from piccolo.local_features.view_positions import cell_table, view_positions

RINGS = 24
CELLS = len(make_grid(RINGS))


def _open(count, distance=50.0):
    return np.full((count, CELLS), distance, np.float32)


def test_positions_equal_their_twin():
    rng = np.random.default_rng(4)
    centers = rng.uniform([0, 0, 0], [9, 7, 3], (120, 3))
    ranges = rng.choice([0.0, 0.3, 1.0, 2.0], (120, CELLS)).astype(np.float32)
    found = view_positions(centers, ranges, RINGS)
    assert 5 < len(found) < 120
    assert found.tolist() == naive.view_positions(centers, ranges, RINGS)


def test_what_is_near_and_seen_needs_no_position():
    centers = np.array([[0.0, 0, 1], [2.0, 0, 1], [2.6, 0, 1], [0.0, 0, 3.3], [0.0, 0, 3.5]])
    assert view_positions(centers, _open(5), RINGS).tolist() == [0, 2, 4]
    behind_a_wall = _open(5)
    behind_a_wall[0, cell_table(RINGS)[24]] = 0.5  # level, all around
    assert view_positions(centers[:2], behind_a_wall[:2], RINGS).tolist() == [0, 1]
    thin = _open(5)
    thin[0, cell_table(RINGS)[24]] = 1.1  # what is hardly behind is seen
    assert view_positions(centers[:2], thin[:2], RINGS).tolist() == [0]
    assert len(view_positions(np.empty((0, 3)), _open(0), RINGS)) == 0


def test_known_positions_spare_others_and_are_not_named_again():
    rng = np.random.default_rng(4)
    centers = rng.uniform([0, 0, 0], [9, 7, 3], (120, 3))
    alone = view_positions(centers, _open(120), RINGS)
    known = np.concatenate([centers[alone[:4]], centers])
    more = view_positions(known, _open(124), RINGS, 4)
    assert more.min() >= 4
    assert (more - 4).tolist() == alone[4:].tolist()
    assert len(view_positions(np.concatenate([centers[alone], centers]), _open(200), RINGS, len(alone))) == 0


def test_positions_a_metre_above_the_lowest_come_first():
    centers = np.array([[1.0, 1, 0.3], [1.0, 1, 1.3], [1.0, 1, 2.3]])
    assert view_positions(centers, _open(3), RINGS).tolist() == [1]


def test_a_small_room_takes_few():
    m = rooms.scan_map(1)
    ranges = np.linalg.norm(m.offsets.astype(np.float32), axis=1) * m.offset_unit[:, None] * m.is_seen
    chosen = view_positions(m.centers, ranges, RINGS)
    assert 2 <= len(chosen) <= 16
    distance = np.linalg.norm(m.centers[:, None, :2] - m.centers[chosen][:, :2], axis=2).min(axis=1)
    assert distance.max() < 2.5


def test_positions_are_bounded(monkeypatch):
    centers = np.stack(np.meshgrid(np.arange(30) * 3.0, np.arange(30) * 3.0, [1.5]), axis=-1).reshape(-1, 3)
    ranges = _open(len(centers))
    assert len(view_positions(centers, ranges, RINGS)) == 900
    monkeypatch.setattr(view_positions_module, "MAX_VIEWS", 300)
    assert 50 < len(view_positions(centers, ranges, RINGS)) <= 300
