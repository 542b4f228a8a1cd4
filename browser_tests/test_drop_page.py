"""The page of a service: photos are dropped on it, and it says where they were taken, or why it can not."""

import re

import pytest
from dropping import FLAT, LISTEN, PHONE, answering, choose, giving, list_names, tell_place, wait_for

from piccolo.api.result_files import read_results

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

# says of photos that another helped them
WITH_HELPER = """() => {
  const { get } = Object.getOwnPropertyDescriptor(XMLHttpRequest.prototype, "responseText");
  Object.defineProperty(XMLHttpRequest.prototype, "responseText", {
    get() {
      return get.call(this).replaceAll('"beside": []', '"beside": ["phone.jpg"]');
    },
  });
}"""

LATE = '{"error": "found a part of the body after 60 s"}'

SCREENS = {"light": {"color_scheme": "light"}, "dark": {"color_scheme": "dark"}, "phone": PHONE}


def test_panorama_phone_photo_and_photo_of_another_place(visit, elsewhere, shoot):
    page = visit()
    assert page.locator(".drop h2").is_visible()
    assert page.locator(".drop >> text=The service keeps no photo.").is_visible()
    assert not page.locator("#filters").is_visible()
    page.wait_for_timeout(400)
    shoot(page, "drop-empty")
    photos = [FLAT / "images" / "living_room.jpg", elsewhere, FLAT / "images" / "phone.jpg"]
    choose(page, *photos)
    assert list_names(page) == ["living_room", "elsewhere", "phone"]
    assert page.locator(".row-status").all_inner_texts() == ["Waiting"] * 3
    sent = page.locator(".row-facts").all_inner_texts()
    assert all(re.match(r"Being (localized|sent, \d+ %)", words) for words in sent[:2])
    assert sent[2] == "Waiting for its turn"
    shoot(page, "drop-waiting")
    wait_for(page, "localized", "not_localized", "localized")
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
    with answering(page, lambda route: route.abort()):
        choose(page, FLAT / "images" / "bedroom.jpg")
        page.wait_for_selector("#row-3 >> text=The connection")
    assert page.inner_text("#photo-name") == "elsewhere"  # it stays open: a person opened it
    page.click("text=Take off the list")
    page.wait_for_selector("body:not(.viewing)")
    assert list_names(page) == ["living_room", "phone", "bedroom"]


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
    choose(page, FLAT / "images" / "living_room.jpg", notes, FLAT / "images" / "phone.jpg")
    wait_for(page, "localized", "unreadable", "localized")
    assert [url.endswith("/show") for url in asked].count(True) == 1
    assert page.evaluate("told.together")
    page.click("#row-0")
    page.wait_for_selector("#facts dd >> text=phone.jpg")
    assert page.locator("#facts dt >> text=Found with").is_visible()
    shoot(page, "drop-together-found")
    page.click("#row-1")
    page.wait_for_selector("#facts >> text=wanted a whole JPEG")
    page.uncheck("input[name=together]")
    with answering(page, lambda route: route.abort()):
        choose(page, FLAT / "images" / "bedroom.jpg", FLAT / "images" / "phone.jpg")
        page.wait_for_selector("#row-3 >> text=The connection")
        page.wait_for_selector("#row-4 >> text=The connection")
    assert [url.endswith("/show") for url in asked].count(True) == 3
    assert page.evaluate("told.together") is None


