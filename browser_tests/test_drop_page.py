"""The page of a service: photos are dropped on it, and it says where they were taken, or why it can not."""

import re
import subprocess
import sys
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pytest
from conftest import opening
from report_scenes import House

from piccolo.result_files import read_results

ROOT = Path(__file__).resolve().parents[1]
FLAT = ROOT / "examples" / "flat"
SLOW_MS = 120_000  # for a photo, on a machine that does much else
CHOOSER = "input[type=file][multiple]"
PHONE = {"width": 390, "height": 844, "device_scale_factor": 2, "has_touch": True, "is_mobile": True}
# a file as a person drops it, put together in the page
DROP = """([name, type, content]) => {
  const data = new DataTransfer();
  data.items.add(new File([Uint8Array.from(atob(content), c => c.charCodeAt(0))], name, { type }));
  for (const kind of ["dragover", "drop"]) {
    document.body.dispatchEvent(new DragEvent(kind, { dataTransfer: data, bubbles: true, cancelable: true }));
  }
}"""

PASTE = """() => {
  const data = new DataTransfer();
  data.items.add(new File(["no picture"], "pasted.png", { type: "image/png" }));
  document.dispatchEvent(new ClipboardEvent("paste", { clipboardData: data }));
}"""
# keeps the options that are sent in window.told
LISTEN = """() => {
  const append = FormData.prototype.append;
  FormData.prototype.append = function (name, value) {
    if (name === "options") window.told = JSON.parse(value);
    append.call(this, name, value);
  };
}"""

# says of photos that another helped them
WITH_HELPER = """() => {
  const { get } = Object.getOwnPropertyDescriptor(XMLHttpRequest.prototype, "responseText");
  Object.defineProperty(XMLHttpRequest.prototype, "responseText", {
    get() {
      return get.call(this).replaceAll('"beside": []', '"beside": ["phone.jpg"]');
    },
  });
}"""

WITHOUT_PICTURES = """() => {
  const { get } = Object.getOwnPropertyDescriptor(XMLHttpRequest.prototype, "responseText");
  Object.defineProperty(XMLHttpRequest.prototype, "responseText", {
    get() {
      const [found, pictures] = get.call(this).split("\\n");
      return pictures === undefined ? found : found + '\\n{"error": "found no memory"}\\n';
    },
  });
}"""


@contextmanager
def _serving(cache, *more):
    """Within this, the address of a service of the sample flat."""
    words = ["--cloud", str(FLAT / "cloud.ply"), "--port", "0", "--jobs", "2", "--cache", str(cache)]
    serve = [sys.executable, str(ROOT / "tools" / "serve.py"), *words, *map(str, more)]
    with subprocess.Popen(serve, stderr=subprocess.PIPE, text=True) as process:
        try:
            for line in process.stderr:
                if found := re.search(r"open (http://\S+) in a browser", line):
                    break
            yield found[1]
        finally:
            process.terminate()
            process.communicate(timeout=30)


@pytest.fixture(scope="session")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="session")
def service(cache):
    """The address of a service that keeps nothing."""
    with _serving(cache) as address:
        yield address


@pytest.fixture
def visit(browser, service):
    """A function that opens the service's page."""
    with opening(browser, (service, "data:", "blob:"), is_strict=False) as visit:

        def open_page(width=1400, height=860, **more):
            page = visit(service, width, height, **more)
            page.set_default_timeout(SLOW_MS)
            return page

        yield open_page


@pytest.fixture(scope="session")
def elsewhere(tmp_path_factory):
    """A panorama of a room that is not in the scan."""
    house = House(tmp_path_factory.mktemp("elsewhere"), 1024)
    house.add(0, "elsewhere.jpg")
    return house.folder / "photos" / "elsewhere.jpg"


def _choose(page, *files):
    page.set_input_files(CHOOSER, [str(file) for file in files])


def _wait(page, *statuses):
    """Wait until the list says these, in order."""
    for index, status in enumerate(statuses):
        page.wait_for_selector(f"#row-{index} .row-status.{status}")


def _names(page):
    return page.locator(".row-name").all_inner_texts()


