"""A second look at photos of a batch that are not sure, beside those that are.

The first test takes one as a whole; where many are needed, which photos are sure alone or beside others is
made up by their names, and what a batch asks for and keeps is looked at.
"""

import errno
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import rooms
from batches import untimed
from camera_room import SEED, place
from pictures import encoded, write
from poses import judged
from results import PHONE

from piccolo import open_scan
from piccolo.api import scan_look
from piccolo.api.result_files import read_results
from piccolo.api.scan import Scan
from piccolo.api.scan_look import Looking, Others
from piccolo.batch.localizer import Localizer
from piccolo.cli import localize
from piccolo.cloud.cloud_settings import CloudSettings
from piccolo.geometry.pose import Pose, yaw_rotation
from piccolo.judge.belief import make_belief
from piccolo.judge.pose_covariance import describe_errors
from piccolo.judge.result_parts import Beside
from piccolo.photo.camera import Mount
from piccolo.photo.camera.calibration import document_of
from piccolo.photo.camera.model import pinhole
from piccolo.photo.photo import Photo
from piccolo.system.errors import InputError
from piccolo.system.jobs.threads import Workers
from piccolo.together.second_looks import Look
from research.synthetic.world import render_picture

TIER = "scene"
pytestmark = pytest.mark.usefixtures("searched_once")


def test_a_doubtful_photo_is_sure_beside_another(tmp_path):
    """A narrow photo of what a wide one shows, which is added to the run; a copy of itself is none."""
    room, pose = place()
    near = Pose(yaw_rotation(0.2) @ pose.R_cam_from_world, pose.center_world + np.array([0.15, 0.1, 0.05]))
    photos = tmp_path / "photos"
    cameras = tmp_path / "cameras"
    out = tmp_path / "poses.jsonl"
    photos.mkdir()
    cameras.mkdir()
    for name, focal, at in (("narrow", 240.0, near), ("wide", 90.0, pose)):
        camera = Mount(pinhole(320, 240, focal))
        write(photos / f"{name}.png", encoded(render_picture(camera, room, at, Workers(2)), ".png"))
        write(cameras / f"{name}.camera.json", json.dumps(document_of((camera,))).encode())
    words = ["--cloud", str(rooms.map_path(SEED)), "--camera", str(cameras), "--gravity", "known", "--quiet"]
    assert localize.main([*words, "--pano", str(photos / "narrow.png"), "--out", str(out)]) == 1
    (before,) = read_results([out])
    assert localize.main([*words, "--pano", str(photos), "--out", str(out)]) == 0
    narrow, wide = sorted(read_results([out]), key=lambda result: result.pano)
    assert before.status != "localized"
    assert (wide.status, wide.beside) == ("localized", None)
    assert (narrow.status, narrow.beside.photos) == ("localized", (wide.pano,))
    assert before.confidence < narrow.confidence <= wide.confidence
    assert narrow.pose.distance(near) < 0.05
    localizer = Localizer((Path("room"),), rooms.KNOWN, CloudSettings(), Photo("", camera=cameras), None)
    look = Look(0, narrow.pano, before, (narrow,), "1")
    task = localizer.task(photos / "narrow.png")
    again = localizer.answer_in(rooms.scan(SEED))(task._replace(look=look))
    assert again.result == replace(before, beside=Beside((), "1"))


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


def _sure_by(confidence):
    """The fields of a result whose best pose is the only one that is likely."""
    belief = make_belief([confidence])
    stated = {"confidence": confidence, "probability_none": 1.0 - confidence}
    return {"belief": belief, "alternatives": (), **stated}


@pytest.fixture
def looked(monkeypatch):
    """What is looked at again; b and d are not sure before, and d is not after."""
    ask = Scan.localize_photo
    known = {}
    looked = Looked([], {})

    def localize(self, asked, *more, **noted):
        photo = asked.photo
        content = photo.path.read_bytes()
        if content not in known:
            known[content] = ask(self, asked, *more, **noted)
        found = replace(known[content], pano=photo.name)
        is_sure = photo.path.name not in ("b.jpg", "d.jpg")
        status = found.status if is_sure else "ambiguous"
        found = replace(found, cameras=PHONE, status=status, **_sure_by(0.95))
        looked.firsts[photo.path.name] = found.to_json()
        return found

    def localize_again(_self, photo, first, list_pictures, *_):
        names = tuple(list_pictures())
        looked.asked.append((photo.path.name, [Path(name).name for name in names]))
        return (first, ()) if photo.path.name == "d.jpg" else (replace(first, status="localized"), names[:1])

    monkeypatch.setattr(Scan, "localize_photo", localize)
    monkeypatch.setattr(Looking, "localize_again", localize_again)
    monkeypatch.setattr(Looking, "place", lambda self, photo, result, settings: result)
    monkeypatch.setattr(Looking, "localize_series", lambda self, asked, known: {})
    return looked


