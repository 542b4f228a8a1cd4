"""A second look at photos of a batch that are not sure, beside those that are."""

import json
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import pytest

from piccolo import open_scan, opened_scan
from piccolo.batch import localizer as module
from piccolo.batch.localizer import MOST_PICTURES, Answer
from piccolo.batch.outputs import StreamOutput
from piccolo.batch.second_look import list_looks
from piccolo.camera import Mount
from piccolo.camera.model import pinhole
from piccolo.cli import localize
from piccolo.confidence.localization import Localization
from piccolo.errors import InputError
from piccolo.panorama import ReadOptions
from piccolo.result import Result

CAMERA = {"model": "PINHOLE"}
PHONE = (Mount(pinhole(1024, 512, 400.0)),)


def _text(pano, status="localized", beside=None, camera=CAMERA):
    return json.dumps({"pano": pano, "status": status, "beside": beside, "camera": camera})


def test_doubtful_phone_photos_are_looked_at_beside_sure_ones():
    """What was localized beside others is no picture for others; spheres are not looked at again."""
    statuses = ("localized", "ambiguous", "not_localized", "unreadable", "failed")
    texts = [_text(f"{k}", status) for k, status in enumerate(statuses)]
    texts += [_text("5", "localized", ["0"]), _text("6", "localized", camera=None)]
    texts += [_text("7", "ambiguous", camera=None), _text("8", "not_localized", [])]
    looks = list_looks(texts, is_again=False)
    assert [(look.number, look.status, look.first) for look in looks] == [
        (1, "ambiguous", texts[1]),
        (2, "not_localized", texts[2]),
    ]
    assert all(look.beside == (texts[0], texts[6]) for look in looks)
    assert [look.number for look in list_looks(texts, is_again=True)] == [1, 2, 8]
    assert list_looks(texts[1:5], is_again=True) == []


def test_a_photo_is_looked_at_beside_the_nearest_in_order():
    texts = [_text(f"{k}", "ambiguous" if k == 40 else "localized") for k in range(MOST_PICTURES + 30)]
    (look,) = list_looks(texts, is_again=False)
    assert look.beside == tuple(text for k, text in enumerate(texts) if k != 40 and k <= MOST_PICTURES)


def test_lines_on_a_stream_keep_their_order_and_wait_for_one_that_may_change():
    texts = [_text(f"{k}", status) for k, status in enumerate(("localized", "ambiguous", "localized"))]
    for may_change, before in ((True, texts[:1]), (False, texts)):
        written = []
        output = StreamOutput(written.append, may_change)
        for text in texts:
            output.write(text)
        assert written == before
        if may_change:
            output.replace(1, "surer")
            assert output.texts() == [texts[0], "surer", texts[2]]
        output.finish()
        assert written == ([texts[0], "surer", texts[2]] if may_change else texts)


@pytest.fixture
def photos(scene, tmp_path):
    """A folder of three photos, b of which is not sure alone."""
    folder = tmp_path / "photos"
    folder.mkdir()
    for k, name in enumerate("abc"):
        (folder / f"{name}.jpg").write_bytes((scene / "images" / f"clean_{k}.jpg").read_bytes())
    return folder


class Looked(NamedTuple):
    """Photos that were looked at again, each with those beside it; and first results, by name."""

    asked: list
    firsts: dict


@pytest.fixture
def looked(monkeypatch):
    """What is looked at again; b and d are not sure before, and d is not after."""
    answer, looked = module.Localizer.answer, Looked([], {})

    def answer_first(self, scan, task):
        found = answer(self, scan, task).result
        is_sure = task.pano.name not in ("b.jpg", "d.jpg")
        found = replace(found, cameras=PHONE, status=found.status if is_sure else "ambiguous")
        looked.firsts[task.pano.name] = found.to_json()
        return Answer(found)

    def answer_again(self, scan, task, locate):
        first = Result.from_json(task.first)
        looked.asked.append((task.pano.name, [Path(json.loads(text)["pano"]).name for text in task.beside]))
        if task.pano.name == "d.jpg":
            return Answer(replace(first, beside=()))
        return Answer(replace(first, status="localized", beside=(json.loads(task.beside[0])["pano"],)))

    monkeypatch.setattr(module.Localizer, "answer", answer_first)
    monkeypatch.setattr(module.Localizer, "answer_again", answer_again)
    return looked


def _run(scene, photos, *more):
    cloud = str(scene / "cloud.ply")
    return localize.main(["--cloud", cloud, "--pano", str(photos), "--cache", "none", *map(str, more)])


def _lines(text):
    return [(Path(d["pano"]).name, d["status"], d["beside"]) for d in map(json.loads, text.splitlines())]


def test_a_photo_is_found_beside_others_in_a_file_and_on_stdout(scene, photos, tmp_path, looked, capsys):
    out = tmp_path / "poses.jsonl"
    first = str(photos / "a.jpg")
    expected = [("a.jpg", "localized", None), ("b.jpg", "localized", [first]), ("c.jpg", "localized", None)]
    assert _run(scene, photos, "--out", out) == 0
    assert _lines(out.read_text()) == expected
    assert looked.asked == [("b.jpg", ["a.jpg", "c.jpg"])]
    assert "3 localized, 0 ambiguous" in capsys.readouterr().err
    assert _run(scene, photos) == 0
    assert _lines(capsys.readouterr().out) == expected
    assert _run(scene, photos, "--out", out) == 0
    assert "nothing is left to do" in capsys.readouterr().err
    assert len(looked.asked) == 2
    assert _run(scene, photos / "b.jpg", "--out", tmp_path / "alone.jsonl", "--quiet") == 1
    assert len(looked.asked) == 2, "a photo alone has none beside it"


