"""Reports: what is in the folder, what is made again, what is refused."""

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
from report_scenes import (
    STOREY,
    decode_picture,
    document_of,
    lifted,
    mixed_house,
    photo_named,
    pictures_of,
    run_report,
)

import piccolo
from piccolo.apps.report import report
from piccolo.apps.report.drawings import pack_depth
from piccolo.judge.belief import make_belief
from piccolo.judge.reasons import Reason
from piccolo.system.errors import InputError
from research.synthetic.walk_frames import writing_video

TIER = "scene"

STOREYS = ["--storeys", "Ground floor", "First floor"]


@pytest.fixture(scope="module")
def house(tmp_path_factory):
    """Fourteen photos of every status, six of them frames of a walk, and their result files."""
    return mixed_house(tmp_path_factory.mktemp("house"), 26, width=128)


@pytest.fixture(scope="module")
def made(house, tmp_path_factory):
    out = tmp_path_factory.mktemp("made") / "report"
    assert run_report(house, out, *STOREYS, "--title", "12 High Street") == 0
    return out


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
    lower, upper = document_of(made)["storeys"]
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
    document = document_of(made)
    for index in (0, 1, 2, 3):
        _, _, pose = house[0].pose(index)
        photo = photo_named(document, f"{index:03}.jpg")
        assert photo["storey"] == index % 2
        assert photo["height"] == pytest.approx(pose.center_world[2], abs=0.05)
        world = lifted(pose, index % 2).center_world
        np.testing.assert_allclose(photo["pose"]["world"], world, atol=1e-6)
        np.testing.assert_allclose(photo["pose"]["rotation"], pose.R_cam_from_world.ravel(), atol=1e-6)
        center = photo["pose"]["center"] + np.array(document["origin"])
        np.testing.assert_allclose(center, world, atol=1e-6)
    spread = photo_named(document, "000.jpg")["spread"]
    assert spread["ellipse"] == pytest.approx([0.004895, 0.002448, 0], abs=2e-5)
    upper = np.zeros((6, 6))
    upper[np.triu_indices(6)] = spread["covariance"]
    np.testing.assert_allclose(np.diag(upper), [1e-7, 1e-7, 1e-7, 4e-6, 1e-6, 1e-6])


def test_every_status_is_there_with_what_it_has(made):
    photos = document_of(made)["photos"]
    ambiguous = photo_named({"photos": photos}, "007.jpg")
    assert ambiguous["status"] == "ambiguous"
    assert [other["probability"] for other in ambiguous["alternatives"]] == [0.3, 0.1]
    assert len([a for a in pictures_of(made, ambiguous)["alternatives"] if a]) == 2
    unreadable = photo_named({"photos": photos}, "019.jpg")
    assert (unreadable["pose"], unreadable["thumb"], unreadable["hasPictures"]) == (None, None, False)
    assert "no picture" in unreadable["error"]
    walk = [photo for photo in photos if photo["walk"] is not None]
    assert [photo["time"] for photo in walk] == [1.5 * k for k in range(6)]
    assert [photo["gap"] for photo in walk] == [k == 4 for k in range(6)]


def test_sphere_and_scan_show_the_same_in_every_direction(made):
    document = document_of(made)
    for name in ("000.jpg", "001.jpg", "walk_3.jpg"):
        pictures = pictures_of(made, photo_named(document, name))
        sphere = decode_picture(pictures["sphere"])
        scan = decode_picture(pictures["scan"])
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
    document = document_of(made)
    assert run_report(house, made, *STOREYS, "--title", "12 High Street") == 0
    assert {path.name: path.stat().st_mtime_ns for path in made.glob("photos/*")} == before
    assert document_of(made) == document
    key = photo_named(document, "002.jpg")["key"]
    (made / "photos" / f"{key}.js").unlink()  # as where a run was stopped
    (made / "photos" / f".{key}.js.0123456789abcdef").write_bytes(b"half")
    (made / "thumbs" / f"{'0' * 32}.jpg").write_bytes(b"of an earlier report")
    (made / "thumbs" / "mine.jpg").write_bytes(b"of the user")
    assert run_report(house, made, *STOREYS, "--title", "12 High Street") == 0
    after = {path.name: path.stat().st_mtime_ns for path in made.glob("photos/*")}
    assert {name for name in after if after[name] != before[name]} == {f"{key}.js"}
    assert not (made / "thumbs" / f"{'0' * 32}.jpg").exists()
    assert (made / "thumbs" / "mine.jpg").exists()


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
    assert run_report(house, out, "--self-contained") == 0
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


