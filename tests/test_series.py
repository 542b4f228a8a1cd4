"""Photos of a batch that were taken together, by times and names, and the looks that are taken at them."""

from dataclasses import replace

import numpy as np

from piccolo.api.scan_look import take_surer
from piccolo.geometry.pose import Pose
from piccolo.judge.result import Result
from piccolo.judge.result_parts import Beside, FocalLength, Source
from piccolo.photo.camera import Mount
from piccolo.photo.camera.model import pinhole
from piccolo.together.second_looks import follow, list_looks_beside, list_looks_together
from piccolo.together.series import MOST_IN_SERIES, list_series

PHONE = (Mount(pinhole(640, 480, 400.0)),)
NOWHERE = Pose(np.eye(3), np.zeros(3))
SOME_TIME = "2024-05-01T10:00:{}"


def _result(pano, status="localized", time=None, cameras=PHONE, **more):
    source = Source(None, "1" * 64, (640, 480), time)
    confidence = 0.95 if status == "localized" else 0.5
    about = {"source": source, "cameras": cameras, "confidence": confidence, **more}
    return Result(status, cloud="a.ply", pano=pano, best_pose=NOWHERE, **about)


def test_times_tell_what_was_taken_together():
    times = ["10:00:30", "10:00:00", "10:01:30", "10:02:31", "10:03:00"]
    results = [_result(f"IMG_{k}.jpg", time=f"2024-05-01T{time}") for k, time in enumerate(times)]
    assert list_series(results) == [[1, 0, 2], [3, 4]]
    with_offset = _result("other.jpg", time="2024-05-01T10:00:00+02:00")
    assert list_series([*results, with_offset]) == [[1, 0, 2], [3, 4]], "clocks that can't be compared"


def test_names_tell_what_was_taken_together_where_no_times_do():
    names = ["a/room_1.jpg", "a/room_02.jpg", "b/room_3.jpg", "a/IMG-20240501-WA0007.jpg", "a/door.jpg"]
    names += ["a/IMG-20240501-WA0012.jpg", "a/window.jpg"]
    results = [_result(name) for name in names]
    assert list_series(results) == [[0, 1], [2, 4, 6], [3, 5]], "the rest may be of one place"
    results[0] = _result(names[0], time=SOME_TIME.format("00"))
    assert list_series(results) == [[1, 2, 4, 6], [3, 5]]
    results[5] = _result(names[5], cameras=())
    assert list_series(results) == [[1, 2, 3, 4, 6]], "a sphere is not of them"


def test_a_long_series_is_divided_evenly():
    results = [_result(f"{k}.jpg") for k in range(2 * MOST_IN_SERIES + 1)]
    found = list_series(results)
    assert [len(series) for series in found] == [16, 16, 17]
    assert [k for series in found for k in series] == list(range(len(results)))


def test_photos_that_are_not_localized_are_looked_at_together_once():
    results = [
        _result(f"{k}.jpg", status) for k, status in enumerate(("localized", "ambiguous", "localized"))
    ]
    assert list_looks_together([results[0], results[2]]) == []
    (beside,) = list_looks_beside(results)
    results[1] = replace(results[1], beside=Beside((), beside.asked_sha256))
    (look,) = list_looks_together(results)
    assert (look.number, look.first, look.series) == (1, results[1], tuple(results))
    assert (look.beside, look.asked_sha256) == ((), beside.asked_sha256)
    results[1] = take_surer(results[1], None, look.asked_sha256)
    assert results[1].beside == Beside((), beside.asked_sha256, is_together=True)
    assert list_looks_together(results) == list_looks_beside(results) == []
    more = [*results, _result("3.jpg", "not_localized")]
    assert [look.number for look in list_looks_beside(more)] == [1, 3], "another was taken with it"
    elsewhere = [*results, _result("elsewhere.jpg", "not_localized")]
    assert [look.number for look in list_looks_beside(elsewhere)] == [3]


def test_without_any_that_is_sure_they_are_looked_at_together():
    results = [_result(f"{k}.jpg", "ambiguous") for k in range(2)]
    assert list_looks_beside(results) == []
    looks = list_looks_together(results)
    assert [look.number for look in looks] == [0, 1]
    results = [take_surer(one, None, look.asked_sha256) for one, look in zip(results, looks, strict=True)]
    assert list_looks_together(results) == list_looks_beside(results) == []
    (alone,) = list_looks_beside(results[:1])
    assert (alone.first, alone.beside) == (results[0], ()), "it is as it was before"


def test_only_what_is_surer_counts():
    first = _result("0.jpg", "ambiguous", beside=Beside(("sure.jpg",), "1"))
    unsurer = _result("0.jpg", "not_localized", beside=Beside(("1.jpg",), ""))
    assert take_surer(first, unsurer, "1") == replace(
        first, beside=Beside(("sure.jpg",), "1", is_together=True)
    )
    surer = _result("0.jpg", beside=Beside(("1.jpg",), ""))
    assert take_surer(first, surer, "1") == replace(surer, beside=Beside(("1.jpg",), "1", is_together=True))


def test_what_a_photo_said_alone_of_its_focal_length_stays():
    alone = FocalLength(400.0, 4.0, 390.0, 8.0, 405.0, 5.0)
    found = FocalLength(402.0, 1.0, 390.0, 8.0, 402.5, 1.5, 0.1)
    first = _result("0.jpg", focal_length=alone)
    placed = _result("0.jpg", focal_length=found)
    assert follow(first, placed).focal_length == replace(alone, px=402.0, std_px=1.0, doubt=0.1)
    without = replace(first, focal_length=None)
    told = follow(without, placed).focal_length
    assert told == replace(found, picture_px=None, picture_std_px=None)
    assert told.opinion is None, "others told it"
