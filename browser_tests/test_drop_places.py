"""What a person tells the page of a service of where a photo was taken, and what it shows of that."""

from functools import partial

import pytest
from dropping import FLAT, LISTEN, answering, choose, giving, tell_place, wait_for

WRONG = {
    "Contradicts the place you told": ((29.0, -7.5), "near"),  # at the other end of the flat
    "The place you told is not in the scan": ((500.0, 500.0), "nowhere"),
}

# the azimuth [deg] at which the second photo looks
AHEAD = """() => {
  const { rotation } = PICCOLO_REPORT.photos[1].pose;
  return (Math.atan2(rotation[1], rotation[0]) * 180) / Math.PI;
}"""


def test_a_place_is_shown_on_the_plan(visit, ask):
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
    choose(page, FLAT / "images" / "bedroom.jpg")
    wait_for(page, "localized")
    assert page.evaluate("told") == {"prior": {"near": [x, y, None], "radius": 5}}
    assert page.locator(f".told >> text={told}").is_visible()  # it is told of the next ones too
    page.click(".told >> text=Clear")
    assert not page.locator(".told").is_visible()
    with answering(page, giving(ask("bedroom"))):
        choose(page, FLAT / "images" / "bedroom.jpg")
        wait_for(page, "localized", "localized")
    assert page.evaluate("told") == {}


@pytest.mark.parametrize("verdict", WRONG)
def test_a_place_that_the_photo_contradicts_is_the_headline(visit, shoot, verdict):
    page = visit()
    place, reason = WRONG[verdict]
    tell_place(page, *place, 1.0)
    choose(page, FLAT / "images" / "bedroom.jpg")
    wait_for(page, "not_localized")
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
    wait_for(page, "localized")
    assert page.evaluate("told") == {}
    page.wait_for_selector("#facts .verdict >> text=Localized")
    page.click(".drop >> text=Options")  # the place is not told of later photos either
    assert page.input_value("[name=x]") == ""


def test_the_view_turns_to_a_photo_that_would_be_out_of_sight(visit):
    page = visit()
    choose(page, FLAT / "images" / "living_room.jpg", FLAT / "images" / "phone.jpg")
    wait_for(page, "localized", "localized")
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
    with answering(page, lambda route: route.fulfill(**busy)):
        choose(page, FLAT / "images" / "bedroom.jpg")
        page.wait_for_selector("#row-0 >> text=The service is busy")
    with answering(page, lambda route: route.abort()):
        choose(page, FLAT / "images" / "living_room.jpg")
        page.wait_for_selector("#row-1 >> text=The connection")
    page.click("#row-0")
    page.click("text=Take off the list")
    page.wait_for_selector("#photo-name >> text=living_room")
