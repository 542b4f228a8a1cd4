#!/usr/bin/env python3
"""The gain of each part of the default method: recall by variant with one part removed at a time."""

import argparse
import time
from dataclasses import replace
from pathlib import Path

import _checkout  # noqa: F401
import numpy as np

from piccolo.cli.errors import run_command
from piccolo.cli.parser import add_run_options, new_parser
from piccolo.cloud import read_cloud
from piccolo.cloud.model import Cloud
from piccolo.coarse_to_fine import localize as method
from piccolo.coarse_to_fine import query as look
from piccolo.coarse_to_fine import scan_map
from piccolo.coarse_to_fine.settings import EngineSettings
from piccolo.geometry.pose_error import is_correct
from piccolo.geometry.rotations import Gravity
from piccolo.panorama import read_panorama
from piccolo.panorama.local_normalization import Scale
from piccolo.runtime.stopwatch import Stopwatch
from piccolo.runtime.threads import Workers, num_cores
from piccolo.scenes.scene import Scene, read_scene

EPILOG = """\
example:
  python tools/ablation.py BENCH/house BENCH/hospital

A folder has cloud.ply, queries.json and images. Gravity is unknown for the variant tilt, else known;
correct is under 0.1 m and 5 degrees. Seconds are medians of a query.
"""
VARIANTS = ("clean", "tilt", "photo", "change")
VIEWS = ("MIDDLE_VIEW", "FINE_VIEW", "FINISH_VIEW")
EVERYTHING = 120.0  # [deg] a neighbourhood that is the whole sphere: one mean and one deviation for all
SEE_THROUGH = 1e6  # times the nearest range
SETTINGS = {
    "all of it": EngineSettings(),
    "12 starts": EngineSettings(min_starts=12, max_starts=12),
    "300 starts": EngineSettings(min_starts=300, max_starts=300),
    "no halving": EngineSettings(num_coarse=1000, num_middle=1000, num_fine=48),
    "no polish": EngineSettings(num_polished=1, num_fine=1),
}


def change_views(part: str) -> None:
    """Take local normalisation or visibility out of every view, in place."""
    for module, names in ((look, VIEWS), (scan_map, ("SEARCH_VIEW",)), (look, ("SEARCH_VIEW",))):
        for name in names:
            kind = getattr(module, name)
            if part == "no local normalisation":
                kind = replace(kind, sigma_deg=EVERYTHING)
            elif part == "no visibility":
                kind = replace(kind, front=SEE_THROUGH, visible=SEE_THROUGH)
            setattr(module, name, kind)
    if part == "no local normalisation":
        look.SCALES = tuple(Scale(s.width, s.cell_deg, EVERYTHING) for s in look.SCALES)


def row(part: str, scenes: list[tuple[Scene, Cloud]]) -> str:
    """One line of the table."""
    counts = dict.fromkeys(VARIANTS, 0)
    totals = dict.fromkeys(VARIANTS, 0)
    seconds, errors = [], []
    workers = Workers(num_cores())
    for scene, cloud in scenes:
        prepared = scan_map.prepare_map(cloud, workers)
        for query in scene.queries:
            panorama = read_panorama(query.image)
            gravity: Gravity = "unknown" if query.variant == "tilt" else "known"
            settings = replace(SETTINGS.get(part, EngineSettings()), gravity=gravity)
            begin = time.perf_counter()
            found = method.localize(prepared, panorama, settings, workers, Stopwatch())
            seconds.append(time.perf_counter() - begin)
            totals[query.variant] += 1
            if found.pose is not None and is_correct(found.pose, query.pose):
                counts[query.variant] += 1
                errors.append(float(np.linalg.norm(found.pose.center_world - query.pose.center_world)))
    recall = " | ".join(f"{counts[v]}/{totals[v]}" for v in VARIANTS)
    median_mm = 1000.0 * float(np.median(errors)) if errors else float("nan")
    return f"| {part} | {recall} | {median_mm:.1f} | {np.median(seconds):.2f} |"


def run(arguments: argparse.Namespace) -> int:
    """Print the table."""
    scenes = [(scene, read_cloud(scene.cloud)) for scene in map(read_scene, arguments.scenes)]
    print("| part | clean | tilt | photo | change | median mm | s |")
    print("|---|---:|---:|---:|---:|---:|---:|")
    row("all of it", scenes[:1])  # compiles
    for part in SETTINGS:
        print(row(part, scenes), flush=True)
    kept = {name: getattr(look, name) for name in (*VIEWS, "SEARCH_VIEW", "SCALES")}
    for part in ("no local normalisation", "no visibility"):
        change_views(part)
        print(row(part, scenes), flush=True)
        for name, value in kept.items():
            setattr(look, name, value)
        scan_map.SEARCH_VIEW = kept["SEARCH_VIEW"]
    return 0


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    parser = new_parser("ablation", __doc__, EPILOG)
    parser.add_argument("scenes", type=Path, nargs="+", metavar="FOLDER", help="scenes with true poses")
    add_run_options(parser)
    return run_command(parser, argv, run)


if __name__ == "__main__":
    raise SystemExit(main())