@contextmanager
def _answering(page, answer):
    """Within this, requests to localize a photo are answered by a function of their route."""
    page.route("**/show", answer)
    yield
    page.unroute("**/show")


def test_panorama_phone_photo_and_photo_of_another_place(visit, elsewhere, shoot):
    page = visit()
    assert page.locator(".drop h2").is_visible()
    assert page.locator(".drop >> text=The service keeps no photo.").is_visible()
    assert not page.locator("#filters").is_visible()
    page.wait_for_timeout(400)
    shoot(page, "drop-empty")
    photos = [FLAT / "images" / "living_room.jpg", elsewhere, FLAT / "images" / "phone.jpg"]
    _choose(page, *photos)
    assert _names(page) == ["living_room", "elsewhere", "phone"]
    assert page.locator(".row-status").all_inner_texts() == ["Waiting"] * 3
    sent = page.locator(".row-facts").all_inner_texts()
    assert all(re.match(r"Being (localized|sent, \d+ %)", words) for words in sent[:2])
    assert sent[2] == "Waiting for its turn"
    shoot(page, "drop-waiting")
    _wait(page, "localized", "not_localized", "localized")
    page.wait_for_selector("#viewer[data-shown]")  # the last one to finish is opened by itself
    page.wait_for_timeout(700)
    shoot(page, "drop-found")
    page.click("#row-0")
    page.wait_for_selector('#viewer[data-shown="0"]')
    for mode in ("blend", "split", "scan", "photo"):
        page.click(f"[data-mode={mode}]")
    assert page.locator("#row-0 img").get_attribute("src").startswith("data:image/jpeg")
    assert "photo=living_room.jpg" in page.evaluate("location.hash")
    page.click("#row-1")
    page.wait_for_selector("#facts >> text=What would help")
    assert page.locator("#facts >> text=tell its field of view").is_visible()
    page.wait_for_selector('#viewer[data-shown="1"]')
    shoot(page, "drop-elsewhere")
    with page.expect_download() as saved:
        page.click('button[aria-label^="Download the results"]')
    assert saved.value.suggested_filename == "results.jsonl"
    results = read_results([saved.value.path()])
    assert [result.pano for result in results] == [photo.name for photo in photos]
    assert [result.status for result in results] == ["localized", "not_localized", "localized"]
    with _answering(page, lambda route: route.abort()):
        _choose(page, FLAT / "images" / "bedroom.jpg")
        page.wait_for_selector("#row-3 >> text=The connection")
    assert page.inner_text("#photo-name") == "elsewhere"  # it stays open: a person opened it
    page.click("text=Take off the list")
    page.wait_for_selector("body:not(.viewing)")
    assert _names(page) == ["living_room", "phone", "bedroom"]


def test_photos_of_one_spot_are_sent_together(visit, tmp_path, shoot):
    """One request has all of them, and each says what was found of it, and with which."""
    page = visit()
    page.evaluate(LISTEN)
    page.evaluate(WITH_HELPER)
    asked = []
    page.on("request", lambda request: asked.append(request.url))
    notes = tmp_path / "notes.jpg"
    notes.write_bytes(b"no picture")
    page.check("input[name=together]")
    shoot(page, "drop-together")
    _choose(page, FLAT / "images" / "living_room.jpg", notes, FLAT / "images" / "phone.jpg")
    _wait(page, "localized", "unreadable", "localized")
    assert [url.endswith("/show") for url in asked].count(True) == 1
    assert page.evaluate("told.together")
    page.click("#row-0")
    page.wait_for_selector("#facts dd >> text=phone.jpg")
    assert page.locator("#facts dt >> text=Found with").is_visible()
    shoot(page, "drop-together-found")
    page.click("#row-1")
    page.wait_for_selector("#facts >> text=wanted a whole JPEG")
    page.uncheck("input[name=together]")
    with _answering(page, lambda route: route.abort()):
        _choose(page, FLAT / "images" / "bedroom.jpg", FLAT / "images" / "phone.jpg")
        page.wait_for_selector("#row-3 >> text=The connection")
        page.wait_for_selector("#row-4 >> text=The connection")
    assert [url.endswith("/show") for url in asked].count(True) == 3
    assert page.evaluate("told.together") is None


