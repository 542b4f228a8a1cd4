"""The page of a service of the sample flat, and what a person does on it."""

import re
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FLAT = ROOT / "examples" / "flat"
SLOW_MS = 120_000  # for a photo, on a machine that does much else
CHOOSER = "input[type=file][multiple]"
# keeps the options that are sent in window.told
LISTEN = """() => {
  const append = FormData.prototype.append;
  FormData.prototype.append = function (name, value) {
    if (name === "options") window.told = JSON.parse(value);
    append.call(this, name, value);
  };
}"""
PHONE = {"width": 390, "height": 844, "device_scale_factor": 2, "has_touch": True, "is_mobile": True}


@contextmanager
def serving(cache, *more):
    """Within this, the address of a service of the sample flat."""
    words = ["--cloud", str(FLAT / "cloud.ply"), "--port", "0", "--jobs", "2", "--cache", str(cache)]
    serve = [sys.executable, str(ROOT / "tools" / "serve.py"), *words, *map(str, more)]
    with subprocess.Popen(serve, stderr=subprocess.PIPE, text=True) as process:
        try:
            for line in process.stderr:
                if found := re.search(r"open (http://\S+) in a browser", line):
                    break
            yield found[1]
        finally:
            process.terminate()
            process.communicate(timeout=30)


def choose(page, *files):
    page.set_input_files(CHOOSER, [str(file) for file in files])


def wait_for(page, *statuses):
    """Wait until the list says these, in order."""
    for index, status in enumerate(statuses):
        page.wait_for_selector(f"#row-{index} .row-status.{status}")


def list_names(page):
    return page.locator(".row-name").all_inner_texts()


@contextmanager
def answering(page, answer):
    """Within this, requests to localize a photo are answered by a function of their route."""
    page.route("**/show", answer)
    yield
    page.unroute("**/show")


def giving(answer):
    """A function of a route that gives an answer that the service once gave."""
    return lambda route: route.fulfill(status=200, content_type="application/x-ndjson", body=answer)


def tell_place(page, x, y, radius):
    page.click(".drop >> text=Options")
    for name, value in (("x", x), ("y", y), ("radius", radius)):
        page.fill(f"[name={name}]", str(value))
    page.click(".options .main")
