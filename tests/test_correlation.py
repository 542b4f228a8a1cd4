"""Correlations of views with a turned photo: twins, and the same bits in any order and by any threads."""

import naive
import numpy as np
import pytest
import rooms

from piccolo.geometry.pose import uniform_rotations
from piccolo.geometry.sphere import make_grid, whole_areas, wider_cells
from piccolo.localization import correlation
from piccolo.localization.search import turn_panorama
from piccolo.system.jobs.threads import Workers

TIER = "scene"

AREA = make_grid(24).solid_angle
WIDE_AREA = wider_cells(12)[1]


def test_scores_equal_correlations_one_by_one():
    rng = np.random.default_rng(0)
    scan_map = rooms.scan_map(1)
    query = rooms.ask(rooms.scene(1)[1], scan_map)
    samples, validity = turn_panorama(query.photo.images.search(), uniform_rotations(50))
    validity[:, rng.random(validity.shape[1]) < 0.2] = 0
    samples *= validity[:, None]
    panorama = correlation.weigh_by_area(samples, validity, AREA, 1)
    candidate, rotation = rng.integers(0, len(scan_map.centers), 40), rng.integers(0, 50, 40)
    row, views = scan_map.views.at(candidate, Workers(2))
    pairs = np.empty(40, np.float32)
    features = views.features.reshape(len(views.features), -1)
    seen = views.is_seen.view(np.uint8)
    scores = correlation.masked_correlation(features, seen, panorama, Workers(2))
    how = whole_areas(24), panorama, row, rotation
    correlation.correlate_pairs(views.features, views.is_seen, *how, pairs)
    twin = []
    for c, r in zip(row, rotation, strict=True):
        w = AREA * views.is_seen[c] * validity[r]
        f = views.features[c].astype(float)
        s = samples[r].astype(float)
        twin.append((w * f * s).sum() / np.sqrt((w * f * f).sum() * (w * s * s).sum()))
    for found in (scores[row, rotation], pairs):  # each up to a factor of its own
        factor = (found @ twin) / (found @ found)
        np.testing.assert_allclose(factor * found, twin, atol=3e-3)


def test_sums_of_a_search_are_exact():
    """No partial sum of what features and samples can be at most reaches 2^24, so no order changes a bit."""
    for area, most_seen in ((AREA, 1), (wider_cells(12)[1], 255)):
        one = np.ones((1, 3, len(area)), np.float32)
        panorama = correlation.weigh_by_area(127.5 * one, one[:, 0], area, most_seen)
        assert 127 * panorama.samples.sum(dtype=float) < 2**24
        assert most_seen * panorama.energy.sum(dtype=float) < 2**24
        assert 127 * panorama.samples.sum(dtype=float) > 2**22  # the room is used
        for values in panorama[:3]:
            np.testing.assert_array_equal(values, np.rint(values))
    rng = np.random.default_rng(0)
    samples = rng.uniform(-127.5, 127.5, (20, 3, len(AREA))).astype(np.float32)
    validity = (rng.random((20, len(AREA))) < 0.8).astype(np.float32)
    features = rng.choice(np.array([-127, 127, 126], np.int8), (50, 3, len(AREA)))
    seen = rng.integers(0, 2, (50, len(AREA)), dtype=np.uint8)
    panorama = correlation.weigh_by_area(samples * validity[:, None], validity, AREA, 1)
    expected = correlation.masked_correlation(features.reshape(50, -1), seen, panorama, Workers(1))
    cells, views = rng.permutation(len(AREA)), rng.permutation(50)
    parts = (values[..., cells] for values in panorama[:4])
    shuffled = correlation.TurnedPanorama(*parts, panorama.most_seen)
    features = features[views][..., cells].reshape(50, -1)
    seen = seen[views][:, cells]
    found = correlation.masked_correlation(features, seen, shuffled, Workers(1))
    np.testing.assert_array_equal(found, expected[views])


