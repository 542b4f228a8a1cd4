#!/usr/bin/env python3
"""Time, size and memory of a report, and of its page in headless Chromium, which draws by software.

First view: from the navigation until plan and list are drawn. Frames: while the plan is zoomed and moved.
Memory: proportional set size of the page's process after 20 photos were opened.
"""

import argparse
import shutil
import statistics
import sys
import time
from pathlib import Path
from typing import Any

import _checkout  # noqa: F401
from playwright.sync_api import sync_playwright

from piccolo.cli import report
from piccolo.cli.command import command, option
from piccolo.cli.options import add_cloud_options
from piccolo.errors import InputError

PHOTOS = 20  # opened in the page
# milliseconds from frame to frame while the plan is moved; kind is "zoom" or "pan"
FRAMES = """kind => new Promise(resolve => {
  const plan = document.getElementById('plan'), box = plan.getBoundingClientRect(), times = [];
  const at = (x, y) => ({ clientX: box.left + x, clientY: box.top + y, bubbles: true, cancelable: true });
  const pointer = (name, x) => plan.dispatchEvent(new PointerEvent(name, { pointerId: 1, ...at(x, 300) }));
  plan.setPointerCapture = () => undefined;
  if (kind === 'pan') pointer('pointerdown', 400);
  const step = now => {
    times.push(now);
    const k = times.length % 40;
    if (times.length > 120) {
      if (kind === 'pan') pointer('pointercancel', 400);
      return resolve(times.slice(1).map((time, i) => time - times[i]));
    }
    if (kind === 'pan') pointer('pointermove', 400 + 10 * (k < 20 ? k : 40 - k));
    else plan.dispatchEvent(new WheelEvent('wheel', { deltaY: k < 20 ? -40 : 40, ...at(400, 300) }));
    requestAnimationFrame(step);
  };
  requestAnimationFrame(step);
})"""


def measure_page(index: Path) -> dict[str, float]:
    """First view [s], median frames a second while zooming and moving, memory of the tab [MB]."""
    chromium = shutil.which("chromium")
    if chromium is None:
        raise InputError("found no chromium, wanted it installed: apt-get install chromium")
    with sync_playwright() as p:
        flags = ["--no-sandbox", "--enable-unsafe-swiftshader"]
        browser = p.chromium.launch(executable_path=chromium, args=flags)
        page = browser.new_page(viewport={"width": 1440, "height": 900})
        begin = time.perf_counter()
        page.goto(index.resolve().as_uri())
        page.wait_for_selector("html[data-ready] #row-0")
        page.evaluate("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
        found = {"first view": time.perf_counter() - begin}
        page.wait_for_timeout(1000)
        for kind in ("zoom", "pan"):
            found[kind] = 1000.0 / statistics.median(page.evaluate(FRAMES, kind))
        page.click("#row-0")
        page.click("[data-mode=blend]")
        for _ in range(PHOTOS):
            page.keyboard.press("n")
            page.wait_for_timeout(400)
        found["memory"] = tab_memory(browser)
        browser.close()
    return found


def tab_memory(browser: Any) -> float:
    """Memory [MB] of the largest of a browser's page processes."""
    session = browser.new_browser_cdp_session()
    processes = session.send("SystemInfo.getProcessInfo")["processInfo"]
    sizes = []
    for process in processes:
        if process["type"] == "renderer":
            lines = Path(f"/proc/{process['id']}/smaps_rollup").read_text().splitlines()
            sizes += [int(line.split()[1]) / 1000.0 for line in lines if line.startswith("Pss:")]
    return max(sizes)


def folder_size(folder: Path) -> float:
    """[MB]."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 1e6


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """All options."""
    option(parser, "--results FILE ...", "JSON lines of localize.py", required=True)
    add_cloud_options(parser, "their scan or map")
    option(parser, "--out FOLDER", "a new folder", required=True)


@command(__file__, __doc__, "", add_arguments)
def main(arguments: argparse.Namespace) -> int:
    """Build, measure, print a row."""
    words = ["--results", *map(str, arguments.results), "--cloud", *map(str, arguments.cloud), "--quiet"]
    begin, cpu = time.perf_counter(), time.process_time()
    if code := report.main([*words, "--out", str(arguments.out)]):
        return code
    seconds, cpu = time.perf_counter() - begin, time.process_time() - cpu
    page = measure_page(arguments.out / "index.html")
    print("| built [s] | CPU [s] | size [MB] | first view [s] | zoom [1/s] | pan [1/s] | tab [MB] |")
    print("|---|---|---|---|---|---|---|")
    numbers = f"{seconds:.0f} | {cpu:.0f} | {folder_size(arguments.out):.0f} | {page['first view']:.2f}"
    print(f"| {numbers} | {page['zoom']:.0f} | {page['pan']:.0f} | {page['memory']:.0f} |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
