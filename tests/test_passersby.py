"""People in photos that colour a scan: who is outvoted, where blame spreads, and what remains of them."""

import functools
from dataclasses import replace

import cv2
import naive
import numpy as np
import pytest
import rooms
from batches import COARSE

from piccolo.cloud.octree import build_octree
from piccolo.photo.panorama import Panorama
from piccolo.system.jobs.threads import Workers
from piccolo.together.coloring import alignment, passersby
from piccolo.together.coloring.alignment import Sightings
from piccolo.together.coloring.painting import make_brushes, paint_points
from piccolo.together.coloring.passersby import (
    Votes,
    cast_votes,
    find_blame,
    remove_passersby,
    spread_votes,
    without,
)

SEED = 1
NUM_POINTS = 60_000
WIDTH = 512
CLOTHES = np.array([[230, 10, 10], [10, 230, 10], [10, 10, 230]])


def test_votes_spread_as_in_numpy():
    rng = np.random.default_rng(0)
    votes = rng.integers(0, 3, (20, 40, 2)).astype(np.float32)
    votes[rng.random((20, 40)) < 0.5] = 0.0
    guide = rng.uniform(0, 255, (20, 40, 3)).astype(np.float32)
    guide[:, 30:] = 100.0
    found = np.empty_like(votes)
    spread_votes(votes, guide, found)
    wanted = naive.spread_votes(
        votes, guide, passersby.VOTE_REACH, float(passersby.VOTE_DEVIATION), float(passersby.ALIKE)
    )
    assert np.allclose(found, wanted, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("grays", "agreed", "outvoted", "num_pairs"),
    [
        ([100, 110], [1, 1], [0, 0], 0),
        ([100, 180], [0, 0], [0, 0], 1),
        ([100, 140], [1, 1], [0, 0], 0),  # the most that two differ if they agree, and three
        ([100, 141], [0, 0], [0, 0], 1),
        ([100, 100, 140], [1, 1, 1], [0, 0, 0], 0),
        ([100, 100, 141], [1, 1, 0], [0, 0, 1], 0),
        ([100, 110, 200], [1, 1, 0], [0, 0, 1], 0),
        ([100, 110, None, 200], [1, 1, 0, 0], [0, 0, 0, 1], 0),
        ([100, None, 200], [0, 0, 0], [0, 0, 0], 1),
        ([100, None], [0, 0], [0, 0], 0),
        ([100, 105, 200, 205], [0, 0, 0, 0], [0, 0, 0, 0], 0),
        ([100, 105, 110, 200, 250, 108], [1, 1, 1, 0, 0, 1], [0, 0, 0, 1, 1, 0], 0),
    ],
)
def test_most_decide_and_of_two_nobody(grays, agreed, outvoted, num_pairs):
    """A second point, which is seen alike, changes nothing."""
    count = len(grays)
    point = np.repeat([0, 1], [count, 2])
    photo = np.r_[np.arange(count), 0, 1]
    sightings = Sightings(np.array([0, count, count + 2]), point, photo, [])
    values = np.array([*(np.nan if gray is None else gray for gray in grays), 50, 50], np.float32)
    votes = cast_votes(sightings, np.stack([values, values, values + 5], axis=1))
    assert votes.is_agreed.tolist() == [*map(bool, agreed), True, True]
    assert votes.is_outvoted.tolist() == [*map(bool, outvoted), False, False]
    assert len(votes.pairs) == num_pairs
    assert all(np.isfinite(values[pair]).all() for pair in votes.pairs)


@pytest.mark.parametrize(
    ("num_agreed", "num_outvoted", "blame"), [(0, 1, 0.5), (1, 2, 0.5), (0, 3, 0.75), (9, 0, 0.0)]
)
def test_a_cell_begins_with_one_vote_for_it(num_agreed, num_outvoted, blame):
    is_agreed = np.arange(num_agreed + num_outvoted) < num_agreed
    votes = Votes(is_agreed, ~is_agreed, np.empty((0, 2), np.int64))
    cell = 60 * passersby.VOTE_WIDTH + 100
    gray = np.full((256, 512, 3), 90, np.uint8)
    found = find_blame(votes, np.full(len(is_agreed), cell), [gray], Workers(1))
    assert found.ravel()[cell] == pytest.approx(blame, abs=1e-6)


