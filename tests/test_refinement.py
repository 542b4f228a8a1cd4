"""Descents on the views of a room, and decisions of the refinement, each in a made-up case."""

import functools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import rooms
from made_up import PARTIAL, PROBLEM, WHOLE, at, make_candidate, move, place

from piccolo.evidence.examine import examine
from piccolo.geometry.cone import EVERYWHERE
from piccolo.geometry.nearness import Nearness
from piccolo.geometry.pose import Pose, step
from piccolo.geometry.sphere import NUM_BLOCKS, make_grid
from piccolo.judge.candidate import CONTRADICTS, Comparison
from piccolo.localization import beam, ladder
from piccolo.localization.beam import best_and_alternatives, narrow
from piccolo.localization.search import Starts
from piccolo.problem.method import METHOD
from piccolo.problem.profile import VIEWS, WHOLE_BEAM
from piccolo.problem.stages import AROUND_FINE, AROUND_MIDDLE, FULL, LAST, NEARLY, SECOND, Limits, Rounds
from piccolo.system.jobs.threads import Workers
from piccolo.views.points_around import round_position
from piccolo.views.view import Cells

TIER = "scene"

FINE_BLOCKS = VIEWS["fine"].arrays.blocks
ALL = np.ones(len(FINE_BLOCKS), bool)
ALONE = Workers(1)


@functools.lru_cache
def _problem(seed):
    return rooms.ask(rooms.scene(seed)[1], rooms.scan_map(seed))


# What is compared


@pytest.mark.parametrize(
    ("scores", "kept"),
    [
        ([0.6, 0.3, 0.16, 0.14], [0.6, 0.3, 0.16]),  # less than a quarter of the best is nothing
        ([0.05, 0.21, 0.06], [0.21, 0.06]),
        ([], []),
    ],
)
def test_poses_far_fainter_than_the_best_are_not_compared(scores, kept):
    found = beam.keep_comparable([at(k, score) for k, score in enumerate(scores)], METHOD.faint_part)
    assert sorted((h.score for h in found), reverse=True) == kept


# The beam


def test_a_quarter_of_the_beam_is_for_the_best_that_lie_far_apart():
    """Twenty poses in a row 0.2 m apart, and behind them two at other places."""
    x = np.concatenate([0.2 * np.arange(20), [50.0, 60.0]])
    rotations = np.repeat(np.eye(3)[None], 22, axis=0)
    centers = np.outer(x, [1.0, 0, 0])
    near = Nearness(0.15, 0.1)
    kept = best_and_alternatives(rotations, centers, 8, near)
    assert kept.tolist() == [0, 1, 2, 3, 4, 5, 6, 9]  # six near ones; of those half a metre apart, two more
    few = np.concatenate([np.arange(6), [20, 21]])
    assert best_and_alternatives(rotations[few], centers[few], 6, near).tolist() == [0, 1, 2, 3, 4, 6]
    kept = best_and_alternatives(rotations, centers, 8, near._replace(distance=0.3))
    assert kept.tolist() == [0, 2, 3, 4, 6, 8, 9, 10]


def test_narrow_ranks_poses_first():
    close = [at(0.0, 0.5), at(0.05, 0.9), at(3.0, 0.1), at(5.0, 0.7)]
    assert [place(pose) for pose in narrow(close, 4)] == [0.05, 5.0, 3.0]
    assert [place(pose) for pose in narrow(close, 1)] == [0.05]
    turned = [at(0.0, 0.9), at(0.09, 0.8), at(0.11, 0.7), at(0.0, 0.6, 4.9), at(0.0, 0.5, 5.1)]
    assert narrow(turned, 8) == [turned[k].pose for k in (0, 2, 4)]


