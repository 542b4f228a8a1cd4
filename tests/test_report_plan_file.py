"""Plans without a browser: what other programs read from the PNG, SVG and DXF."""

import base64
import math
import re
from xml.etree import ElementTree

import cv2
import ezdxf
import numpy as np
import pytest
from report_scenes import HOSTILE, House, lifted

from piccolo.cli import report

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
    np.testing.assert_allclose(ahead, house.pose(0)[2].R_cam_from_world[0], atol=1e-3)
    assert {text.dxf.text for text in space.query("TEXT")} >= {"a.jpg", "c.jpg"}
    ellipse = space.query("ELLIPSE").first
    assert ellipse.dxf.major_axis.magnitude == pytest.approx(2e-3 * math.sqrt(5.991), rel=1e-3)


def test_svg_has_the_plans_and_marks_where_the_cameras_are(house, tmp_path):
    root = ElementTree.fromstring(_plan(house, tmp_path / "p.svg").read_bytes())
    groups = root.findall(f"{SVG}g")
    assert [len(group.findall(f"{SVG}g")) for group in groups] == [2, 1]
    titles = [title.text for title in root.iter(f"{SVG}title")]
    assert titles == ["a.jpg: localized", "c.jpg: ambiguous", f"{HOSTILE[0]}: not localized"]
    image = groups[0].find(f"{SVG}image")
    plan = cv2.imdecode(
        np.frombuffer(base64.b64decode(image.get("href").partition(",")[2]), np.uint8), cv2.IMREAD_UNCHANGED
    )
    assert plan.shape[:2] == (int(image.get("height")), int(image.get("width")))
    paths = [group.find(f"{SVG}path").get("d") for group in groups[0].findall(f"{SVG}g")]
    at = np.array([re.match(r"M([\d.]+) ([\d.]+)l", path).groups() for path in paths], float)
    scale = float(groups[0].get("transform").partition("scale(")[2].removesuffix(")")) / 1000.0
    moved = np.diff([house.pose(index)[2].center_world[:2] for index in (0, 2)], axis=0)
    np.testing.assert_allclose(np.diff(at, axis=0) * scale * [1, -1], moved, atol=1e-3)


def test_png_shows_each_photo_in_the_color_of_its_status(house, tmp_path):
    sheet = cv2.imread(str(_plan(house, tmp_path / "p.png")))
    for color in ((76, 120, 8), (0, 83, 166), (45, 37, 193)):
        is_there = (np.abs(sheet.astype(int) - color).max(axis=2) < 3).astype(np.uint8)
        assert cv2.erode(is_there, np.ones((9, 9))).any()
