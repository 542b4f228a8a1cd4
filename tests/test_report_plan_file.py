"""Plans without a browser: what other programs read from the PNG, SVG and DXF."""

import json
import math
from xml.etree import ElementTree

import cv2
import ezdxf
import numpy as np
import pytest
from refusals import assert_input_error
from report_scenes import HOSTILE, House, lifted

from piccolo.apps.report import report
from piccolo.apps.report.drawings import PIXEL, plan_matrix, read_control_points
from piccolo.apps.report.plan_file import COLORS, DPI, color_of, segments_of
from piccolo.system.errors import InputError

TIER = "scene"

SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture(scope="module")
def house(tmp_path_factory):
    """Three photos on two storeys, of which only the results are looked at."""
    house = House(tmp_path_factory.mktemp("house"), 128)
    house.write_cloud()
    house.add(0, "a.jpg")
    house.add(1, HOSTILE[0], status="not_localized")
    house.add(2, "c.jpg", status="ambiguous")
    house.add(3, status="unreadable")
    house.write_results()
    return house


def _plan(house, out, *more):
    words = ["--results", str(house.folder / "poses.jsonl"), "--cloud", str(house.cloud), "--quiet"]
    assert report.main([*words, "--plan", str(out), *more]) == 0
    return out


def test_dxf_has_the_positions_in_world_coordinates_a_layer_a_storey(house, tmp_path):
    out = _plan(house, tmp_path / "p.dxf", "--storeys", "Ground/floor", "First floor")
    space = ezdxf.readfile(out).modelspace()
    points = {point.dxf.layer: [] for point in space.query("POINT")}
    for point in space.query("POINT"):
        points[point.dxf.layer].append(tuple(point.dxf.location))
    below, above = points["PHOTOS 1 Ground_floor"], points["PHOTOS 2 First floor"]
    expected = [house.pose(index)[2].center_world for index in (0, 2)]
    np.testing.assert_allclose(below, expected, atol=1e-6)
    np.testing.assert_allclose(above, [lifted(house.pose(1)[2], 1).center_world], atol=1e-6)
    line = space.query("LINE").first
    ahead = np.array(line.dxf.end - line.dxf.start)
    np.testing.assert_allclose(ahead, 0.5 * house.pose(0)[2].R_cam_from_world[0], atol=1e-3)
    assert {text.dxf.text for text in space.query("TEXT")} >= {"a.jpg", "c.jpg"}
    ellipse = space.query("ELLIPSE").first
    assert ellipse.dxf.major_axis.magnitude == pytest.approx(2e-3 * math.sqrt(5.991), rel=1e-3)


def test_svg_has_the_plans_and_marks_where_the_cameras_are(house, tmp_path):
    names = "Ground floor", "First floor"
    root = ElementTree.fromstring(_plan(house, tmp_path / "p.svg", "--storeys", *names).read_bytes())
    assert {text.text for text in root.iter(f"{SVG}text")} >= {*names, "1", "2", "3"}
    assert len(list(root.iter(f"{SVG}image"))) == 2
    marks = {group.get("id"): group for group in root.iter(f"{SVG}g")}
    assert {"a.jpg", "c.jpg", HOSTILE[0]} <= set(marks)
    uses = [next(marks[name].iter(f"{SVG}use")) for name in ("a.jpg", "c.jpg")]
    at = np.array([[float(use.get(axis)) for axis in "xy"] for use in uses])
    moved = np.diff([house.pose(index)[2].center_world[:2] for index in (0, 2)], axis=0)
    np.testing.assert_allclose(np.diff(at, axis=0) * PIXEL * DPI / 72.0 * [1, -1], moved, atol=1e-3)


def test_pdf_is_vectors(house, tmp_path):
    content = _plan(house, tmp_path / "p.pdf").read_bytes()
    assert content.startswith(b"%PDF")
    assert content == _plan(house, tmp_path / "p.pdf").read_bytes()


