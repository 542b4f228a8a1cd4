"""The page of a service that is slow, full, lost or another, and what it keeps."""

from contextlib import contextmanager

import pytest
from conftest import opening
from dropping import FLAT, PHONE, SLOW_MS, answering, choose, giving, list_names, serving, wait_for

WITHOUT_PICTURES = """() => {
  const { get } = Object.getOwnPropertyDescriptor(XMLHttpRequest.prototype, "responseText");
  Object.defineProperty(XMLHttpRequest.prototype, "responseText", {
    get() {
      const [found, pictures] = get.call(this).split("\\n");
      return pictures === undefined ? found : found + '\\n{"error": "found no memory"}\\n';
    },
  });
}"""

LATE = '{"error": "found a part of the body after 60 s"}'

ANSWERS = {
    507: ("found no room on the disk of the service", "The disk of the service is full"),
    502: ("or a proxy before it, answered 502", "does not run behind its proxy"),
    500: ("the photo was given up", "see what the service printed"),
}


def test_a_slow_upload_is_not_called_unreadable(visit, ask):
    page = visit()
    with answering(page, lambda route: route.fulfill(status=408, body=LATE)):
        choose(page, FLAT / "images" / "bedroom.jpg")
        page.wait_for_selector("#facts .verdict >> text=Sent too slowly")
    assert page.locator(".count.unreadable").count() == 0
    with answering(page, giving(ask("bedroom"))):
        page.click('.copy:has-text("Try again")')
        wait_for(page, "localized")
    assert page.inner_text("#row-0 .row-status") == "Localized"


def test_without_pictures_the_viewer_says_so(visit, ask):
    page = visit()
    page.evaluate(WITHOUT_PICTURES)
    with answering(page, giving(ask("bedroom"))):
        choose(page, FLAT / "images" / "bedroom.jpg")
        wait_for(page, "localized")
    page.wait_for_selector("text=pictures could not be loaded")
    assert page.locator("#row-0 img").get_attribute("src").startswith("blob:")


def test_a_full_service_is_asked_again_and_a_lost_one_when_told_to(visit, ask, shoot):
    page = visit()
    busy = {"status": 503, "headers": {"Retry-After": "1"}, "body": '{"error": "found 32 photos that wait"}'}
    with answering(page, lambda route: route.fulfill(**busy)):
        choose(page, FLAT / "images" / "bedroom.jpg")
        page.wait_for_selector("#row-0 >> text=The service is busy; next try in 1 s")
    wait_for(page, "localized")
    with answering(page, lambda route: route.abort()):
        choose(page, FLAT / "images" / "bedroom.jpg")
        page.wait_for_selector("#row-1 >> text=The connection to the service was lost.")
    assert list_names(page) == ["bedroom", "bedroom (2)"]
    page.click("#row-1")
    shoot(page, "drop-lost")
    with answering(page, giving(ask("bedroom"))):
        page.click('.copy:has-text("Try again")')
        wait_for(page, "localized", "localized")


@pytest.mark.parametrize("status", ANSWERS)
def test_what_gave_way_is_told(visit, ask, shoot, status):
    page = visit()
    found, advice = ANSWERS[status]
    body = "<h1>Bad gateway</h1>" if status == 502 else f'{{"error": "{found}"}}'
    with answering(page, lambda route: route.fulfill(status=status, body=body)):
        choose(page, FLAT / "images" / "bedroom.jpg")
        page.wait_for_selector(f"#facts >> text={found}")
    assert page.locator(f"#facts >> text={advice}").is_visible()
    assert "opens here" not in page.inner_text("#facts")
    shoot(page, f"drop-{status}")
    with answering(page, giving(ask("bedroom"))):
        page.click('.copy:has-text("Try again")')
        wait_for(page, "localized")


def test_a_slow_upload_shows_how_far_it_is(visit, tmp_path):
    page = visit(**PHONE)
    link = {"offline": False, "latency": 0, "downloadThroughput": -1, "uploadThroughput": 500_000}
    page.context.new_cdp_session(page).send("Network.emulateNetworkConditions", link)
    large = tmp_path / "large.jpg"
    large.write_bytes((FLAT / "images" / "bedroom.jpg").read_bytes() + bytes(1_500_000))
    choose(page, large)
    page.wait_for_selector(r".progress >> text=/large: Being sent, [1-9]\d? %/")  # in sight
    page.wait_for_selector(".progress >> text=large: Being localized")
    page.wait_for_selector("#viewer[data-shown]")


def test_a_reload_asks_before_it_loses_what_was_found(visit, ask):
    page = visit()
    asked = []
    page.on("dialog", lambda dialog: asked.append(dialog.type))
    with answering(page, giving(ask("bedroom"))):
        choose(page, FLAT / "images" / "bedroom.jpg")
        wait_for(page, "localized")
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
    with serving(cache, "--keep", folder) as address, opening(browser, (address, "data:", "blob:")) as visit:
        yield address, visit


def test_what_is_kept_is_there_again_and_links_open_it(browser, cache, tmp_path, shoot):
    photos = [FLAT / "images" / name for name in ("bedroom.jpg", "living_room.jpg")]
    with _keeping(browser, cache, tmp_path) as (address, visit):
        page = visit(address, 1400, 860)
        page.set_default_timeout(SLOW_MS)
        choose(page, photos[0])  # one after the other, as they are kept in the order of their answers
        wait_for(page, "localized")
        choose(page, photos[1])
        wait_for(page, "localized", "localized")
        page.click("#row-1")
        page.wait_for_selector('#viewer[data-shown="1"]')
        assert page.locator(".copy:has-text('Copy link')").count() == 1
        link = page.evaluate("location.href")
        page.reload()  # it asks nothing
        assert list_names(page) == ["bedroom", "living_room"]
    with _keeping(browser, cache, tmp_path) as (again, visit):
        page = visit(link.replace(address, again), 1400, 860)
        page.set_default_timeout(SLOW_MS)
        page.wait_for_selector('#viewer[data-shown="1"]')
        assert page.inner_text("#photo-name") == "living_room"
        assert list_names(page) == ["bedroom", "living_room"]
        assert page.locator("#row-1 img").evaluate("image => image.naturalWidth") > 0
        shoot(page, "drop-kept")
        choose(page, photos[0])  # the same photo takes its own place
        page.wait_for_selector("#row-1 >> text=bedroom")
        wait_for(page, "localized", "localized")
        assert sorted(list_names(page)) == ["bedroom", "living_room"]


def test_the_answer_of_another_scan_is_not_shown_on_old_plans(visit, ask):
    page = visit()
    page.evaluate("PICCOLO_REPORT.scanSha256 = '0'.repeat(64)")  # as if it was loaded before
    with answering(page, giving(ask("bedroom"))):
        choose(page, FLAT / "images" / "bedroom.jpg")
        page.wait_for_selector("#row-0 >> text=The scan was replaced")
    assert "The scan was replaced after this page was loaded" in page.inner_text("#note")
    page.click("text=load the page again")
    page.wait_for_selector("body.no-photos")
