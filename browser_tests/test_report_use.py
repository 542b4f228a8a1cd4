"""The page of a report as people use it: with the mouse, fingers and keys."""

import csv
import json
import re

import cv2
import numpy as np
import pytest

from piccolo.api.result_files import read_results
from piccolo.photo.panorama.cameras import GUESS, HOW
from piccolo.photo.panorama.read import CHOICES

DOWNLOAD = "Download as a table (CSV)"
# the names of all photos that the key n leads to
STEPS = """() => {
  const names = [], name = document.getElementById('photo-name');
  for (let k = 0; k < 298; k++) {
    document.body.dispatchEvent(new KeyboardEvent('keydown', { key: 'n', bubbles: true }));
    names.push(name.textContent);
  }
  return names;
}"""


def test_every_mode_and_what_it_shows(demo, open_page, shoot):
    page = open_page(demo[1])
    page.wait_for_timeout(300)
    shoot(page, "demo-plan")
    page.click("#row-0")
    page.wait_for_selector("#viewer[data-shown]")
    for key, mode in enumerate(("photo", "blend", "split", "scan"), 1):
        page.keyboard.press(str(key))
        assert page.locator(f"[data-mode={mode}]").get_attribute("aria-pressed") == "true"
        assert page.locator(".amount").is_visible() == (mode in ("blend", "split"))
        page.wait_for_timeout(400)
        shoot(page, f"demo-{mode}")
    page.click("[data-mode=split]")
    box = page.locator("#viewer").bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 3)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] / 4, box["y"] + box["height"] / 3, steps=4)
    page.mouse.up()
    assert int(page.locator(".amount").input_value()) == pytest.approx(25, abs=1)
    page.click(".toggle")
    assert "differences=1" in page.evaluate("new Promise(r => setTimeout(() => r(location.hash), 500))")
    page.keyboard.press("Escape")
    assert not page.locator("body.viewing").count()


def test_all_photos_by_keyboard(many, open_page):
    page = open_page(many)
    page.focus("#list")
    page.keyboard.press("End")
    page.keyboard.press("Enter")
    assert page.inner_text("#photo-name") == "walk_5"
    page.focus("#list")
    page.keyboard.press("Home")
    page.keyboard.press("Enter")
    seen = {page.inner_text("#photo-name")}
    page.keyboard.press("n")
    seen.add(page.inner_text("#photo-name"))
    seen |= set(page.evaluate(STEPS))
    photos = page.evaluate("PICCOLO_REPORT.photos.map(photo => photo.name.replace('.jpg', ''))")
    assert seen == set(photos)
    assert page.locator("#viewer-head button").last.is_disabled()
    page.focus(".look")
    before = page.evaluate("new Promise(r => setTimeout(() => r(location.hash), 400))")
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("+")
    assert page.evaluate("new Promise(r => setTimeout(() => r(location.hash), 400))") != before


def test_all_rows_of_the_list_by_scrolling_and_marks_by_mouse_and_touch(many, open_page):
    page = open_page(many, has_touch=True)
    page.wait_for_timeout(300)
    seen = set()
    for top in range(0, 300 * 76, 560):
        page.evaluate("top => { document.getElementById('list').scrollTop = top }", top)
        page.wait_for_timeout(30)
        seen |= set(page.locator(".row-name").all_inner_texts())
    assert len(seen) == 300
    assert page.locator(".row").count() < 40
    page.click('[data-storey="1"]')
    page.fill("#search", "101")
    for press in (page.mouse.click, page.touchscreen.tap):
        page.evaluate("location.hash = ''")
        page.wait_for_selector("body:not(.viewing)")
        page.click("#zooms button:nth-child(3)")
        x, y = _mark(page, "101.jpg")
        press(x, y)
        page.wait_for_selector("body.viewing")
        assert page.inner_text("#photo-name") == "101"


def _mark(page, name):
    """Where on the screen a photo's mark is: the plan is fitted into its box."""
    at = """name => {
      const report = PICCOLO_REPORT, photo = report.photos.find(photo => photo.name === name);
      const plan = report.storeys[photo.storey].plan, [a,, , d, e, f] = plan.matrix;
      const box = document.getElementById('plan').getBoundingClientRect();
      const pad = Math.min(48, box.width * 0.06);
      const wide = a * plan.width, high = -d * plan.height;
      const scale = Math.min((box.width - 2 * pad) / wide, (box.height - 2 * pad) / high);
      const [x, y] = photo.pose.center;
      return [box.left + box.width / 2 + scale * (x - e - wide / 2),
              box.top + box.height / 2 - scale * (y - f + high / 2)];
    }"""
    return page.evaluate(at, name)


