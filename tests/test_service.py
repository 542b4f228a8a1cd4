"""The service as its clients have it: the command is started, and asked over HTTP."""

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields
from importlib import import_module
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from batches import workers_of
from plyfile import PlyData, PlyElement
from services import serving

from piccolo.apps.service.description import describe_service
from piccolo.cli import localize
from piccolo.judge.result import Result
from piccolo.photo.photo import Photo, Prior

TIER = "process"

NEEDED = ("status", "confidence", "center_world", "R_cam_from_world", "covariance", "alternatives")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("service")


@pytest.fixture(scope="module")
def photo(scene):
    return (scene / "images" / "clean_0.jpg").read_bytes()


@pytest.fixture(scope="module")
def service(scene, folder):
    words = ["--cache", folder / "maps", "--max-megabytes", "2", "--max-megapixels", "1"]
    with serving("--cloud", scene / "cloud.ply", "--jobs", "2", *words) as client:
        yield client
    assert client.process.returncode == 143
    assert "Traceback" not in client.rest


@pytest.fixture(scope="module")
def expected(scene, folder, service):
    """The line that the command line writes of the same photo, with the map that the service made."""
    out = folder / "expected.jsonl"
    words = ["--cloud", str(scene / "cloud.ply"), "--pano", str(scene / "images" / "clean_0.jpg")]
    assert localize.main([*words, "--cache", str(folder / "maps"), "--threads", "1", "--out", str(out)]) == 0
    return json.loads(out.read_text())


def _same(found, expected):
    changed = {"seconds": 0, "pano": 0}
    return {**found, **changed} == {**expected, **changed}


def test_a_photo_gets_the_line_of_the_command_line(service, photo, expected):
    status, headers, body = service.post("/localize", "where.jpg", photo)
    assert status == 200
    found = json.loads(body)
    assert Result.from_json(body.decode()).status == "localized"
    assert found["pano"] == "where.jpg"
    assert _same(found, expected)
    assert headers["content-type"] == "application/json"


def test_options_count(service, photo):
    asked = {"prior": {"near": [90.0, 0.0, None], "radius": 1.0}, "gravity": "known"}
    status, _, body = service.post("/localize", "a.jpg", photo, asked)
    assert status == 200
    found = json.loads(body)
    assert found["status"] == "not_localized"
    assert found["settings"]["gravity"] == "known"


def test_a_request_says_how_exact_a_pose_must_be(service, photo, expected):
    """The place is as certain as ever; metres alone leave degrees as the service has them."""
    status, _, body = service.post("/show", "a.jpg", photo, {"accuracy": {"metres": 0.0001}})
    assert status == 200
    shown, _ = map(json.loads, body.decode().splitlines())
    found = shown["result"]
    assert found["settings"]["accuracy"] == {"metres": 0.0001, "degrees": 5.0}
    assert (found["status"], found["place_probability"]) == ("not_localized", expected["place_probability"])
    assert found["hint"] == shown["photo"]["hint"]
    assert found["hint"].endswith("`accuracy` 0.01 would accept it")
    assert shown["photo"]["accuracy"] == [0.0001, 5.0]


def test_the_page_gets_a_photo_in_two_lines(service, photo, expected):
    name = "über dem <Haus> & Tom's 😀.jpg"
    status, headers, body = service.post("/show", name, photo)
    assert status == 200
    assert headers["content-type"].startswith("application/x-ndjson")
    first, second = map(json.loads, body.decode().splitlines())
    assert _same(first["result"], expected)
    assert first["photo"]["name"] == first["result"]["pano"] == name
    assert first["photo"]["pose"]["world"] == pytest.approx(expected["center_world"], abs=1e-5)
    assert second["thumb"].startswith("data:image/jpeg;base64,/9j/")
    assert second["pictures"]["sphere"]
    assert second["pictures"]["scan"]


def test_several_photos_get_a_line_each(service, photo, expected):
    """One of them can't be read, which costs the others nothing."""
    pictures = {"a.jpg": photo, "b.jpg": b"no picture", "c.jpg": photo}
    status, headers, body = service.post_all("/localize", pictures)
    assert (status, headers["content-type"]) == (200, "application/x-ndjson")
    first, broken, last = map(json.loads, body.decode().splitlines())
    assert [one["pano"] for one in (first, broken, last)] == list(pictures)
    assert _same(first, expected)
    assert _same(last, expected)
    assert broken["status"] == "unreadable"
    assert "/tmp" not in broken["error"]
    status, _, body = service.post_all("/show", pictures)
    lines = list(map(json.loads, body.decode().splitlines()))
    assert [line["photo"]["name"] for line in lines[::2]] == list(pictures)
    assert ["pictures" in line for line in lines[1::2]] == [True, False, True]