def _run(scene, photos, *more):
    cloud = str(scene / "cloud.ply")
    cache = scene.parent / "maps"
    return localize.main(["--cloud", cloud, "--pano", str(photos), "--cache", str(cache), *map(str, more)])


def _lines(text):
    """Name, status, and names of those beside which it was found."""
    found = [(Path(d["pano"]).name, d["status"], d["beside"]) for d in map(json.loads, text.splitlines())]
    return [
        (name, status, beside and [Path(photo).name for photo in beside["photos"]])
        for name, status, beside in found
    ]


SURE = ("localized", None)


def test_a_photo_is_found_beside_others_in_a_file_and_on_stdout(scene, photos, tmp_path, looked, capsys):
    out = tmp_path / "poses.jsonl"
    expected = [("a.jpg", *SURE), ("b.jpg", "localized", ["a.jpg"]), ("c.jpg", *SURE)]
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


def test_a_second_look_is_of_the_photos_that_there_are(scene, photos, tmp_path, looked, capsys):
    """Wherever a run was killed, and whatever was added or removed, it ends like one that was not."""
    out, whole = tmp_path / "poses.jsonl", tmp_path / "whole.jsonl"
    (photos / "d.jpg").write_bytes((photos / "c.jpg").read_bytes())

    def run_again(*repeated):
        looked.asked.clear()
        assert _run(scene, photos, "--out", out, "--quiet") == 1
        assert [name for name, _ in looked.asked] == list(repeated)
        assert _run(scene, photos, "--out", whole, "--quiet", "--overwrite") == 1
        assert untimed(out) == untimed(whole)

    run_again("b.jpg", "d.jpg")
    a, b, c, d = out.read_text().splitlines(keepends=True)
    assert _lines(b + d) == [("b.jpg", "localized", ["a.jpg"]), ("d.jpg", "ambiguous", [])]
    first, last = (looked.firsts[name] + "\n" for name in ("b.jpg", "d.jpg"))
    for lines, repeated in (
        ((a, first, c, last), ("b.jpg", "d.jpg")),
        ((a, first, c, last, b), ("d.jpg",)),
        ((a, first, c, last, b, d[:50]), ("d.jpg",)),
        ((a, b, c, d), ()),
    ):
        out.write_text("".join(lines))
        run_again(*repeated)
    (photos / "bad.jpg").write_bytes(b"nothing")
    assert _run(scene, photos, "--out", out, "--quiet") == 3
    assert len(_lines(out.read_text())) == 5
    (photos / "bad.jpg").unlink()
    run_again()
    (photos / "e.jpg").write_bytes((photos / "a.jpg").read_bytes())
    run_again("b.jpg", "d.jpg")
    for name in ("a.jpg", "e.jpg"):
        (photos / name).unlink()
        run_again("b.jpg", "d.jpg")
    (photos / "c.jpg").unlink()
    run_again()  # with nothing beside them they are as they were alone, and asked together
    assert [line[1:] for line in _lines(out.read_text())] == [("ambiguous", [])] * 2
    capsys.readouterr()


def test_a_photo_named_twice_keeps_its_lines(scene, photos, tmp_path, looked, capsys):
    """A run with nothing left to do leaves the file as it is."""
    out = tmp_path / "poses.jsonl"
    names = [str(photos / f"{name}.jpg") for name in "aabb"]
    for asked in (4, 0):
        looked.firsts.clear()
        assert _run(scene, names[0], "--pano", *names, "--out", out) == 0
        assert len(_lines(out.read_text())) == 4
        assert bool(looked.firsts) == bool(asked)
        before = out.stat().st_ino, out.read_bytes()
    assert _run(scene, names[0], "--pano", *names, "--out", out) == 0
    assert (out.stat().st_ino, out.read_bytes()) == before
    assert "nothing is left to do" in capsys.readouterr().err


def test_of_lines_that_stay_those_are_dropped_that_others_replace(
    scene, photos, tmp_path, looked, monkeypatch, capsys
):
    """A run was killed in a second look; the next is of a name on standard input."""
    out = tmp_path / "poses.jsonl"
    assert _run(scene, photos, "--out", out, "--quiet") == 0
    a, b, c = out.read_text().splitlines(keepends=True)
    before = json.dumps(json.loads(b) | {"seconds": {"read": 1.0}}) + "\n"
    out.write_text(a + looked.firsts["b.jpg"] + "\n" + c + before + b)
    names = tmp_path / "names"
    names.write_text(str(photos / "a.jpg"))
    with names.open() as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        assert _run(scene, "-", "--out", out) == 0
    assert "dropped" not in capsys.readouterr().err
    assert out.read_text() == c + b + a