def _pixels(page):
    return cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)


def test_pan_pinch_and_zoom_move_the_plan(many, open_page):
    page = open_page(many, has_touch=True)
    page.wait_for_timeout(300)
    box = page.locator("#plan").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    scales = [page.inner_text("#scale-text")]
    page.mouse.move(x, y)
    for _ in range(6):
        page.mouse.wheel(0, -240)
    page.wait_for_timeout(100)
    scales.append(page.inner_text("#scale-text"))
    before = _pixels(page)
    page.mouse.down()
    page.mouse.move(x + 120, y + 60, steps=5)
    page.mouse.up()
    page.wait_for_timeout(150)
    assert np.abs(_pixels(page).astype(int) - before).mean() > 1.0
    assert not page.locator("body.viewing").count()  # a drag opens nothing
    page.focus("#plan")
    page.keyboard.press("0")
    scales.append(page.inner_text("#scale-text"))
    assert scales[0] == scales[2] != scales[1]
    fingers = page.context.new_cdp_session(page)
    for gap in (40, 60, 90, 140):
        points = [{"x": x - gap, "y": y, "id": 0}, {"x": x + gap, "y": y, "id": 1}]
        kind = "touchStart" if gap == 40 else "touchMove"
        fingers.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
    fingers.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    page.wait_for_timeout(150)
    assert page.inner_text("#scale-text") != scales[2]


def test_filters_and_orders(many, open_page, shoot):
    page = open_page(many)
    photos = page.evaluate("PICCOLO_REPORT.photos")

    def shown():
        return int(re.match(r"(\d+)", page.inner_text(".shown"))[1])

    def count(**wanted):
        return sum(all(photo[key] == value for key, value in wanted.items()) for photo in photos)

    assert shown() == 300
    page.click(".chip.localized")
    assert shown() == 300 - count(status="localized")
    page.click(".chip.not_localized")
    page.click(".chip.unreadable")
    assert shown() == count(status="ambiguous") > 0
    assert set(page.locator(".row-status").all_inner_texts()) == {"Ambiguous"}
    page.click(".link")
    assert shown() == 300
    page.select_option("select >> nth=0", label="First floor")
    assert shown() == count(storey=1)
    assert page.locator('[data-storey="1"]').get_attribute("aria-pressed") == "true"
    page.click(".link")
    page.fill("input[type=range]", "95")
    assert shown() == sum(photo["confidence"] >= 0.95 for photo in photos)
    page.click(".link")
    page.select_option("select >> nth=1", "confidence")
    first = [photo for photo in photos if photo["status"] == "unreadable"]
    assert page.inner_text("#row-0 .row-name") == first[0]["name"].replace(".jpg", "")
    page.fill("#search", "walk_3")
    assert shown() == 1
    page.fill("#search", "nothing like it")
    assert page.locator(".empty").is_visible()
    page.click(".link")
    shoot(page, "many-plan")


def test_guesses_stacks_folders_and_the_table(odd, open_page, shoot):
    page = open_page(odd)
    page.wait_for_timeout(400)
    shoot(page, "odd-plan")
    assert "another scan" in page.inner_text("#note")
    names = page.locator(".row-name").all_inner_texts()
    assert names[:3] == ["a/0.jpg", "b/0.jpg", "1"]
    assert page.locator("#filters select").last.locator("option").all_inner_texts()[:2] == [
        "As in the results",
        "Name",
    ]
    with page.expect_download() as saved:
        page.click(f'button[aria-label="{DOWNLOAD}"]')
    with saved.value.path().open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert saved.value.suggested_filename == "house.csv"
    assert [row["photo"] for row in rows][-1] == "'=cmd|' !A1.jpg"
    assert float(rows[0]["x"]) == page.evaluate("PICCOLO_REPORT.photos[0].pose.world[0]")
    page.click("#row-0")
    page.wait_for_selector("#viewer[data-shown]")
    assert page.locator(".viewer-bar").is_visible()
    page.evaluate("location.hash = '#photo=gone.jpg'")
    page.wait_for_selector(".viewer.no-picture")
    assert not page.locator(".viewer-bar").is_visible()
    page.evaluate("location.hash = '#photo=hopeless.jpg'")
    page.wait_for_selector("text=Most likely not of this scan")