def _form(parts):
    mark = "x" * 20
    body = "".join(f"--{mark}\r\nContent-Disposition: form-data; {h}\r\n\r\n{v}\r\n" for h, v in parts)
    return {"body": f"{body}--{mark}--\r\n".encode(), "Content_Type": f"multipart/form-data; boundary={mark}"}


def _blank(width, height):
    """A PNG that is blank and much smaller than what it becomes."""
    from PIL import Image  # noqa: PLC0415

    file = BytesIO()
    Image.new("RGB", (width, height)).save(file, "PNG")
    return file.getvalue()


BROKEN = {
    "text": (422, "picture", lambda c, p: c.post("/localize", "a.jpg", b"no picture at all")),
    "cut": (422, "damaged|cut|whole", lambda c, p: c.post("/localize", "a.jpg", p[: len(p) // 2])),
    "empty": (422, "picture", lambda c, p: c.post("/localize", "a.jpg", b"")),
    "too large": (413, "at most 2000000 bytes", lambda c, p: c.post("/localize", "a.jpg", bytes(20_000_000))),
    "too many pixels": (422, "1 megapixels", lambda c, p: c.post("/localize", "a.png", _blank(4096, 2048))),
    "no form": (400, "multipart/form-data", lambda c, p: c.ask("POST", "/localize", p)),
    "no picture": (
        400,
        "no picture",
        lambda c, p: c.ask("POST", "/localize", **_form([('name="options"', "")])),
    ),
    "torn form": (400, "", lambda c, p: c.ask("POST", "/localize", p, Content_Type="multipart/form-data")),
    "no JSON": (400, "JSON", lambda c, p: c.post("/localize", "a.jpg", p, "{")),
    "a list": (400, "object", lambda c, p: c.post("/localize", "a.jpg", p, [])),
    "unknown": (400, "'speed'", lambda c, p: c.post("/localize", "a.jpg", p, {"speed": 1})),
    "a path": (
        400,
        "'mask'",
        lambda c, p: c.post("/localize", "a.jpg", p, {"photo": {"mask": "/etc/passwd"}}),
    ),
    "a file": (
        400,
        "camera",
        lambda c, p: c.post("/localize", "a.jpg", p, {"photo": {"camera": "/etc/passwd"}}),
    ),
    "bad value": (400, "fov_deg", lambda c, p: c.post("/localize", "a.jpg", p, {"photo": {"fov_deg": -1}})),
    "no accuracy": (
        400,
        "wanted metres above 0",
        lambda c, p: c.post("/localize", "a.jpg", p, {"accuracy": {"metres": -1}}),
    ),
    "bad type": (400, "near", lambda c, p: c.post("/localize", "a.jpg", p, {"prior": {"near": "here"}})),
    "one name": (
        400,
        "two pictures named 'a'",
        lambda c, p: c.ask(
            "POST", "/localize", **_form([(f'name="picture"; filename="{k}"', "b") for k in "aa"])
        ),
    ),
    "many options": (
        400,
        "found options twice",
        lambda c, p: c.ask("POST", "/localize", **_form([('name="options"', "b") for _ in range(20)])),
    ),
    "a field": (
        400,
        "'fov_deg', wanted it in options.photo",
        lambda c, p: c.ask(
            "POST", "/localize", **_form([('name="picture"; filename="a"', "b"), ('name="fov_deg"', "9")])
        ),
    ),
    "an address": (400, "'fov_deg' in the address", lambda c, p: c.post("/localize?fov_deg=70", "a.jpg", p)),
    "misplaced": (
        400,
        "'near', wanted it in options.prior",
        lambda c, p: c.post("/localize", "a.jpg", p, {"photo": {"near": [1, 2]}}),
    ),
    "method": (405, "", lambda c, p: c.ask("GET", "/localize")),
    "another page": (403, "evil", lambda c, p: c.post("/localize", "a.jpg", p, Origin="http://evil.example")),
    "no host": (403, "host", lambda c, p: c.ask("GET", "/scan", Host="[x")),
    "another host": (403, "evil", lambda c, p: c.ask("GET", "/report.js", Host="evil.example:80")),
}


@pytest.mark.parametrize("name", BROKEN)
def test_what_is_wrong_gets_its_own_line(service, photo, name):
    wanted, words, ask = BROKEN[name]
    status, _, body = ask(service, photo)
    assert status == wanted, body
    error = json.loads(body)["error"]
    assert "\n" not in error
    assert any(word in error for word in words.split("|")), error
    assert "/tmp" not in error
    assert service.ask("GET", "/health")[0] == 200


@pytest.mark.parametrize("asked", [{"Host": "scans.example"}, {"Origin": "https://scans.example"}])
def test_a_refusal_says_what_a_proxy_needs(service, asked):
    status, _, body = service.post("/localize", "a.jpg", b"", **asked)
    assert (status, "`public_url`" in json.loads(body)["error"]) == (403, True)


TRICKS = (
    "/../requirements.txt", "/..%2f..%2fetc/passwd", "/%2e%2e/%2e%2e/etc/passwd", "/plans/../app.py",
    "//etc/passwd", "/plans/%00", "/static/", "/.git/config", "/results.jsonl", "/app.js/../../x",
    "/openapi.json/..%5c..%5cx", "/plans/" + "0" * 32 + ".png", "/%5c..%5c", "/~root", "/proc/self/environ",
    "/app.js%00.png",
)  # fmt: skip


def test_nothing_but_the_page_can_be_read(service):
    for path in TRICKS:
        assert service.ask("GET", path)[0] in (400, 404), path
    page = service.ask("GET", "/")
    assert page[0] == 200
    assert b"connect-src 'self'" in page[2]
    assert page[1]["content-security-policy"] == "frame-ancestors 'none'"
    document = json.loads(service.ask("GET", "/scan")[2])
    assert document["photos"] == []
    plan = document["storeys"][0]["plan"]["file"]
    assert service.ask("GET", f"/{plan}")[2].startswith(b"\x89PNG")
    for name in ("app.js", "app.css", "report.js"):
        assert service.ask("GET", f"/{name}")[0] == 200


def test_the_description_has_the_options_of_photos_and_priors():
    schemas = describe_service()["components"]["schemas"]
    found = {name: schemas[name]["properties"] for name in ("PhotoOptions", "PriorOptions")}
    assert schemas["AccuracyOptions"]["properties"].keys() == {"metres", "degrees"}
    for kind, left_out in ((Photo, {"picture", "mask", "rig"}), (Prior, set())):
        properties = found[f"{kind.__name__}Options"]
        assert properties.keys() == {f.name for f in fields(kind)} - left_out
        for name, schema in properties.items():
            assert schema["oneOf"][-1] == {"type": "null"}, name
            assert len(schema["description"]) > 10, name
    kinds = {name: schema["oneOf"][:-1] for part in found.values() for name, schema in part.items()}
    number = {"type": "number"}
    z = {"oneOf": [number, {"type": "null"}]}
    assert kinds["near"] == [{"type": "array", "items": z, "minItems": 3, "maxItems": 3}]
    assert kinds["gravity_vector"] == [{"type": "array", "items": number, "minItems": 3, "maxItems": 3}]
    assert kinds["within"] == [{"type": "array", "items": {"type": "string"}}]
    assert kinds["use_gps"] == [{"type": "boolean"}]
    assert "cylindrical" in kinds["projection"][0]["enum"]
    assert kinds["camera"] == [{"type": "object", "additionalProperties": True}]


def test_a_client_is_generated_from_the_description(service, photo, expected, tmp_path, monkeypatch):
    (tmp_path / "openapi.json").write_bytes(service.ask("GET", "/openapi.json")[2])
    (tmp_path / "config.yml").write_text("post_hooks: []")
    words = [
        "generate",
        "--path",
        "openapi.json",
        "--config",
        "config.yml",
        "--meta",
        "none",
        "--output-path",
        "asking_piccolo",
    ]
    command = [sys.executable, "-m", "openapi_python_client", *words, "--fail-on-warning"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    monkeypatch.syspath_prepend(tmp_path)
    made = import_module("asking_piccolo")
    models = import_module("asking_piccolo.models")
    localize = import_module("asking_piccolo.api.default.localize").sync
    file = import_module("asking_piccolo.types").File(BytesIO(photo), "a.jpg", "image/jpeg")
    with made.Client(f"http://127.0.0.1:{service.port}", timeout=120) as client:
        result = localize(client=client, body=models.PhotoForm(file))
        assert type(result) is models.Result
        assert result.center_world == expected["center_world"]
        assert result.r_cam_from_world == expected["R_cam_from_world"]
        far = models.Options(prior=models.PriorOptions(near=[90.0, 0.0, None], radius=1.0))
        other = localize(client=client, body=models.PhotoForm(file, far))
        assert other.status == models.ResultStatus.NOT_LOCALIZED


def test_a_request_can_be_tried_without_the_net(service):
    status, headers, body = service.ask("GET", "/docs")
    assert (status, headers["content-type"]) == (200, "text/html; charset=utf-8")
    assert b"http" not in body.replace(b"http-equiv", b"")
    assert b'action="localize"' in body


def test_null_is_not_given(service, photo, expected):
    asked = {"photo": {"fov_deg": None}, "prior": {"near": None}, "gravity": None, "min_confidence": None}
    status, _, body = service.post("/localize", "a.jpg", photo, {**asked, "prior": None})
    assert status == 200
    assert _same(json.loads(body), expected)
    assert service.post("/localize", "a.jpg", photo, asked)[0] == 200


def test_a_worker_that_is_killed_costs_no_answer(service, photo, expected):
    for worker in workers_of(service.process):
        os.kill(worker, signal.SIGKILL)
    for _ in range(3):
        status, _, body = service.post("/localize", "a.jpg", photo)
        assert status == 200
        assert _same(json.loads(body), expected)


def test_a_full_queue_asks_to_come_again(scene, folder, photo):
    words = ["--jobs", "1", "--max-waiting", "2", "--keep", folder]
    with serving("--cloud", scene / "cloud.ply", "--cache", folder / "maps", *words) as client:
        with ThreadPoolExecutor(8) as pool:
            answers = list(pool.map(lambda k: client.post("/localize", f"{k}.jpg", photo), range(8)))
        assert {status for status, *_ in answers} == {200, 503}
        assert all(headers["retry-after"] == "2" for status, headers, _ in answers if status == 503)
        kept = (folder / "results.jsonl").read_text().splitlines()
        assert len(kept) == sum(status == 200 for status, *_ in answers)
        assert all(Path(json.loads(line)["pano"]).read_bytes() == photo for line in kept)
        # one that is at work is finished after SIGTERM
        with ThreadPoolExecutor(1) as pool:
            last = pool.submit(client.post, "/localize", "last.jpg", photo)
            while json.loads(client.ask("GET", "/health")[2])["waiting"] == 0:
                time.sleep(0.01)
            client.end()
            assert last.result()[0] == 200
    assert client.process.returncode == 143


def test_a_photo_that_takes_too_long_is_given_up(scene, folder, photo):
    words = ["--jobs", "1", "--max-seconds", "0.1"]
    before = set(Path(tempfile.gettempdir()).glob("piccolo-*/**/a.jpg"))
    with serving("--cloud", scene / "cloud.ply", "--cache", folder / "maps", *words) as client:
        status, _, body = client.post("/localize", "a.jpg", photo)
        assert status in (500, 503)  # 503 if the scan could not be opened in ten times that
        assert "more than 0.1 s" in json.loads(body)["error"] or status == 503
    assert set(Path(tempfile.gettempdir()).glob("piccolo-*/**/a.jpg")) <= before


KNOWN = {"gravity": "known"}


def _write_moved(path, scene, by):
    """A third of a scene's points as they would be so far [m] to the east."""
    points = PlyData.read(scene / "cloud.ply")["vertex"].data[::3].copy()
    points["x"] += by
    PlyData([PlyElement.describe(points, "vertex")]).write(path)


def test_a_scan_that_is_replaced_is_opened_again(folder, scene, photo):
    path = folder / "replaced.ply"
    path.write_bytes((scene / "cloud.ply").read_bytes())
    with serving("--cloud", path, "--cache", folder / "maps", "--jobs", "1") as client:
        before = json.loads(client.post("/localize", "a.jpg", photo)[2])
        path.write_bytes(b"ply\nnothing")
        assert client.ask("GET", "/scan")[0] == 200
        assert client.says("can't be opened")
        for worker in workers_of(client.process):
            os.kill(worker, signal.SIGKILL)
        assert json.loads(client.post("/localize", "a.jpg", photo)[2])["status"] == "localized"
        assert json.loads(client.ask("GET", "/scan")[2])["scanSha256"] == before["cloud_sha256"]
        _write_moved(path, scene, 30.0)
        deadline = time.monotonic() + 60.0
        with ThreadPoolExecutor(2) as pool:
            while json.loads(client.ask("GET", "/scan")[2])["scanSha256"] == before["cloud_sha256"]:
                assert time.monotonic() < deadline
                shown = list(pool.map(lambda k: client.post("/show", f"{k}.jpg", photo, KNOWN), range(2)))
                assert all(body.count(b"\n") == 2 and b'"pictures"' in body for _, _, body in shown)
        after = json.loads(client.post("/localize", "a.jpg", photo)[2])
    assert (before["status"], after["status"]) == ("localized", "localized")
    moved = np.subtract(after["center_world"], before["center_world"])
    np.testing.assert_allclose(moved, [30.0, 0.0, 0.0], atol=0.01)
