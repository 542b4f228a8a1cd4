"""Photos of one place without relative poses, localized together: links between them, and a room."""

import functools
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import rooms
from groups import SEED, taken_photos
from made_up import make_candidate
from once import search_alone_once

from piccolo.evidence.examine import count_agreeing, examine
from piccolo.geometry.pose import Pose, pose_errors, yaw_rotation
from piccolo.geometry.pose_gaussian import PoseGaussian, add, subtract
from piccolo.judge.belief import make_belief
from piccolo.judge.candidate import NO_CANDIDATE, Selection
from piccolo.judge.probability import Mirrored
from piccolo.judge.reasons import MIRRORED, Reason
from piccolo.judge.result import Result, nothing_found
from piccolo.judge.selection import assess, assess_mirrored, select_mirrored
from piccolo.local_features.keypoints import Keypoints
from piccolo.localization.mirror import find_mirrored
from piccolo.photo.panorama import Panorama
from piccolo.system.jobs.threads import Stopwatch, Workers
from piccolo.together import group, members, mirrored
from piccolo.together.bundle_search import Support
from piccolo.together.expected import Expected
from piccolo.together.group import localize_group, weigh_supports
from piccolo.together.links import FIRM, WEAK, Links, Placed, compute_new, find_links, list_pairs, spread
from piccolo.together.members import Shot
from piccolo.together.optima import spread_optima

TIER = "scene"
SUPPORT = Support(NO_CANDIDATE, None, is_found=True, odds=1.0, odds_elsewhere=0.0, num_places=100)


@pytest.fixture(autouse=True, scope="module")
def _searched_once():
    """At any number of threads, of which test_bundle.py has that a search by itself is the same."""
    with pytest.MonkeyPatch.context() as patch:
        search_alone_once(patch, is_per_threads=False)
        yield


def _sphere(num, seed):
    """Keypoints in random directions, that look like no others."""
    rng = np.random.default_rng(seed)
    rays = rng.normal(size=(num, 3))
    rays = (rays / np.linalg.norm(rays, axis=1, keepdims=True)).astype(np.float32)
    return Keypoints(rays, rays, rng.random(num, np.float32), rng.integers(0, 255, (num, 128), np.uint8))


def _linked(*pairs):
    """Links of photos of which only is known which are linked."""
    numbers = {number for pair in pairs for number in pair}
    matches = np.arange(3), np.arange(3)
    every = {two: matches for one, other in pairs for two in ((one, other), (other, one))}
    return Links(dict.fromkeys(numbers), {k: _sphere(3, k) for k in numbers}, every, rooms.WORKERS)


def test_groups_are_photos_that_are_linked_by_others_too():
    links = _linked((0, 4), (4, 7), (2, 3))
    assert links.list_groups() == [[0, 4, 7], [2, 3]]
    assert links.list_linked(4) == [0, 7]