def test_clicks_on_a_stack_go_through_it(odd, open_page):
    page = open_page(odd, "#photo=1.jpg", width=1800)
    page.wait_for_selector("#viewer[data-shown]")
    page.click("#swap")
    page.wait_for_timeout(300)
    page.click("#zooms button:nth-child(3)")
    opened = []
    for _ in range(3):
        page.mouse.click(*_mark(page, "1.jpg"))
        opened.append(page.inner_text("#photo-name"))
    assert opened == ["2", "3", "1"]


def test_links_lead_to_photos_views_and_alternatives(many, open_page, shoot):
    page = open_page(many, "#photo=007.jpg&view=120.0,-10.0,60.0&mode=blend,30&alternative=1")
    page.wait_for_selector("#viewer[data-shown]")
    assert page.inner_text("#photo-name") == "007"
    assert page.locator(".alternative >> nth=1").get_attribute("aria-pressed") == "true"
    assert page.locator(".amount").input_value() == "30"
    page.wait_for_timeout(500)
    shoot(page, "many-alternative")
    assert "view=120.0,-10.0,60.0" in page.evaluate("location.hash")
    page.click(".alternative >> nth=0")
    page.click("#viewer-head button >> nth=-1")
    assert page.inner_text("#photo-name") == "008"
    page.go_back()
    page.wait_for_function("document.getElementById('photo-name').textContent === '007'")
    page.evaluate("location.hash = '#photo=no such photo'")
    page.wait_for_selector("body:not(.viewing)")


def test_ways_lead_to_neighbours_and_along_a_walk(many, open_page, shoot):
    page = open_page(many, "#photo=walk_2.jpg&view=0,-35,100")
    page.wait_for_selector("#viewer[data-shown]")
    page.wait_for_timeout(400)
    shoot(page, "many-walk")
    assert page.inner_text(".place") == "3 of 6"
    page.keyboard.press("PageDown")
    assert page.inner_text("#photo-name") == "walk_3"
    page.wait_for_selector(".way:not(.away)", state="attached")
    labels = [way.get_attribute("aria-label") for way in page.locator(".way").all()]
    assert len(labels) >= 3
    for label in labels:  # the walk is in the room at the corner: no way leads through its walls
        name = re.match(r"Go to (.*), \d", label)[1] + ".jpg"
        pose = page.evaluate("name => PICCOLO_REPORT.photos.find(p => p.name === name).pose.world", name)
        assert pose[0] < 4.6
        assert pose[1] < 3.6
    ways = page.locator(".way:not(.away)")
    label = ways.first.get_attribute("aria-label")
    ways.first.dispatch_event("click")
    assert f"Go to {page.inner_text('#photo-name')}," in label


def test_the_clipboard_gets_what_the_buttons_say(demo, open_page):
    page = open_page(demo[1], permissions=["clipboard-read", "clipboard-write"])
    page.click("#row-0")
    page.click("#facts .copy >> nth=1")
    page.wait_for_selector("text=Copied")
    pose = json.loads(page.evaluate("navigator.clipboard.readText()"))
    result = read_results([demo[0] / "poses.jsonl"])[0]
    np.testing.assert_allclose(pose["center_world"], result.pose.center_world, atol=1e-6)
    np.testing.assert_allclose(pose["R_cam_from_world"], result.pose.R_cam_from_world, atol=1e-9)


def test_messages_say_in_plain_words_what_the_api_calls_by_name(demo, open_page):
    page = open_page(demo[1])
    notes = [f"read as a pinhole photo{HOW}", CHOICES.format(65), f"{GUESS}: `cube_order`"]
    page.evaluate("notes => { PICCOLO_REPORT.photos[0].warnings = notes; }", notes)
    page.click("#row-0")
    said = page.locator(".notes li").all_inner_texts()
    assert not any(
        name in " ".join(said) for name in ("`", "focal_px", "fov_deg", "cube_order", "refine_focal")
    )
    assert said[0].endswith(
        "; a calibration file, a focal length in pixels, or a field of view in degrees "
        "with the projection pinhole set it exactly"
    )
    assert "unknown, a field of view of about 65°. If it" in said[1]


def test_a_deviation_is_the_same_wherever_it_is_told(demo, open_page):
    page = open_page(demo[1])
    row = re.search(r"±(\S+ mm)", page.inner_text("#row-0 .row-facts"))[1]
    page.click("#row-0")
    assert re.search(r"(\S+ mm) and \S+° \(one standard deviation", page.inner_text("#facts"))[1] == row
