"""Reports in Debian's Chromium, opened from disk: what they need, and what all of them must never do."""

import functools
import shutil
import sys
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from playwright.sync_api import sync_playwright

ROOT = Path(__file__).resolve().parents[1]
sys.path += [str(ROOT), str(ROOT / "tests")]

from dropping import FLAT, SLOW_MS, serving  # noqa: E402
from report_scenes import HOSTILE, House, mixed_house  # noqa: E402
from services import Client  # noqa: E402

from piccolo.apps.report import report  # noqa: E402
from piccolo.cli import localize  # noqa: E402
from piccolo.judge.result_parts import Source  # noqa: E402
from research.synthetic import make_room  # noqa: E402

ARTIFACTS = ROOT / "browser_tests" / "screenshots"
AXE = ROOT / "page" / "node_modules" / "axe-core" / "axe.min.js"
FLAGS = ["--no-sandbox", "--enable-unsafe-swiftshader"]


@pytest.fixture(scope="session")
def browser():
    path = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    assert path, "found no chromium, wanted it installed: apt-get install chromium"
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=path, args=FLAGS)
        yield chromium
        chromium.close()


@contextmanager
def opening(browser, own, is_strict=True):
    """Yield a function that opens an address; at the end nothing may have been asked of any not `own`.

    Strictly, nothing else may have gone wrong either: no request failed, no error in the console.
    """
    contexts = []
    wrong = []

    def answer(dialog):
        if dialog.type != "beforeunload":
            wrong.append(f"dialog: {dialog.message}")
        dialog.accept()

    def watch(page):
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("dialog", answer)
        page.on("request", lambda asked: asked.url.startswith(own) or wrong.append(f"asked: {asked.url}"))
        if is_strict:
            page.on("console", lambda message: message.type == "error" and wrong.append(message.text))
            page.on("requestfailed", lambda asked: wrong.append(f"failed: {asked.url}"))

    def visit(address, width, height, **more):
        context = browser.new_context(viewport={"width": width, "height": height}, **more)
        contexts.append(context)
        page = context.new_page()
        watch(page)
        page.goto(address)
        page.wait_for_selector("html[data-ready]")
        return page

    yield visit
    for context in contexts:
        context.close()
    assert wrong == []


@pytest.fixture
def open_page(browser):
    """A function that opens a report from disk."""
    with opening(browser, ("file:", "data:", "blob:")) as visit:

        def open_page(file, hash="", width=1440, height=900, **more):
            return visit(file.resolve().as_uri() + hash, width, height, **more)

        yield open_page


@pytest.fixture(scope="session")
def find_barriers():
    """A function that returns what axe-core finds on a page."""
    source = AXE.read_text()

    def find(page):
        page.evaluate(source)
        found = page.evaluate("axe.run({ preload: false }).then(result => result.violations)")
        return [(v["id"], v["impact"], [node["html"][:150] for node in v["nodes"][:3]]) for v in found]

    return find


@pytest.fixture
def shoot(request):
    """A function that keeps a screenshot as an artifact of the test."""
    ARTIFACTS.mkdir(exist_ok=True)
    return lambda page, name: page.screenshot(path=ARTIFACTS / f"{name}.png")


@pytest.fixture(scope="session")
def demo(tmp_path_factory):
    """The room of the demo with three photos at full width: its folder, and the page."""
    folder = tmp_path_factory.mktemp("demo")
    words = "--seed 7 --points 200000 --panoramas 3 --width 2048 --quiet"
    assert make_room.main(["--out", str(folder), *words.split()]) == 0
    cloud, results = folder / "cloud.ply", folder / "poses.jsonl"
    words = ["--cloud", str(cloud), "--pano", str(folder / "images"), "--out", str(results), "--quiet"]
    assert localize.main(words) == 0
    words = ["--results", str(results), "--cloud", str(cloud), "--out", str(folder / "report"), "--quiet"]
    assert report.main([*words, "--title", "Demo room"]) == 0
    return folder, folder / "report" / "index.html"