def test_the_export_keeps_names(visit, tmp_path):
    page = visit()
    names = ["Tom & Jerry's <1> 😀.jpg", 'the "Hall".jpg', "50 %22.jpg"]
    for name in names:
        (tmp_path / name).write_bytes((FLAT / "images" / "living_room.jpg").read_bytes())
    _choose(page, *(tmp_path / name for name in names))
    _wait(page, *["localized"] * len(names))
    with page.expect_download() as saved:
        page.click('button[aria-label^="Download the results"]')
    assert [result.pano for result in read_results([saved.value.path()])] == names


def test_what_is_refused_says_why(visit, tmp_path, shoot):
    page = visit()
    asked = []
    page.on("request", lambda request: asked.append(request.url))
    large = tmp_path / "large.jpg"
    with large.open("wb") as file:
        file.truncate(200_000_000)
    _choose(page, large)
    page.wait_for_selector("#facts >> text=The file has 200 MB; the service takes 100 MB at most.")
    assert page.locator("#facts >> text=Save the photo smaller").is_visible()
    assert not any(url.endswith("/show") for url in asked)
    page.evaluate(DROP, ["notes.txt", "text/plain", "bm90IGEgcGhvdG8="])
    _wait(page, "waiting", "unreadable")
    assert page.inner_text("#row-0 .row-status") == "Too large"
    page.click("#row-1")
    page.wait_for_selector("#facts >> text=wanted a whole JPEG")
    assert page.locator("#facts >> text=Drop a JPEG").is_visible()
    assert page.locator('.copy:has-text("Tell field")').count() == 0
    assert page.locator('.copy:has-text("Try again")').count() == 0
    page.evaluate(PASTE)
    _wait(page, "waiting", "unreadable", "unreadable")
    assert _names(page) == ["large", "notes", "pasted"]
    shoot(page, "drop-refused")


def test_a_phone_photo_without_focal_length_is_localized_once_its_field_is_told(visit, tmp_path, shoot):
    content = (FLAT / "images" / "phone.jpg").read_bytes()
    start = content.index(b"\xff\xe1")
    length = int.from_bytes(content[start + 2 : start + 4], "big")
    bare = tmp_path / "bare.jpg"
    bare.write_bytes(content[:start] + content[start + 2 + length :])
    page = visit()
    _choose(page, bare)
    page.wait_for_selector("#facts .verdict >> text=Needs its field of view")
    assert page.inner_text("#row-0 .row-status") == "Needs its field of view"
    assert page.locator(".count.unreadable").count() == 0
    assert "`" not in page.inner_text("#facts")
    page.click('.copy:has-text("Tell field")')
    assert page.locator("[name=fov]").input_value() == "65"
    page.wait_for_timeout(200)
    shoot(page, "drop-options")
    page.evaluate(LISTEN)
    page.click(".options .main")
    _wait(page, "localized")
    lens = {"fov_deg": 65, "refine_focal": True, "projection": "pinhole"}
    assert page.evaluate("told") == {"photo": lens}


def test_a_pose_that_is_not_exact_enough_is_accepted_by_who_says_so(visit):
    page = visit()
    page.click(".drop >> text=Options")
    page.fill("[name=accuracy]", "0.001")
    page.click(".options .main")
    assert page.inner_text(".told span") == "Told of the next photos: exact enough is 0.001 m"
    _choose(page, FLAT / "images" / "bedroom.jpg")
    _wait(page, "not_localized")
    facts = page.inner_text("#facts")
    assert "the place is certain, the position only to 0.0" in facts
    assert re.search(r"an accuracy of 0\.0\d+ m would accept it", facts)
    assert page.locator('.confidence[title*="within 0.001 m and 5°"]').count() == 1
    assert float(page.inner_text('.confidence:has-text("Place") b').rstrip(" %")) > 90.0
    page.evaluate(LISTEN)
    page.click('.copy:has-text("Say what is exact enough")')
    page.fill("[name=accuracy]", "0.25")
    page.click(".options .main")
    _wait(page, "localized")
    assert page.evaluate("told") == {"accuracy": {"metres": 0.25}}