def test_what_is_blamed_at_the_seam_goes_on_across_it():
    is_blamed = np.zeros((128, 256), bool)
    is_blamed[60, 0] = True
    panorama = Panorama(np.zeros((256, 512, 3), np.uint8), np.ones((256, 512), bool))
    left = ~without(panorama, is_blamed).is_valid
    assert np.flatnonzero(left.any(axis=0)).tolist() == [0, 1, 2, 3, 510, 511]
    assert np.flatnonzero(left.any(axis=1)).tolist() == [*range(118, 124)]


@functools.lru_cache
def _octree():
    return build_octree(rooms.stream(rooms.room(SEED, NUM_POINTS)[1]).voxels(np.eye(3)))


def _photos(places):
    """Photos of a made room with people at some columns, in clothes of each photo, and poses in the map."""
    taken = [rooms.query(SEED, index=k, width=WIDTH) for k in range(len(places))]
    photos = []
    for one, columns, color in zip(taken, places, CLOTHES.tolist(), strict=True):
        rgb = one.rgb.copy()
        for column in columns:
            cv2.ellipse(rgb, (column, 140), (16, 50), 0, 0, 360, color, -1)
        photos.append(Panorama(rgb, np.ones(rgb.shape[:2], bool)))
    return photos, [rooms.local(SEED, one.pose, NUM_POINTS) for one in taken]


def test_of_people_hardly_anything_remains(monkeypatch):
    """In three photos, of which many points of the room are seen by one or two alone."""
    monkeypatch.setattr(alignment, "POINTS_PER_PHOTO", 0)
    for name, value in COARSE["passersby"].items():
        monkeypatch.setattr(passersby, name, value)
    photos, poses = _photos([(100, 300), (220,), (330, 20)])
    octree = _octree()
    gains = np.ones((3, 3), np.float32)
    workers = Workers(2)
    points = np.ascontiguousarray(octree.level(octree.leaf_size)[:, :3])
    num_dressed = []
    num_colored = []
    for shown in (photos, remove_passersby(octree, photos, poses, gains, workers)):
        paint = paint_points(points, make_brushes(octree, shown, poses, gains, workers), workers)
        off = np.abs(paint.colors.astype(int)[:, None] - CLOTHES).max(axis=2).min(axis=1)
        num_dressed.append(int((off < 30).sum()))
        num_colored.append(int((paint.num_photos > 0).sum()))
    assert num_dressed[0] > 0.01 * num_colored[0]
    assert num_dressed[1] < 0.05 * num_dressed[0]
    assert num_colored[1] > 0.9 * num_colored[0]


def test_photos_that_agree_and_one_in_another_light_stay_whole():
    photos, poses = _photos([(), (), ()])

    def shares(shown):
        left = remove_passersby(_octree(), shown, poses, np.ones((3, 3), np.float32), Workers(2))
        return [panorama.is_valid.mean() for panorama in left]

    assert min(shares(photos)) > 0.98
    *others, dark = shares([*photos[:2], replace(photos[2], rgb=photos[2].rgb // 4)])
    assert (min(others) > 0.9, dark) == (True, 1.0)


def test_a_part_that_most_contradict_is_removed_but_no_more_than_half_of_a_photo(monkeypatch):
    photos, poses = _photos([(), (), ()])

    def blame_some(votes, cells, pictures, workers):
        """Just over half of the votes in two and in three fifths of what is seen; half of them in all."""
        blame = np.zeros((3, passersby.VOTE_WIDTH // 2, passersby.VOTE_WIDTH), np.float32)
        voted = np.bincount(cells, minlength=blame.size).reshape(3, -1) > 0
        for k, (share, value) in enumerate(((0.4, 0.51), (0.6, 0.51), (1.0, 0.5))):
            seen = np.flatnonzero(voted[k])
            blame[k].ravel()[seen[: int(share * len(seen))]] = value
        return blame

    monkeypatch.setattr(passersby, "find_blame", blame_some)
    left = remove_passersby(_octree(), photos, poses, np.ones((3, 3), np.float32), Workers(2))
    is_whole = [panorama.is_valid.all() for panorama in left]
    assert is_whole == [False, True, True]
