"""Poses compared by blocks: an occluder costs what it hides, and what is not shown costs nothing."""

import functools
from dataclasses import replace

import naive
import numpy as np
import pytest
import rooms
from made_up import make_candidate

from piccolo.evidence import comparison
from piccolo.evidence.examine import count_agreeing, examine
from piccolo.geometry.pose import Pose, exp_so3, uniform_yaws, yaw_rotation
from piccolo.geometry.sphere import (
    BLOCK_RINGS,
    CHANCE_CORRELATION,
    NUM_BLOCKS,
    find_cell,
    pixel_rays,
    solid_angles,
)
from piccolo.judge.candidate import CONTRADICTS, Comparison
from piccolo.judge.selection import is_mirrored
from piccolo.localization import mirror
from piccolo.localization.beam import Ends
from piccolo.localization.mirror import find_mirrored, is_found_again, list_mirrored
from piccolo.localization.search import Starts
from piccolo.photo.panorama import Panorama
from piccolo.photo.panorama.texels import pack_texels
from piccolo.problem.method import METHOD
from research.synthetic.world import mask_outside_field, occlude

TIER = "scene"

WIDTH = rooms.WIDTH
TILTED = exp_so3(np.array([0.4, -1.1, 0.7]))
AREAS = solid_angles(WIDTH)[:, None] / (4 * np.pi) * np.ones(WIDTH)


def _problem(rgb, is_hidden=None):
    is_valid = np.ones(rgb.shape[:2], bool) if is_hidden is None else ~is_hidden
    return rooms.ask(Panorama(rgb, is_valid), rooms.scan_map(1))


@functools.lru_cache
def _clean():
    true_pose = rooms.scene(1)[2]
    return comparison.compare(_problem(rooms.query(1).rgb), true_pose), true_pose


@functools.lru_cache
def _hidden(fraction):
    """A photo behind pieces of another room, and where (H, W) it is hidden."""
    rgb, other = rooms.query(1).rgb, rooms.query(2).rgb
    shown = occlude(rgb, other, fraction, np.random.default_rng(1))
    return shown, (shown != rgb).any(axis=2)


def _blocks_of(is_chosen):
    """Fraction (blocks,) of each block that is chosen (H, W)."""
    block = find_cell(pixel_rays(WIDTH).reshape(-1, 3).astype(np.float32), BLOCK_RINGS)
    total = np.bincount(block, AREAS.ravel(), NUM_BLOCKS)
    return np.bincount(block, (AREAS * is_chosen).ravel(), NUM_BLOCKS) / total


def test_a_photo_is_sampled_as_its_twin():
    rng = np.random.default_rng(2)
    is_valid = np.ones((128, 256), bool)
    is_valid[:30] = False
    v, u = np.mgrid[0:128, 0:256] / 256 * 2 * np.pi
    rgb = np.stack([127 + 100 * np.sin((k + 1) * u + v) for k in range(3)], axis=-1).astype(np.uint8)
    offsets = rng.normal(size=(3, 900)).astype(np.float32)
    texels = pack_texels(rgb, is_valid)
    weights = rng.uniform(0.5, 1.5, 900).astype(np.float32)
    colors, shared, rays = (np.empty(shape, np.float32) for shape in ((3, 900), 900, (3, 900)))
    center = np.array([0.01, -0.02, 0.03])
    comparison.sample_photo(offsets, weights, texels, TILTED, center, colors, shared, rays)
    pixels = naive.project(offsets.T, TILTED, center, 256)
    r, g, b = naive.sample(rgb, pixels).T / 255
    np.testing.assert_allclose(colors, [(r + g + b) / 3, (r - b) / 2, (2 * g - r - b) / 4], atol=2e-3)
    shows = naive.sample(is_valid[..., None], pixels)[:, 0] > 1 - 1e-9
    assert (shared == weights * shows).mean() > 0.995
    np.testing.assert_allclose(rays, TILTED @ (offsets - center[:, None]), atol=1e-5)


def test_blocks_correlate_as_their_twin():
    rng = np.random.default_rng(3)
    first = rng.normal(size=(3, 2000)).astype(np.float32)
    second = (0.6 * first + 0.8 * rng.normal(size=(3, 2000))).astype(np.float32)
    blocks = rng.integers(NUM_BLOCKS - 2, size=2000).astype(np.int32)  # the last two show nothing
    shared = (rng.uniform(size=2000) * (rng.uniform(size=2000) < 0.8)).astype(np.float32)
    correlation, area = np.empty(NUM_BLOCKS), np.empty(NUM_BLOCKS)
    comparison.correlate_blocks(first, second, shared, blocks, correlation, area)
    expected = naive.block_correlation(first, second, shared, blocks, NUM_BLOCKS)
    np.testing.assert_allclose(correlation, expected[0], atol=1e-5)
    np.testing.assert_allclose(area, expected[1], rtol=1e-5)
    assert correlation[-1] == area[-1] == 0


