"""Batches: what is named, what is written, and how a stopped one goes on."""

import errno
import hashlib
import json
import os
import signal
import sys
from collections import Counter
from pathlib import Path
from typing import ClassVar

import pytest
from batches import PAPER, start_localize

from piccolo.api.result_files import read_results
from piccolo.batch import localizer as module
from piccolo.batch.inputs import list_panoramas
from piccolo.cli import localize, settings_given
from piccolo.system.errors import InputError
from research.scene import read_scene

TIER = "scene"
pytestmark = pytest.mark.usefixtures("searched_once")


@pytest.fixture
def out(tmp_path):
    return tmp_path / "poses.jsonl"


@pytest.fixture
def images(scene):
    """The content of the three photos."""
    return [(scene / "images" / f"clean_{k}.jpg").read_bytes() for k in range(3)]


@pytest.fixture
def counted(monkeypatch):
    """The panoramas that are localized, in order."""
    names = []
    answer = module.Localizer.answer

    def counting(self, *given):
        path = given[-1].photo.path
        names.extend([] if "piccolo-temporary" in str(path) else [path.name])  # a check for left-handed scans
        return answer(self, *given)

    monkeypatch.setattr(module.Localizer, "answer", counting)
    return names


def _run(scene, out, *more, pano=None):
    cloud = str(scene / "cloud.ply")
    panos = pano or [str(scene / "images")]
    cache = str(scene.parent / "maps")
    return localize.main(["--cloud", cloud, "--pano", *panos, "--out", str(out), "--cache", cache, *more])


def _lines(out):
    """The lines of a file of results without what differs from run to run."""
    return [json.loads(line) | {"seconds": None} for line in out.read_text().splitlines()]


@pytest.fixture(scope="module")
def two(scene, tmp_path_factory):
    """Two photos, the second of which lies elsewhere, and the content of their file of results."""
    folder = tmp_path_factory.mktemp("two")
    photo = folder / "clean_1.jpg"
    out = folder / "poses.jsonl"
    photo.write_bytes((scene / "images" / "clean_1.jpg").read_bytes())
    panos = [str(scene / "images" / "clean_0.jpg"), str(photo)]
    assert _run(scene, out, "--quiet", pano=panos) == 0
    return panos, out.read_bytes()


def test_folders_lists_and_standard_input_name_panoramas(scene, tmp_path):
    names = ["clean_0.jpg", "clean_1.jpg", "clean_2.jpg"]
    listed = tmp_path / "list.txt"
    listed.write_bytes(b"\xef\xbb\xbfb c.jpg\n\ncaf\xe9.png\r\n")
    with (tmp_path / "stdin").open("w+") as stdin:
        stdin.write("e.jpg\r\n\nf.jpg")
        stdin.seek(0)
        found = list(list_panoramas([str(scene), "a.jpg", f"@{listed}", "-"], stdin, Counter()))
    assert found[:3] == [scene / "images" / name for name in names]
    assert [str(path) for path in found[3:]] == ["a.jpg", "b c.jpg", "caf\udce9.png", "e.jpg", "f.jpg"]
    cube = tmp_path / "photos" / "cube"
    cube.mkdir(parents=True)
    for face in ("px", "nx", "py", "ny", "pz", "nz"):
        (cube / f"{face}.png").touch()
    (tmp_path / "photos" / "a.webp").touch()
    (tmp_path / "photos" / ".hidden.jpg").touch()
    found = list_panoramas([str(tmp_path / "photos"), str(cube)], None, Counter())
    assert list(found) == [tmp_path / "photos/a.webp", cube, cube]
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="empty: a folder without a JPEG"):
        list(list_panoramas([str(tmp_path / "empty")], None, Counter()))


