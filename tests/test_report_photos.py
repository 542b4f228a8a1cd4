"""The photos of a report: where their pictures are found, and their names, which stay text."""

import hashlib
import shutil
from dataclasses import replace

import pytest
from poses import write_results
from report_scenes import HOSTILE, House, document_of, mixed_house, pictures_of

from piccolo.apps.report import report
from piccolo.apps.report.site import collect_entries, shorten_names, unique_names

TIER = "scene"


@pytest.fixture(scope="module")
def house(tmp_path_factory):
    """Photos of every status, and their result files."""
    return mixed_house(tmp_path_factory.mktemp("house"), 26, width=128)


def test_a_moved_folder_of_photos_and_one_that_is_gone(house, tmp_path, capsys):
    scene, (results, _) = house
    words = ["--results", str(results), "--cloud", str(scene.cloud), "--jobs", "1"]
    empty = tmp_path / "empty"
    empty.mkdir()
    assert report.main([*words, "--out", str(tmp_path / "r"), "--images", str(empty)]) == 0
    assert "no pictures of it" in capsys.readouterr().err
    assert {photo["hasPictures"] for photo in document_of(tmp_path / "r")["photos"]} == {False}
    moved = tmp_path / "moved.jsonl"
    write_results(moved, [replace(r, pano=f"gone/{k}.jpg") for k, r in enumerate(scene.results)])
    assert report.main(["--results", str(moved), *words[2:], "--out", str(tmp_path / "m")]) == 0
    assert "; if it is in another folder, give --images FOLDER\n" in capsys.readouterr().err
    assert report.main([*words, "--out", str(tmp_path / "r"), "--images", str(tmp_path / "no")]) == 3


@pytest.fixture
def twins(house, tmp_path):
    """Two photos of one name in two folders, one with signs in its name; their results, and the scan."""
    scene = house[0]
    results = []
    for name, k in (("a/IMG.jpg", 0), ("b/IMG.jpg", 1), ("c/Tom & <J>'s 😀.jpg", 2)):
        path = tmp_path / "photos" / name
        path.parent.mkdir(parents=True)
        shutil.copy(scene.results[k].pano, path)
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        source = replace(scene.results[k].source, pano_sha256=digest)
        results.append(replace(scene.results[k], pano=name, source=source))
    return tmp_path / "photos", results, ["--cloud", str(scene.cloud), "--jobs", "1", "--quiet"]


def _shown(twins, out, panos, *more):
    """The spheres that a report shows of the results under other paths, None for none."""
    _, results, words = twins
    write_results(
        out.with_suffix(".jsonl"), [replace(r, pano=p) for r, p in zip(results, panos, strict=True)]
    )
    words = ["--results", str(out.with_suffix(".jsonl")), *words, "--out", str(out), *more]
    assert report.main(words) == 0
    photos = document_of(out)["photos"]
    return [pictures_of(out, photo)["sphere"] if photo["hasPictures"] else None for photo in photos]


def test_photos_are_found_by_path_and_digest(twins, tmp_path):
    folder, results, _ = twins
    images = "--images", str(folder)
    whole = _shown(twins, tmp_path / "whole", [str(folder / r.pano) for r in results])
    assert len({*whole}) == 3
    assert None not in whole
    below = _shown(twins, tmp_path / "below", [f"/elsewhere/{r.pano}" for r in results], *images)
    bare = _shown(twins, tmp_path / "bare", [r.pano.partition("/")[2] for r in results], *images)
    out_of_it = _shown(twins, tmp_path / "up", [f"../b/../{r.pano}" for r in results], *images)
    assert whole == below == bare == out_of_it
    crossed = [f"gone/{k}/IMG.jpg" for k in "ba"]  # each with the other's folder
    assert _shown(twins, tmp_path / "crossed", [*crossed, results[2].pano], *images) == whole


