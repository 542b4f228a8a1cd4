"""Tables of walks, by hand."""

import dataclasses

import numpy as np
from poses import result

from piccolo.geometry.pose import Pose, exp_so3
from piccolo.scene import Query, Scene
from piccolo.walk.results import Alone, WalkFrame
from research.evaluation.query_result import (
    PAPER_THRESHOLDS,
    QueryResult,
    make_query_result,
    match_results,
)
from research.evaluation.tables import (
    alone_table,
    group_walks,
    walk_table,
)

RATE = 2.0


def walk_of(tmp_path, name="w", count=8, seed=0, bad=2):
    """Frames along a tilted path, in a shuffled order; the third, unless told otherwise, has no answer."""
    rng = np.random.default_rng(seed)
    queries = []
    for k in range(count):
        pose = Pose(exp_so3(rng.normal(size=3)), np.array([0.6 * k, 0.2 * k, 1.6]) + 0.1 * rng.normal(size=3))
        queries.append(Query(tmp_path / f"{name}_{k}.jpg", "clean", pose, None, (), name, k / RATE, k != bad))
    return [queries[k] for k in rng.permutation(count)]


def found(query, distance=0.02, angle_deg=1.0, status="localized"):
    """A result that is off by so much, in a direction of its own."""
    rng = np.random.default_rng(int(1000 * query.time))
    axis, away = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    turn = exp_so3(np.radians(angle_deg) * axis)
    pose = Pose(turn @ query.pose.R_cam_from_world, query.pose.center_world + distance * away)
    return result(query.image, None if status == "unreadable" else pose, status)


def frames_of(tmp_path, changes, alone=None, **more):
    """The frames of a walk whose results are changed by number; some have one alone too."""
    queries = walk_of(tmp_path, **more)
    scene = Scene("hall", tmp_path, tmp_path / "cloud.ply", tuple(queries))
    rows = []
    for query in queries:
        number = int(RATE * query.time)
        walk = WalkFrame(query.time, number, "tracked", (alone or {}).get(number), None)
        together = dataclasses.replace(found(query, **changes.get(number, {})), walk=walk)
        rows.append(make_query_result(scene, query, together, None))
    return group_walks([scene], rows)


def test_frames_of_a_video_are_those_of_the_walk_of_its_name(tmp_path):
    queries = [*walk_of(tmp_path), *walk_of(tmp_path, "other")]
    scene = Scene("hall", tmp_path, tmp_path / "cloud.ply", tuple(queries))
    told = []

    def matched(pano):
        return [row.image for row in match_results([scene], [result(pano, None)], told.append)]

    assert matched("videos/w.mp4#t=1.500") == ["w_3.jpg"]
    assert matched("other.mp4#t=0.000") == ["other_0.jpg"]
    for pano in ("w.mp4#t=1.510", "x.mp4#t=1.500", "w.mp4#t=99.000"):
        assert matched(pano) == []
        assert told.pop().startswith(f"{pano}: found a result without a true pose, wanted")


def test_walk_counts_what_is_right_sure_wrong_and_refused(tmp_path):
    changes = {
        0: {"status": "not_localized", "distance": 2.0},
        1: {"status": "ambiguous"},  # right, not sure
        2: {"status": "unreadable"},  # has no answer
        4: {"distance": 0.5},  # sure and wrong
        6: {"angle_deg": 9.0},  # sure and wrong too
    }
    table = walk_table(frames_of(tmp_path, changes), PAPER_THRESHOLDS)
    assert table.columns == ("walk", "frames", "correct", "localized", "wrong of all", "bad refused")
    assert table.rows == (("hall w", "8", "0.571", "0.714", "2", "1 of 1"),)


def test_a_bad_frame_that_is_called_localized_is_wrong(tmp_path):
    """Even where it happens to be at the camera."""
    walks = frames_of(tmp_path, {2: {"distance": 0.0, "angle_deg": 0.0}})
    assert walk_table(walks, PAPER_THRESHOLDS).rows == (("hall w", "8", "1.000", "1.000", "1", "0 of 1"),)


def test_walks_are_summed_up(tmp_path):
    first = frames_of(tmp_path, {}, name="a", seed=1, bad=None)
    second = frames_of(tmp_path, {0: {"status": "ambiguous"}}, name="b", seed=2, count=5)
    lost = frames_of(tmp_path, {k: {"status": "unreadable"} for k in range(4)}, name="c", count=4)
    assert walk_table(first | second | lost, PAPER_THRESHOLDS).rows == (
        ("hall a", "8", "1.000", "1.000", "0", "-"),
        ("hall b", "5", "1.000", "0.750", "1", "0 of 1"),
        ("hall c", "4", "0.000", "0.000", "0", "1 of 1"),
        ("all", "17", "0.800", "0.733", "1", "1 of 2"),
    )


def test_a_photo_without_an_answer_has_no_errors_and_is_read_back_without(tmp_path):
    query = dataclasses.replace(walk_of(tmp_path)[0], is_answerable=False)
    scene = Scene("hall", tmp_path, tmp_path / "cloud.ply", (query,))
    row = make_query_result(scene, query, found(query), None)
    again = QueryResult.from_json(row.to_json())
    assert not row.is_correct()
    assert (again.position_error, again.rotation_error) == (np.inf, np.inf)
    assert again.result.best_pose is not None
    assert not again.has_errors


def test_frames_alone_and_together_are_counted_side_by_side(tmp_path):
    """Of three searched alone, one was sure and wrong, and is right with the others."""
    poses = {query.time * RATE: query.pose for query in walk_of(tmp_path)}
    alone = {
        0: Alone("localized", 0.95, poses[0]),
        1: Alone("localized", 0.93, poses[0]),
        3: Alone("ambiguous", 0.5, poses[3]),
    }
    ((name, frames),) = frames_of(tmp_path, {}, alone).items()
    table = alone_table({name: frames}, PAPER_THRESHOLDS)
    assert table.columns[2:5] == ("correct alone", "localized alone", "wrong alone")
    assert table.rows == (("hall w", "3", "2", "2", "1", "3", "3", "0"),)
    assert alone_table({name: [f._replace(alone=None) for f in frames]}, PAPER_THRESHOLDS).rows[0][2] == "-"
