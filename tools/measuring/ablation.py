"""The gain of each part of the default method: recall by variant with one part removed at a time."""

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from piccolo.cloud import read_cloud
from piccolo.cloud.stream import Cloud
from piccolo.geometry.pose import is_correct
from piccolo.geometry.rotations import Gravity
from piccolo.jobs.stopwatch import Stopwatch
from piccolo.jobs.threads import Workers, num_cores
from piccolo.localization.localize import localize
from piccolo.localization.settings import METHOD, Beam, CoarseToFineSettings, ImageScales, MethodConfig
from piccolo.panorama import read_panorama
from piccolo.scan_map.scan_map import prepare_map
from piccolo.scenes.scene import Scene, read_scene
from piccolo.views.candidate_views import SEARCH_VIEW
from piccolo.views.view import ViewConfig

EPILOG = """\
example:
  python tools/benchmark.py ablation BENCH/house BENCH/hospital

A folder has cloud.ply, queries.json and images. Gravity is unknown for the variant tilt, else known;
correct is under 0.1 m and 5 degrees. Seconds are medians of a query.
"""
VARIANTS = ("clean", "tilt", "photo", "change")
EVERYTHING = 120.0  # [deg] a neighbourhood that is the whole sphere: one mean and one deviation for all
SEE_THROUGH = 1e6  # times the nearest range
Parts = tuple[MethodConfig, ViewConfig, int]  # the method, its search view, the most starts


def with_views(change: Callable[[ViewConfig], ViewConfig], scales: ImageScales = METHOD.scales) -> Parts:
    """The method with every view changed."""
    m = METHOD
    method = m._replace(
        middle_view=change(m.middle_view), fine_view=change(m.fine_view), full_view=change(m.full_view)
    )
    return method._replace(scales=scales), change(SEARCH_VIEW), 4000


GLOBAL_SCALES = ImageScales(*(scale._replace(sigma_deg=EVERYTHING) for scale in METHOD.scales))
PARTS: dict[str, Parts] = {
    "all of it": (METHOD, SEARCH_VIEW, 4000),
    "search alone": (METHOD._replace(uses_features=False), SEARCH_VIEW, 4000),
    "features alone": (METHOD._replace(uses_search=False), SEARCH_VIEW, 4000),
    "12 starts": (METHOD._replace(min_starts=12), SEARCH_VIEW, 12),
    "300 starts": (METHOD._replace(min_starts=300), SEARCH_VIEW, 300),
    "no halving": (METHOD._replace(beam=Beam(1000, 1000, 48, 2)), SEARCH_VIEW, 4000),
    "no perturbation": (METHOD._replace(beam=Beam(400, 48, 1, 1)), SEARCH_VIEW, 4000),
    "no local normalisation": with_views(lambda v: replace(v, sigma_deg=EVERYTHING), GLOBAL_SCALES),
    "no visibility": with_views(lambda v: replace(v, front=SEE_THROUGH, visible=SEE_THROUGH)),
}


def row(part: str, scenes: list[tuple[Scene, Cloud]]) -> str:
    """One line of the table."""
    counts = dict.fromkeys(VARIANTS, 0)
    totals = dict.fromkeys(VARIANTS, 0)
    seconds = []
    errors = []
    workers = Workers(num_cores())
    method, search_view, max_starts = PARTS[part]
    for scene, cloud in scenes:
        prepared = prepare_map(cloud, workers, view=search_view)
        for query in scene.queries:
            panorama = read_panorama(query.image)
            gravity: Gravity = "unknown" if query.variant == "tilt" else "known"
            settings = CoarseToFineSettings(gravity=gravity, max_starts=max_starts)
            begin = time.perf_counter()
            found = localize(prepared, panorama, settings, workers, Stopwatch(), method)
            seconds.append(time.perf_counter() - begin)
            totals[query.variant] += 1
            if found.pose is not None and is_correct(found.pose, query.pose):
                counts[query.variant] += 1
                errors.append(float(np.linalg.norm(found.pose.center_world - query.pose.center_world)))
    recall = " | ".join(f"{counts[v]}/{totals[v]}" for v in VARIANTS)
    median_mm = 1000.0 * float(np.median(errors)) if errors else float("nan")
    return f"| {part} | {recall} | {median_mm:.1f} | {np.median(seconds):.2f} |"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """All options."""
    parser.add_argument("scenes", type=Path, nargs="+", metavar="FOLDER", help="scenes with true poses")


def run(arguments: argparse.Namespace) -> int:
    """Print the table."""
    scenes = [(scene, read_cloud(scene.cloud)) for scene in map(read_scene, arguments.scenes)]
    print("| part | clean | tilt | photo | change | median mm | s |")
    print("|---|---:|---:|---:|---:|---:|---:|")
    row("all of it", scenes[:1])  # compiles
    for part in PARTS:
        print(row(part, scenes), flush=True)
    return 0
