"""Descents on the views of a room, and decisions of the refinement, each in a made-up case."""

import collections
import functools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import rooms
from made_up import QUERY, VIEWS, at, place
from piccolo.localization.query import Cache

from piccolo.confidence.alternatives import Hypothesis
from piccolo.evidence.comparison import CONTRADICTS, Comparison
from piccolo.geometry.cone import EVERYWHERE
from piccolo.geometry.nearness import Nearness
from piccolo.geometry.pose import Pose, step
from piccolo.geometry.sphere import make_grid
from piccolo.jobs.threads import Workers
from piccolo.localization import beam, ladder, query as query_module, settings
from piccolo.localization.beam import Ends, best_and_alternatives, narrow
from piccolo.localization.ladder import AROUND_MIDDLE, FINE, SECOND, Limits
from piccolo.localization.search import Starts
from piccolo.views.view import Cells

FINE_BLOCKS = settings.VIEWS["fine"].arrays.blocks
ALL = np.ones(len(FINE_BLOCKS), bool)


def _fit(x, score, yaw_deg=0.0):
    return at(x, score, yaw_deg)


def _asked(is_partial=False):
    """A query whose images are their names, of a photo that shows all cells."""
    photo = SimpleNamespace(
        image=lambda name: name,
        find_shown_cells=lambda *_: np.ones(3),
        find_cone=lambda *_: EVERYWHERE,
        is_partial=is_partial,
    )
    return replace(QUERY, photo=photo, cache=Cache(VIEWS))


@functools.lru_cache
def _query(seed):
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
    found = beam.keep_comparable([_fit(k, score) for k, score in enumerate(scores)])
    assert sorted((h.score for h in found), reverse=True) == kept


# The beam


def test_a_quarter_of_the_beam_is_for_the_best_that_lie_far_apart():
    """Twenty poses in a row 0.2 m apart, and behind them two at other places."""
    x = np.concatenate([0.2 * np.arange(20), [50.0, 60.0]])
    rotations, centers = np.repeat(np.eye(3)[None], 22, axis=0), np.outer(x, [1.0, 0, 0])
    near = Nearness(0.15, 0.1)
    kept = best_and_alternatives(rotations, centers, 8, near)
    assert kept.tolist() == [0, 1, 2, 3, 4, 5, 6, 9]  # six near ones; of those half a metre apart, two more
    few = np.concatenate([np.arange(6), [20, 21]])
    assert best_and_alternatives(rotations[few], centers[few], 6, near).tolist() == [0, 1, 2, 3, 4, 6]
    kept = best_and_alternatives(rotations, centers, 8, near._replace(distance=0.3))
    assert kept.tolist() == [0, 2, 3, 4, 6, 8, 9, 10]


def test_narrow_ranks_poses_first():
    close = [_fit(0.0, 0.5), _fit(0.05, 0.9), _fit(3.0, 0.1), _fit(5.0, 0.7)]
    assert [place(pose) for pose in narrow(close, 4)] == [0.05, 5.0, 3.0]
    assert [place(pose) for pose in narrow(close, 1)] == [0.05]
    turned = [_fit(0.0, 0.9), _fit(0.09, 0.8), _fit(0.11, 0.7), _fit(0.0, 0.6, 4.9), _fit(0.0, 0.5, 5.1)]
    assert narrow(turned, 8) == [turned[k].pose for k in (0, 2, 4)]


@pytest.mark.parametrize(("is_partial", "first"), [(False, 5), (True, 12)])
def test_the_beam_narrows_from_stage_to_stage(monkeypatch, is_partial, first):
    """From 500 starts to 400, 48 and 8 poses, of which two are perturbed for as long as that helps.

    The first descents of a photo of a part of the sphere are as long as the second.
    """
    made, descents = collections.Counter(), []

    def descend_prepared(query, starts, stage):
        descents.append((stage.limits.num_iterations, len(starts.candidate)))
        return Ends(starts, None)

    def done(name, query, found, first=None):
        made[first or name] += 1
        pose = getattr(found, "pose", found)
        return Hypothesis(pose, 0.1 - 1e-5 * place(pose))

    monkeypatch.setattr(beam, "descend_prepared", descend_prepared)
    for name in ("refine", "climb", "score_pose"):
        monkeypatch.setattr(beam, name, functools.partial(done, name))
    centers = np.outer(np.arange(500), [1.0, 0.0, 0.0])
    starts = Starts(np.repeat(np.eye(3)[None], 500, axis=0), centers, np.arange(500))
    found = beam.refine_starts(_asked(is_partial), starts, settings.WHOLE_BEAM)
    assert descents == [(first, 500), (12, 400)]
    assert list(made.values()) == [48, 8, 8, 2, 12]
    assert [place(h.pose) for h in found] == list(range(12))


# Perturbations and the last millimetres