def test_png_shows_each_photo_in_the_color_of_its_status(house, tmp_path):
    sheet = cv2.imread(str(_plan(house, tmp_path / "p.png"))).astype(int)
    for status, color in COLORS.items():
        is_there = (np.abs(sheet - color[::-1]).max(axis=2) < 3).astype(np.uint8)
        assert is_there.sum() > 40
        assert cv2.erode(is_there, np.ones((9, 9))).any() == (status == "localized")  # a guess is hollow


@pytest.fixture(scope="module")
def walked(tmp_path_factory):
    """A walk of seven frames, with a gap before the fifth; the last but one is not very sure."""
    house = House(tmp_path_factory.mktemp("walked"), 128)
    house.write_cloud()
    lines = [json.loads(line) for line in house.add_walk(7)]
    lines[5]["confidence"] = 0.6
    house.write_results(lines=[json.dumps(line) for line in lines])
    return house


def test_a_walk_is_a_path_in_the_colors_of_its_confidence(walked, tmp_path):
    root = ElementTree.fromstring(_plan(walked, tmp_path / "p.svg").read_bytes())
    sure, unsure = ("#{:02x}{:02x}{:02x}".format(*color_of(confidence)) for confidence in (0.995, 0.6))
    styles = [path.get("style") or "" for path in root.iter(f"{SVG}path")]
    lines = [style for style in styles if sure in style or unsure in style]
    assert [unsure in line for line in lines] == [False] * 4 + [True] * 2
    assert ["stroke-dasharray" in line for line in lines] == [k == 3 for k in range(6)]
    texts = [text.text for text in root.iter(f"{SVG}text")]
    assert {"1", "0.5", "confidence"} <= set(texts)
    assert "2" not in texts
    sheet = cv2.imread(str(_plan(walked, tmp_path / "p.png"))).astype(int)
    for confidence in (0.995, 0.6):
        is_there = np.abs(sheet[60:] - color_of(confidence)[::-1]).max(axis=2) < 12
        assert is_there.sum() > 50, confidence
    space = ezdxf.readfile(_plan(walked, tmp_path / "p.dxf")).modelspace()
    colors = [color_of(0.995)] * 4 + [color_of(0.6)] * 2
    assert [line.rgb for line in space.query("LINE")][:7] == [*colors, COLORS["localized"]]


def test_frames_that_are_likely_elsewhere_are_passed_over():
    def frame(time, confidence, storey=0, walk=0):
        pose = {"center": [time, 0.0, 0.0]}
        more = {"walk": walk, "storey": storey, "gap": False}
        return {"time": time, "confidence": confidence, "pose": pose, **more}

    photos = [frame(2.0, 0.95), frame(0.0, 0.9), frame(1.0, 0.4), frame(3.0, 0.9, 1), frame(4.0, 0.9, None)]
    photos += [frame(9.0, 1.0, walk=None), frame(1.5, 1.0, walk=1)]
    photos.append({**frame(2.5, 1.0, walk=1), "pose": None})
    found = [(a["time"], b["time"], min(a["confidence"], b["confidence"])) for a, b in segments_of(photos)]
    assert found == [(0.0, 2.0, 0.9), (3.0, 4.0, 0.9)]


def test_two_control_points_give_a_turn_and_a_scale():
    pixels = np.array([[100.0, 200.0], [300.0, 50.0]])
    angle, scale = 0.7, 0.02
    flipped = pixels * [1.0, -1.0]
    turn = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    a, b, c, d, e, f = plan_matrix(pixels, flipped @ turn.T + [3.0, -4.0])
    np.testing.assert_allclose([[a, c], [b, d]], turn @ np.diag([1.0, -1.0]))
    np.testing.assert_allclose([e, f], [3.0, -4.0], atol=1e-9)
    with pytest.raises(InputError, match="one point or on one line"):
        plan_matrix(np.array([[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]]), np.zeros((3, 2)))


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("u,v,x\n1,2,3\n", "found the columns"),
        ("u,v,x,y\n1,2,3,4\n", "found 1 control points"),
        ("u,v,x,y\n1,2,3,four\n", "could not convert"),
    ],
)
def test_control_points_that_are_none(tmp_path, text, found):
    path = tmp_path / "points.csv"
    path.write_text(text)
    assert_input_error(found, read_control_points, path)
