"""The page of a report: aligned with render_pose; strangers' names, screen readers, phones, paper, speed."""

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from report_scenes import HOSTILE

from piccolo.api.result_files import read_results
from piccolo.cloud.cloud_settings import BY_FILE
from piccolo.photo.camera.model import pinhole
from piccolo.scan_map.open_map import open_points
from piccolo.system.jobs.threads import Workers
from piccolo.views.pictures import cut, fill_holes
from piccolo.views.surfels import render_points

LOOKS = [(0, 0), (75, -20), (150, 25), (225, -45), (300, 10)]  # heading and pitch [deg]
FIELD = 60.0  # [deg] of the views compared
PATCH = 300  # [px] that is compared in the middle


def _show(page, name, **more):
    """Lead a page to a photo by its address, as a link does."""
    parts = [f"photo={name}", *(f"{key}={value}" for key, value in more.items())]
    page.evaluate("hash => { location.hash = hash }", f"#{'&'.join(parts)}")
    page.wait_for_selector("body.viewing")
    index = page.evaluate("name => PICCOLO_REPORT.photos.findIndex(photo => photo.name === name)", name)
    page.wait_for_selector(f'#viewer[data-shown="{index}"]')
    page.wait_for_timeout(450)  # what was there before fades out


def _shot(page, clip=None):
    png = np.frombuffer(page.screenshot(clip=clip), np.uint8)
    return cv2.cvtColor(cv2.imdecode(png, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


def _level_lens(heading_deg, pitch_deg):
    """R_lens_from_world of a lens that looks there."""
    yaw, pitch = math.radians(90.0 - heading_deg), math.radians(pitch_deg)
    forward = [math.cos(pitch) * math.cos(yaw), math.cos(pitch) * math.sin(yaw), math.sin(pitch)]
    left = [-math.sin(yaw), math.cos(yaw), 0.0]
    return np.stack([forward, left, np.cross(forward, left)])


def _correlation(one, other):
    one, other = (cv2.GaussianBlur(p, (0, 0), 4).astype(float).ravel() for p in (one, other))
    return float(np.corrcoef(one, other)[0, 1])


def test_sphere_and_scan_are_aligned_with_render_pose(demo, open_page, shoot):
    folder, index = demo
    result = read_results([folder / "poses.jsonl"])[0]
    cloud = open_points([folder / "cloud.ply"], BY_FILE, Workers(2))
    view = render_points(cloud.points, cloud.from_world(result.pose), 2048, Workers(2))
    pictures = {
        "scan": fill_holes(view.rgb, view.is_seen),
        "photo": cv2.cvtColor(cv2.imread(result.pano), cv2.COLOR_BGR2RGB),
    }
    page = open_page(index)
    name = Path(result.pano).name
    for mode, sphere in pictures.items():
        for heading, pitch in LOOKS:
            _show(page, name, view=f"{heading},{pitch},{FIELD}", mode=f"{mode},50")
            box = page.locator("#viewer").bounding_box()
            middle = {"x": box["x"] + box["width"] / 2, "y": box["y"] + box["height"] / 2}
            clip = {k: middle[k] - PATCH / 2 for k in ("x", "y")} | {"width": PATCH, "height": PATCH}
            page.evaluate("document.querySelector('.ways').hidden = true")
            seen = _shot(page, clip)
            focal = box["height"] / 2 / math.tan(math.radians(FIELD / 2))

            def expected(turn, focal=focal, heading=heading, pitch=pitch, sphere=sphere):
                lens = _level_lens(heading + turn, pitch) @ result.pose.R_cam_from_world.T
                return cut(sphere, pinhole(PATCH, PATCH, focal), lens)

            there, beside = _correlation(seen, expected(0.0)), _correlation(seen, expected(1.5))
            assert there > 0.97, (mode, heading, pitch, there)
            assert there > beside
            assert np.abs(seen.astype(float) - expected(0.0)).mean() < 9.0
    shoot(page, "demo-scan")


def test_names_of_strangers_do_nothing(hostile, open_page, shoot):
    for index, file in enumerate(hostile):
        page = open_page(file)
        page.wait_for_selector("#row-3")
        assert page.title() == HOSTILE[1]
        names = page.locator(".row-name").all_text_contents()
        assert names[0].startswith("<img src=x")
        for _ in HOSTILE:
            page.keyboard.press("n")
            page.wait_for_selector("#viewer[data-shown]")
        page.evaluate("window.dispatchEvent(new Event('beforeprint'))")
        assert page.evaluate("window.injected") is None
        assert page.locator("script:not([src])").count() == (1 + 1 + len(HOSTILE) if index else 0)
        assert page.locator("img[src=x], .row-name *, h1 *, .verdict b").count() == 0
        shoot(page, f"hostile-{index}")


def test_links_to_hostile_names_find_them(hostile, open_page):
    page = open_page(hostile[0])
    for _ in HOSTILE:
        page.keyboard.press("n")
        name = page.inner_text("#photo-name")
        link = page.evaluate("location.hash")
        other = open_page(hostile[0], link)
        other.wait_for_selector("body.viewing")
        assert other.inner_text("#photo-name") == name


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_nothing(many, open_page, shoot, find_barriers, scheme):
    page = open_page(many, color_scheme=scheme)
    page.wait_for_timeout(300)
    for state in ("plan", "photo", "help"):
        if state == "photo":
            page.click("#row-7")
            page.wait_for_selector("#viewer[data-shown]")
        if state == "help":
            page.keyboard.press("?")
        page.wait_for_timeout(400)
        assert find_barriers(page) == [], state
        shoot(page, f"axe-{scheme}-{state}")


def test_a_phone(many, open_page, shoot):
    how = {"width": 390, "height": 844, "device_scale_factor": 2, "has_touch": True, "is_mobile": True}
    page = open_page(many, **how)
    page.wait_for_timeout(300)
    shoot(page, "phone-plan")
    assert page.locator(".count").all_inner_texts() == ["271", "12", "12", "5"]
    assert page.locator("h1").bounding_box()["width"] > 100
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    page.locator("#actions button >> visible=true").first.tap()
    page.wait_for_timeout(400)
    shoot(page, "phone-list")
    page.locator("#row-2").tap()
    page.wait_for_selector("#viewer[data-shown]")
    page.wait_for_timeout(500)
    shoot(page, "phone-photo")
    button = page.locator("#actions button >> visible=true").last.bounding_box()
    assert button["x"] + button["width"] <= 390
    page.locator("#actions button >> visible=true").nth(1).tap()
    page.wait_for_timeout(400)
    assert page.locator("#facts").is_visible()
    shoot(page, "phone-facts")


def test_paper(many, open_page, shoot):
    page = open_page(many)
    page.emulate_media(media="print")
    page.evaluate("window.dispatchEvent(new Event('beforeprint'))")
    page.wait_for_timeout(500)
    assert page.locator("#print tbody tr").count() == 300
    assert page.locator("#print figure").count() == 2
    shoot(page, "paper")
    pdf = page.pdf(format="A4")
    assert pdf.startswith(b"%PDF")
    assert pdf.count(b"/Type /Page\n") + pdf.count(b"/Type /Page ") >= 5


def test_the_plan_stays_smooth_and_the_first_view_is_quick(many, open_page):
    page = open_page(many)
    timing = page.evaluate("performance.getEntriesByType('navigation')[0].domContentLoadedEventEnd")
    frames = page.evaluate("""() => new Promise(resolve => {
      const plan = document.getElementById('plan'), box = plan.getBoundingClientRect(), times = [];
      const step = now => {
        times.push(now);
        if (times.length > 60) return resolve(times.slice(1).map((time, k) => time - times[k]));
        const about = { clientX: box.left + 400, clientY: box.top + 300, bubbles: true, cancelable: true };
        plan.dispatchEvent(new WheelEvent('wheel', { deltaY: times.length % 40 < 20 ? -40 : 40, ...about }));
        requestAnimationFrame(step);
      };
      requestAnimationFrame(step);
    })""")
    assert timing < 3000  # [ms] on a machine that does much else; 1.5 s is what an idle one is held to
    assert np.median(frames) < 66.0