def test_the_beam_narrows_from_stage_to_stage():
    """From 500 starts to 400, 48 and 8 poses, of which two are perturbed for as long as that helps.

    In a grey photo no pose is better than another. The first descents of a photo of a part of the sphere are
    as long as the second.
    """
    gray = rooms.as_panorama(np.full((256, 512, 3), 128, np.uint8))
    problem = rooms.ask(gray, rooms.scan_map(1))
    workers, asked = rooms.listen()
    centers = np.outer(np.arange(500), [1.0, 0.0, 0.0])
    starts = Starts(np.repeat(np.eye(3)[None], 500, axis=0), centers, np.zeros(500, np.int64))
    found = beam.refine_starts(problem, starts, WHOLE_BEAM, workers)
    around = len(ladder.perturbations(METHOD, 1.0)) // ladder.PERTURBED_BATCH
    counts = [total for label, total in asked if label == "descend" and total != around]
    assert counts == [-(-500 // beam.STARTS_A_TASK), 400 // beam.STARTS_A_TASK, 48, 8, 8, 2, 12]
    assert [sum(h.is_climbed for h in found), len(found)] == [2, 12]
    assert [one.first.limits.num_iterations for one in (WHOLE, PARTIAL)] == [5, 12]
    assert SECOND.limits.num_iterations == 12


# Perturbations and the last millimetres


@pytest.mark.parametrize(
    ("gains", "rounds", "expected"),
    [([0.2, 0.02, 0.005, 1], 3, 0.725), ([0.1] * 9, 5, 1.0), ([-0.3, 0.5], 1, 0.5), ([0.1, -0.1, 1], 2, 0.6)],
)
def test_poses_are_perturbed_for_as_long_as_that_helps(gains, rounds, expected):
    scores = list(0.5 + np.cumsum(gains))
    asked = []

    def perturb(best):
        asked.append(best.score)
        return at(float(len(asked)), scores[len(asked) - 1])

    found = ladder.climb_by(perturb, at(0.0, 0.5), METHOD)
    assert found.score == pytest.approx(expected)
    assert len(asked) == rounds
    assert asked == sorted(asked)
    assert (AROUND_FINE.around.image, AROUND_FINE.image, AROUND_FINE.around.size) == ("middle", "fine", 0.4)


def test_what_has_climbed_climbs_no_more():
    climbed = make_candidate(0.0, 0.3, is_climbed=True)
    assert ladder.climb_whole(PROBLEM, climbed, ALONE) is climbed


@pytest.mark.parametrize(
    ("is_masked", "scores", "rounds", "end"),
    [
        (True, [0.5, 0.6, 0.7, 0.8], 2, 2),  # two rounds at most
        (True, [0.5, 0.511, 0.6], 2, 2),
        (True, [0.5, 0.509, 0.6], 1, 1),  # a gain of less than a fiftieth ends them
        (True, [0.5, 0.4, 0.6], 1, 0),
        (False, [0.5, 0.6, 0.7], 1, 1),  # nothing to mask
    ],
)
def test_occluders_are_masked_again_where_that_gains(monkeypatch, is_masked, scores, rounds, end):
    made = []
    whole = SimpleNamespace(mask=lambda is_hidden: "masked")
    correlation = np.full(NUM_BLOCKS, 0.9)
    correlation[-1] = CONTRADICTS - 0.01 if is_masked else 0.9
    seen = Comparison(correlation, np.ones(NUM_BLOCKS), np.ones(NUM_BLOCKS), 1.0)

    def climb(problem, start, workers):
        made.append(start.unoccluded.photo)
        return replace(move(start, 1.0), score=scores[len(made)])

    for name in ("climb_masked", "climb_whole"):
        monkeypatch.setattr(ladder, name, climb)
    start = replace(make_candidate(0.0, scores[0]), comparison=seen)
    found = ladder.climb_unoccluded(replace(PROBLEM, photo=whole), start, ALONE)
    assert made == ["masked" if is_masked else whole] * rounds
    assert found.unoccluded.photo == made[-1]
    assert (place(found.pose), found.score) == (end, scores[end])


@pytest.fixture(scope="module")
def settled():
    """A problem, a candidate near the true pose, and that at rest."""
    problem = _problem(1)
    start = examine(problem, step(rooms.scene(1)[2], np.array([0, 0, 0, 0.02, 0.01, 0.0])))
    return problem, start, ladder.settle(problem, start, ALONE)


@pytest.mark.parametrize(("share", "is_taken"), [(0.5, True), (0.89, True), (0.91, True), (1.12, False)])
def test_full_resolution_is_taken_back_where_the_score_falls(settled, share, is_taken):
    """By a tenth at most may it fall, in exchange for millimetres."""
    problem, start, rest = settled
    before = replace(start, score=share * rest.score)
    end = ladder.settle(problem, before, ALONE)
    if is_taken:
        assert (end.pose.key, end.score) == (rest.pose.key, rest.score)
    else:
        assert (end.pose, end.score) == (start.pose, before.score)


def test_points_are_taken_again_from_where_the_pose_is_until_it_hardly_moves(settled):
    problem, start, _ = settled
    places = []

    def points(place, *shown):
        places.append(place)
        return problem.views.points(place, *shown)

    views = SimpleNamespace(points=points, averages=problem.views.averages)
    asked = replace(problem, views=views)
    shown = ladder.mask_occluders(problem, start.comparison)
    begin = replace(start, unoccluded=shown)
    near = ladder.converge(asked, begin, LAST._replace(rounds=Rounds(6, np.inf)), ALONE)
    assert places == [round_position(start.pose)]
    places.clear()
    ladder.converge(asked, begin, LAST._replace(rounds=Rounds(6, 0.0)), ALONE)
    assert places[:2] == [round_position(start.pose), round_position(near.pose)]
    assert len(places) == 6
    assert (LAST.rounds, FULL.rounds) == ((6, 1e-4), (2, NEARLY))


def test_cells_and_points_are_those_that_the_photo_shows():
    """Cells around the camera that point where the photo has a picture; all, for a photo of a sphere."""
    whole = _problem(1)
    pose = at(0.0, 0.0, 70.0).pose
    is_hidden = ~(np.abs(np.arange(16) - 4) < 2) & np.ones((8, 1), bool)  # but a fifth, around the left
    narrow = whole.show(whole.photo.mask(is_hidden))
    grid = make_grid(VIEWS["points"].num_rings)
    azimuth = np.degrees(np.arctan2(*(grid.directions @ pose.R_cam_from_world.T).T[1::-1]))
    shown = narrow.photo.find_shown_cells(VIEWS["points"].num_rings, pose)
    assert whole.photo.find_shown_cells(VIEWS["points"].num_rings, pose).all()
    cone = narrow.photo.find_cone(VIEWS["points"].num_rings, pose)
    assert (grid.directions[shown] @ cone.axis > cone.cos_angle).all()
    assert (grid.directions @ cone.axis > cone.cos_angle).mean() < 0.8
    assert whole.photo.find_cone(VIEWS["points"].num_rings, pose) == EVERYWHERE
    is_inside = np.abs((azimuth - 78.75 + 180) % 360 - 180) < 33.75
    assert (shown == is_inside).mean() > 0.98
    cells, of_all = (problem.view_at(pose, "fine") for problem in (narrow, whole))
    np.testing.assert_array_equal(cells.weights, of_all.weights * shown)
    assert (of_all.weights[~shown] > 0.0).any()
    asked = replace(narrow, views=SimpleNamespace(points=lambda place, config, *shown: shown))
    assert asked.view_at(pose, "points") == (shown.tobytes(), cone, 30_000)


@pytest.mark.parametrize("view", ["middle", "fine"])
def test_cells_of_no_weight_are_left_out_of_a_part_of_the_sphere_and_change_no_score(view):
    whole = _problem(1)
    pose = rooms.scene(1)[2]
    is_hidden = ~(np.abs(np.arange(64) - 20) < 8) & np.ones((32, 1), bool)
    narrow = whole.show(whole.photo.mask(is_hidden))
    cells, blocks = ladder.see_cells(narrow, pose, view)
    of_all = narrow.view_at(pose, view)
    all_blocks = VIEWS[view].arrays.blocks
    assert (cells.weights > 0.0).all()
    assert len(cells.weights) == len(blocks) == np.count_nonzero(of_all.weights) < 0.4 * len(all_blocks)
    image = narrow.photo.image(view)
    some = ladder.score_on_cells(cells, blocks, image, pose).score
    every = ladder.score_on_cells(of_all, all_blocks, image, pose).score
    assert some == pytest.approx(every, rel=1e-6)
    assert len(ladder.see_cells(whole, pose, view)[1]) == len(all_blocks)


@pytest.mark.parametrize(("seed", "most"), [(1, 5e-5), (3, 5e-4), (4, 5e-5)])
def test_the_end_hardly_depends_on_where_the_descent_begins(seed, most):
    """Starts 5 mm apart end within 0.05 mm where the loss has one minimum; in noise it has several."""
    problem = _problem(seed)
    true_pose = rooms.scene(seed)[2]
    ends = [
        ladder.settle(problem, examine(problem, step(true_pose, np.array([0, 0, 0, *d]))), ALONE).pose
        for d in ([0.002, 0.001, 0.0], [-0.002, -0.001, 0.002])
    ]
    rooms.assert_near(*ends, most, 0.03)
    again = ladder.settle(problem, examine(problem, ends[0]), ALONE).pose
    assert rooms.errors(again, ends[0])[0] < 2e-5
    assert rooms.errors(ends[0], true_pose)[0] < 0.01


# Descents on cells


@functools.lru_cache
def _fine():
    true_pose = rooms.scene(1)[2]
    octree = rooms.scan_map(1).octree
    return rooms.view(octree, true_pose.center_world, VIEWS["fine"], ALL), true_pose


def test_descent_finds_the_true_pose_again():
    (cells, true_pose) = _fine()
    image = _problem(1).photo.images.fine()
    off = step(true_pose, np.array([0.03, -0.02, 0.04, 0.06, -0.05, 0.04]))
    pose = ladder.descend(cells, image, off, Limits(1.0, 30, 1e-5))
    assert rooms.errors(pose, true_pose)[0] < 0.01
    before, after = (ladder.score_on_cells(cells, FINE_BLOCKS, image, p).score for p in (off, pose))
    assert after > max(0.6, before)
    assert rooms.errors(ladder.descend(cells, image, off, Limits(1.0, 1, 1e-5)), true_pose)[0] > 0.01


def test_perturbed_descents_lead_out_of_a_place_a_quarter_of_a_metre_off():
    (_, true_pose) = _fine()
    images = _problem(1).photo.images
    off = step(true_pose, ladder.perturbations(METHOD, 1.0)[1])
    assert rooms.errors(off, true_pose)[0] > 0.2
    cells = rooms.view(rooms.scan_map(1).octree, off.center_world, VIEWS["fine"], ALL)
    stage = AROUND_MIDDLE._replace(view="fine")
    seen = cells, FINE_BLOCKS
    found, by_two = (ladder.descend_around(_problem(1), *seen, off, stage, Workers(n)) for n in (1, 2))
    assert (found.pose.key, found.score) == (by_two.pose.key, by_two.score)
    assert rooms.errors(found.pose, true_pose)[0] < 0.06
    expected = ladder.score_on_cells(cells, FINE_BLOCKS, images.middle(), found.pose)
    np.testing.assert_allclose(found.score, expected.score, atol=1e-5)


def test_starts_descend_on_their_candidates_views_as_one_does_alone():
    scan_map = rooms.scan_map(1)
    (_, true_pose) = _fine()
    image = _problem(1).photo.images.search()
    distance = np.linalg.norm(scan_map.centers - true_pose.center_world, axis=1)
    k, far = int(np.argmin(distance)), int(np.argmax(distance))
    candidate = np.array([k, far, k])
    R = true_pose.R_cam_from_world
    starts = Starts(np.stack([R] * 3), scan_map.centers[candidate], candidate)
    ends, scores = beam.descend_prepared(_problem(1), starts, SECOND, rooms.WORKERS)
    assert ends.candidate.tolist() == [k, k, far]  # the best first
    assert scores[0] == scores[1] > max(0.4, scores[2])
    (row,), views = scan_map.views.at(np.array([k]), Workers(1))
    offsets = (views.offsets[row] * views.offset_unit[row]).astype(np.float32)
    channels = views.features[row].astype(np.float32) / np.float32(63.75)
    weights = (views.is_seen[row] * make_grid(24).solid_angle).astype(np.float32)
    cells = Cells(offsets, channels, weights, scan_map.centers[k])
    center = scan_map.centers[k]
    alone = ladder.descend(cells, image, Pose(R, center), Limits(1.2, 12, 2e-3))
    np.testing.assert_allclose(ends.center_map[0], alone.center_world, atol=1e-4)
    np.testing.assert_allclose(ends.R_cam_from_map[0], alone.R_cam_from_world, atol=1e-4)
    assert rooms.errors(alone, true_pose)[0] < 0.1