def test_a_look_that_fails_is_told_and_leaves_the_result(
    scene, photos, tmp_path, looked, monkeypatch, capsys
):
    out = tmp_path / "poses.jsonl"

    def localize_again(*_):
        raise OSError(errno.EIO, "Input/output error", "disk")

    monkeypatch.setattr(Looking, "localize_again", localize_again)
    assert _run(scene, photos, "--out", out, "--quiet") == 1
    assert "disk: cannot be used (Input/output error)" in capsys.readouterr().err
    assert _lines(out.read_text())[1] == ("b.jpg", "ambiguous", [])

    def stop(*_):
        raise RuntimeError

    monkeypatch.setattr(Looking, "localize_again", stop)
    assert _run(scene, photos, "--quiet") == 4
    assert len(_lines(capsys.readouterr().out)) == 3, "lines that waited are not lost"


def test_what_is_looked_at(scene, monkeypatch):
    """No photo whose focal length is a guess, none that is another by now; and with all that was found."""
    scan = open_scan(scene / "cloud.ply", cache=False)
    photo = scene / "images" / "clean_0.jpg"
    first = replace(scan.localize(str(photo)), status="ambiguous", **_sure_by(0.5))
    asked = []
    other = replace(first, source=replace(first.source, pano_sha256="0"))

    def localize_beside(_prepared, _picture, poses, pictures, *_):
        asked.append([pose.key for pose in poses[:1]])
        return judged("localized", make_belief([0.93]), first.best_pose), tuple(pictures)

    monkeypatch.setattr(scan_look, "localize_beside", localize_beside)

    def look(before, pictures):
        looking = Looking(scan.prepared, scan.reader, scan.workers)
        return looking.localize_again(Photo(photo), before, lambda: pictures, scan.settings)

    found, names = look(first, {"x": None})
    assert (found.status, found.confidence, names) == ("localized", 0.93, ("x",))
    assert found.source == first.source
    assert look(replace(first, **_sure_by(0.95)), {"x": None})[1] == (), "it is no surer"
    del asked[1:]
    assert asked == [[scan.prepared.from_world(first.best_pose).key]]
    assert look(first, {}) == (first, ())
    assert len(asked) == 2
    assert look(other, {"x": None}) == (other, ())
    monkeypatch.setattr(scan_look, "has_guessed_focal", lambda picture: True)
    assert look(first, {"x": None}) == (first, ())
    assert len(asked) == 2


def test_pictures_are_read_once_and_only_as_they_were(scene, tmp_path, monkeypatch):
    scan = open_scan(scene / "cloud.ply", cache=False)
    photo = tmp_path / "a.jpg"
    photo.write_bytes((scene / "images" / "clean_0.jpg").read_bytes())
    sure = scan.localize(str(photo))
    settings = scan.settings, scan.cloud_settings
    localizer = Localizer((scene / "cloud.ply",), *settings, Photo(""), None)
    others = Others(scan, localizer.ask_by_result)
    located, confidence, gaussian = others.place(sure)
    assert confidence == sure.confidence
    in_world = describe_errors(gaussian, scan.prepared.R_map_from_world.T).matrix
    np.testing.assert_allclose(in_world, sure.covariance.matrix, atol=1e-9)
    assert located.pose.key == scan.from_world(sure.best_pose).key
    assert len(located.ranges) == len(located.keypoints.rays) > 50
    assert (located.ranges > 0.0).all()
    asked = []
    others = [replace(sure, pano=name) for name in "bcd"]
    with monkeypatch.context() as patch:
        patch.setattr(Looking, "place", lambda self, photo, one, settings: asked.append(one.pano))
        patch.setattr(Looking, "localize_again", lambda self, path, first, found, *_: (first, (*found(),)))
        answer = localizer.answer_in(scan)
        for beside in (others[:2], others[1:]):
            look = Look(0, str(photo), sure, tuple(beside), "1")
            answer(localizer.task(photo)._replace(look=look))
    assert asked == ["b", "c", "d"]
    photo.write_bytes((scene / "images" / "clean_1.jpg").read_bytes())
    assert Others(scan, localizer.ask_by_result).place(sure) is None
    photo.unlink()
    assert Others(scan, localizer.ask_by_result).place(sure) is None
    with pytest.raises(InputError, match="photos beside others: not available with the preset paper"):
        scan.require_default_method("photos beside others", None)