def test_score_and_ratio_by_hand():
    """Blocks below chance give nothing; only what both poses show is compared."""
    half = CHANCE_CORRELATION + 0.5 * (1 - CHANCE_CORRELATION)
    area = np.array([0.2, 0.1, 0.1])
    a = Comparison(np.array([half, 0.1, -0.9]), area, area, 0.5)
    assert a.score == pytest.approx(0.5 * 0.2 / 0.5)
    b = Comparison(np.array([1.0, 1.0, half]), area, np.array([0.1, 0.0, 0.1]), 0.5)
    assert a.compute_ratio(b) == pytest.approx((0.5 * 0.1) / (1.0 * 0.1 + 0.5 * 0.1))
    assert b.compute_ratio(a) == pytest.approx(1 / a.compute_ratio(b))
    assert a.compute_ratio(a) == 1.0
    elsewhere = Comparison(np.ones(3), area, np.array([0.01, 0.0, 0.3]), 0.5)
    other = Comparison(np.ones(3), area, np.array([0.3, 0.0, 0.02]), 0.5)
    assert elsewhere.compute_ratio(other) == 0.0


def test_the_true_pose_explains_more_than_others():
    seen, true_pose = _clean()
    assert 0.6 < seen.score < 1.0
    assert seen.compute_ratio(seen) == 1.0
    assert seen.valid_area == pytest.approx(1.0, abs=1e-3)
    problem = _problem(rooms.query(1).rgb)
    R = yaw_rotation(1.0) @ true_pose.R_cam_from_world
    turned = comparison.compare(problem, Pose(R, true_pose.center_world))
    beside = true_pose.center_world + np.array([0.3, 0.0, 0.0])
    moved = comparison.compare(problem, Pose(true_pose.R_cam_from_world, beside))
    for wrong in (turned, moved):
        assert wrong.score < 0.5 * seen.score
        assert wrong.compute_ratio(seen) < 0.5


def test_what_is_seen_from_a_pose_near_is_placed_as_it_is():
    """A view of 2 cm beside is compared from the pose itself: no shift; it is not rendered again."""
    seen, true_pose = _clean()
    beside = Pose(true_pose.R_cam_from_world, true_pose.center_world + np.array([0.015, -0.012, 0.0]))
    problem = _problem(rooms.query(1).rgb)
    problem.view_at(beside, "fine")
    found = comparison.compare(problem, true_pose, seen_from=beside)
    assert problem.views.averages.cache_info().misses == 1
    assert found.score == pytest.approx(seen.score, abs=0.02)
    assert found.score != seen.score
    assert comparison.compare(problem, true_pose).score == seen.score  # whoever asked before


@pytest.mark.parametrize("fraction", [0.2, 0.5])
def test_an_occluder_costs_what_it_hides(fraction):
    seen, true_pose = _clean()
    rgb, is_hidden = _hidden(fraction)
    behind = comparison.compare(_problem(rgb), true_pose)
    touched = _blocks_of(is_hidden)
    lost = (
        (touched > 0.02)
        * seen.area
        * np.maximum(seen.correlation - CHANCE_CORRELATION, 0)
        / (1 - CHANCE_CORRELATION)
    ).sum()
    assert behind.score >= seen.score - lost - 0.02
    assert behind.score < seen.score - 0.3 * fraction * seen.score
    untouched = (touched == 0.0) & (seen.area > 0.0)
    assert untouched.sum() >= 5
    # the occluder's edges in the neighbour's mean and deviation cost little
    assert np.median((behind.correlation - seen.correlation)[untouched]) > -0.05


def test_blocks_outside_a_narrow_photo_count_nothing():
    seen, true_pose = _clean()
    outside = mask_outside_field(WIDTH, 90.0, 0.5)
    narrow = comparison.compare(_problem(rooms.query(1).rgb, outside), true_pose)
    shown = _blocks_of(~outside)
    assert (narrow.visible_area[shown == 0.0] == 0.0).all()
    assert (narrow.area[shown == 0.0] == 0.0).all()
    assert narrow.valid_area == pytest.approx((AREAS * ~outside).sum(), abs=0.01)
    assert narrow.visible_area.sum() <= narrow.valid_area + 0.01
    assert narrow.score > 0.7 * seen.score
    black = np.where(outside[..., None], 0, rooms.query(1).rgb).astype(np.uint8)
    again = comparison.compare(_problem(black, outside), true_pose)
    np.testing.assert_array_equal(again.correlation, narrow.correlation)


def test_what_contradicts_is_masked_and_the_rest_stays():
    true_pose = rooms.scene(1)[2]
    rgb, is_hidden = _hidden(0.4)
    problem = _problem(rgb)
    seen = comparison.compare(problem, true_pose)
    unoccluded = comparison.mask_occluders(problem, seen)
    shown = problem.show(unoccluded.photo)
    masked = _blocks_of(~shown.photo.panorama.is_valid[::2, ::2])
    covered = _blocks_of(is_hidden)
    assert masked[covered > 0.9].mean() > 0.8
    assert masked[covered == 0.0].mean() < 0.15
    assert comparison.mask_occluders(problem, seen, unoccluded) is unoccluded
    assert problem.photo.panorama.is_valid.all()  # as it was
    after = comparison.compare(shown, true_pose)
    assert after.score > seen.score
    left = 1.0 - (AREAS * ~shown.photo.panorama.is_valid[::2, ::2]).sum()
    assert after.valid_area == pytest.approx(left, abs=0.02)
    clean = _problem(rooms.query(1).rgb)
    seen = comparison.compare(clean, true_pose)
    fits = (seen.correlation >= CONTRADICTS).all()
    assert (comparison.mask_occluders(clean, seen).photo is clean.photo) == fits