def test_a_batch_goes_on_where_it_was_stopped(scene, tmp_path, out, counted, capsys):
    whole = tmp_path / "whole.jsonl"
    assert _run(scene, whole) == 0
    assert "3 photos in" in (err := capsys.readouterr().err)
    assert "3 localized, 0 ambiguous, 0 not localized, 0 unreadable" in err
    lines = whole.read_bytes().splitlines(keepends=True)
    for torn in (b"", lines[1][:1], lines[1][:-1]):
        counted.clear()
        out.write_bytes(lines[0] + torn)
        assert _run(scene, out, "--quiet") == 0
        assert counted == ["clean_1.jpg", "clean_2.jpg"]
        assert _lines(out) == _lines(whole)
    counted.clear()
    assert _run(scene, out) == 0
    assert counted == []
    assert "nothing is left to do" in capsys.readouterr().err
    assert _run(scene, out, "--quiet", "--overwrite") == 0
    assert len(counted) == 3
    assert _lines(out) == _lines(whole)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["--gravity", "known"], "line 1: made with --gravity auto, now --gravity known; use"),
        (["--height", "0.5", "2"], "line 1: made without --height, now --height 0.5 2; use"),
        (["--gravity-vector", "0", "0", "-1"], "made without --gravity-vector, now --gravity-vector 0 0 -1"),
        (["--focal", "1585"], "line 1: made without --focal, now --focal 1585; use"),
        (["--preset", "paper"], "line 1: made with --preset default, now --preset paper; use"),
        (["--crs", "none"], "line 1: made with GPS, now without GPS; use"),
        (["--cloud", "other"], "line 1: made with another scan, or the scan has changed since"),
        (["--pano", "clean_1.jpg"], "it has no result of the photos given"),
        (b"some notes of the user\n", "line 1: not a result of localize.py"),
        (b"notes without an end", "its last line does not belong to results"),
        (b'{"format": "piccolo-pose/3"}\n', "line 1: found format 'piccolo-pose/3'"),
    ],
)
def test_a_file_of_another_run_is_refused_with_both_ways(scene, tmp_path, out, two, change, message, capsys):
    panos, before = two
    (tmp_path / "other.ply").write_bytes((scene / "cloud.ply").read_bytes() + b"\0")
    more = []
    if isinstance(change, bytes):
        before = change
    elif change[0] == "--pano":
        panos = [str(scene / "images" / change[1])]
    else:
        more = [word.replace("other", str(tmp_path / "other.ply")) for word in change]
    out.write_bytes(before)
    assert _run(scene, out, "--quiet", *more, pano=panos) == 3
    err = capsys.readouterr().err
    assert message in err
    assert "use --overwrite to start again, or another --out" in err
    assert err.count("\n") == 1
    assert out.read_bytes() == before


def test_an_unreadable_photo_is_a_line_until_its_file_is_another(
    scene, tmp_path, out, images, counted, capsys
):
    bad = tmp_path / "bad.jpg"
    bad.write_bytes(b"\xff\xd8\xff nothing more")
    panos = [str(bad), str(tmp_path / "missing.jpg"), str(scene / "images" / "clean_0.jpg")]
    for expected in (["bad.jpg", "missing.jpg", "clean_0.jpg"], []):
        counted.clear()
        assert _run(scene, out, pano=panos) == 3
        assert counted == expected
    assert [line["status"] for line in _lines(out)] == ["unreadable", "unreadable", "localized"]
    assert "1 localized, 0 ambiguous, 0 not localized, 2 unreadable" in capsys.readouterr().err
    for name in ("bad.jpg", "missing.jpg"):
        counted.clear()
        (tmp_path / name).write_bytes(images[1])
        assert _run(scene, out, pano=panos) == (3 if name == "bad.jpg" else 0)
        assert counted == [name]
    assert [line["pano"] for line in _lines(out)] == panos
    assert {line["status"] for line in _lines(out)} == {"localized"}


def test_photos_added_removed_or_changed_cost_only_their_own_lines(
    scene, tmp_path, out, images, counted, capsys
):
    photos, whole = tmp_path / "photos", tmp_path / "whole.jsonl"
    photos.mkdir()

    def written(contents, *panos):
        for path in photos.iterdir():
            path.unlink()
        for name, content in contents.items():
            (photos / name).write_bytes(content)
        counted.clear()
        assert _run(scene, out, *PAPER, pano=[*panos] or [str(photos)]) < 2
        done = list(counted)
        err = capsys.readouterr().err
        assert _run(scene, whole, *PAPER, "--overwrite", "--quiet", pano=[*panos] or [str(photos)]) < 2
        assert _lines(out) == _lines(whole)
        return done, err

    first = {"b.jpg": images[0], "d.jpg": images[1]}
    assert written(first)[0] == ["b.jpg", "d.jpg"]
    assert written({**first, "a.jpg": images[2], "c.jpg": images[0]})[0] == ["a.jpg", "c.jpg"]
    done, err = written({"d.jpg": images[1], "c.jpg": images[2]})
    assert done == ["c.jpg"]
    assert "; dropped 2 results of photos that are no longer given\n" in err
    names = [str(photos / name) for name in ("d.jpg", "c.jpg", "d.jpg")]
    assert written({"d.jpg": images[1], "c.jpg": images[2]}, *names)[0] == ["d.jpg"]
    before = _lines(out)
    for path in photos.iterdir():
        path.unlink()
    counted.clear()
    assert _run(scene, out, *PAPER, pano=names) < 2  # a disk that is not there takes no result along
    assert (counted, _lines(out)) == ([], before)


