import math
from pathlib import Path

import naive
import numpy as np
from clouds import seeded_cloud
from hypothesis import given, settings, strategies as st

from piccolo.cloud.readers.reader import PointSource, RawCloud
from piccolo.cloud.stream import CloudPoints, CloudStream
from piccolo.cloud.voxels import morton_codes, morton_order

A = Path("a")


def clean(path, raw, scale):
    """The cloud of points in memory as if they had been read from a file."""
    return CloudStream([PointSource(path, lambda: iter([raw]), units=(scale,) * 3)]).read()


def same_bits(a: CloudPoints, b: CloudPoints):
    return (
        a.points.tobytes() == b.points.tobytes()
        and a.colors.tobytes() == b.colors.tobytes()
        and a.origin_world.tobytes() == b.origin_world.tobytes()
        and a.warnings == b.warnings
    )


def test_morton_codes_equal_twin():
    rng = np.random.default_rng(1)
    cells = rng.integers(0, 1 << 21, (300, 3))
    cells[0] = 0
    cells[1] = (1 << 21) - 1
    codes = morton_codes(cells)
    np.testing.assert_array_equal(codes, naive.interleave(cells))
    assert codes[1] == (1 << 63) - 1


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), step=st.sampled_from([0.0, 0.01, 0.5, 3.0]))
def test_shuffling_points_changes_no_bit(seed, step, tmp_path_factory):
    raw = seeded_cloud(seed, step=step)
    raw.points_world[::7] = np.nan
    shuffle = np.random.default_rng(seed + 1).permutation(len(raw.colors))
    shuffled = RawCloud(raw.points_world[shuffle], raw.colors[shuffle])
    path = tmp_path_factory.getbasetemp()
    a, b = clean(path, raw, 1.0), clean(path, shuffled, 1.0)
    assert same_bits(a, b)


def test_signed_zeros_do_not_tell_points_apart():
    raw = seeded_cloud(4, step=1.0)
    flipped = RawCloud(np.where(raw.points_world == 0.0, -raw.points_world, raw.points_world), raw.colors)
    assert same_bits(clean(A, raw, 1.0), clean(A, flipped, 1.0))


def test_order_keeps_neighbours_together_and_sorts_colors_in_one_place():
    raw = seeded_cloud(5, num_points=20_000)
    points = raw.points_world.astype(np.float32)
    steps = np.linalg.norm(np.diff(points[morton_order(points, raw.colors)], axis=0), axis=1)
    spacing = (6.0 * 5.0 * 2.5 / 20_000) ** (1 / 3)
    assert np.median(steps) < 1.5 * spacing
    points = np.ones((1200, 3), dtype=np.float32)
    colors = seeded_cloud(6, num_points=1200).colors
    ordered = colors[morton_order(points, colors)]
    assert ordered.tolist() == sorted(colors.tolist())


def test_utm_coordinates_keep_their_millimetres_around_the_middle_of_the_box():
    raw = seeded_cloud(7)
    origin = np.array([637_012.25, 5_849_028.75, 431.5])
    far = clean(A, RawCloud(raw.points_world + origin, raw.colors), 1.0)
    assert np.abs(far.origin_world - origin).max() < 1.0
    np.testing.assert_array_equal(far.origin_world, np.round(far.origin_world))
    assert np.abs(far.points).max() < 4.0
    restored = far.points + far.origin_world
    gaps = np.linalg.norm(restored[:50, None] - (raw.points_world + origin)[None], axis=2).min(axis=1)
    assert gaps.max() < 1e-6
    raw = seeded_cloud(8)
    raw.points_world[:2] = [[0, 0, 0], [20.9, 10, 3.2]]
    assert clean(A, RawCloud(np.abs(raw.points_world), raw.colors), 1.0).origin_world.tolist() == [10, 5, 2]


def test_millimetres_and_far_outliers_are_warned_of():
    raw = seeded_cloud(9)
    millimetres = RawCloud(raw.points_world * 1000, raw.colors)
    (warning,) = clean(Path("room.ply"), millimetres, 1.0).warnings
    assert "`units` to mm" in warning
    assert "room.ply" in warning
    metres = clean(Path("room.ply"), millimetres, 0.001)
    assert metres.warnings == ()
    np.testing.assert_allclose(np.ptp(metres.points, axis=0), np.ptp(raw.points_world, axis=0), rtol=1e-5)
    raw = seeded_cloud(10, size=(5000.0, 30.0, 10.0))
    assert clean(A, raw, 1.0).warnings == ()
    raw = seeded_cloud(11)
    raw.points_world[:5] = 9000.0
    assert clean(A, raw, 1.0).warnings == ()
    raw = seeded_cloud(16)
    raw.points_world[0] = 5e6
    (warning,) = clean(A, raw, 1.0).warnings
    words = "points 5000004 m apart limit the precision of the rest to 0.25 m; remove the outliers"
    assert warning == f"a: {words}"


def test_points_that_are_not_finite_are_dropped_and_counted():
    raw = seeded_cloud(12)
    raw.points_world[10, 0] = math.nan
    raw.points_world[20, 2] = math.inf
    raw.points_world[30, 1] = -math.inf
    cloud = clean(A, raw, 1.0)
    assert "3 points with NaN" in cloud.warnings[0]
    assert len(cloud.points) == len(cloud.colors) == 1497
    assert np.isfinite(cloud.points).all()
