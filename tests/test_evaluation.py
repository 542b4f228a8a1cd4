"""Errors, statistics, tables, plots and comparisons of an evaluation, and tables of its walks."""

import csv
import dataclasses
import io

import cv2
import numpy as np
import pytest
from poses import result
from refusals import assert_input_error, assert_refused

from piccolo.geometry.nearness import RIGHT
from piccolo.geometry.pose import Pose, exp_so3
from piccolo.judge.result_parts import Alone, WalkFrame
from piccolo.system.errors import InputError
from research.evaluation import tables
from research.evaluation.query_result import (
    PAPER_THRESHOLDS,
    QueryResult,
    Thresholds,
    make_query_result,
    match_results,
    read_run,
)
from research.evaluation.tables import (
    alone_table,
    errors_figure,
    figure_png,
    group_walks,
    risk_figure,
    walk_table,
)
from research.scene import Query, Scene

pytestmark = pytest.mark.research

TRUE_POSE = Pose(exp_so3(np.array([0.4, 0.1, -2.0])), np.array([10.0, -4.0, 1.5]))


def _pose(distance, angle_deg):
    """A pose that is off by so much."""
    turn = exp_so3(np.radians(angle_deg) * np.array([0.0, 0.6, 0.8]))
    center = TRUE_POSE.center_world + distance * np.array([0.8, 0.6, 0])
    return Pose(turn @ TRUE_POSE.R_cam_from_world, center)


def _scene(tmp_path, names=("a.jpg", "b.jpg"), name="room"):
    queries = tuple(Query(tmp_path / name / "images" / n, "clean", TRUE_POSE) for n in names)
    return Scene(name, tmp_path / name, tmp_path / name / "cloud.ply", queries)


def _row(image, distance, angle_deg, **more):
    kind = {"scene": "room", "variant": "clean", "is_in_box": True} | more
    status, confidence = kind.pop("status", "localized"), kind.pop("confidence", 0.95)
    has_pose = np.isfinite(distance)
    found = result(image, _pose(distance, angle_deg) if has_pose else None, status, confidence=confidence)
    where = kind["scene"], image, kind["variant"], kind["is_in_box"]
    return QueryResult(*where, TRUE_POSE, found)


ROWS = [
    _row("a.jpg", 0.01, 0.2),
    _row("b.jpg", 0.03, 0.4, variant="photo", status="ambiguous", confidence=0.5),
    _row("c.jpg", 0.09, 6.0, scene="hall"),
    _row("d.jpg", np.inf, np.inf, scene="hall", status="not_localized", confidence=0.0, is_in_box=False),
]


def test_errors_of_a_query_and_the_thresholds_of_the_paper(tmp_path):
    scene = _scene(tmp_path)
    row = make_query_result(scene, scene.queries[0], result("a.jpg", _pose(0.05, 3.0)), True)
    assert row.position_error == pytest.approx(0.05)
    assert np.degrees(row.rotation_error) == pytest.approx(3.0)
    assert (row.scene, row.image, row.variant) == ("room", "images/a.jpg", "clean")
    assert row.is_correct()
    assert not row.is_correct(Thresholds(max_distance=0.04))
    assert not row.is_correct(Thresholds(max_angle=np.radians(2.0)))
    poses = _pose(0.09, 4.9), _pose(0.11, 0.0), _pose(0.0, 5.1)
    assert [RIGHT.holds(pose, TRUE_POSE) for pose in poses] == [True, False, False]


@pytest.mark.parametrize("row", ROWS)
def test_a_query_result_comes_back(row):
    back = QueryResult.from_json(row.to_json())
    assert back.to_json() == row.to_json()
    assert back.rotation_error == pytest.approx(row.rotation_error, abs=1e-15)


@pytest.mark.parametrize("text", ["", "{}", "[]", '{"format": "piccolo-pose/2"}'])
def test_what_is_no_query_result_is_refused(text):
    assert_input_error("evaluation: found", QueryResult.from_json, text)


