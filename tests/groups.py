"""Photos of one place that overlap, each with its true pose."""

import functools

import numpy as np
import rooms

SEED = 5
TURN = (6.75, 7.0, 7.25)  # eighths, of photos of 75 degrees that overlap: none is sure alone


def _offsets():
    """Where the photos were taken [m] from a place of the room, by how far they are turned."""
    return {k: np.random.default_rng(int(10 * k)).uniform(-0.2, 0.2, 3) for k in TURN}


def true_places():
    """Poses of the photos."""
    return rooms.turned_poses(SEED, _offsets())


@functools.lru_cache
def taken_photos():
    """Photos with their true poses."""
    return rooms.take_photos(SEED, 75.0, _offsets(), 1024)
