"""Measuring in a report: against the scan, by mouse, keys, fingers, links; what else the page says."""

import csv
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest

from piccolo.api.result_files import read_results
from piccolo.apps.report import report
from piccolo.cloud.cloud_settings import BY_FILE
from piccolo.scan_map.open_map import open_points
from piccolo.system.jobs.threads import Workers

FIELD = 70.0  # [deg]
LABEL = re.compile(r"([\d.]+) m ± (\d+) mm(?:, ([\d.]+) m horizontal, ([\d.]+) m vertical)?")
PHONE = {"width": 390, "height": 844, "device_scale_factor": 2, "has_touch": True, "is_mobile": True}


@pytest.fixture(scope="module")
def scan(demo):
    """The room's points (N, 3), and where its first photo was taken."""
    cloud = open_points([demo[0] / "cloud.ply"], BY_FILE, Workers(2))
    result = read_results([demo[0] / "poses.jsonl"])[0]
    return cloud.points.stack() + cloud.origin_world, result.pose.center_world, Path(result.pano).name


def _open(open_page, file, name, heading=40, pitch=-20, more="", **how):
    page = open_page(file, f"#photo={name}&view={heading},{pitch},{FIELD}{more}", **how)
    page.wait_for_selector("#viewer[data-shown]")
    page.wait_for_timeout(450)
    return page


def _at(page, across, down):
    box = page.locator(".look").bounding_box()
    return box["x"] + across * box["width"], box["y"] + down * box["height"]


def _read(page):
    """Metres, deviation [m], and the horizontal and vertical part."""
    page.wait_for_selector(".ruler-label:not([hidden])")
    page.wait_for_timeout(150)
    metres, mm, level, upright = LABEL.match(page.inner_text(".ruler-panel p")).groups()
    assert page.inner_text(".ruler-label") == f"{metres} m ± {mm} mm"
    return float(metres), int(mm) / 1000.0, float(level), float(upright)


def _scanned(scan, page, across, down, heading=40, pitch=-20):
    """Where the ray through a place of the view meets the scan, by the plane of the points beside it."""
    points, center, _ = scan
    box = page.locator(".look").bounding_box()
    tangent = math.tan(math.radians(FIELD / 2))
    yaw = math.radians(90.0 - heading)
    elevation = math.radians(pitch)
    right = (2 * across - 1) * tangent * box["width"] / box["height"]
    up = (1 - 2 * down) * tangent
    ahead = math.cos(elevation) - math.sin(elevation) * up
    ray = np.array(
        [
            math.cos(yaw) * ahead + math.sin(yaw) * right,
            math.sin(yaw) * ahead - math.cos(yaw) * right,
            math.sin(elevation) + math.cos(elevation) * up,
        ]
    )
    ray /= np.linalg.norm(ray)
    offsets = points - center
    ranges = np.linalg.norm(offsets, axis=1)
    beside = np.flatnonzero(offsets @ ray > math.cos(0.08) * ranges)
    first = offsets[beside[ranges[beside] < np.median(ranges[beside]) + 0.1]]
    normal = np.linalg.svd(first - first.mean(axis=0))[2][2]
    return center + ray * (normal @ first.mean(axis=0)) / (normal @ ray)