def test_results_find_their_queries_by_path_then_by_name(tmp_path):
    first, second = _scene(tmp_path), _scene(tmp_path, ("a.jpg", "c.jpg"), "hall")
    scenes = [first, second]
    by_path = result(str(tmp_path / "hall" / "images" / "a.jpg"), _pose(0.0, 0.0))
    by_name = result("elsewhere/c.jpg", _pose(0.0, 0.0))
    rows = list(match_results(scenes, [by_path, by_name], pytest.fail))
    assert [row.key for row in rows] == [("hall", "images/a.jpg"), ("hall", "images/c.jpg")]
    with pytest.raises(InputError, match="found a second result of this panorama"):
        list(match_results(scenes, [by_path, by_path], pytest.fail))
    told = []
    strange = [result("a.jpg", None), result(f"{'x' * 5000}.jpg", None)]
    assert len(list(match_results(scenes, [*strange, by_path], told.append))) == 1
    assert told[0].startswith("a.jpg: found 2 queries of this name")
    assert len(told) == 2


def test_summary_accuracies_and_quartiles_of_errors_some_of_which_are_infinite():
    assert tables.quartiles([1.0, 2.0, 3.0, 4.0, np.inf]).tolist() == [2.0, 3.0, 4.0]
    assert tables.quartiles([1.0, np.inf]).tolist() == [np.inf] * 3
    assert tables.quartiles([1.0, 1.0, 1.0, np.inf]).tolist() == [1.0, 1.0, np.inf]
    found = tables.statistics(ROWS)
    assert [found[name] for name in ("number", "correct", "localized")] == ["4", "2", "2"]
    assert (found["wrong of these"], found["accuracy"]) == ("1", "0.500")
    assert found["t 50 % [m]"] == "0.0600"


def test_risk_over_coverage():
    errors = {"a": (0.9, 0.0), "b": (0.5, 1.0), "c": (0.95, 0.0), "d": (0.5, 0.0)}
    rows = [_row(name, error, 0.0, confidence=sure) for name, (sure, error) in errors.items()]
    points = tables.risk_and_coverage(rows)
    found = [(p.confidence, p.coverage, p.num_wrong) for p in points]
    assert found == [(0.95, 0.25, 0), (0.9, 0.5, 0), (0.5, 1.0, 1)]
    assert points[-1].risk == 0.25
    text = tables.risk_table(points).markdown()
    assert "| 0.9 | 50.0 % | 0 | 0.00 % |" in text
    assert "| 0.0 | 100.0 % | 1 | 25.00 % |" in text


def test_tables_have_a_line_a_split_a_room_and_all():
    text = tables.summary_table(ROWS, PAPER_THRESHOLDS, "all 4 queries").markdown()
    assert text.startswith("all 4 queries; correct: under 0.1 m and 5 deg\n\n| queries | number |")
    names = [line.split(" | ")[0] for line in text.splitlines()[4:]]
    assert names == ["| clean", "| photo", "| hall", "| room", "| all"]
    assert text.splitlines()[7].startswith("| room | 2 | 2 | 1.000 | 0.0150 | 0.0200 | 0.0250 | 0.250 | 0.3")
    for angle_deg, line in (
        (5.0, "| all | 0.250 | 0.500 | 0.500 |"),
        (10.0, "| all | 0.250 | 0.500 | 0.750 |"),
    ):
        assert line in tables.threshold_table(ROWS, Thresholds(max_angle=np.radians(angle_deg))).markdown()
    assert "| hall | d.jpg | not_localized | inf | inf | 0.000 |" in tables.per_query(ROWS).markdown()


def test_csv_has_base_units_and_blanks_where_there_is_no_pose():
    lines = list(csv.DictReader(io.StringIO(tables.csv_text(ROWS))))
    assert [line["image"] for line in lines] == ["a.jpg", "b.jpg", "c.jpg", "d.jpg"]
    assert float(lines[2]["position_error_m"]) == pytest.approx(0.09)
    assert float(lines[2]["rotation_error_deg"]) == pytest.approx(6.0)
    assert (lines[3]["position_error_m"], lines[3]["is_in_box"]) == ("", "false")