@pytest.mark.parametrize(
    ("gains", "rounds", "expected"),
    [([0.2, 0.02, 0.005, 1], 3, 0.725), ([0.1] * 9, 5, 1.0), ([-0.3, 0.5], 1, 0.5), ([0.1, -0.1, 1], 2, 0.6)],
)
def test_poses_are_perturbed_for_as_long_as_that_helps(monkeypatch, gains, rounds, expected):
    left, sizes = list(gains), []

    def around(query, cells, pose, stage):
        sizes.append(stage.around.size)
        assert (stage.around.image, stage.image) == ("middle", "fine")
        return Hypothesis(pose, score[0])

    def fine(query, pose, stage):
        assert stage is FINE
        score[0] += left.pop(0)
        return Hypothesis(pose, score[0])

    score = [0.5]
    monkeypatch.setattr(query_module, "normalize_view", lambda *_: None)
    monkeypatch.setattr(ladder, "score_on_cells", lambda *_: _fit(0.0, 0.5))  # whatever another view said
    monkeypatch.setattr(ladder, "descend_around", around)
    monkeypatch.setattr(ladder, "refine", fine)
    query = _asked()
    found = ladder.climb(query, _fit(0.0, 0.9))
    assert found.score == pytest.approx(expected)
    assert sizes == [0.4] * rounds
    again = Hypothesis(found.pose, 0.3)
    assert ladder.climb(query, again) is again
    assert sizes == [0.4] * rounds


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
    query, masked, made = _asked(), _asked(), []
    correlation = np.array([0.9, CONTRADICTS - 0.01 if is_masked else 0.9])
    seen = Comparison(correlation, np.ones(2), np.ones(2), 2.0)
    monkeypatch.setattr(ladder, "score_pose", lambda query, pose: at(place(pose), scores[int(place(pose))]))
    monkeypatch.setattr(ladder, "compare", lambda query, pose: seen)
    monkeypatch.setattr(ladder, "mask_occluders", lambda query, seen: masked if is_masked else query)

    def refine(shown, pose, *stages):
        assert stages == (AROUND_MIDDLE, FINE)
        made.append(shown)
        return Hypothesis(pose, 0.0)

    def climb(shown, start):
        made.append(shown)
        return at(place(start.pose) + 1, 0)

    monkeypatch.setattr(ladder, "refine", refine)
    monkeypatch.setattr(ladder, "climb", climb)
    shown, found = ladder.climb_unoccluded(query, at(0.0, 0.0).pose)
    assert made == ([masked] * 2 * rounds if is_masked else [query])
    assert shown is made[-1]
    assert (place(found.pose), found.score) == (end, scores[end])


@pytest.mark.parametrize(("after", "is_taken"), [(0.60, True), (0.475, True), (0.46, False), (0.1, False)])
def test_full_resolution_is_taken_back_where_the_score_falls(monkeypatch, after, is_taken):
    """By a tenth at most may it fall, in exchange for millimetres."""
    moved, start = at(0.04, after), at(0.0, 0.52)
    asked = []
    clear = Comparison(np.ones(1), np.ones(1), np.ones(1), 1.0)
    monkeypatch.setattr(ladder, "climb_unoccluded", lambda query, pose: (query, start))
    monkeypatch.setattr(ladder, "compare", lambda query, pose: clear)
    monkeypatch.setattr(ladder, "score_pose", lambda query, pose: Hypothesis(pose, after))
    monkeypatch.setattr(type(QUERY), "view_at", lambda query, pose, name: asked.append((place(pose), name)))
    monkeypatch.setattr(ladder, "descend", lambda *_: moved.pose)
    expected = moved if is_taken else start
    query = _asked()
    assert ladder.climb_to_full(query, start.pose) == expected
    assert asked == [(0.0, "points"), (0.04, "points")]  # they are taken again from where the pose is
    assert ladder.settle(query, start) == expected
    assert len(asked) == 4  # the second round of settling moves nothing
    monkeypatch.setattr(ladder, "descend", lambda *_: at(len(asked), 0.0).pose)
    ladder.settle(query, start)
    assert len(asked) == 10  # six rounds at most
    monkeypatch.setattr(ladder, "descend", lambda *_: at(0.019, 0.0).pose)
    ladder.climb_to_full(query, start.pose)
    assert len(asked) == 11  # so near by it sees the same points


def test_cells_and_points_are_those_that_the_photo_shows(monkeypatch):
    """Cells around the camera that point where the photo has a picture; all, for a photo of a sphere."""
    whole, pose = _query(1), at(0.0, 0.0, 70.0).pose
    is_hidden = ~(np.abs(np.arange(16) - 4) < 2) & np.ones((8, 1), bool)  # but a fifth, around the left
    narrow = whole.mask(is_hidden)
    grid = make_grid(settings.VIEWS["points"].num_rings)
    azimuth = np.degrees(np.arctan2(*(grid.directions @ pose.R_cam_from_world.T).T[1::-1]))
    shown = narrow.photo.find_shown_cells(settings.VIEWS["points"].num_rings, pose)
    assert whole.photo.find_shown_cells(settings.VIEWS["points"].num_rings, pose).all()
    cone = narrow.photo.find_cone(settings.VIEWS["points"].num_rings, pose)
    assert (grid.directions[shown] @ cone.axis > cone.cos_angle).all()
    assert (grid.directions @ cone.axis > cone.cos_angle).mean() < 0.8
    assert whole.photo.find_cone(settings.VIEWS["points"].num_rings, pose) == EVERYWHERE
    is_inside = np.abs((azimuth - 78.75 + 180) % 360 - 180) < 33.75
    assert (shown == is_inside).mean() > 0.98
    monkeypatch.setattr(query_module, "normalize_view", lambda sums, center, config, shown: shown)
    views = SimpleNamespace(averages=lambda *_: None, points=lambda place, config, *shown: shown)
    asked = replace(narrow, cache=Cache(views))
    assert (asked.view_at(pose, "fine") == shown).all()
    assert asked.view_at(pose, "points") == (shown.tobytes(), cone, 30_000)