def test_a_distance_by_the_mouse_is_that_of_the_scan(demo, scan, open_page, shoot):
    page = _open(open_page, demo[1], scan[2], permissions=["clipboard-read", "clipboard-write"])
    page.click("text=Measure")
    assert "Pick a point" in page.inner_text(".ruler-panel")
    places = [(0.3, 0.35), (0.6, 0.8)]
    for place in places:
        page.mouse.click(*_at(page, *place))
        page.wait_for_timeout(150)
    metres, deviation, level, upright = _read(page)
    shoot(page, "measure")
    gap = np.subtract(*(_scanned(scan, page, *place) for place in places))
    assert 0.001 <= deviation < 0.03
    assert abs(metres - np.linalg.norm(gap)) < 3.0 * deviation + 0.01
    assert abs(level - np.linalg.norm(gap[:2])) < 3.0 * deviation + 0.01
    assert metres == pytest.approx(math.hypot(level, upright), abs=0.002)
    page.click("text=Copy distance")
    page.wait_for_selector("text=Copied")
    assert page.evaluate("navigator.clipboard.readText()").startswith(f"{metres:.3f} m ± ")
    page.mouse.move(*_at(page, 0.5, 0.2))  # a drag turns, and picks nothing
    page.mouse.down()
    page.mouse.move(*_at(page, 0.45, 0.2), steps=4)
    page.mouse.up()
    assert _read(page)[0] == metres
    page.wait_for_timeout(400)
    assert "view=40.0," not in page.evaluate("location.hash")
    page.mouse.click(*_at(page, 0.5, 0.6))  # a third one begins anew
    page.wait_for_selector("text=Pick the second point")
    page.keyboard.press("Escape")
    assert not page.locator(".ruler-panel").is_visible()
    assert page.locator("body.viewing").count()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_keys_measure_and_a_link_leads_back(demo, scan, open_page, shoot, scheme):
    page = _open(open_page, demo[1], scan[2], color_scheme=scheme)
    page.focus(".look")
    page.keyboard.press("m")
    page.keyboard.press("Enter")
    for key in ("ArrowRight", "ArrowRight", "Shift+ArrowDown", "Enter"):
        page.keyboard.press(key)
    measured = _read(page)
    assert page.locator(".reticle").is_visible()
    page.wait_for_timeout(400)  # the address follows
    shoot(page, f"measure-keys-{scheme}")
    other = open_page(demo[1], page.evaluate("location.hash"))
    assert _read(other) == measured
    other.keyboard.press("n")  # in another photo the marks are where they were
    other.wait_for_selector('#viewer[data-shown="1"]')
    assert _read(other) == measured
    other.wait_for_timeout(400)
    assert other.evaluate("location.hash").count(scan[2]) == 2
    other.keyboard.press("m")
    other.wait_for_timeout(400)
    assert "&at=" not in other.evaluate("location.hash")
    broken = open_page(demo[1], f"#photo={scan[2]}&at=1,2,x,{scan[2]}&at=999,0,1,{scan[2]}&at=0,0,1,gone.jpg")
    broken.wait_for_selector("#viewer[data-shown]")
    assert not broken.locator(".ruler-panel").is_visible()


def _measure(page, *places):
    page.keyboard.press("m")
    for place in places:
        page.mouse.click(*_at(page, *place))
        page.wait_for_timeout(150)
    return _read(page)


def test_distances_are_listed_saved_and_downloaded(demo, scan, open_page, shoot, find_barriers):
    page = _open(open_page, demo[1], scan[2])
    assert not page.locator(".ruler-panel >> text=List").is_visible()
    places = [(0.3, 0.35), (0.6, 0.8)]
    measured = [_measure(page, *places)]
    page.click("text=Keep")
    page.keyboard.press("Escape")
    measured.append(_measure(page, (0.35, 0.4), (0.6, 0.7)))
    page.click("text=Keep")
    page.click("text=List (2)")
    page.fill("[aria-label='Note on measurement 1']", "=door")
    page.keyboard.press("Tab")
    assert find_barriers(page) == []
    shoot(page, "measurements")
    with page.expect_download() as saved:
        page.click(".measurements >> text=Download")
    assert saved.value.suggested_filename == "Demo room measurements.csv"
    with saved.value.path().open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["note"] for row in rows] == ["'=door", ""]
    for row, (metres, deviation, level, upright) in zip(rows, measured, strict=True):
        found = [float(row[name]) for name in ("distance_m", "std_m", "horizontal_m", "vertical_m")]
        assert found == pytest.approx([metres, deviation, level, upright], abs=0.0006)
        ends = [[float(row[f"{axis}_{k}"]) for axis in "xyz"] for k in (1, 2)]
        assert math.dist(*ends) == pytest.approx(metres, abs=0.001)
        assert row["photo_1"] == row["photo_2"] == scan[2]
    for k, place in enumerate(places, 1):
        point = [float(rows[0][f"{axis}_{k}"]) for axis in "xyz"]
        np.testing.assert_allclose(point, _scanned(scan, page, *place), atol=0.03)
    page.click("[aria-label='Remove measurement 2']")
    page.reload()  # the browser has saved them
    page.wait_for_selector(".ruler-panel >> text=List (1)")
    page.keyboard.press("Escape")
    page.keyboard.press("m")
    page.click("text=List (1)")
    assert page.input_value("[aria-label='Note on measurement 1']") == "=door"
    page.click("[aria-label='Show measurement 1']")
    assert _read(page) == measured[0]
    page.click("text=List (1)")
    page.click("[aria-label='Remove measurement 1']")
    page.wait_for_selector(".measurements", state="hidden")
    assert not page.locator(".ruler-panel >> text=List").is_visible()