def _curves(axes):
    """Label, x and y of each curve, without the far ends; the vertical line of a threshold has x alone."""
    curves = [(line.get_label(), *np.transpose(line.get_xydata()[1:-1])) for line in axes.get_lines()]
    return [(label, *(np.round(v, 6).tolist() for v in xy)) for label, *xy in curves if len(xy) == 2]


def test_plots_show_the_errors_and_risk_over_coverage():
    figure = errors_figure({"one": ROWS, "two": ROWS[:2]}, PAPER_THRESHOLDS)
    position, rotation, recall = figure.axes
    distances = [0.01, 0.03, 0.09], [25.0, 50.0, 75.0]  # the fourth has no pose
    assert _curves(position)[:2] == [("one", *distances), ("two", distances[0][:2], [50.0, 100.0])]
    assert _curves(rotation)[0] == ("one", [0.2, 0.4, 6.0], distances[1])
    assert _curves(recall)[1] == ("one, under 5 deg", distances[0][:2], distances[1][:2])
    assert [axes.get_lines()[-1].get_xdata()[0] for axes in figure.axes] == [0.1, 5.0, 0.1]
    image = cv2.imdecode(np.frombuffer(figure_png(figure), np.uint8), cv2.IMREAD_COLOR)
    assert image.shape == (504, 1680, 3)
    assert (image != 255).any(axis=2).mean() > 0.02  # ink
    (axes,) = risk_figure(tables.risk_and_coverage(ROWS)).axes
    curve, *marks = axes.get_lines()
    expected = [[0.0, 50.0], [50.0, 50.0], [75.0, 100 / 3], [100.0, 50.0]]
    np.testing.assert_allclose(curve.get_xydata(), expected)
    assert [mark.get_label() for mark in marks] == ["confidence 0.9", "confidence 0.5"]
    np.testing.assert_allclose([mark.get_xydata()[0] for mark in marks], expected[1:3])


def test_two_runs_side_by_side():
    second = [_row("a.jpg", 0.01, 0.2), _row("b.jpg", 0.5, 0.4, variant="photo"), ROWS[2]]
    pairs = tables.pair_up(ROWS, second)
    assert [first.image for first, _ in pairs] == ["c.jpg", "a.jpg", "b.jpg"]
    table = tables.side_by_side(pairs, ("old", "new"), PAPER_THRESHOLDS)
    columns = ("run", "number", "correct", "accuracy", "localized", "wrong of these")
    lines = [dict(zip(table.columns, row, strict=True)) for row in table.rows]
    assert [[line[name] for name in columns] for line in lines] == [
        ["old", "3", "2", "0.667", "2", "1"],
        ["new", "3", "1", "0.333", "3", "2"],
    ]
    changed = tables.changes(pairs, PAPER_THRESHOLDS).markdown().splitlines()[4:]
    change = "ambiguous 0.50: 0.030 m, 0.40 deg | localized 0.95: 0.500 m, 0.40 deg"
    assert changed == [f"| room | b.jpg | worse | {change} |"]


def test_a_run_is_resumed_after_its_last_whole_line(tmp_path):
    path = tmp_path / "run.jsonl"
    path.write_text("".join(row.to_json() + "\n" for row in ROWS[:2]) + ROWS[2].to_json()[:50])
    rows, size = read_run(path)
    assert len(rows) == 2
    assert path.read_bytes()[size:] == ROWS[2].to_json()[:50].encode()
    path.write_text('{"my": "notes"}')
    assert_refused("its last line does not belong to a run of tools/evaluate.py", read_run, path)
    path.write_text("{}\n")
    assert_refused(r"run\.jsonl, line 1: evaluation: found", read_run, path)


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


def test_walks_are_summed_up_and_a_bad_frame_that_is_called_localized_is_wrong(tmp_path):
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
