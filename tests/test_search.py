import dataclasses
import functools
import itertools

import naive
import numpy as np
import pytest
import rooms
from pictures import encoded, with_metadata, xmp_packet

from piccolo.geometry.pose import angle_between, exp_so3, uniform_rotations, uniform_yaws
from piccolo.geometry.sphere import make_grid, whole_areas, wider_cells
from piccolo.localization import attempts, search
from piccolo.photo.panorama import Panorama, read_panorama
from piccolo.photo.panorama.gpano import GPano
from piccolo.photo.panorama.local_normalization import normalize_panorama, sample_channels
from piccolo.photo.panorama.panorama import resize
from piccolo.photo.photo import Photo, Prior
from piccolo.problem.method import METHOD
from piccolo.problem.photo_images import make_images
from piccolo.problem.profile import ImageScales
from piccolo.problem.settings import Effort
from piccolo.system.jobs.threads import Workers
from research.synthetic.world import mask_outside_field

TIER = "scene"

AREA = make_grid(24).solid_angle
EFFORT = Effort(num_yaws=12, num_rotations=2000, max_starts=4000)


@functools.lru_cache
def _problem(gpano=None):
    panorama = dataclasses.replace(rooms.scene(1)[1], gpano=gpano)
    return rooms.ask(panorama, rooms.scan_map(1))


def _narrow(is_hidden, gpano=None):
    """The problem of the photo without some pixels."""
    panorama = dataclasses.replace(rooms.scene(1)[1], gpano=gpano)
    return rooms.ask(dataclasses.replace(panorama, is_valid=~is_hidden), rooms.scan_map(1))


def _levels(texels):
    """Channels (H, W, 3) less the zero level, and validity (H, W), of packed texels."""
    inner = texels.rgbx.reshape(-1, texels.width + 2)[1:-1, 1:-1]
    channels = np.stack([(inner >> shift) & 255 for shift in (0, 8, 16)], axis=-1) - 127.5
    return channels, inner >> 24 == 1


def test_what_is_masked_does_not_bleed():
    panorama = rooms.scene(1)[1]
    is_valid = panorama.is_valid.copy()
    is_valid[200:] = False
    black, white = panorama.rgb.copy(), panorama.rgb.copy()
    black[200:], white[200:] = 0, 255
    black_and_white = (make_images(Panorama(rgb, is_valid), ImageScales()).search() for rgb in (black, white))
    (a, valid), (b, _) = map(_levels, black_and_white)
    np.testing.assert_array_equal(a[valid], b[valid])
    assert valid.mean() == pytest.approx(200 / 256, abs=0.02)


def test_samples_along_turned_directions_equal_their_twin():
    texels = normalize_panorama(resize(rooms.scene(1)[1], 128), 7.5, 22.0)
    directions = make_grid(24).directions
    channels, is_valid = _levels(texels)
    rotations = uniform_rotations(5).astype(np.float32)
    samples, validity = np.empty((5, 3, len(AREA)), np.float32), np.empty((5, len(AREA)), np.float32)
    sample_channels(texels.rgbx, 128, directions, rotations, samples, validity)
    assert is_valid.all()
    assert (validity == 1).all()
    for R, found in zip(rotations, samples, strict=True):
        expected = naive.sample(channels, naive.project(directions, R, np.zeros(3), 128))
        np.testing.assert_allclose(found.T, expected, atol=0.1)


def test_wide_samples_are_averages_by_area():
    rng = np.random.default_rng(3)
    (cells, areas) = wider_cells(12)
    samples = rng.uniform(-127.5, 127.5, (600, 3, len(AREA))).astype(np.float32)
    validity = (rng.random((600, len(AREA))) < 0.6).astype(np.float32)
    matrix = (np.eye(len(areas))[cells] * whole_areas(24)[:, None]).astype(np.float32)
    for num_threads in (1, 2):
        wide, is_valid = search.widen_samples(samples, validity, Workers(num_threads))
        np.testing.assert_array_equal(wide, np.rint(samples) @ matrix / areas)
        np.testing.assert_array_equal(is_valid, np.rint(validity @ matrix / areas))


@pytest.mark.parametrize(("tilts", "most"), [("known", 10), ("any", 100)])
def test_best_score_is_near_the_true_pose(tilts, most):
    true_pose = rooms.scene(1)[2]
    scan_map = rooms.scan_map(1)
    rotations = uniform_yaws(48) if tilts == "known" else uniform_rotations(2000)
    samples, validity = search.turn_panorama(_problem().photo.images.search(), rotations)
    sparse, rotation, values = search.best_poses_wide(scan_map, samples, validity, 200, 512, Workers(2))
    assert (np.diff(values) <= 0).all()
    starts = search.search_poses(_problem(), tilts, EFFORT, rooms.WORKERS)
    centers = scan_map.centers[scan_map.sparse[sparse]]
    for found in ((centers, rotations[rotation]), (starts.center_map, starts.R_cam_from_map)):
        near = [
            np.linalg.norm(center - true_pose.center_world) < 0.8
            and np.degrees(angle_between(R, true_pose.R_cam_from_world)) < 25
            for center, R in zip(*found, strict=True)
        ]
        assert any(near[:most])


