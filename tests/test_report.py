"""Reports: what is in the folder, what is made again, what is refused; names of strangers stay text."""

import base64
import hashlib
import json
import math
import re
import shutil
import zlib
from dataclasses import replace

import cv2
import numpy as np
import pytest
from poses import write_results
from refusals import assert_input_error
from report_scenes import HOSTILE, STOREY, House, lifted, mixed_house

import piccolo
from piccolo.cli import report
from piccolo.errors import InputError
from piccolo.judge.belief import make_belief
from piccolo.judge.reasons import Reason
from piccolo.report.pictures import pack_depth
from piccolo.report.site import collect_entries, shorten_names, unique_names
from research.synthetic.walk_frames import writing_video

STOREYS = ["--storeys", "Ground floor", "First floor"]


@pytest.fixture(scope="module")
def house(tmp_path_factory):
    """Fourteen photos of every status, six of them frames of a walk, and their result files."""
    return mixed_house(tmp_path_factory.mktemp("house"), 26, width=128)


@pytest.fixture(scope="module")
def made(house, tmp_path_factory):
    out = tmp_path_factory.mktemp("made") / "report"
    assert _run(house, out, *STOREYS, "--title", "12 High Street") == 0
    return out


def _run(house, out, *more):
    house, results = house
    words = ["--results", *map(str, results), "--cloud", str(house.cloud), "--quiet", "--jobs", "2"]
    return report.main([*words, "--out", str(out), *more])


def _document(out):
    text = (out / "report.js").read_text()
    return json.loads(text.removeprefix("window.PICCOLO_REPORT = ").removesuffix(";\n"))


def _photo(document, name):
    return next(photo for photo in document["photos"] if photo["name"] == name)


def _pictures(out, photo):
    text = (out / "photos" / f"{photo['key']}.js").read_text()
    return json.loads(text.partition(" = ")[2].removesuffix(";\n"))


def _decoded(text):
    return cv2.imdecode(np.frombuffer(base64.b64decode(text), np.uint8), cv2.IMREAD_COLOR)


