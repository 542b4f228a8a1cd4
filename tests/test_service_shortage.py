"""A service whose disk is full, or that may open no more files: the request says so, the next one works."""

import json
import resource
import time
from contextlib import contextmanager
from pathlib import Path

import pytest
from batches import workers_of
from services import serving

from piccolo.apps.service.connections import LINES

TIER = "process"

NO_FILE = resource.RLIMIT_NOFILE
FULL = resource.RLIMIT_FSIZE  # no file grows beyond it, as on a full disk


@pytest.fixture(scope="module")
def photo(scene):
    return (scene / "images" / "clean_0.jpg").read_bytes()


@pytest.fixture(scope="module")
def keep(tmp_path_factory):
    return tmp_path_factory.mktemp("keep")


@pytest.fixture(scope="module")
def service(scene, keep, photo):
    words = ["--cache", scene.parent / "maps", "--jobs", "1", "--keep", keep]
    with serving("--cloud", scene / "cloud.ply", *words) as client:
        _assert_works(client, keep, photo)  # a process keeps the limits that it begins with
        yield client
    assert "Traceback" not in client.rest
    assert client.rest.count("could not be answered") == LINES


@contextmanager
def _limited(pid, what, limit):
    before = resource.prlimit(pid, what)
    resource.prlimit(pid, what, (limit, before[1]))
    yield
    resource.prlimit(pid, what, before)


def _next_file(pid):
    """The number that the next file gets, as soon as those of the request before are closed."""
    used = None
    while (now := {int(path.name) for path in Path(f"/proc/{pid}/fd").iterdir()}) != used:
        used = now
        time.sleep(0.5)
    return min(set(range(len(used) + 1)) - used)


def _files(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def _assert_refused(client, keep, content, wanted, path="/localize"):
    before = _files(keep)
    status, headers, body = client.post(path, "a.jpg", content)
    assert status == wanted, body
    assert ("retry-after" in headers) == (wanted == 503)
    assert "\n" not in json.loads(body)["error"]
    assert str(keep) not in body.decode()
    assert "/tmp" not in body.decode()
    assert _files(keep) == before


def _assert_works(client, keep, content):
    assert client.post("/localize", "a.jpg", content)[0] == 200
    lines = (keep / "results.jsonl").read_text().splitlines()
    assert all(json.loads(line)["status"] == "localized" for line in lines)


@pytest.mark.parametrize(
    ("limit", "path"), [(0, "/localize"), (1000, "/show"), ("the photo", "/localize"), ("the photo", "/show")]
)
def test_no_room_to_keep_a_photo(service, keep, photo, limit, path):
    with _limited(service.process.pid, FULL, len(photo) - 1 if limit == "the photo" else limit):
        _assert_refused(service, keep, photo, 507, path)
    _assert_works(service, keep, photo)


def test_no_room_for_the_line_of_a_photo(service, keep, photo):
    results = keep / "results.jsonl"
    while results.stat().st_size <= len(photo):
        with results.open("a") as file:
            file.write(results.read_text())
    with _limited(service.process.pid, FULL, results.stat().st_size + 10):
        _assert_refused(service, keep, photo + b"another", 507)
    _assert_works(service, keep, photo)


def test_no_room_for_an_upload(service, keep, photo):
    with _limited(service.process.pid, FULL, 500_000):
        _assert_refused(service, keep, photo + bytes(2_000_000), 507)
    _assert_works(service, keep, photo)


@pytest.mark.parametrize("limit", [0, 1000])
def test_no_room_where_a_process_is_at_work(service, keep, photo, limit):
    (worker,) = workers_of(service.process)
    with _limited(worker, FULL, limit):
        _assert_refused(service, keep, photo, 507)
    _assert_works(service, keep, photo)


def test_a_thumbnail_that_can_not_be_kept_costs_no_photo(service, keep, photo):
    thumbs = keep / "thumbs"
    thumbs.touch()
    status, _, body = service.post("/show", "a.jpg", photo)
    thumbs.unlink()
    assert status == 200
    first, second = map(json.loads, body.splitlines())
    assert first["result"]["status"] == "localized"
    assert second["error"]


@pytest.mark.parametrize("more", range(2))
def test_too_many_files_where_a_process_is_at_work(service, keep, photo, more):
    (worker,) = workers_of(service.process)
    with _limited(worker, NO_FILE, _next_file(worker) + more):
        _assert_refused(service, keep, photo, 503)
    _assert_works(service, keep, photo)


def test_too_many_files_to_keep_a_photo(service, keep, photo):
    with _limited(service.process.pid, NO_FILE, _next_file(service.process.pid) + 1):
        _assert_refused(service, keep, photo, 503)
    _assert_works(service, keep, photo)