def test_names_that_come_on_standard_input_take_what_is_done_and_drop_nothing(
    scene, tmp_path, out, monkeypatch, capsys
):
    names = [str(scene / "images" / f"clean_{k}.jpg") for k in range(3)]
    stdin = tmp_path / "stdin"
    for given, left in ((names[:2], names[:2]), ([names[2], names[1]], [names[0], names[2], names[1]])):
        before = out.read_text().splitlines() if out.exists() else []
        stdin.write_text("\n".join(given))
        with stdin.open() as file:
            monkeypatch.setattr(sys, "stdin", file)
            assert _run(scene, out, *PAPER, pano=["-"]) < 2
        err = capsys.readouterr().err
        assert f"{len(given)} photos in" in err
        assert "dropped" not in err
        after = out.read_text().splitlines()
        assert [json.loads(line)["pano"] for line in after] == left
        assert set(before) <= set(after)


class Short(module.Localizer):
    """Localizes, but memory and a disk give way at two of the photos, once."""

    errors: ClassVar = {}

    def open_scan(self, workers):
        scan = super().open_scan(workers)
        ask = type(scan).localize_photo

        def localize(self, asked, *more, **noted):
            if error := Short.errors.pop(asked.photo.path.name, None):
                raise error
            return ask(self, asked, *more, **noted)

        return type("Scan", (type(scan),), {"localize_photo": localize})(**vars(scan))


def test_what_the_system_did_to_a_photo_is_tried_again(scene, out, counted, monkeypatch, capsys):
    names = ["clean_0.jpg", "clean_1.jpg", "clean_2.jpg"]
    monkeypatch.setattr(settings_given, "Localizer", Short)
    Short.errors.update({names[0]: MemoryError(), names[2]: OSError(errno.EIO, "Input/output error", "x")})
    assert _run(scene, out, *PAPER) == 3
    err = capsys.readouterr().err
    assert "0 unreadable, 2 failed, which the same command will try again" in err
    assert "not enough memory (none is left)" in err
    assert [line["status"] == "failed" for line in _lines(out)] == [True, False, True]
    counted.clear()
    assert _run(scene, out, *PAPER) < 2
    assert counted == [names[0], names[2]]
    assert [Path(line["pano"]).name for line in _lines(out)] == names
    assert "failed" not in {line["status"] for line in _lines(out)}


def test_a_photo_is_read_once_so_that_its_digest_is_of_its_pixels(scene, tmp_path, out, images, monkeypatch):
    photo = tmp_path / "a.jpg"
    read = Path.read_bytes
    reads = []

    def read_and_replaced(path):
        content = read(path)
        if path == photo:
            reads.append(path)
            photo.write_bytes(images[1])
        return content

    monkeypatch.setattr(Path, "read_bytes", read_and_replaced)
    for content in (images[0], images[0][:2000]):
        photo.write_bytes(content)
        _run(scene, out, *PAPER, "--overwrite", pano=[str(photo)])
        assert _lines(out)[0]["pano_sha256"] == hashlib.sha256(content).hexdigest()
    assert len(reads) == 2
    assert _lines(out)[0]["status"] == "unreadable"


ODD = [b"a\nb.jpg", b"a\tb.jpg", b"caf\xe9.jpg", b"\x1b[31m.jpg", b"x\xe2\x80\xa8y.jpg", b"y" * 251 + b".jpg"]