def test_the_export_keeps_names(visit, tmp_path):
    page = visit()
    names = ["Tom & Jerry's <1> 😀.jpg", 'the "Hall".jpg', "50 %22.jpg"]
    for name in names:
        (tmp_path / name).write_bytes((FLAT / "images" / "living_room.jpg").read_bytes())
    choose(page, *(tmp_path / name for name in names))
    wait_for(page, *["localized"] * len(names))
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
    choose(page, large)
    page.wait_for_selector("#facts >> text=The file has 200 MB; the service takes 100 MB at most.")
    assert page.locator("#facts >> text=Save the photo smaller").is_visible()
    assert not any(url.endswith("/show") for url in asked)
    page.evaluate(DROP, ["notes.txt", "text/plain", "bm90IGEgcGhvdG8="])
    wait_for(page, "waiting", "unreadable")
    assert page.inner_text("#row-0 .row-status") == "Too large"
    page.click("#row-1")
    page.wait_for_selector("#facts >> text=wanted a whole JPEG")
    assert page.locator("#facts >> text=Drop a JPEG").is_visible()
    assert page.locator('.copy:has-text("Tell field")').count() == 0
    assert page.locator('.copy:has-text("Try again")').count() == 0
    page.evaluate(PASTE)
    wait_for(page, "waiting", "unreadable", "unreadable")
    assert list_names(page) == ["large", "notes", "pasted"]
    shoot(page, "drop-refused")


def test_a_phone_photo_without_focal_length_is_localized_once_its_field_is_told(visit, tmp_path, shoot):
    content = (FLAT / "images" / "phone.jpg").read_bytes()
    start = content.index(b"\xff\xe1")
    length = int.from_bytes(content[start + 2 : start + 4], "big")
    bare = tmp_path / "bare.jpg"
    bare.write_bytes(content[:start] + content[start + 2 + length :])
    page = visit()
    choose(page, bare)
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
    wait_for(page, "localized")
    lens = {"fov_deg": 65, "refine_focal": True, "projection": "pinhole"}
    assert page.evaluate("told") == {"photo": lens}


def test_a_pose_that_is_not_exact_enough_is_accepted_by_who_says_so(visit):
    page = visit()
    page.click(".drop >> text=Options")
    page.fill("[name=accuracy]", "0.001")
    page.click(".options .main")
    assert page.inner_text(".told span") == "Told of the next photos: exact enough is 0.001 m"
    choose(page, FLAT / "images" / "bedroom.jpg")
    wait_for(page, "not_localized")
    facts = page.inner_text("#facts")
    assert "the place is certain, the position only to 0.0" in facts
    assert re.search(r"an accuracy of 0\.0\d+ m would accept it", facts)
    assert page.locator('.confidence[title*="within 0.001 m and 5°"]').count() == 1
    assert float(page.inner_text('.confidence:has-text("Place") b').rstrip(" %")) > 90.0
    page.evaluate(LISTEN)
    page.click('.copy:has-text("Say what is exact enough")')
    page.fill("[name=accuracy]", "0.25")
    page.click(".options .main")
    wait_for(page, "localized")
    assert page.evaluate("told") == {"accuracy": {"metres": 0.25}}


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
    tell_place(page, 29.0, -7.5, 1.0)
    look("told")
    busy = {"status": 503, "headers": {"Retry-After": "600"}, "body": '{"error": "found 32 photos"}'}
    with answering(page, lambda route: route.fulfill(**busy)):
        choose(page, FLAT / "images" / "bedroom.jpg")
        page.wait_for_selector("#row-0 >> text=The service is busy", state="attached")
        look("waiting")
        assert page.locator(".progress >> text=The service is busy").count() == 1
    page.evaluate("document.body.classList.add('showing-list')")
    with answering(page, lambda route: route.fulfill(status=408, body=LATE)):
        choose(page, FLAT / "images" / "living_room.jpg")
        page.wait_for_selector("#row-1 >> text=Sent too slowly")
    look("slow")


def test_axe_finds_nothing_in_answers(screen, ask):
    page, look = screen
    tell_place(page, 29.0, -7.5, 1.0)
    with answering(page, giving(ask("living_room", '{"prior": {"near": [29, -7.5, null], "radius": 1}}'))):
        choose(page, FLAT / "images" / "living_room.jpg")
        page.wait_for_selector("#facts .verdict >> text=Contradicts the place")
    look("contradicts")
    with answering(page, giving(ask("living_room"))):
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
