"""Two halves of a panorama that ask for other poses, as of two lenses that were put together wrongly."""

import cv2
import numpy as np
import pytest
import rooms
from rooms import as_panorama, query

from piccolo.evidence import blocks, covariance
from piccolo.geometry.nearness import ROOM_RANGE
from piccolo.geometry.pose import exp_so3, yaw_rotation
from piccolo.geometry.sphere import compute_pixels, pixel_rays
from piccolo.problem.method import METHOD

TIER = "scene"


def block_sums(rng, is_ahead, apart):
    """Sums (B, 29) at the best pose of all blocks, where that of those ahead is `apart` (6,) from others'."""
    rows = rng.normal(size=(len(is_ahead), 40, 6))
    wanted = rng.normal(size=(len(is_ahead), 40)) + np.einsum("bni,i,b->bn", rows, apart, is_ahead - 0.5)
    return sums_of(rows, wanted)


def sums_of(rows, wanted):
    """Sums (B, 29) of blocks at the best pose of all, by rows (B, n, 6) and values (B, n)."""
    matrices = np.swapaxes(rows, 1, 2) @ rows
    right = np.einsum("bni,bn->bi", rows, wanted)
    gradients = matrices @ np.linalg.solve(matrices.sum(axis=0), right.sum(axis=0)) - right
    sums = np.zeros((len(rows), 29))
    sums[:, 2:8] = gradients
    sums[:, 8:] = matrices[:, *np.triu_indices(6)]
    return sums


def test_halves_that_ask_for_other_poses_score_far_beyond_chance():
    rng = np.random.default_rng(2)
    is_ahead = rng.permuted(np.tile(np.arange(150) % 2 == 0, (40, 1)), axis=1)
    alone = np.arange(150)
    none = np.zeros(6)
    by_chance = [covariance.score_halves(block_sums(rng, is_ahead[0], none), is_ahead, alone) for _ in "1234"]
    assert np.mean(by_chance) == pytest.approx(1.0, abs=0.1)
    assert np.percentile(by_chance, 95) < METHOD.halves_score
    sums = block_sums(rng, is_ahead[7], np.array([0.0, 0, 0, 0, 0, 0.4]))
    scores = covariance.score_halves(sums, is_ahead, alone)
    assert scores.argmax() == 7
    assert scores[7] > 3.0 * METHOD.halves_score
    sums[np.flatnonzero(is_ahead[7])[12:]] = 0.0
    assert covariance.score_halves(sums, is_ahead, alone)[7] == 0.0


def test_halves_that_errors_along_edges_set_apart_score_as_by_chance():
    """By gradients of single blocks, right photos would seem to be stitched wrongly."""
    rng = np.random.default_rng(4)
    wide = np.arange(160) // 4
    is_ahead = rng.permuted(np.tile(np.arange(40) % 2 == 0, (40, 1)), axis=1)[:, wide]
    found = []
    for _ in range(4):
        rows = rng.normal(size=(160, 40, 6))
        wanted = rng.normal(size=(160, 40)) + np.einsum("bni,bi->bn", rows, rng.normal(size=(40, 6))[wide])
        sums = sums_of(rows, wanted)
        scores = [covariance.score_halves(sums, is_ahead, which) for which in (wide, np.arange(160))]
        found.append(np.mean(scores, axis=1))
    as_wide, as_single = np.mean(found, axis=0)
    assert as_wide == pytest.approx(1.0, abs=0.25)
    assert as_single > 2.0 * as_wide


def test_a_pose_that_is_not_the_best_of_all_does_not_set_halves_apart():
    """Nor if one half has most of the information, as with noise in some blocks that was not masked."""
    rng = np.random.default_rng(3)
    is_ahead = np.arange(150) % 2 == 0
    sums = block_sums(rng, is_ahead, np.zeros(6))
    sums[:20:2] *= 100.0
    alone = np.arange(150)
    expected = covariance.score_halves(sums, is_ahead[None], alone)
    sums[:, 2:8] += blocks.fill_symmetric(sums[:, 8:]) @ np.full(6, 0.01)
    np.testing.assert_allclose(covariance.score_halves(sums, is_ahead[None], alone), expected, rtol=0.3)
    assert expected < METHOD.halves_score


def turn_half(rgb, azimuth, turn):
    """A panorama whose half around an azimuth [rad] is turned by (3,) [rad], as two lenses put together."""
    rays = pixel_rays(rgb.shape[1])
    u, v = compute_pixels(rays @ exp_so3(turn), rgb.shape[1])
    turned = cv2.remap(rgb, np.float32(u - 0.5), np.float32(v - 0.5), cv2.INTER_CUBIC, None, cv2.BORDER_WRAP)
    is_ahead = rays @ yaw_rotation(azimuth)[0] > 0.0
    return np.where(is_ahead[..., None], turned, rgb)


@pytest.mark.parametrize(("seed", "azimuth", "turn"), [(1, 0.0, (0, 0, 0.03)), (3, 1.0, (0.02, 0, 0))])
def test_a_half_that_is_turned_widens_the_covariance_until_it_covers_the_true_position(seed, azimuth, turn):
    taken = query(seed)
    scan_map = rooms.scan_map(seed)
    chi_squares = []
    stds = []
    for rgb in (taken.rgb, turn_half(taken.rgb, azimuth, np.array(turn))):
        found = rooms.locate(as_panorama(rgb), scan_map, rooms.KNOWN)
        error = taken.pose.center_world - found.pose.center_world
        chi_squares.append(error @ np.linalg.solve(found.covariance.matrix[3:, 3:], error))
        stds.append(found)
        assert found.status == "localized"
    assert max(chi_squares) < 7.81
    assert stds[0].covariance.largest_std < 0.003  # [m]
    of_fit = stds[1].std_of_fit * ROOM_RANGE
    assert stds[1].covariance.largest_std > 1.5 * max(of_fit, stds[0].covariance.largest_std)