def test_a_place_is_shown_on_the_plan(visit):
    page = visit()
    page.click(".drop >> text=Options")
    page.click("text=Show the place on the plan")
    box = page.locator("#plan").bounding_box()
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    x, y = (float(page.locator(f"[name={name}]").input_value()) for name in "xy")
    [plan] = [storey["plan"] for storey in page.evaluate("PICCOLO_REPORT.storeys")]
    origin = page.evaluate("PICCOLO_REPORT.origin")
    a, _, _, d, e, f = plan["matrix"]
    assert x == pytest.approx(origin[0] + e + a * plan["width"] / 2, abs=0.05)
    assert y == pytest.approx(origin[1] + f + d * plan["height"] / 2, abs=0.05)
    page.click(".options .main")
    told = f"Told of the next photos: taken within 5 m of {x:.2f}, {y:.2f}"
    assert page.inner_text(".told span") == told
    page.evaluate(LISTEN)
    _choose(page, FLAT / "images" / "bedroom.jpg")
    _wait(page, "localized")
    assert page.evaluate("told") == {"prior": {"near": [x, y, None], "radius": 5}}
    assert page.locator(f".told >> text={told}").is_visible()  # it is told of the next ones too
    page.click(".told >> text=Clear")
    assert not page.locator(".told").is_visible()
    _choose(page, FLAT / "images" / "bedroom.jpg")
    _wait(page, "localized", "localized")
    assert page.evaluate("told") == {}


def _tell_place(page, x, y, radius):
    page.click(".drop >> text=Options")
    for name, value in (("x", x), ("y", y), ("radius", radius)):
        page.fill(f"[name={name}]", str(value))
    page.click(".options .main")


WRONG = {
    "Contradicts the place you told": ((29.0, -7.5), "near"),  # at the other end of the flat
    "The place you told is not in the scan": ((500.0, 500.0), "nowhere"),
}


@pytest.mark.parametrize("verdict", WRONG)
def test_a_place_that_the_photo_contradicts_is_the_headline(visit, shoot, verdict):
    page = visit()
    place, reason = WRONG[verdict]
    _tell_place(page, *place, 1.0)
    _choose(page, FLAT / "images" / "bedroom.jpg")
    _wait(page, "not_localized")
    page.wait_for_selector("#viewer[data-shown]")
    assert page.inner_text("#facts .verdict") == verdict
    assert page.inner_text("#row-0 .row-status") == verdict
    facts = page.inner_text("#facts")
    assert "%" not in page.inner_text(".facts-head")
    assert "Most likely not of this scan" not in facts
    assert page.evaluate("PICCOLO_REPORT.photos[0].contradicts") == [reason]
    (warning,) = page.evaluate("PICCOLO_REPORT.photos[0].warnings")
    assert facts.count(warning[1:].replace("`near`", "the place")) == 1
    shoot(page, f"drop-{verdict[:3]}".lower())
    page.evaluate(LISTEN)
    page.click('.copy:has-text("Search everywhere")')
    _wait(page, "localized")
    assert page.evaluate("told") == {}
    page.wait_for_selector("#facts .verdict >> text=Localized")
    page.click(".drop >> text=Options")  # the place is not told of later photos either
    assert page.input_value("[name=x]") == ""


# the azimuth [deg] at which the second photo looks
AHEAD = """() => {
  const { rotation } = PICCOLO_REPORT.photos[1].pose;
  return (Math.atan2(rotation[1], rotation[0]) * 180) / Math.PI;
}"""


def test_the_view_turns_to_a_photo_that_would_be_out_of_sight(visit):
    page = visit()
    _choose(page, FLAT / "images" / "living_room.jpg", FLAT / "images" / "phone.jpg")
    _wait(page, "localized", "localized")
    heading = 90.0 - page.evaluate(AHEAD)

    def look_in_the_first_then_open_the_second(off, how):
        page.evaluate(f"location.hash = '#photo=living_room.jpg&view={heading + off:.1f},0,80'")
        page.wait_for_selector('#viewer[data-shown="0"]')
        how()
        page.wait_for_selector('#viewer[data-shown="1"]')
        page.wait_for_timeout(500)
        view = page.evaluate("new URLSearchParams(location.hash.slice(1)).get('view')")
        return (float(view.split(",")[0]) - heading + 180.0) % 360.0 - 180.0

    by_click = partial(page.click, "#row-1")
    assert abs(look_in_the_first_then_open_the_second(180.0, by_click)) < 3.0
    assert abs(look_in_the_first_then_open_the_second(-100.0, by_click)) < 3.0
    assert look_in_the_first_then_open_the_second(10.0, by_click) == pytest.approx(10.0, abs=0.2)
    link = f"location.hash = '#photo=phone.jpg&view={heading + 170:.1f},0,80'"
    told = look_in_the_first_then_open_the_second(180.0, partial(page.evaluate, link))
    assert told == pytest.approx(170.0, abs=0.2)  # a link leads where it says


