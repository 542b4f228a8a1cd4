"""Profiles across patches of surfaces, against NumPy."""

import naive
import numpy as np
import pytest
import rooms

from piccolo.cloud import profiles
from piccolo.cloud.layers import choose_leaves
from piccolo.cloud.octree import build_octree
from piccolo.geometry.pose import exp_so3
from piccolo.system.jobs.threads import Workers


def _corner(count, seed):
    """Points of three walls of 1.2 m, turned so that none is along an axis."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(0.0, 1.2, (count, 3))
    points[np.arange(count), rng.integers(0, 3, count)] = 0.0
    return points @ exp_so3(np.array([0.2, 0.3, 0.35])).T + rng.normal(0.0, 0.001, points.shape)


def test_profiles_are_those_of_numpy():
    octree = build_octree(rooms.voxels(np.concatenate([_corner(20_000, 0), _corner(20_000, 1) + 0.03])))
    leaves = octree.nodes[octree.level_start[-2] :, :3]
    chosen = choose_leaves(octree)[::60]
    found = profiles.measure_profiles(octree, chosen, 0.2, Workers(2))
    starts = octree.nodes[chosen, :3].astype(float)
    assert len(found.places) > 8
    for place, normal, counts in zip(found.places, found.normals, found.counts, strict=True):
        start = starts[np.linalg.norm(starts - place, axis=1).argmin()]
        own, own_place, totals = naive.profile(leaves, start, 0.2)
        sign = int(np.sign(own @ normal))
        assert sign * own @ normal == pytest.approx(1.0, abs=1e-6)
        np.testing.assert_allclose(place, own_place, atol=1e-6)
        assert np.abs(counts.sum(axis=0) - totals[::sign]).sum() <= 4  # on the edges of bins


def test_what_has_no_plane_is_left_out():
    points = np.random.default_rng(3).uniform(0.0, 3.0, (60, 3))
    octree = build_octree(rooms.voxels(points))
    found = profiles.measure_profiles(octree, choose_leaves(octree), 0.2, Workers())
    assert found.places.shape == (0, 3)
    assert found.counts.shape == (0, 4, 2 * profiles.NUM_PROFILE_BINS + 1)