@pytest.fixture(scope="session")
def many(tmp_path_factory):
    """Three hundred small photos of every status on two storeys, and a walk."""
    folder = tmp_path_factory.mktemp("many")
    house, results = mixed_house(folder, 300, width=128)
    words = ["--results", *map(str, results), "--cloud", str(house.cloud), "--out", str(folder / "report")]
    storeys = ["--storeys", "Ground floor", "First floor", "--title", "12 High Street", "--quiet"]
    assert report.main([*words, *storeys]) == 0
    return folder / "report" / "index.html"


@pytest.fixture(scope="session")
def odd(tmp_path_factory):
    """Photos with one name in two folders, three at one spot, guesses, and results of another scan."""
    folder = tmp_path_factory.mktemp("odd")
    house = House(folder, 128)
    house.write_cloud()
    for name in ("a/0.jpg", "b/0.jpg", "1.jpg"):
        (folder / "photos" / name).parent.mkdir(parents=True, exist_ok=True)
        house.add(0 if "/" in name else 2, name)
    house.results += [replace(house.results[-1], pano=str(folder / "photos" / f"{k}.jpg")) for k in (2, 3)]
    house.add(4, "guess.jpg", status="not_localized")
    house.add(6, "hopeless.jpg", status="not_localized", confidence=0.003)
    house.add(8, "gone.jpg", status="unreadable")
    house.add(10, "=cmd|' !A1.jpg")
    source = Source(cloud_sha256="0" * 64)
    house.results = [replace(result, source=source) for result in house.results]
    words = ["--results", str(house.write_results()), "--cloud", str(house.cloud), "--quiet", "--force"]
    assert report.main([*words, "--out", str(folder / "report")]) == 0
    return folder / "report" / "index.html"


@pytest.fixture(scope="session")
def hostile(tmp_path_factory):
    """Photos whose names try to be markup, code and links, as a folder and as one file."""
    folder = tmp_path_factory.mktemp("hostile")
    house = House(folder, 128)
    house.write_cloud()
    for k, name in enumerate(HOSTILE):
        house.add(k, name.replace("/", "\u2215"))
    words = ["--results", str(house.write_results()), "--cloud", str(house.cloud), "--quiet"]
    words += ["--title", HOSTILE[1], "--storeys", HOSTILE[0], HOSTILE[2]]
    assert report.main([*words, "--out", str(folder / "report")]) == 0
    assert report.main([*words, "--out", str(folder / "report.html"), "--self-contained"]) == 0
    return folder / "report" / "index.html", folder / "report.html"


@pytest.fixture(scope="session")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="session")
def service(cache):
    """The address of a service that keeps nothing."""
    with serving(cache) as address:
        yield address


@pytest.fixture(scope="session")
def ask(service):
    """A function that returns the service's answer to a photo of the sample; it is asked once."""
    client = Client(int(service.split(":")[2].rstrip("/")), None)

    @functools.cache
    def ask(name, options="{}"):
        content = (FLAT / "images" / f"{name}.jpg").read_bytes()
        status, _, answer = client.post("/show", f"{name}.jpg", content, options)
        assert status == 200
        return answer

    return ask


@pytest.fixture
def visit(browser, service):
    """A function that opens the service's page."""
    with opening(browser, (service, "data:", "blob:"), is_strict=False) as visit:

        def open_page(width=1400, height=860, **more):
            page = visit(service, width, height, **more)
            page.set_default_timeout(SLOW_MS)
            return page

        yield open_page


@pytest.fixture(scope="session")
def elsewhere(tmp_path_factory):
    """A panorama of a room that is not in the scan.

    It is localized once without a limit of time, so that no browser waits for kernels to be compiled.
    """
    house = House(tmp_path_factory.mktemp("elsewhere"), 1024)
    house.add(0, "elsewhere.jpg")
    photo = house.folder / "photos" / "elsewhere.jpg"
    words = ["--cloud", str(FLAT / "cloud.ply"), "--cache", "none", "--pano", str(photo), "--quiet"]
    assert localize.main(words) == 1
    return photo