@pytest.mark.parametrize("more", [PAPER, ["--walk", "--times", "order"]])
def test_any_name_that_a_file_may_have_is_localized(scene, tmp_path, out, images, more, capsys):
    photos, overlays = tmp_path / "photos", tmp_path / "overlays"
    photos.mkdir()
    overlays.mkdir()
    for name in ODD:
        (photos / os.fsdecode(name)).write_bytes(images[0])
    (photos / "bad\n.jpg").write_bytes(images[0][:999])
    more = more if "--walk" in more else [*more, "--overlay", str(overlays)]
    assert _run(scene, out, *more, pano=[str(photos), "z" * 5000, "x\0y.jpg"]) == 3
    found = {os.fsencode(Path(result.pano).name): result.status for result in read_results([out])}
    unreadable = [b"bad\n.jpg", b"z" * 5000, b"x\0y.jpg"]
    assert set(found) == {*ODD, *unreadable}
    assert [name for name, status in found.items() if status == "unreadable"] == unreadable
    err = capsys.readouterr().err
    assert "bad\\n.jpg: " in err
    assert "File name too long" in err
    assert "embedded null byte" in err
    assert "\x1b" not in err
    assert "Errno" not in err


def test_files_left_out_are_counted_and_links_to_folders_searched(scene, tmp_path, out, images, capsys):
    photos, elsewhere = tmp_path / "photos", tmp_path / "elsewhere"
    (elsewhere / "inner").mkdir(parents=True)
    photos.mkdir()
    (photos / "link").symlink_to(elsewhere)
    (elsewhere / "inner" / "loop").symlink_to(photos)
    (photos / "self").symlink_to("self")
    (elsewhere / "inner" / "a.jpg").write_bytes(images[0])
    left_out = Counter()
    found = list(list_panoramas([str(photos)], None, left_out))
    assert found == [photos / "link" / "inner" / "a.jpg"]
    assert left_out == Counter({"": 1})  # the link that leads to itself
    for name in ("a.GIF", "b.gif", "c.bmp", "d"):
        (photos / name).touch()
    assert _run(scene, out, *PAPER, pano=[str(photos)]) < 2
    assert "; 5 files left out: 2 without a suffix, 2 .gif, 1 .bmp\n" in capsys.readouterr().err
    (tmp_path / "few").mkdir()
    for name in "abcdefg":
        (tmp_path / "few" / f"x.{name}").touch()
    with pytest.raises(InputError, match=r"; 7 files left out: 1 \.\w, .* 2 of other kinds$"):
        list(list_panoramas([str(tmp_path / "few")], None, Counter()))


@pytest.mark.process
def test_a_signal_ends_a_batch_after_the_photo_at_work(scene, out):
    name = str(scene / "images" / "clean_0.jpg")
    words = ["--cloud", str(scene / "cloud.ply"), "--pano", *[name] * 30, "--out", str(out)]
    words += ["--cache", str(scene.parent / "maps")]
    with start_localize(words) as process:
        while "localized at" not in process.stderr.readline():
            pass
        process.send_signal(signal.SIGINT)
        err = process.stderr.read()
    assert process.returncode == 130
    assert "the same command continues from here" in err
    assert "Traceback" not in err
    assert 1 <= len(_lines(out)) < 30
    assert out.read_bytes().endswith(b"\n")


def test_a_full_device_is_named(scene, capsys):
    assert _run(scene, Path("/dev/full"), "--quiet", pano=[str(scene / "images" / "clean_0.jpg")]) == 3
    assert capsys.readouterr().err == "localize.py: /dev/full: cannot be used (No space left on device)\n"


def test_priors_of_a_table_go_before_the_general_one(scene, tmp_path, out, capsys):
    x, y, _ = read_scene(scene).by_name["clean_0.jpg"].pose.center_world
    table = tmp_path / "priors.csv"
    rows = f"clean_0.jpg,{x},{y},0.5,1.5\nclean_9.jpg,1,2,,\nclean_1.jpg,,,,\n"
    table.write_text(f"name,x,y,radius,height\n{rows}")
    assert _run(scene, out, "--priors", str(table), "--height", "0.2", "2.2") == 0
    err = capsys.readouterr().err
    assert "1 names without a photo, such as clean_9.jpg" in err.splitlines()[0]  # before the work
    assert "%|" not in err  # a bar is for a terminal
    priors = [line["settings"]["prior"] for line in _lines(out)]
    assert priors[0]["near"] == [x, y, None]
    assert (priors[0]["radius"], priors[0]["height"]) == (0.5, [1.2, 1.8])
    assert [prior["near"] for prior in priors[1:]] == [None, None]
    assert priors[1]["height"] == priors[2]["height"] == [0.2, 2.2]