@pytest.mark.parametrize(("seed", "most"), [(1, 5e-5), (3, 5e-4), (4, 5e-5)])
def test_the_end_hardly_depends_on_where_the_descent_begins(seed, most):
    """Starts 5 mm apart end within 0.05 mm where the loss has one minimum; in noise it has several."""
    query, true_pose = _query(seed), rooms.scene(seed)[2]
    ends = [
        ladder.settle(query, Hypothesis(step(true_pose, np.array([0, 0, 0, *d])), 0.0)).pose
        for d in ([0.002, 0.001, 0.0], [-0.002, -0.001, 0.002])
    ]
    rooms.assert_near(*ends, most, 0.03)
    again = ladder.settle(query, Hypothesis(ends[0], 0.0)).pose
    assert rooms.errors(again, ends[0])[0] < 2e-5
    assert rooms.errors(ends[0], true_pose)[0] < 0.01


# Descents on cells


@functools.lru_cache
def _fine():
    true_pose = rooms.scene(1)[2]
    octree = rooms.scan_map(1).octree
    return rooms.view(octree, true_pose.center_world, settings.VIEWS["fine"], ALL), true_pose


def test_descent_finds_the_true_pose_again():
    (cells, true_pose), image = _fine(), _query(1).photo.images.fine()
    off = step(true_pose, np.array([0.03, -0.02, 0.04, 0.06, -0.05, 0.04]))
    pose = ladder.descend(cells, image, off, Limits(1.0, 30, 1e-5))
    assert rooms.errors(pose, true_pose)[0] < 0.01
    before, after = (ladder.score_on_cells(cells, FINE_BLOCKS, image, p).score for p in (off, pose))
    assert after > max(0.6, before)
    assert rooms.errors(ladder.descend(cells, image, off, Limits(1.0, 1, 1e-5)), true_pose)[0] > 0.01


def test_perturbed_descents_lead_out_of_a_place_a_quarter_of_a_metre_off():
    (_, true_pose), images = _fine(), _query(1).photo.images
    off = step(true_pose, ladder.perturbations(1.0)[1])
    assert rooms.errors(off, true_pose)[0] > 0.2
    cells = rooms.view(rooms.scan_map(1).octree, off.center_world, settings.VIEWS["fine"], ALL)
    stage = AROUND_MIDDLE._replace(view="fine")
    queries = (replace(_query(1), workers=Workers(n)) for n in (1, 2))
    found, by_two = (ladder.descend_around(query, cells, off, stage) for query in queries)
    assert (found.pose.key, found.score) == (by_two.pose.key, by_two.score)
    assert rooms.errors(found.pose, true_pose)[0] < 0.06
    expected = ladder.score_on_cells(cells, FINE_BLOCKS, images.middle(), found.pose)
    np.testing.assert_allclose(found.score, expected.score, atol=1e-5)


def test_starts_descend_on_their_candidates_views_as_one_does_alone():
    scan_map, (_, true_pose), image = rooms.scan_map(1), _fine(), _query(1).photo.images.search()
    distance = np.linalg.norm(scan_map.centers - true_pose.center_world, axis=1)
    k, far = int(np.argmin(distance)), int(np.argmax(distance))
    candidate, R = np.array([k, far, k]), true_pose.R_cam_from_world
    starts = Starts(np.stack([R] * 3), scan_map.centers[candidate], candidate)
    ends, scores = beam.descend_prepared(_query(1), starts, SECOND)
    assert ends.candidate.tolist() == [k, k, far]  # the best first
    assert scores[0] == scores[1] > max(0.4, scores[2])
    (row,), views = scan_map.views.at(np.array([k]), Workers(1))
    offsets = (views.offsets[row] * views.offset_unit[row]).astype(np.float32)
    channels = views.features[row].astype(np.float32) / np.float32(63.75)
    weights = (views.is_seen[row] * make_grid(24).solid_angle).astype(np.float32)
    cells, center = Cells(offsets, channels, weights, scan_map.centers[k]), scan_map.centers[k]
    alone = ladder.descend(cells, image, Pose(R, center), Limits(1.2, 12, 2e-3))
    np.testing.assert_allclose(ends.center_map[0], alone.center_world, atol=1e-4)
    np.testing.assert_allclose(ends.R_cam_from_map[0], alone.R_cam_from_world, atol=1e-4)
    assert rooms.errors(alone, true_pose)[0] < 0.1