def test_another_picture_is_not_shown(twins, tmp_path, capsys):
    folder, results, words = twins
    (folder / "a" / "IMG.jpg").unlink()
    words = [word for word in words if word != "--quiet"]
    shown = _shown(
        (folder, results, words), tmp_path / "r", [r.pano for r in results], "--images", str(folder)
    )
    assert [sphere is None for sphere in shown] == [True, False, False]
    lines = [line for line in capsys.readouterr().err.splitlines() if "no pictures" in line]
    wanted = (
        f"{folder / 'b' / 'IMG.jpg'}: no pictures of it, as it is not the photo of this result (its SHA-256)"
    )
    assert lines == [f"report.py: warning: {wanted}"]


@pytest.fixture
def strangers(house, tmp_path):
    """The same scan with no photo yet."""
    empty = House(tmp_path, 128)
    empty.cloud = house[0].cloud
    return empty


def test_names_that_try_to_be_markup_stay_text(strangers, tmp_path):
    house = strangers
    for k, name in enumerate(HOSTILE):
        house.add(k, name.replace("/", "\u2215"), confidence=0.99)
    house.results = [  # a name with a slash is a folder's: given to the results only
        result.__class__(**{**vars(result), "warnings": (HOSTILE[1],), "pano": result.pano})
        for result in house.results
    ]
    words = ["--cloud", str(house.cloud), "--title", HOSTILE[1], "--quiet"]
    results = ["--results", str(house.write_results())]
    assert report.main([*results, *words, "--out", str(tmp_path / "r")]) == 0
    assert "<" not in (tmp_path / "r" / "report.js").read_text()
    assert document_of(tmp_path / "r")["title"] == HOSTILE[1]
    assert report.main([*results, *words, "--out", str(tmp_path / "r.html"), "--self-contained"]) == 0
    page = (tmp_path / "r.html").read_text()
    assert "<img src=x" not in page
    assert page.count("</script>") == 2 + len(HOSTILE)


def test_names_are_short_and_different(tmp_path):
    house = House(tmp_path, 128)
    for name in ("a.jpg", "b.jpg", "a.jpg"):
        house.add(0, name)
    assert unique_names(collect_entries([house.write_results()])) == ["a.jpg", "b.jpg", "a.jpg (2)"]


def test_short_names_have_folders_where_they_would_repeat():
    names = ["f1/a.jpg", "f2/a.jpg", "f1/b.jpg", "c.jpg", "c.png", "d.jpg", "d.jpg (2)"]
    assert shorten_names(names) == ["f1/a.jpg", "f2/a.jpg", "b", "c.jpg", "c.png", "d", "d (2)"]


def test_a_name_spoils_neither_page_nor_plan(strangers, tmp_path):
    house = strangers
    for k, name in enumerate(("a.jpg", "new\nline.jpg", "tab\t.jpg", "\udcff.jpg", "\u2028.jpg")):
        house.add(k, name)
    folder = tmp_path / "photos"
    more = [f"{folder}/{'x' * 5000}.jpg", f"{folder}/NUL\0.jpg"]
    house.results += [replace(house.results[0], pano=pano, status="not_localized") for pano in more]
    words = ["--results", str(house.write_results()), "--cloud", str(house.cloud), "--quiet"]
    assert report.main([*words, "--out", str(tmp_path / "r")]) == 0
    text = (tmp_path / "r" / "report.js").read_text()
    photos = document_of(tmp_path / "r")["photos"]
    names = ["a.jpg", r"new\nline.jpg", r"tab\t.jpg", r"\udcff.jpg", r"\u2028.jpg"]
    assert [photo["name"] for photo in photos] == [*names, "x" * 5000 + ".jpg", r"NUL\x00.jpg"]
    assert [photo["hasPictures"] for photo in photos] == [True] * 5 + [False] * 2
    assert str(tmp_path) not in text  # what is shown to others does not say where it lay
    for suffix in ("png", "svg", "dxf"):
        assert report.main([*words, "--plan", str(tmp_path / f"p.{suffix}")]) == 0
    assert "new\\nline.jpg" in (tmp_path / "p.dxf").read_text()