def test_an_own_plan_is_put_where_its_control_points_are(house, made, tmp_path):
    plan = tmp_path / "plan.png"
    cv2.imwrite(str(plan), np.full((300, 400, 3), 200, np.uint8))
    points = tmp_path / "points.csv"
    points.write_text("u,v,x,y\n0,0,0,7\n400,0,10,7\n400,300,10,-0.5\n")
    how = "--own-plan", "2", str(plan), str(points)
    shutil.copytree(made, tmp_path / "r")  # whose pictures stay as they are
    assert run_report(house, tmp_path / "r", *how) == 0
    own = document_of(tmp_path / "r")["storeys"][1]["plan"]
    origin = np.array(document_of(made)["origin"])
    expected = [0.025, 0.0, 0.0, -0.025, -origin[0], 7.0 - origin[1]]
    assert own["matrix"] == pytest.approx(expected)
    assert (own["width"], own["height"]) == (400, 300)
    points.write_text("u,v,x,y\n5,5,0,7\n5,5,10,7\n")
    assert run_report(house, tmp_path / "r", *how) == 3


def test_results_of_another_scan_are_refused_or_told_of_on_the_page(house, tmp_path, capsys):
    scene, _ = house
    digest = hashlib.sha256(scene.cloud.read_bytes()).hexdigest()
    sources = [replace(scene.results[0].source, cloud_sha256=s) for s in (digest, "0" * 64, None)]
    results = [replace(r, source=s) for r, s in zip(scene.results, sources, strict=False)]
    lines = write_results(tmp_path / "poses.jsonl", results)
    words = ["--results", str(lines), "--cloud", str(scene.cloud)]
    for option, name in (("--out", "r"), ("--plan", "p.svg")):
        assert report.main([*words, option, str(tmp_path / name)]) == 3
        line = capsys.readouterr().err.splitlines()[-1]
        assert "001.jpg: found 1 of 3 results of another scan than that given, the first of house.npz" in line
        assert not (tmp_path / name).exists()
    assert report.main([*words, "--out", str(tmp_path / "r"), "--force"]) == 0
    note = "found 1 of 3 results of another scan than that given"
    assert f"warning: {note}" in capsys.readouterr().err
    assert document_of(tmp_path / "r")["note"] == note
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
    assert [photo["isOnPlan"] for photo in document_of(tmp_path / "r")["photos"]] == [False, True]
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
    photos = document_of(tmp_path / "r")["photos"]
    told = [photo["contradicts"] for photo in photos]
    assert told == [["heading", "near"], ["calibration"], [], [], []]
    assert [photo["isOnPlan"] for photo in photos] == [True, True, False, False, True]


def test_in_python(house, tmp_path):
    scene, results = house
    told = []
    scan = piccolo.open_scan(scene.cloud, progress=lambda *words: told.append(words))
    page = piccolo.write_report(results[1], scan, tmp_path / "r", piccolo.ReportSettings(title="A walk"))
    assert page == tmp_path / "r" / "index.html"
    assert document_of(tmp_path / "r")["title"] == "A walk"
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
    document = document_of(tmp_path / "r")
    for photo, result in zip(document["photos"], scene.results, strict=False):
        frame = decode_picture(pictures_of(tmp_path / "r", photo)["sphere"]).astype(float)
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