def test_fingers_measure_on_a_phone(demo, scan, open_page, shoot):
    page = _open(open_page, demo[1], scan[2], **PHONE)
    page.locator(".toggle >> nth=1").tap()
    for place in ((0.3, 0.4), (0.7, 0.55)):
        page.touchscreen.tap(*_at(page, *place))
        page.wait_for_timeout(150)
    assert _read(page)[1] < 0.1
    shoot(page, "measure-phone")
    for name in (".ruler-panel", ".viewer-bar", ".ruler-label"):
        box = page.locator(name).bounding_box()
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= 390
    assert page.evaluate("document.documentElement.scrollWidth") <= 390


def test_where_nothing_was_scanned_the_page_says_so(demo, scan, tmp_path, open_page, shoot):
    points = scan[0][scan[0][:, 2] < scan[1][2] + 0.3]  # the room without its ceiling
    np.savez(tmp_path / "open.npz", points=points, colors=np.full(points.shape, 128, np.uint8))
    words = ["--results", str(demo[0] / "poses.jsonl"), "--cloud", str(tmp_path / "open.npz"), "--force"]
    assert report.main([*words, "--out", str(tmp_path / "report"), "--quiet"]) == 0
    page = _open(open_page, tmp_path / "report" / "index.html", scan[2], pitch=60)
    page.keyboard.press("m")
    page.mouse.click(*_at(page, 0.5, 0.3))
    page.wait_for_selector("text=Nothing was scanned there")
    assert page.locator(".ruler circle").count() == 0
    shoot(page, "measure-nothing")


def test_ways_lead_around_one_place_and_keep_the_heading(odd, open_page):
    page = open_page(odd, "#photo=a%2F0.jpg&view=200,-80,100")
    page.wait_for_selector("#viewer[data-shown]")
    for name, other in (("a/0.jpg", "b/0.jpg"), ("b/0.jpg", "a/0.jpg")):
        assert page.inner_text("#photo-name") == name
        way = page.locator(f'.way[aria-label="Go to {other}, 0.0 m away"]')
        way.wait_for(state="attached")
        way.dispatch_event("click")
        page.wait_for_timeout(400)
        assert "view=200.0,-80.0,100.0" in page.evaluate("location.hash")


def test_an_unreadable_photo_says_once_why(odd, open_page, shoot):
    page = open_page(odd, "#photo=1.jpg&mode=split,50")
    page.wait_for_selector("#viewer[data-shown]")
    assert page.locator(".divider").is_visible()
    page.evaluate("location.hash = '#photo=gone.jpg'")
    page.wait_for_selector(".viewer.no-picture")
    assert not page.locator(".divider").is_visible()
    assert page.locator("text=no picture >> visible=true").count() == 1
    page.keyboard.press("m")
    assert not page.locator(".ruler-panel").is_visible()
    shoot(page, "unreadable")


def test_a_pose_that_is_less_probable_than_another_is_not_called_the_best(many, open_page):
    page = open_page(many)
    photo = json.loads(page.evaluate("JSON.stringify(PICCOLO_REPORT.photos[7])"))
    page.click("#row-7")
    assert page.inner_text(".alternative >> nth=0").startswith("Best pose")
    page.keyboard.press("Escape")
    page.evaluate("PICCOLO_REPORT.photos[7].confidence = 0.25")
    page.click("#row-7")
    assert photo["alternatives"][0]["probability"] > 0.25
    assert page.inner_text(".alternative >> nth=0").startswith("Chosen pose")
    assert page.locator("text=Its probability is not the highest").is_visible()