LATE = '{"error": "found a part of the body after 60 s"}'


def test_a_slow_upload_is_not_called_unreadable(visit):
    page = visit()
    with _answering(page, lambda route: route.fulfill(status=408, body=LATE)):
        _choose(page, FLAT / "images" / "bedroom.jpg")
        page.wait_for_selector("#facts .verdict >> text=Sent too slowly")
    assert page.locator(".count.unreadable").count() == 0
    page.click('.copy:has-text("Try again")')
    _wait(page, "localized")
    assert page.inner_text("#row-0 .row-status") == "Localized"


def test_a_place_is_told_whole_or_given_up(visit):
    page = visit()
    page.click(".drop >> text=Options")
    page.fill("[name=radius]", "3")
    page.click(".options .main")
    told = page.locator("[name=y]").evaluate("input => input.validationMessage")
    assert told.startswith("A place needs both")
    page.click("text=Show the place on the plan")
    page.wait_for_selector(".options", state="hidden")
    page.keyboard.press("Escape")
    page.wait_for_selector(".options[open]")
    assert page.locator("body.picking").count() == 0
    page.fill("[name=radius]", "")
    page.click(".options .main")
    page.wait_for_selector(".options", state="hidden")


def test_when_the_last_that_waits_is_taken_off_the_list_the_one_before_is_opened(visit):
    page = visit()
    busy = {"status": 503, "headers": {"Retry-After": "600"}, "body": '{"error": "found 32 photos"}'}
    with _answering(page, lambda route: route.fulfill(**busy)):
        _choose(page, FLAT / "images" / "bedroom.jpg")
        page.wait_for_selector("#row-0 >> text=The service is busy")
    with _answering(page, lambda route: route.abort()):
        _choose(page, FLAT / "images" / "living_room.jpg")
        page.wait_for_selector("#row-1 >> text=The connection")
    page.click("#row-0")
    page.click("text=Take off the list")
    page.wait_for_selector("#photo-name >> text=living_room")


def test_without_pictures_the_viewer_says_so(visit):
    page = visit()
    page.evaluate(WITHOUT_PICTURES)
    _choose(page, FLAT / "images" / "bedroom.jpg")
    _wait(page, "localized")
    page.wait_for_selector("text=pictures could not be loaded")
    assert page.locator("#row-0 img").get_attribute("src").startswith("blob:")


def test_a_full_service_is_asked_again_and_a_lost_one_when_told_to(visit, shoot):
    page = visit()
    busy = {"status": 503, "headers": {"Retry-After": "1"}, "body": '{"error": "found 32 photos that wait"}'}
    with _answering(page, lambda route: route.fulfill(**busy)):
        _choose(page, FLAT / "images" / "bedroom.jpg")
        page.wait_for_selector("#row-0 >> text=The service is busy; next try in 1 s")
    _wait(page, "localized")
    with _answering(page, lambda route: route.abort()):
        _choose(page, FLAT / "images" / "bedroom.jpg")
        page.wait_for_selector("#row-1 >> text=The connection to the service was lost.")
    assert _names(page) == ["bedroom", "bedroom (2)"]
    page.click("#row-1")
    shoot(page, "drop-lost")
    page.click('.copy:has-text("Try again")')
    _wait(page, "localized", "localized")


ANSWERS = {
    507: ("found no room on the disk of the service", "The disk of the service is full"),
    502: ("or a proxy before it, answered 502", "does not run behind its proxy"),
    500: ("the photo was given up", "see what the service printed"),
}