def _ranges(text):
    """Ranges (H, W) [m] of a packed depth, 0 for nothing, as the page's pictures.ts reads them."""
    planes = np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8).reshape(2, -1)
    high, low = planes.astype(np.int64)
    width = math.isqrt(2 * len(high))
    folded = (256 * high + low).reshape(width // 2, width)
    codes = np.where(folded % 2, -(folded + 1) // 2, folded // 2).cumsum(axis=0).cumsum(axis=1)
    return np.where(codes > 0, 0.05 * np.exp((codes - 1) * 0.001), 0.0)


def test_a_packed_depth_keeps_ranges_to_half_a_thousandth():
    rng = np.random.default_rng(0)
    depth = np.exp(rng.uniform(math.log(0.05), math.log(1e5), (32, 64))).astype(np.float32)
    depth[rng.random(depth.shape) < 0.2] = np.inf
    found = _ranges(base64.b64encode(pack_depth(depth)))
    assert ((found == 0.0) == np.isinf(depth)).all()
    np.testing.assert_allclose(found[found > 0.0], depth[found > 0.0], rtol=0.00051)


def test_storeys_have_their_names_levels_and_plans_in_metres(made):
    lower, upper = _document(made)["storeys"]
    assert [lower["name"], upper["name"]] == ["Ground floor", "First floor"]
    assert [lower["level"], upper["level"]] == pytest.approx([0.0, STOREY], abs=0.03)
    for storey in (lower, upper):
        plan = storey["plan"]
        image = cv2.imread(str(made / plan["file"]), cv2.IMREAD_UNCHANGED)
        assert image.shape == (plan["height"], plan["width"], 4)
        assert plan["matrix"][0] == plan["pixel"] == -plan["matrix"][3]
        assert plan["width"] * plan["pixel"] == pytest.approx(
            2 * 4.5 + 0.4 + 1.0, abs=0.6
        )  # two rooms, margins
        assert 0.5 < (image[..., 3] > 0).mean() < 1.0


def test_photos_know_their_storey_height_and_place_on_the_plan(house, made):
    document = _document(made)
    for index in (0, 1, 2, 3):
        _, _, pose = house[0].pose(index)
        photo = _photo(document, f"{index:03}.jpg")
        assert photo["storey"] == index % 2
        assert photo["height"] == pytest.approx(pose.center_world[2], abs=0.05)
        world = lifted(pose, index % 2).center_world
        np.testing.assert_allclose(photo["pose"]["world"], world, atol=1e-6)
        np.testing.assert_allclose(photo["pose"]["rotation"], pose.R_cam_from_world.ravel(), atol=1e-6)
        center = photo["pose"]["center"] + np.array(document["origin"])
        np.testing.assert_allclose(center, world, atol=1e-6)
    spread = _photo(document, "000.jpg")["spread"]
    assert spread["ellipse"] == pytest.approx([0.004895, 0.002448, 0], abs=2e-5)
    upper = np.zeros((6, 6))
    upper[np.triu_indices(6)] = spread["covariance"]
    np.testing.assert_allclose(np.diag(upper), [1e-7, 1e-7, 1e-7, 4e-6, 1e-6, 1e-6])


def test_every_status_is_there_with_what_it_has(made):
    photos = _document(made)["photos"]
    ambiguous = _photo({"photos": photos}, "007.jpg")
    assert ambiguous["status"] == "ambiguous"
    assert [other["probability"] for other in ambiguous["alternatives"]] == [0.3, 0.1]
    assert len([a for a in _pictures(made, ambiguous)["alternatives"] if a]) == 2
    unreadable = _photo({"photos": photos}, "019.jpg")
    assert (unreadable["pose"], unreadable["thumb"], unreadable["hasPictures"]) == (None, None, False)
    assert "no picture" in unreadable["error"]
    walk = [photo for photo in photos if photo["walk"] is not None]
    assert [photo["time"] for photo in walk] == [1.5 * k for k in range(6)]
    assert [photo["gap"] for photo in walk] == [k == 4 for k in range(6)]


def test_sphere_and_scan_show_the_same_in_every_direction(made):
    document = _document(made)
    for name in ("000.jpg", "001.jpg", "walk_3.jpg"):
        pictures = _pictures(made, _photo(document, name))
        sphere, scan = _decoded(pictures["sphere"]), _decoded(pictures["scan"])
        assert sphere.shape == scan.shape == (64, 128, 3)
        blurred = [cv2.GaussianBlur(p, (0, 0), 1.5).astype(float).ravel() for p in (sphere, scan)]
        turned = cv2.GaussianBlur(np.roll(scan, 8, axis=1), (0, 0), 1.5).astype(float).ravel()
        assert np.corrcoef(*blurred)[0, 1] > 0.85
        assert np.corrcoef(blurred[0], turned)[0, 1] < np.corrcoef(*blurred)[0, 1] - 0.1
        assert 0.5 < np.median(_ranges(pictures["depth"])) < 4.0  # of a room of 4.5 x 3.5 m
        mask = cv2.imdecode(np.frombuffer(base64.b64decode(pictures["mask"]), np.uint8), cv2.IMREAD_GRAYSCALE)
        assert (mask == 255).mean() < 0.2


def test_the_same_command_makes_only_what_has_changed(house, made, tmp_path):
    before = {path.name: path.stat().st_mtime_ns for path in made.glob("photos/*")}
    document = _document(made)
    assert _run(house, made, *STOREYS, "--title", "12 High Street") == 0
    assert {path.name: path.stat().st_mtime_ns for path in made.glob("photos/*")} == before
    assert _document(made) == document
    key = _photo(document, "002.jpg")["key"]
    (made / "photos" / f"{key}.js").unlink()  # as where a run was stopped
    (made / "photos" / f".{key}.js.0123456789abcdef").write_bytes(b"half")
    (made / "thumbs" / f"{'0' * 32}.jpg").write_bytes(b"of an earlier report")
    (made / "thumbs" / "mine.jpg").write_bytes(b"of the user")
    assert _run(house, made, *STOREYS, "--title", "12 High Street") == 0
    after = {path.name: path.stat().st_mtime_ns for path in made.glob("photos/*")}
    assert {name for name in after if after[name] != before[name]} == {f"{key}.js"}
    assert not (made / "thumbs" / f"{'0' * 32}.jpg").exists()
    assert (made / "thumbs" / "mine.jpg").exists()


def test_a_moved_folder_of_photos_and_one_that_is_gone(house, tmp_path, capsys):
    scene, (results, _) = house
    words = ["--results", str(results), "--cloud", str(scene.cloud), "--jobs", "1"]
    empty = tmp_path / "empty"
    empty.mkdir()
    assert report.main([*words, "--out", str(tmp_path / "r"), "--images", str(empty)]) == 0
    assert "no pictures of it" in capsys.readouterr().err
    assert {photo["hasPictures"] for photo in _document(tmp_path / "r")["photos"]} == {False}
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
    photos = _document(out)["photos"]
    return [_pictures(out, photo)["sphere"] if photo["hasPictures"] else None for photo in photos]


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


def test_the_page_and_its_policy_come_with_it(made):
    page = (made / "index.html").read_text()
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', page)[1]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert not re.search(r"\son\w+=|style=|javascript:", page)
    assert {"app.js", "app.css"} <= {path.name for path in made.iterdir()}
    assert (made / "app.js").stat().st_size < 120_000


def test_one_file_holds_all_of_a_small_report(house, tmp_path):
    out = tmp_path / "report.html"
    assert _run(house, out, "--self-contained") == 0
    page = out.read_text()
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]
    scripts = re.findall(r"<script>(.*?)</script>", page, flags=re.DOTALL)
    (style,) = re.findall(r"<style>(.*?)</style>", page, flags=re.DOTALL)
    for text in (*scripts, style):
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert f"'sha256-{digest}'" in page
    data = re.search(r'<script type="application/json" id="report">(.*?)</script>', page, flags=re.DOTALL)[1]
    photos = json.loads(data)["photos"]
    assert all(photo["thumb"].startswith("data:image/jpeg") for photo in photos if photo["thumb"])
    assert all(f'id="photo-{photo["key"]}"' in page for photo in photos if photo["hasPictures"])


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
    assert _document(tmp_path / "r")["title"] == HOSTILE[1]
    assert report.main([*results, *words, "--out", str(tmp_path / "r.html"), "--self-contained"]) == 0
    page = (tmp_path / "r.html").read_text()
    assert "<img src=x" not in page
    assert page.count("</script>") == 2 + len(HOSTILE)


def test_an_own_plan_is_put_where_its_control_points_are(house, made, tmp_path):
    plan = tmp_path / "plan.png"
    cv2.imwrite(str(plan), np.full((300, 400, 3), 200, np.uint8))
    points = tmp_path / "points.csv"
    points.write_text("u,v,x,y\n0,0,0,7\n400,0,10,7\n400,300,10,-0.5\n")
    how = "--own-plan", "2", str(plan), str(points)
    shutil.copytree(made, tmp_path / "r")  # whose pictures stay as they are
    assert _run(house, tmp_path / "r", *how) == 0
    own = _document(tmp_path / "r")["storeys"][1]["plan"]
    origin = np.array(_document(made)["origin"])
    expected = [0.025, 0.0, 0.0, -0.025, -origin[0], 7.0 - origin[1]]
    assert own["matrix"] == pytest.approx(expected)
    assert (own["width"], own["height"]) == (400, 300)
    points.write_text("u,v,x,y\n5,5,0,7\n5,5,10,7\n")
    assert _run(house, tmp_path / "r", *how) == 3


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
    photos = _document(tmp_path / "r")["photos"]
    names = ["a.jpg", r"new\nline.jpg", r"tab\t.jpg", r"\udcff.jpg", r"\u2028.jpg"]
    assert [photo["name"] for photo in photos] == [*names, "x" * 5000 + ".jpg", r"NUL\x00.jpg"]
    assert [photo["hasPictures"] for photo in photos] == [True] * 5 + [False] * 2
    assert str(tmp_path) not in text  # what is shown to others does not say where it lay
    for suffix in ("png", "svg", "dxf"):
        assert report.main([*words, "--plan", str(tmp_path / f"p.{suffix}")]) == 0
    assert "new\\nline.jpg" in (tmp_path / "p.dxf").read_text()


def test_results_of_another_scan_are_refused_or_told_of_on_the_page(house, tmp_path, capsys):
    scene, _ = house
    digest = hashlib.sha256(scene.cloud.read_bytes()).hexdigest()
    sources = [replace(scene.results[0].source, cloud_sha256=s) for s in (digest, "0" * 64, None)]
    results = [replace(r, source=s) for r, s in zip(scene.results, sources, strict=False)]
    lines = write_results(tmp_path / "poses.jsonl", results)
    words = ["--results", str(lines), "--cloud", str(scene.cloud), "--cache", "none"]
    for option, name in (("--out", "r"), ("--plan", "p.svg")):
        assert report.main([*words, option, str(tmp_path / name)]) == 3
        line = capsys.readouterr().err.splitlines()[-1]
        assert "001.jpg: found 1 of 3 results of another scan than that given, the first of house.npz" in line
        assert not (tmp_path / name).exists()
    assert report.main([*words, "--out", str(tmp_path / "r"), "--force"]) == 0
    note = "found 1 of 3 results of another scan than that given"
    assert f"warning: {note}" in capsys.readouterr().err
    assert _document(tmp_path / "r")["note"] == note
    scan = piccolo.open_scan(scene.cloud)
    assert_input_error("results of another scan", piccolo.write_report, lines, scan, tmp_path / "r")
    piccolo.write_report(lines, scan, tmp_path / "r", piccolo.ReportSettings(force=True))


def test_hopeless_guesses_are_on_no_plan(house, tmp_path):
    """However exact a likely one is."""
    scene, _ = house
    guesses = ((0, 0.003), (2, 0.3))
    unsure = ({"status": "not_localized", "confidence": 0.01, "belief": make_belief([c])} for _, c in guesses)
    results = [replace(scene.results[k], **how) for (k, _), how in zip(guesses, unsure, strict=True)]
    lines = write_results(tmp_path / "poses.jsonl", results)
    words = ["--results", str(lines), "--cloud", str(scene.cloud), "--quiet"]
    assert report.main([*words, "--out", str(tmp_path / "r"), "--plan", str(tmp_path / "p.svg")]) == 0
    assert [photo["isOnPlan"] for photo in _document(tmp_path / "r")["photos"]] == [False, True]
    text = (tmp_path / "p.svg").read_text()
    assert ('id="000.jpg"' in text, 'id="002.jpg"' in text) == (False, True)


def test_what_contradicts_a_result_is_told_apart(house, tmp_path):
    scene, _ = house
    told = [{Reason.HEADING, Reason.NEAR}, {Reason.CALIBRATION}, {Reason.MIRRORED}, set()]
    results = [
        replace(
            result,
            status="not_localized",
            confidence=0.0,
            belief=make_belief([0.9 if reasons else 0.0]).rule_out(*reasons),
        )
        for result, reasons in zip(scene.results, told, strict=False)
    ]
    results.append(scene.results[0])
    lines = write_results(tmp_path / "poses.jsonl", results)
    words = ["--results", str(lines), "--cloud", str(scene.cloud), "--quiet"]
    assert report.main([*words, "--out", str(tmp_path / "r")]) == 0
    photos = _document(tmp_path / "r")["photos"]
    told = [photo["contradicts"] for photo in photos]
    assert told == [["heading", "near"], ["calibration"], [], [], []]
    assert [photo["isOnPlan"] for photo in photos] == [True, True, False, False, True]


def test_in_python(house, tmp_path):
    scene, results = house
    told = []
    scan = piccolo.open_scan(scene.cloud, progress=lambda *words: told.append(words))
    page = piccolo.write_report(results[1], scan, tmp_path / "r", piccolo.ReportSettings(title="A walk"))
    assert page == tmp_path / "r" / "index.html"
    assert _document(tmp_path / "r")["title"] == "A walk"
    assert ("photos", 6, 6) in told
    assert_input_error("`title`: found 1, wanted a text", piccolo.ReportSettings, title=1)
    with pytest.raises(InputError, match=r"`scan`: found .*, wanted Scan"):
        piccolo.write_report(results, str(scene.cloud), tmp_path / "r")
    with pytest.raises(InputError, match="found 1 names, wanted 2"):
        piccolo.write_report(results, scan, tmp_path / "r", piccolo.ReportSettings(storeys=["Ground floor"]))


@pytest.mark.parametrize(
    ("more", "code", "text"),
    [
        ([], 2, "--out, --plan: found none"),
        (["--out", "{}/r", "--storeys", "one"], 3, "--storeys: found 1 names, wanted 2"),
        (["--out", "{}", "--jobs", "1"], 3, "found a folder that is not empty"),
        (["--out", "{}/no/r"], 3, "wanted one that exists"),
        (["--out", "{}/r.txt", "--self-contained"], 2, "wanted a name that ends with .html"),
        (["--plan", "{}/p.jpg"], 2, "wanted a name that ends with .png, .svg, .pdf, .dxf"),
        (["--out", "{}/r", "--own-plan", "x", "a", "b"], 2, "found storey 'x'"),
        (["--out", "{}/r", "--own-plan", "3", "a", "b"], 3, "found storey 3, wanted 1 to 2"),
        (["--out", "{}/r", "--jobs", "0"], 2, "--jobs: found 0"),
    ],
)
def test_refusals(house, tmp_path, capsys, more, code, text):
    scene, results = house
    (tmp_path / "other.txt").touch()
    words = ["--results", *map(str, results), "--cloud", str(scene.cloud), "--quiet"]
    assert report.main([*words, *(word.format(tmp_path) for word in more)]) == code
    (line,) = capsys.readouterr().err.splitlines()
    assert text in line


def test_frames_of_a_video_are_taken_out_of_it(house, tmp_path, capsys):
    scene, _ = house
    results = [
        replace(result, pano=f"{tmp_path}/walk.mp4#t={k}.000") for k, result in enumerate(scene.results[:2])
    ]
    with writing_video(tmp_path / "walk.mp4", 1.0, (128, 64)) as add:
        for result in scene.results[:2]:
            add(cv2.cvtColor(cv2.imread(result.pano), cv2.COLOR_BGR2RGB))
    lines = write_results(tmp_path / "poses.jsonl", results)
    words = ["--results", str(lines), "--cloud", str(scene.cloud), "--out", str(tmp_path / "r")]
    assert report.main(words) == 0
    document = _document(tmp_path / "r")
    for photo, result in zip(document["photos"], scene.results, strict=False):
        frame = _decoded(_pictures(tmp_path / "r", photo)["sphere"]).astype(float)
        assert np.abs(frame - cv2.imread(result.pano)).mean() < 8.0
    (tmp_path / "walk.mp4").write_bytes(b"damaged")
    for path in (tmp_path / "r" / "photos").iterdir():
        path.unlink()
    assert report.main(words) == 0
    assert capsys.readouterr().err.count("no pictures of it") == 2


def test_only_few_photos_fit_into_one_file(house, tmp_path, capsys):
    scene, results = house
    words = ["--cloud", str(scene.cloud), "--quiet", "--self-contained", "--out", str(tmp_path / "r.html")]
    assert report.main(["--results", *map(str, [*results, *results]), *words]) == 3
    assert "found 52 photos, wanted 50 or fewer" in capsys.readouterr().err
