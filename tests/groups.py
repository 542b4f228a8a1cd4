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
def one_taken(number):
    """One of the photos with its true pose."""
    turn = TURN[number]
    (taken,) = rooms.take_photos(SEED, 75.0, {turn: _offsets()[turn]}, 1024)
    return taken


def taken_photos():
    """Photos with their true poses."""
    return [one_taken(number) for number in range(len(TURN))]