def _views(seed, has_edges=True, num_views=60, num_rotations=25):
    """Views with the fractions seen, a photo of a part of the sphere in many rotations, and its validity.

    A view is what one of the rotations shows, more or less noisy. Cells at edges are seen in part.
    """
    rng = np.random.default_rng(seed)
    num_cells = len(WIDE_AREA)
    samples = rng.normal(rng.uniform(-30, 30, (num_rotations, 3, 1)), 30.0, (num_rotations, 3, num_cells))
    axes = rng.normal(size=(num_rotations, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    validity = (axes @ make_grid(12).directions.T > rng.uniform(0.3, 0.7)).astype(np.float32)
    samples = (np.clip(samples, -127, 127) * validity[:, None]).astype(np.float32)
    noise = rng.normal(0.0, 30.0, (num_views, 3, num_cells)) * np.linspace(0, 1, num_views)[:, None, None]
    fractions = rng.uniform(-0.5, 2.0, (num_views, num_cells)).clip(0, 1)
    seen = np.rint(255 * (fractions if has_edges else fractions > 0.3)).astype(np.uint8)
    shown = samples[np.arange(num_views) % num_rotations] + noise
    features = np.rint(np.clip(shown, -127, 127) * seen[:, None] / 255).astype(np.int8)
    return features, seen, samples, validity


@pytest.mark.parametrize("has_edges", [True, False])
@pytest.mark.parametrize("seed", [0, 1])
def test_centered_correlations_equal_their_twin(seed, has_edges):
    features, seen, samples, validity = _views(seed, has_edges)
    panorama = correlation.weigh_by_area(samples, validity, WIDE_AREA, 255)
    found = correlation.masked_correlation(
        features.reshape(len(features), -1), seen, panorama, Workers(2), is_centered=True
    )
    expected = naive.centered_correlation(
        features, seen / 255, samples, validity, WIDE_AREA, correlation.FLAT_VIEW, correlation.LEAST_SEEN
    )
    np.testing.assert_allclose(found, expected, atol=0.02)
    own = np.arange(20)  # the views with the least noise
    assert found[own, own].min() > 0.6
    assert found[own, own].min() > 2.0 * np.median(found)
    assert np.abs(found).max() <= 1.01


def test_plain_surfaces_do_not_correlate_whatever_their_brightness():
    """Uncentered they do, wherever both are bright or both are dark."""
    validity = (make_grid(12).directions[None, :, 0] > 0.5).astype(np.float32)
    samples = 60.0 * np.ones((1, 3, 1), np.float32) * validity[:, None]
    panorama = correlation.weigh_by_area(samples, validity, WIDE_AREA, 255)
    features = np.repeat(np.int8([60, -60, 10])[:, None], 3 * len(WIDE_AREA), axis=1)
    seen = np.full((3, len(WIDE_AREA)), 255, np.uint8)
    centered = correlation.masked_correlation(features, seen, panorama, Workers(1), is_centered=True)
    np.testing.assert_allclose(centered, 0.0, atol=0.02)
    plain = correlation.masked_correlation(features, seen, panorama, Workers(1))
    np.testing.assert_allclose(plain[1] / plain[0], -1.0, atol=1e-3)
    assert plain[0] > 0.0


def test_of_a_view_the_root_of_what_it_sees_of_the_photo_counts():
    """Nothing, if that is less than three tenths."""
    rng = np.random.default_rng(5)
    validity = (make_grid(12).directions[None, :, 0] > 0.2).astype(np.float32)
    samples = rng.uniform(-90, 90, (1, 3, len(WIDE_AREA))).astype(np.float32) * validity[:, None]
    shown = np.flatnonzero(validity[0])
    rank = np.cumsum(WIDE_AREA[shown]) / WIDE_AREA[shown].sum()
    fractions = (1.0, 0.75, 0.5, 0.32, 0.28)
    seen = np.zeros((len(fractions), len(WIDE_AREA)), np.uint8)
    for k, fraction in enumerate(fractions):
        seen[k, shown[rank <= fraction]] = 255
    parts = (seen / 255 * validity) @ WIDE_AREA / (validity[0] @ WIDE_AREA)
    features = np.rint(samples[0] * (seen > 0)[:, None]).astype(np.int8).reshape(len(seen), -1)
    panorama = correlation.weigh_by_area(samples, validity, WIDE_AREA, 255)
    found = correlation.masked_correlation(features, seen, panorama, Workers(1), is_centered=True)[:, 0]
    expected = np.sqrt(parts) * (parts > 0.3)
    assert expected[-1] == 0.0 < expected[-2]
    np.testing.assert_allclose(found, expected, atol=0.03)


def test_centered_correlations_are_the_same_bits_in_any_order_and_by_any_threads():
    """Sums are exact, though cells and views are shuffled and blocks are of other sizes."""
    features, seen, samples, validity = _views(2, num_views=700)
    panorama = correlation.weigh_by_area(samples, validity, WIDE_AREA, 255)
    flat = features.reshape(len(features), -1)
    expected = correlation.masked_correlation(flat, seen, panorama, Workers(1), is_centered=True)
    by_two = correlation.masked_correlation(flat, seen, panorama, Workers(2), is_centered=True)
    np.testing.assert_array_equal(by_two, expected)
    rng = np.random.default_rng(3)
    cells, views = rng.permutation(len(WIDE_AREA)), rng.permutation(len(features))
    values = (np.ascontiguousarray(each[..., cells]) for each in panorama[:4])
    shuffled = correlation.TurnedPanorama(*values, panorama.most_seen)
    flat = np.ascontiguousarray(features[views][..., cells]).reshape(len(features), -1)
    mixed = np.ascontiguousarray(seen[views][:, cells])
    found = correlation.masked_correlation(flat, mixed, shuffled, Workers(2), is_centered=True)
    np.testing.assert_array_equal(found, expected[views])
