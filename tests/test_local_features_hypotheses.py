"""Poses that matches vote for: exact from exact matches, right in a room, obedient to what is known."""

import functools
from dataclasses import replace

import naive
import numpy as np
import pytest
import rooms
from made_up import exact_matches

from piccolo.evidence.contradictions import contradictions
from piccolo.geometry.pose import Pose, exp_so3
from piccolo.judge.reasons import explain
from piccolo.local_features.hypotheses import count_inliers, exact_pose, propose_poses, rough_poses
from piccolo.local_features.matching import match_located, merge_matches
from piccolo.localization.attempts import search_features
from piccolo.photo.photo import Prior
from piccolo.problem.photo_images import find_all_around
from piccolo.problem.settings import CoarseToFineSettings
from piccolo.system.jobs.threads import Workers

TIER = "scene"


@functools.lru_cache
def _problem(seed, variant="clean"):
    panorama = rooms.as_panorama(rooms.query(seed, variant).rgb)
    return rooms.ask(panorama, rooms.scan_map(seed))


def _matches(problem):
    places = problem.scan_map.places
    pictures = places.draw(range(len(places.positions)), rooms.WORKERS)
    keypoints = find_all_around(problem.photo, rooms.WORKERS)
    return merge_matches([match_located(keypoints, picture) for picture in pictures])


def _true_pose(seed, variant="clean"):
    return rooms.scan_map(seed).from_world(rooms.query(seed, variant).pose)


POSE = Pose(exp_so3(np.array([0.3, -0.8, 1.9])), np.array([0.4, -0.2, 0.3]))


def test_one_exact_match_gives_the_pose_and_its_votes_equal_their_twin():
    matches = exact_matches(POSE, 40, num_wrong=10)
    matches = matches._replace(query=np.repeat(np.arange(20, dtype=np.int32), 2))
    voters = np.arange(40)
    rotations = np.empty((40, 3, 3))
    centers = np.empty((40, 3))
    votes = np.empty(40, np.int64)
    rough_poses(matches, voters, rotations, centers, votes)
    np.testing.assert_allclose(centers[:30], np.tile(POSE.center_world, (30, 1)), atol=1e-4)
    np.testing.assert_allclose(rotations[:30], np.tile(POSE.R_cam_from_world, (30, 1, 1)), atol=2e-3)
    expected = [naive.votes(matches, *rough) for rough in zip(rotations, centers, strict=True)]
    np.testing.assert_allclose(votes, expected)
    assert votes[:30].min() > votes[30:].max()


def test_the_pose_is_found_among_wrong_matches():
    matches = exact_matches(POSE, 60, num_wrong=40)
    found = propose_poses(matches, 6, Workers())
    assert found[0].num_matches >= 20
    assert rooms.errors(found[0].pose, POSE)[0] < 1e-4
    assert all(one.num_matches <= 6 for one in found[1:])
    assert count_inliers(matches, POSE) == found[0].num_matches
    elsewhere = Pose(POSE.R_cam_from_world, POSE.center_world + np.array([2.0, 0.0, 0.0]))
    assert count_inliers(matches, elsewhere) < 4


def test_the_pose_of_too_few_matches_is_none():
    assert exact_pose(exact_matches(POSE, 30), POSE).num_matches == 30
    assert exact_pose(exact_matches(POSE, 3), POSE) is None


@pytest.mark.parametrize("variant", ["clean", "tilt", "photo"])
def test_a_photo_is_found_in_its_room_with_the_same_bits_for_any_threads(variant):
    matches = _matches(_problem(1, variant))
    found = propose_poses(matches, 6, Workers(2))
    rooms.assert_near(found[0].pose, _true_pose(1, variant), 0.05, 1.0)
    assert found[0].num_matches >= 12
    assert [one.num_matches for one in found] == sorted((one.num_matches for one in found), reverse=True)
    alone = propose_poses(matches, 6, Workers(1))
    for one, other in zip(found, alone, strict=True):
        assert one.pose.key == other.pose.key
        assert one.num_matches == other.num_matches


def test_noise_has_no_pose_that_many_matches_agree_with():
    rgb = np.random.default_rng(9).integers(0, 256, (256, 512, 3)).astype(np.uint8)
    panorama = rooms.as_panorama(rgb)
    scan_map = rooms.scan_map(1)
    found = propose_poses(_matches(rooms.ask(panorama, scan_map)), 6, Workers(2))
    assert max([0, *(one.num_matches for one in found)]) < 8
    flat = rooms.ask(rooms.as_panorama(np.full_like(rgb, 90)), scan_map)
    assert propose_poses(_matches(flat), 6, Workers(2)) == []


def test_poses_that_contradict_a_prior_are_told():
    scan_map = rooms.scan_map(1)
    world = rooms.query(1).pose
    x, y, z = world.center_world
    heading = np.degrees(np.arctan2(*world.R_cam_from_world[0, :2]))
    for prior, wrong in (
        (Prior(), ""),
        (Prior(near=(x + 0.55, y, z), radius=0.5), ""),
        (Prior(near=(x + 1.4, y, None), radius=0.5), "is 1.40 m from the place given, not within 0.5 m"),
        (Prior(height=(z - 0.3, z + 0.3)), ""),
        (Prior(height=(z + 1.0, z + 1.2)), "m above the floor, not"),
        (Prior(heading_deg=heading + 24.0), ""),
        (Prior(heading_deg=heading + 27.0), "looks 27 deg away from the heading given, more than 20 deg"),
    ):
        told = contradictions(scan_map, _true_pose(1), prior)
        assert len(told) == bool(wrong)
        assert wrong in "".join(map(explain, told))


def test_matches_beyond_a_prior_are_asked_too():
    x, y, _ = rooms.query(1).pose.center_world
    prior = Prior(near=(x + 1.4, y, None), radius=0.5)
    asked = replace(_problem(1), prior=prior, gravity="known")
    found, _ = search_features(asked, [], rooms.means())
    assert any(rooms.errors(one.pose, _true_pose(1))[0] < 0.1 for one in found)


def test_a_prior_that_excludes_the_place_makes_no_pose_sure():
    x, y, _ = rooms.query(1).pose.center_world
    prior = Prior(near=(x + 1.4, y, None), radius=0.5)
    settings = CoarseToFineSettings(gravity="known", prior=prior)
    result = rooms.locate(rooms.scene(1)[1], rooms.scan_map(1), settings)
    assert result.status == "not_localized"
    assert "from the place given, not within 0.5 m" in result.warnings[-1]