@pytest.mark.parametrize("status", ANSWERS)
def test_what_gave_way_is_told(visit, shoot, status):
    page = visit()
    found, advice = ANSWERS[status]
    body = "<h1>Bad gateway</h1>" if status == 502 else f'{{"error": "{found}"}}'
    with _answering(page, lambda route: route.fulfill(status=status, body=body)):
        _choose(page, FLAT / "images" / "bedroom.jpg")
        page.wait_for_selector(f"#facts >> text={found}")
    assert page.locator(f"#facts >> text={advice}").is_visible()
    assert "opens here" not in page.inner_text("#facts")
    shoot(page, f"drop-{status}")
    page.click('.copy:has-text("Try again")')
    _wait(page, "localized")


def test_a_slow_upload_shows_how_far_it_is(visit, tmp_path):
    page = visit(**PHONE)
    link = {"offline": False, "latency": 0, "downloadThroughput": -1, "uploadThroughput": 500_000}
    page.context.new_cdp_session(page).send("Network.emulateNetworkConditions", link)
    large = tmp_path / "large.jpg"
    large.write_bytes((FLAT / "images" / "bedroom.jpg").read_bytes() + bytes(1_500_000))
    _choose(page, large)
    page.wait_for_selector(r".progress >> text=/large: Being sent, [1-9]\d? %/")  # in sight
    page.wait_for_selector(".progress >> text=large: Being localized")
    page.wait_for_selector("#viewer[data-shown]")


def test_a_reload_asks_before_it_loses_what_was_found(visit):
    page = visit()
    asked = []
    page.on("dialog", lambda dialog: asked.append(dialog.type))
    _choose(page, FLAT / "images" / "bedroom.jpg")
    _wait(page, "localized")
    page.wait_for_selector("#viewer[data-shown]")
    assert page.locator(".copy:has-text('Copy link')").count() == 0  # it would open an empty page
    page.click("#plan")  # browsers ask only on pages that were used
    page.reload()
    page.wait_for_selector("body.no-photos")
    assert asked == ["beforeunload"]
    page.reload()
    assert asked == ["beforeunload"]


@contextmanager
def _keeping(browser, cache, folder):
    """Within this, the address of a service that keeps photos, and a function that opens its page."""
    with _serving(cache, "--keep", folder) as address, opening(browser, (address, "data:", "blob:")) as visit:
        yield address, visit


def test_what_is_kept_is_there_again_and_links_open_it(browser, cache, tmp_path, shoot):
    photos = [FLAT / "images" / name for name in ("bedroom.jpg", "living_room.jpg")]
    with _keeping(browser, cache, tmp_path) as (address, visit):
        page = visit(address, 1400, 860)
        page.set_default_timeout(SLOW_MS)
        _choose(page, photos[0])  # one after the other, as they are kept in the order of their answers
        _wait(page, "localized")
        _choose(page, photos[1])
        _wait(page, "localized", "localized")
        page.click("#row-1")
        page.wait_for_selector('#viewer[data-shown="1"]')
        assert page.locator(".copy:has-text('Copy link')").count() == 1
        link = page.evaluate("location.href")
        page.reload()  # it asks nothing
        assert _names(page) == ["bedroom", "living_room"]
    with _keeping(browser, cache, tmp_path) as (again, visit):
        page = visit(link.replace(address, again), 1400, 860)
        page.set_default_timeout(SLOW_MS)
        page.wait_for_selector('#viewer[data-shown="1"]')
        assert page.inner_text("#photo-name") == "living_room"
        assert _names(page) == ["bedroom", "living_room"]
        assert page.locator("#row-1 img").evaluate("image => image.naturalWidth") > 0
        shoot(page, "drop-kept")
        _choose(page, photos[0])  # the same photo takes its own place
        page.wait_for_selector("#row-1 >> text=bedroom")
        _wait(page, "localized", "localized")
        assert sorted(_names(page)) == ["bedroom", "living_room"]