def test_a_second_look_goes_on_where_it_was_stopped(scene, photos, tmp_path, looked, capsys):
    """With all first results it begins, with a second one that result is kept; a new photo repeats it."""
    out = tmp_path / "poses.jsonl"
    (photos / "d.jpg").write_bytes((photos / "c.jpg").read_bytes())
    assert _run(scene, photos, "--out", out, "--quiet") == 1
    whole = out.read_text()
    a, b, c, d = whole.splitlines(keepends=True)
    assert _lines(d) == [("d.jpg", "ambiguous", [])]
    firsts = [looked.firsts[name] + "\n" for name in ("b.jpg", "d.jpg")]
    for left, repeated in ((firsts, ["b.jpg", "d.jpg"]), ([*firsts, b], ["d.jpg"]), ([b, d], [])):
        looked.asked.clear()
        out.write_text("".join([a, left[0], c, *left[1:]]))
        assert _run(scene, photos, "--out", out, "--quiet") == 1
        assert [name for name, _ in looked.asked] == repeated
        assert out.read_text() == whole
    looked.asked.clear()
    (photos / "e.jpg").write_bytes((photos / "a.jpg").read_bytes())
    assert _run(scene, photos, "--out", out, "--quiet") == 1
    assert looked.asked == [("d.jpg", ["a.jpg", "c.jpg", "e.jpg"])]
    capsys.readouterr()


def test_a_photo_that_is_gone_then_keeps_its_result(scene, photos, tmp_path, looked, monkeypatch):
    out = tmp_path / "poses.jsonl"
    (photos / "d.jpg").write_bytes((photos / "c.jpg").read_bytes())

    def answer_again(self, scan, task, _locate):
        return self._answer(scan, task, lambda *_, **__: (photos / "none").read_bytes())

    monkeypatch.setattr(module.Localizer, "answer_again", answer_again)
    assert _run(scene, photos, "--out", out, "--quiet") == 1
    assert [line[1:] for line in _lines(out.read_text())][1] == ("ambiguous", None)


def test_a_second_result_counts_if_it_is_surer(scene, monkeypatch):
    """And no photo whose focal length is a guess is looked at."""
    scan = open_scan(scene / "cloud.ply", cache=False)
    photo = str(scene / "images" / "clean_0.jpg")
    first = scan.localize(photo)
    opened, asked = scan._opened, []

    def localize_beside(prepared, picture, poses, pictures, *_):
        asked.append(([scan._opened.from_world(first.best_pose).key], [pose.key for pose in poses[:1]]))
        return Localization("localized", confidence, 0.0, first.best_pose, alternatives=()), tuple(pictures)

    monkeypatch.setattr(opened_scan, "localize_beside", localize_beside)
    for confidence, beside in ((0.7, ("x",)), (0.5, ())):
        doubtful = replace(first, confidence=0.5, status="ambiguous")
        found = opened.localize_again(photo, doubtful, {"x": None}, ReadOptions(), opened.settings)
        assert found.beside == beside
        assert found.confidence == max(confidence, 0.5)
        assert found.status == ("localized" if beside else "ambiguous")
        assert found.source == first.source
    assert all(given == known for given, known in asked)
    monkeypatch.setattr(opened_scan, "has_guessed_focal", lambda picture: True)
    assert opened.localize_again(photo, doubtful, {}, ReadOptions(), opened.settings).beside == ()
    assert len(asked) == 2


def test_a_picture_that_is_gone_is_none_and_others_are_located_once(scene, tmp_path, monkeypatch):
    scan = open_scan(scene / "cloud.ply", cache=False)
    photo = tmp_path / "a.jpg"
    photo.write_bytes((scene / "images" / "clean_0.jpg").read_bytes())
    text = scan.localize(str(photo)).to_json()
    opened = scan._opened
    settings = opened.settings, opened.cloud_settings
    localizer = module.Localizer((scene / "cloud.ply",), *settings, ReadOptions(), None)
    located = localizer.locate(opened, text)
    assert located.pose.key == opened.from_world(Result.from_json(text).best_pose).key
    assert len(located.ranges) == len(located.keypoints.rays) > 50
    assert (located.ranges > 0.0).all()
    asked = []
    monkeypatch.setattr(module.Localizer, "locate", lambda self, scan, line: asked.append(line))
    monkeypatch.setattr(
        module.Localizer, "answer_again", lambda self, scan, task, locate: [locate(t) for t in task.beside]
    )
    answer = localizer.answer_in(opened)
    task = localizer.task_again(text, ("x", "y"))
    assert task.pano == photo
    answer(task)
    answer(task._replace(beside=("y", "z")))
    assert asked == ["x", "y", "z"]
    monkeypatch.undo()
    photo.unlink()
    assert localizer.locate(opened, text) is None
    with pytest.raises(InputError, match="photos beside others: not available with the preset paper"):
        opened.not_of_paper("photos beside others", None)
