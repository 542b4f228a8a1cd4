"""Which photos are looked at again, and the order of results meanwhile: on values."""

from dataclasses import replace

from results import NONE_ASKED, phone_result

from piccolo.batch.results_file import StreamOutput
from piccolo.judge.result_parts import Beside
from piccolo.together.second_looks import MOST_PICTURES, list_looks_beside, localize_in_order


def test_doubtful_phone_photos_are_looked_at_beside_sure_ones():
    """What was localized beside others is no picture for others; spheres are not looked at again."""
    statuses = ("localized", "ambiguous", "not_localized", "unreadable", "failed")
    results = [phone_result(f"{k}", status) for k, status in enumerate(statuses)]
    results += [phone_result("5", beside=Beside(("0",), "0" * 64)), phone_result("6", cameras=())]
    results += [phone_result("7", "ambiguous", cameras=()), phone_result("8", "not_localized", NONE_ASKED)]
    results += [phone_result("9", confidence=0.94)]
    looks = list_looks_beside(results)
    assert [(look.number, look.pano, look.first) for look in looks] == [
        (1, "1", results[1]),
        (2, "2", results[2]),
        (5, "5", None),
        (8, "8", results[8]),
    ]
    assert all(look.beside == (results[0], results[6]) for look in looks)
    results[1] = phone_result("1", "ambiguous", Beside((), looks[0].asked_sha256))
    assert [look.number for look in list_looks_beside(results)] == [2, 5, 8]
    results[6] = phone_result("6", "ambiguous")
    assert [look.number for look in list_looks_beside(results)] == [1, 2, 5, 6, 8]
    assert [(look.number, look.beside) for look in list_looks_beside(results[1:6])] == [(0, ()), (4, ())]


def test_a_photo_is_looked_at_beside_the_nearest_in_order():
    results = [
        phone_result(f"{k}", "ambiguous" if k == 40 else "localized") for k in range(MOST_PICTURES + 30)
    ]
    (look,) = list_looks_beside(results)
    assert look.beside == tuple(one for k, one in enumerate(results) if k != 40 and k <= MOST_PICTURES)


def test_lines_on_a_stream_keep_their_order_and_wait_for_one_that_may_change():
    texts = [
        phone_result(f"{k}", status).to_json()
        for k, status in enumerate(("localized", "ambiguous", "localized"))
    ]
    surer = phone_result("surer").to_json()
    for may_change, before in ((True, texts[:1]), (False, texts)):
        written = []
        output = StreamOutput(written.append, may_change)
        for text in texts:
            output.write(text)
        assert written == before
        if may_change:
            output.replace(1, surer)
            assert [one.pano for one in output.results()] == ["0", "surer", "2"]
        output.close()
        assert written == ([texts[0], surer, texts[2]] if may_change else texts)


def test_results_come_in_order_and_wait_for_one_that_may_change():
    statuses = ("localized", "ambiguous", "localized")
    asked = []

    def localize(k):
        asked.append(k)
        return phone_result(f"{k}", statuses[k])

    def look_again(k, look):
        assert [one.pano for one in look.beside] == ["0", "2"]
        return replace(look.first, status="localized", beside=Beside(("0",), look.asked_sha256))

    found = localize_in_order(range(3), localize, look_again, 0.9)
    assert next(found).pano == "0"
    assert asked == [0]
    second, third = found
    assert asked == [0, 1, 2]
    assert (second.pano, second.status, second.beside.photos) == ("1", "localized", ("0",))
    assert third == phone_result("2")