def test_the_answer_of_another_scan_is_not_shown_on_old_plans(visit):
    page = visit()
    page.evaluate("PICCOLO_REPORT.scanSha256 = '0'.repeat(64)")  # as if it was loaded before
    _choose(page, FLAT / "images" / "bedroom.jpg")
    page.wait_for_selector("#row-0 >> text=The scan was replaced")
    assert "The scan was replaced after this page was loaded" in page.inner_text("#note")
    page.click("text=load the page again")
    page.wait_for_selector("body.no-photos")


SCREENS = {"light": {"color_scheme": "light"}, "dark": {"color_scheme": "dark"}, "phone": PHONE}


@pytest.fixture(params=SCREENS)
def screen(request, visit, find_barriers, shoot):
    """The page on a screen, and a function that looks for barriers in a state of it."""
    page = visit(**SCREENS[request.param])

    def look(state):
        page.wait_for_timeout(400)
        assert find_barriers(page) == [], state
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), state
        shoot(page, f"drop-axe-{request.param}-{state}")

    return page, look


def test_axe_finds_nothing_before_an_answer(screen):
    page, look = screen
    look("empty")
    page.click(".drop >> text=Options")
    look("options")
    page.keyboard.press("Escape")
    _tell_place(page, 29.0, -7.5, 1.0)
    look("told")
    busy = {"status": 503, "headers": {"Retry-After": "600"}, "body": '{"error": "found 32 photos"}'}
    with _answering(page, lambda route: route.fulfill(**busy)):
        _choose(page, FLAT / "images" / "bedroom.jpg")
        page.wait_for_selector("#row-0 >> text=The service is busy", state="attached")
        look("waiting")
        assert page.locator(".progress >> text=The service is busy").count() == 1
    page.evaluate("document.body.classList.add('showing-list')")
    with _answering(page, lambda route: route.fulfill(status=408, body=LATE)):
        _choose(page, FLAT / "images" / "living_room.jpg")
        page.wait_for_selector("#row-1 >> text=Sent too slowly")
    look("slow")


def test_axe_finds_nothing_in_answers(screen):
    page, look = screen
    _tell_place(page, 29.0, -7.5, 1.0)
    _choose(page, FLAT / "images" / "living_room.jpg")
    page.wait_for_selector("#facts .verdict >> text=Contradicts the place")
    look("contradicts")
    page.click('.copy:has-text("Search everywhere")')
    page.wait_for_selector(".row-status.localized", state="attached")
    page.evaluate("document.body.classList.remove('showing-facts')")
    page.wait_for_selector('#viewer[data-shown="0"]')
    look("found")
    page.keyboard.press("m")
    look("measuring")
    page.keyboard.press("Escape")
    page.keyboard.press("Escape")
    page.evaluate(DROP, ["notes.txt", "text/plain", "bm90IGEgcGhvdG8="])
    page.wait_for_selector("#row-1 .row-status.unreadable", state="attached")
    page.evaluate("location.hash = '#photo=notes.txt'")
    page.wait_for_selector("#facts >> text=What would help")
    look("refused")


def test_a_phone(visit, shoot):
    page = visit(**PHONE)
    page.wait_for_timeout(400)
    shoot(page, "drop-phone-empty")
    assert page.locator(".drop >> text=Tap to choose 360° photos").is_visible()
    assert "Drop photos" not in page.inner_text(".drop")
    assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    for label in ("Choose photos", "Take a photo"):
        assert page.locator(f".drop >> text={label}").is_visible()
    page.set_input_files("input[capture=environment]", str(FLAT / "images" / "phone.jpg"))
    page.wait_for_selector(".count.waiting")
    shoot(page, "drop-phone-waiting")
    page.wait_for_selector("#viewer[data-shown]")
    page.wait_for_timeout(500)
    shoot(page, "drop-phone-found")
    page.evaluate(DROP, ["notes.txt", "text/plain", "bm90IGEgcGhvdG8="])
    page.wait_for_selector(".facts >> text=What would help")
    page.wait_for_timeout(400)
    assert page.locator(".facts >> text=Take off the list").is_visible()
    assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    shoot(page, "drop-phone-refused")


def test_a_report_on_disk_shows_none_of_it(odd, open_page):
    page = open_page(odd)
    assert page.locator(".drop, .veil, .pick, .options, input[type=file]").count() == 0
    assert page.locator('button[aria-label^="Download the results"]').count() == 0