def test_of_many_photos_each_is_matched_with_those_that_look_most_like_it():
    """Fifty photos in pairs that show the same."""
    keypoints = {k: _sphere(40, k // 2) for k in range(50)}
    asked = list_pairs(keypoints, rooms.WORKERS)
    assert len(asked) < 50 * 49 / 2
    assert {(k, k + 1) for k in range(0, 50, 2)} <= set(asked)
    few = {k: keypoints[k] for k in range(4)}
    assert len(list_pairs(few, rooms.WORKERS)) == 6, "of few photos all"


def _facing(heading_deg):
    """A photo of 60 degrees, of which only the part of the sphere that it shows is known."""
    columns = (np.arange(64) + 0.5) * 360.0 / 64.0 - 180.0
    is_valid = np.broadcast_to(np.abs(columns) < 30.0, (32, 64))
    photo = SimpleNamespace(panorama=SimpleNamespace(is_valid=is_valid))
    pose = Pose(yaw_rotation(np.radians(heading_deg)), np.zeros(3))
    return SimpleNamespace(photo=photo), pose


def _show_the_same(*headings_deg):
    """Links of photos with keypoints all over what they show, and the photos three metres from all of it."""
    rays = _sphere(4000, 0).rays
    rays = rays[np.abs(np.arctan2(rays[:, 1], rays[:, 0])) < np.radians(29.0)]
    keypoints = Keypoints(rays, rays, np.ones(len(rays)), np.zeros((len(rays), 128), np.uint8))
    photos = [_facing(heading) for heading in headings_deg]
    problems = {k: problem for k, (problem, _) in enumerate(photos)}
    links = Links(problems, dict.fromkeys(problems, keypoints), {}, rooms.WORKERS)
    ranges = np.full(len(rays), 3.0, np.float32)
    return links, {k: Placed(pose, ranges) for k, (_, pose) in enumerate(photos)}


@pytest.mark.parametrize(
    ("turned_deg", "least", "most"),
    [((0.0,), 0.0, 0.05), ((30.0,), 0.3, 0.7), ((30.0, -30.0), 0.0, 0.1), ((90.0,), 1.0, 1.0)],
)
def test_what_other_photos_do_not_show_is_told_by_keypoints(turned_deg, least, most):
    """Two photos together may show all that another does."""
    links, places = _show_the_same(0.0, *turned_deg)
    assert least <= compute_new(links, places, 0) <= most
    nothing = {**places, 0: places[0]._replace(ranges=np.zeros_like(places[0].ranges))}
    assert compute_new(links, nothing, 0) == 1.0, "a bare wall is not known to be shown twice"


def test_what_several_photos_show_counts_once_and_not_less():
    """The photo that tells most of the place counts whole, however many show a part of the same."""
    links, places = _show_the_same(0.0, 0.0, 0.0, 90.0)
    odds = {0: 2.0, 1: 100.0, 2: 0.5, 3: 0.1}
    supports = {k: SUPPORT._replace(odds=one) for k, one in odds.items()}
    (tested,) = weigh_supports(links, [group.Tested(places, supports)])
    weights = {k: one.weight for k, one in tested.supports.items()}
    assert list(weights) == [0, 1, 2, 3]
    assert weights[1] == 1.0
    assert weights[0] == pytest.approx(0.0, abs=0.05)
    assert weights[2] == pytest.approx(0.0, abs=0.05)
    assert weights[3] == 1.0, "it shows something else"


def test_places_are_compared_by_the_same_evidence():
    """Two photos of the same, each of which tells more of another place, say nothing of which it is."""
    links, places = _show_the_same(0.0, 0.0)
    odds = [{0: 2.0, 1: 100.0}, {0: 100.0, 1: 2.0}, {1: 5.0}]
    told = [{k: SUPPORT._replace(odds=one) for k, one in of_place.items()} for of_place in odds]
    tested = weigh_supports(links, [group.Tested(places, supports) for supports in told])
    weights = [{k: one.weight for k, one in at.supports.items()} for at in tested]
    assert weights[0] == weights[1]
    assert weights[2] == {1: weights[0][1]}
    assert weights[0][0] == pytest.approx(0.5, abs=0.02)
    assert [one.odds for one in tested[0].supports.values()] == [2.0, 100.0]


def _support(x, odds):
    """Evidence of a photo for a place at x [m]."""
    return SUPPORT._replace(own=make_candidate(x, 0.5), odds=odds)


@pytest.mark.parametrize(
    ("elsewhere", "confidence"), [(_support(5.0, 80.0), 0.19), (_support(5.0, 19.0), 0.95), (None, 0.95)]
)
def test_a_photo_that_is_sure_is_doubted_where_it_explains_a_place_of_others_better(elsewhere, confidence):
    """As another room of a hotel, of which it had found only a local optimum."""
    alone = nothing_found().take_belief(make_belief([0.95]), 0.9)
    here = make_candidate(0.0, 0.5).pose
    member = SimpleNamespace(alone=alone, is_best=lambda pose: pose.distance(here) < 0.5)
    told = [_support(0.1, 20.0), elsewhere]
    tested = [group.Tested({}, {0: support} if support else {}) for support in told]
    demand = rooms.KNOWN.demand
    doubted = group.doubt_sure(group.Group(None, {0: member}), tested, demand)
    assert doubted.get(0, alone).confidence == pytest.approx(confidence)
    assert list(doubted) == ([0] if confidence < 0.9 else [])
    assert group.doubt_sure(group.Group(None, {0: member}), tested[1:], demand) == {}, "its own is not tested"
    assert group.list_sure(group.Group(None, {0: member}), tested[0]) == {0}
    assert group.list_sure(group.Group(None, {0: member}), tested[1]) == set()


def _gaussian(x, std):
    """A level pose, a distance [m] along x away, with a deviation [m]."""
    covariance = np.diag([1e-6] * 3 + [std**2] * 3)
    return PoseGaussian(Pose(np.eye(3), np.array([x, 0.0, 0.0])), covariance, np.zeros((6, 6)))


@pytest.mark.parametrize(
    ("off", "num_matches", "local_share", "std"),
    [
        (0.2, 12, 0.02, math.hypot(0.15, 0.03)),  # few matches contradict what is surer
        (0.2, 12, 0.30, 0.03),  # they are surer
        (0.2, 300, 0.02, 0.03),  # they are many
        (0.05, 12, 0.02, 0.03),  # they do not contradict it
    ],
)
def test_of_two_poses_that_contradict_each_other_the_surer_counts(off, num_matches, local_share, std):
    expected = Expected(_gaussian(off, 0.03), num_matches)
    tempered = expected.temper(_gaussian(0.0, 0.01), local_share)
    assert tempered.largest_std == pytest.approx(std)
    assert tempered.pose is expected.gaussian.pose


def test_what_few_matches_tell_alone_may_be_a_local_optimum():
    few = Expected(_gaussian(0.0, 0.03), 12).temper(None, 1.0)
    many = Expected(_gaussian(0.0, 0.03), 1200).temper(None, 1.0)
    assert few.largest_std == pytest.approx(math.hypot(0.5 * 0.15, 0.03))
    assert many.largest_std == pytest.approx(0.03, rel=0.05)


@functools.lru_cache
def _problems():
    return {
        k: rooms.ask(photo, rooms.scan_map(SEED), rooms.KNOWN) for k, (photo, _) in enumerate(taken_photos())
    }


def test_poses_of_photos_follow_from_one_by_the_depth_of_the_scan():
    links = find_links(_problems(), rooms.WORKERS)
    poses = [pose for _, pose in taken_photos()]
    anchor = {1: links.place(1, rooms.scan_map(SEED).from_world(poses[1]))}
    places = spread(links, anchor, links.problems, FIRM)
    assert sorted(places) == [0, 1, 2]
    for k, placed in places.items():
        distance, angle = pose_errors(rooms.scan_map(SEED).to_world(placed.pose), poses[k])
        assert distance < 0.1
        assert np.degrees(angle) < 2.0
    within = WEAK._replace(reach=1e-3)
    assert sorted(spread(links, anchor, links.problems, within)) == [1], "all are farther away"


def test_a_mirrored_photo_is_linked_with_none():
    photo = taken_photos()[1][0]
    mirrored = replace(photo, rgb=photo.rgb[:, ::-1], is_valid=photo.is_valid[:, ::-1])
    problems = {**_problems(), 1: rooms.ask(mirrored, rooms.scan_map(SEED), rooms.KNOWN)}
    assert find_links(problems, rooms.WORKERS).list_linked(1) == []


def _belief(status):
    """A photo that was localized, or was not, or was refused as mirrored."""
    belief = make_belief([0.95 if status == "localized" else 0.5])
    if status == "mirrored":
        return Result(status="not_localized", belief=belief.rule_out(Reason.MIRRORED))
    return Result(status=status, belief=belief)


@pytest.mark.parametrize(
    ("alone", "log_odds", "is_refused"),
    [
        (("not_localized", "not_localized"), (0.3, 1.1), True),
        (("not_localized", "not_localized"), (0.3, 0.9), False),
        (("not_localized", "not_localized"), (-2.0, 1.1), False),  # the first photo tells more
        (("localized", "not_localized"), (0.3, 1.1), False),
        (("localized", "mirrored"), (0.3, 1.1), True),
    ],
)
def test_linked_photos_are_refused_if_they_fit_better_mirrored(monkeypatch, alone, log_odds, is_refused):
    odds = iter(log_odds)
    monkeypatch.setattr(mirrored, "compare_mirrored", lambda *_: next(odds))
    members = {k: SimpleNamespace(alone=_belief(status)) for k, status in enumerate(alone)}
    results = dict.fromkeys(members, _belief("localized")) | {2: _belief("not_localized")}
    members[2] = SimpleNamespace(alone=results[2])
    others = {0: (1,), 1: (0,), 2: ()}
    refused = mirrored.refuse_mirrored(results, others, members, 0.9)
    assert list(refused) == ([0, 1] if is_refused else [])
    for result in refused.values():
        assert result.status == "not_localized"
        assert result.belief.ruled_out == {Reason.MIRRORED}
        assert result.warnings == (MIRRORED,)


@pytest.mark.parametrize("is_together", [True, False])
def test_a_photo_that_mirrored_ones_put_at_their_place_is_refused_with_them(monkeypatch, is_together):
    """Of another place of linked photos, those that fit as they are do not speak for it."""
    odds = iter((-3.0, 2.4, 0.0))
    monkeypatch.setattr(mirrored, "compare_mirrored", lambda *_: next(odds))
    statuses = ("localized", "not_localized", "mirrored")
    members = {k: SimpleNamespace(alone=_belief(status)) for k, status in enumerate(statuses)}
    results = dict.fromkeys(members, _belief("localized"))
    others = {0: (), 1: (2,), 2: (1,)} if is_together else {0: (), 1: (), 2: ()}
    refused = mirrored.refuse_mirrored(results, others, members, 0.9)
    assert list(refused) == ([1, 2] if is_together else [1])


@pytest.mark.parametrize("is_mirrored", [False, True])
def test_a_mirrored_photo_has_less_odds_than_its_mirror_image(is_mirrored):
    ((photo, _),) = rooms.take_photos(SEED, 150.0, {1: [0.0, 0.0, 0.0]})
    if is_mirrored:
        photo = replace(photo, rgb=photo.rgb[:, ::-1], is_valid=photo.is_valid[:, ::-1])
    alone = rooms.locate(photo, rooms.scan_map(SEED), rooms.KNOWN)
    problem = rooms.ask(photo, rooms.scan_map(SEED), rooms.KNOWN)
    best = count_agreeing(
        problem, examine(problem, problem.scan_map.from_world(alone.best_pose)), rooms.WORKERS
    )
    seen = find_mirrored(problem, best, rooms.KNOWN.effort, rooms.WORKERS)
    of_mirror = Mirrored(seen and assess_mirrored(problem.profile, best, seen))
    result = replace(alone, standings=tuple(assess(problem.profile, Selection(best, ()))), mirrored=of_mirror)
    member = SimpleNamespace(found=SimpleNamespace(problem=problem))
    odds = mirrored.compare_mirrored(member, result)
    assert bool(select_mirrored({0: odds}, False)) == is_mirrored


def _together(photos, num_threads=2):
    shots = [Shot(photo, rooms.KNOWN) for photo in photos]
    return localize_group(rooms.scan_map(SEED), shots, Workers(num_threads), Stopwatch())


@functools.lru_cache
def _localized():
    return _together([photo for photo, _ in taken_photos()])


def test_photos_that_are_not_sure_alone_are_together():
    photos, poses = zip(*taken_photos(), strict=True)
    for photo in photos:
        shot = Shot(photo, rooms.KNOWN)
        alone = members.find_alone(rooms.scan_map(SEED), shot, rooms.WORKERS, Stopwatch()).alone
        assert alone.status in ("ambiguous", "not_localized")
    for number, (found, others) in enumerate(_localized()):
        assert found.status == "localized"
        assert others == tuple(k for k in range(3) if k != number)
        distance, angle = pose_errors(found.pose, poses[number])
        assert distance < 0.05
        assert np.degrees(angle) < 1.5
        assert distance < 4.0 * found.covariance.largest_std


def test_a_photo_of_a_made_room_is_as_uncertain_as_it_is_wrong():
    """Not sure alone; the true pose is within what its covariance and the optima tell."""
    scan_map = rooms.scan_map(SEED)
    photo, true = taken_photos()[1]
    member = members.find_alone(scan_map, Shot(photo, rooms.KNOWN), rooms.WORKERS, Stopwatch())
    own = next(one for one, _ in member.own_poses if one.pose.distance(scan_map.from_world(true)) < 0.3)
    gaussian = replace(member.alone.gaussian, pose=own.pose)
    spread = spread_optima(member.found.problem.forget(), own, gaussian, rooms.WORKERS)
    step = subtract(scan_map.from_world(true), own.pose)
    assert step @ np.linalg.solve(gaussian.covariance + spread, step) < 12.6
    assert 0.0 < np.sqrt(np.trace(spread[3:, 3:])) < 0.3
    assert add(own.pose, step).distance(scan_map.from_world(true)) < 1e-9


def _bits(found):
    return [(one.status, one.confidence, one.pose.key, one.covariance.matrix.tobytes()) for one, _ in found]


def test_a_stranger_and_a_photo_that_shows_nothing_stay_alone():
    """The others have the same bits, in any order and at any number of threads."""
    photos = [photo for photo, _ in taken_photos()]
    ((stranger, _),) = rooms.take_photos(6, 60.0, {1: [0.0, 0.0, 0.0]})
    nothing = Panorama(photos[0].rgb, np.zeros_like(photos[0].is_valid))
    empty, other, *right = _together([nothing, stranger, *photos[::-1]], num_threads=1)
    assert _bits(right)[::-1] == _bits(_localized())
    assert other.result.status == "not_localized"
    assert other.others == ()
    assert empty.result.best_pose is None


def test_photos_that_share_nothing_are_localized_alone_by_the_api(tmp_path):
    taken = rooms.take_photos(SEED, 360.0, {0: [0.0, 0.0, 0.0], 2: [0.3, 0.2, 0.0]})
    spheres = [photo.rgb for photo, _ in taken]
    missing = tmp_path / "missing.jpg"
    scan = rooms.scan(SEED)
    *found, failed = scan.localize_together([*spheres, missing])
    alone = [scan.localize(sphere) for sphere in spheres]
    assert [one.pose.key for one in found] == [one.pose.key for one in alone]
    assert [one.beside for one in found] == [None, None]
    assert failed.status == "unreadable"
    assert str(missing) in failed.error
    assert [one.status for one in scan.localize_together([missing])] == ["unreadable"]
    assert scan.localize_together([]) == []