def _is_turned_over(problem, best):
    mirrored = find_mirrored(problem, best, rooms.AUTO.effort, rooms.WORKERS)
    own = count_agreeing(problem, best, rooms.WORKERS)
    return mirrored is not None and is_mirrored(METHOD, own, mirrored)


@pytest.mark.parametrize("fov_deg", [None, 90.0])
def test_a_photo_that_was_turned_over_is_told(fov_deg):
    """Whole or narrow: whole views explain nearly all of the mirrored photo where it is found."""
    outside = None if fov_deg is None else mask_outside_field(WIDTH, fov_deg, 0.5)
    rgb = rooms.query(1).rgb
    right = _problem(rgb, outside)
    turned_over = _problem(rgb[:, ::-1].copy(), None if outside is None else outside[:, ::-1].copy())
    assert right.photo.is_partial == turned_over.photo.is_partial == (fov_deg is not None)
    found = examine(right, _clean()[1])
    assert found.score > 0.9
    assert examine(turned_over, found.pose).score < 0.05
    doubtful = replace(found, score=0.69)
    assert count_agreeing(right, doubtful, rooms.WORKERS).num_matches > 15
    assert _is_turned_over(turned_over, doubtful)
    assert not _is_turned_over(right, doubtful)
    plain = replace(found, score=0.7, num_matches=40)  # it explains nearly all of the photo, in detail
    few = replace(found, score=0.7, num_matches=39)
    assert find_mirrored(turned_over, few, rooms.AUTO.effort, rooms.WORKERS) is not None
    for problem, best in ((turned_over, plain), (turned_over.by_views(), doubtful)):
        assert find_mirrored(problem, best, rooms.AUTO.effort, rooms.WORKERS) is None


@pytest.mark.parametrize(("num_matches", "is_searched"), [(None, True), (11, True), (12, False)])
def test_a_mirrored_photo_is_searched_at_any_level_tilt_if_few_matches_agree(
    monkeypatch, num_matches, is_searched
):
    """Its wrong pose is tilted by half a radian, and its mirror image at that tilt is found nowhere."""
    outside = mask_outside_field(WIDTH, 90.0, 0.5)
    turned_over = _problem(rooms.query(1).rgb[:, ::-1].copy(), outside[:, ::-1].copy())
    true_pose = _clean()[1]
    wrong = Pose(exp_so3(np.array([0.0, 0.5, 0.0])) @ true_pose.R_cam_from_world, true_pose.center_world)
    best = replace(make_candidate(0.0, 0.69, num_matches), pose=wrong)
    monkeypatch.setattr(mirror, "search_mirrored", lambda *_: [])
    found = find_mirrored(turned_over, best, rooms.AUTO.effort, rooms.WORKERS)
    assert (found is not None) == is_searched
    if found is not None:
        rooms.assert_near(found.pose, true_pose, 0.05, 2.0)
        assert is_mirrored(METHOD, best, found)


@pytest.mark.parametrize(
    ("score", "num_matches", "expected"),
    [(0.49, 30, False), (0.52, 30, False), (0.53, 30, True), (0.53, 20, False)],
)
def test_a_photo_that_views_explain_as_well_is_not_mirrored_by_its_matches(score, num_matches, expected):
    """The mirrored photo has more matches, as in a place that looks alike in a mirror."""
    own = make_candidate(0.0, 0.5, 20)
    assert is_mirrored(METHOD, own, make_candidate(0.0, score, num_matches)) == expected


def test_the_mirrored_photo_is_searched_as_thoroughly_as_its_own_pose_needs():
    """Briefly, if the best end of a brief search is the photo's own pose; also upside down."""
    own = Pose(np.eye(3), np.zeros(3))
    starts = Starts(
        np.stack([np.eye(3)] * 2), np.array([[0.3, 0.0, 0.0], [0.6, 0.0, 0.0]]), np.zeros(2, np.int64)
    )
    assert is_found_again(Ends(starts, np.array([0.5, 0.4])), own)
    assert not is_found_again(Ends(starts, np.array([0.4, 0.5])), own)
    assert not is_found_again(Ends(starts.take(np.arange(0)), np.empty(0)), own)
    rotations = list_mirrored(TILTED, 12)
    upright = np.array([1.0, -1.0, 1.0])[:, None] * TILTED * [1.0, -1.0, 1.0] @ uniform_yaws(12)
    np.testing.assert_allclose(rotations[:12], upright, atol=1e-12)
    for half, sign in ((rotations[:12], 1.0), (rotations[12:], -1.0)):
        np.testing.assert_allclose(half[:, :, 2], np.tile(sign * upright[0, :, 2], (12, 1)), atol=1e-12)