def test_a_part_of_the_candidates_at_a_time_gives_the_same_poses():
    scan_map = rooms.scan_map(1)
    rotations = uniform_rotations(200)
    samples, validity = search.turn_panorama(_problem().photo.images.search(), rotations)
    num = len(scan_map.sparse)
    whole = search.best_poses_wide(scan_map, samples, validity, 500, num, Workers(1))
    in_parts = search.best_poses_wide(scan_map, samples, validity, 500, num // 4, Workers(2))
    for expected, found in zip(whole, in_parts, strict=True):
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("least", [search.LOWEST, np.float32(0.5)])
def test_of_poses_that_fit_alike_the_first_are_taken(least):
    scores = np.ones((100, 100), np.float32)
    scores[90, 7], scores[95, 3] = 5.0, 6.0
    candidate, rotation, values = search.best_poses(scores, 10, least)
    np.testing.assert_array_equal(values, [6.0, 5.0] + [1.0] * 8)
    np.testing.assert_array_equal(candidate, [95, 90] + [0] * 8)
    np.testing.assert_array_equal(rotation, [3, 7, *range(8)])


@pytest.mark.parametrize(("rank", "count"), [(60, 60), (100, 100), (3000, 100), (0, 0), (None, 100)])
def test_best_poses_are_the_largest_that_have_more_than_the_least(rank, count):
    """As many as there are, however many more have it than are sorted."""
    scores = np.random.default_rng(1).normal(size=(400, 600)).astype(np.float32)
    ranked = np.sort(scores.ravel())[::-1]
    lowest = search.LOWEST if rank is None else ranked[rank]
    candidate, rotation, values = search.best_poses(scores, 100, lowest)
    np.testing.assert_array_equal(values, ranked[:count])
    np.testing.assert_array_equal(scores[candidate, rotation], values)


def test_tilt_in_the_metadata_is_that_of_every_start():
    """Pitch raises the image centre, roll lowers the camera's right side."""
    starts = search.search_poses(
        _problem(GPano(pitch_deg=20.0, roll_deg=10.0)), "known", EFFORT, rooms.WORKERS
    )
    forward, left, _ = starts.R_cam_from_map.transpose(1, 0, 2)
    np.testing.assert_allclose(np.degrees(np.arcsin(forward[:, 2])), 20.0, atol=1e-6)
    assert (left[:, 2] > 0.1).all()
    assert len(np.unique(np.round(forward, 6), axis=0)) > 6


def test_the_users_gravity_goes_before_the_tilt_in_the_metadata(tmp_path):
    path = tmp_path / "a.jpg"
    content = encoded(rooms.query(1).rgb, ".jpg")
    path.write_bytes(with_metadata(content, xmp=xmp_packet({"PosePitchDegrees": 20})))
    assert read_panorama(path).gpano == GPano(pitch_deg=20.0)
    panorama = read_panorama(Photo(path, gravity_vector=(-9.0, 0.0, -9.0)))
    photo = rooms.ask(panorama, rooms.scan_map(1)).photo
    assert photo.has_tilt
    np.testing.assert_allclose(photo.R_cam_from_level @ [0.0, 0.0, -1.0], [-(0.5**0.5), 0.0, -(0.5**0.5)])


def test_about_level_are_seven_pitches_in_forty_headings():
    """Without roll; neighbours in heading are as far apart as those in pitch."""
    rotations = search.list_rotations(_problem(), "level", EFFORT)
    assert len(rotations) == 7 * 40
    forward, left, _ = rotations.transpose(1, 0, 2)
    products = rotations @ rotations.transpose(0, 2, 1)
    np.testing.assert_allclose(products, np.eye(3)[None].repeat(280, 0), atol=1e-9)
    np.testing.assert_allclose(left[:, 2], 0.0, atol=1e-9)
    pitches, counts = np.unique(np.round(np.degrees(np.arcsin(forward[:, 2])), 6), return_counts=True)
    np.testing.assert_allclose(pitches, 9.0 * np.arange(-3, 4), atol=1e-5)
    assert (counts == 40).all()
    for pitch in pitches:
        of_pitch = np.abs(np.degrees(np.arcsin(forward[:, 2])) - pitch) < 1e-3
        headings = np.sort(np.degrees(np.arctan2(forward[of_pitch, 1], forward[of_pitch, 0])) % 360.0)
        np.testing.assert_allclose(np.diff(headings), 9.0, atol=1e-6)


def test_about_level_only_headings_that_the_prior_allows_are_searched():
    prior = Prior(heading_deg=90.0, heading_tolerance_deg=20.0)
    rotations = search.list_rotations(dataclasses.replace(_problem(), prior=prior), "level", EFFORT)
    forward = rotations[:, 0]
    assert len(rotations) == 7 * 5  # 72, 81, 90, 99, 108
    assert (np.abs(np.degrees(np.arctan2(forward[:, 0], forward[:, 1])) - 90.0) < 20.0).all()


def test_a_known_tilt_is_searched_as_known_whatever_the_photo_shows():
    """With all yaws at that tilt, not about level."""
    is_hidden = np.ones((256, 512), bool)
    is_hidden[:, :150] = False
    for gpano, tilts in ((GPano(pitch_deg=0.0), "known"), (None, "level"), (GPano(pitch_deg=12.0), "known")):
        narrow = _narrow(is_hidden, gpano)
        assert narrow.photo.is_partial
        assert narrow.photo.has_tilt == (gpano is not None)
        planned = [run for _, run in attempts.plan_attempts(narrow) if hasattr(run, "keywords")]
        searched = [run.keywords["tilts"] for run in planned]
        assert searched == [tilts, tilts, "any"], "first the few best starts"
        rotations = search.list_rotations(narrow, tilts, EFFORT)
        if gpano is not None:
            assert len(rotations) == EFFORT.num_yaws
            np.testing.assert_allclose(np.degrees(np.arcsin(rotations[:, 0, 2])), gpano.pitch_deg, atol=1e-6)


def test_starts_of_a_narrow_photo_are_the_distinct_best_of_wide_views():
    """With the means subtracted; nearer in angle than those of a whole photo, and near the true pose."""
    true_pose = rooms.scene(1)[2]
    narrow = _narrow(mask_outside_field(512, 90.0, 0.5))
    starts = search.search_poses(narrow, "level", EFFORT, rooms.WORKERS)
    near = [
        np.linalg.norm(center - true_pose.center_world) < 0.8
        and np.degrees(angle_between(R, true_pose.R_cam_from_world)) < 25
        for center, R in zip(starts.center_map, starts.R_cam_from_map, strict=True)
    ]
    assert any(near[:150])
    pairs = itertools.combinations(starts.poses()[:300], 2)
    apart = np.array([rooms.errors(*pair) for pair in pairs])
    nearest = apart[apart[:, 0] < 0.5, 1].min()
    assert 14.0 <= nearest < 20.0
    rotations = search.list_rotations(narrow, "level", EFFORT)
    samples, validity = search.turn_panorama(narrow.photo.images.search(), rotations)
    found = search.best_poses_wide(narrow.scan_map, samples, validity, 20, 512, Workers(1), True)
    best = found[0][0], found[1][0]
    np.testing.assert_array_equal(starts.R_cam_from_map[0], rotations[best[1]])
    assert starts.candidate[0] == narrow.scan_map.sparse[best[0]]


@pytest.mark.parametrize("tilts", ["known", "any"])
def test_heading_is_the_worlds_where_the_map_was_levelled(tilts):
    problem = _problem()
    tilted = dataclasses.replace(problem.scan_map, R_map_from_world=exp_so3(np.array([0.4, 0.3, 1.0])))
    prior = Prior(heading_deg=70.0, heading_tolerance_deg=20.0)
    asked = dataclasses.replace(problem, scan_map=tilted, prior=prior)
    starts = search.search_poses(asked, tilts, EFFORT, rooms.WORKERS)
    forward = (starts.R_cam_from_map @ tilted.R_map_from_world)[:, 0]
    off = np.degrees(np.arctan2(forward[:, 0], forward[:, 1])) - 70.0
    assert len(off) > 0
    assert np.abs(off).max() < 20.0 + 1e-6


@pytest.mark.parametrize(
    ("num_candidates", "most", "expected"),
    [(9000, 4000, 4000), (5000, 4000, 2500), (900, 4000, 1000), (900, 20, 20)],
)
def test_number_of_starts(num_candidates, most, expected):
    """One for every two candidates that are searched, but not fewer and not more than asked for."""
    assert search.thin_starts(METHOD, num_candidates, most) == expected


@pytest.mark.parametrize("most", [20, 150])
def test_starts_are_apart(most):
    problem = _problem()
    effort = EFFORT._replace(max_starts=most)
    for tilts in ("known", "any"):
        starts = search.search_poses(problem, tilts, effort, rooms.WORKERS)
        assert len(starts.candidate) == most
        np.testing.assert_array_equal(starts.center_map, problem.scan_map.centers[starts.candidate])
        pairs = itertools.combinations(starts.poses(), 2)
        apart = np.array([rooms.errors(*pair) for pair in pairs])
        assert 0.5 <= apart[apart[:, 1] < 20.0, 0].min(initial=0.9) < 1.0
        if tilts == "known":  # turned by twelfths of a turn
            assert 20.0 <= apart[apart[:, 0] < 0.5, 1].min() < 40.0
