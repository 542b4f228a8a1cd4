"""Move the constants that decide by a fifth, one at a time, and measure what changes."""

import importlib
import math
import sys
from argparse import ArgumentParser
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import chain, product
from typing import NamedTuple

import numpy as np

from piccolo.cli.command import Arguments, option
from piccolo.cloud.stream import stream_of_arrays
from piccolo.geometry.nearness import RIGHT
from piccolo.jobs.threads import Workers, num_cores
from piccolo.judge.localization import Localization
from piccolo.judge.probability import LOCALIZED
from piccolo.scan_map.scan_map import ScanMap, prepare_map

from ..evaluation.tables import table_of
from ..scene import read_scene
from .claims import Trial
from .confidence import localize_trial, photo_trials, room_trials, scene_trials

EPILOG = """\
example:
  python tools/benchmark.py sensitivity --scenes BENCH/house BENCH/hospital --seeds 900 902 --most 8

Of each scene the first --most panoramas and as many phone photos cut out of them, and of each seed's made
rooms the first --most trials, are localized with every constant as it is, then a fifth smaller and larger.
Prints a table: right, localized, wrong of these, the median error of those right in both, and how many
results changed at all. A cosine is moved by its angle. docs/METHOD.md has the table.
"""
STEP = 0.2
# by module of piccolo; those of compiled kernels and of the map can't be moved once that is made
CONSTANTS: dict[str, tuple[str, ...]] = {
    "judge.probability": ("LEAST_RATIO", "NOISE_MATCHES"),
    "evidence.occlusion": ("CONTRADICTING", "SIGMA_DEG"),
    "evidence.covariance": ("MOST_SCORE", "PIXEL_SHARE", "UNCALIBRATED_SHARE"),
    "evidence.focal_length": ("EDGE_ERROR",),
    "evidence.lens_matches": ("INFLATION", "MATCHED_DEVIATION"),
    "evidence.verification": ("COS_AGREE",),
    "judge.candidate": ("LEAST_SHARED",),
    "judge.selection": (
        "CHANCE_MATCHES",
        "CLEAR_MARGIN",
        "FAINT_SCORE",
        "MIRROR_RATIO",
        "RIVAL_SCORE",
        "SURE_MATCHES",
        "SURE_ODDS",
    ),
    "localization.attempts": ("ENOUGH_MATCHES", "FIRST_MIRROR_RATIO", "NUM_MATCHED"),
    "localization.beam": ("FAINT_PART", "NUM_FOUND", "NUM_SCORED_STARTS"),
    "localization.calibration": ("CLEARLY",),
    "localization.judging": ("WORTH_ASKING",),
    "localization.ladder": ("MAX_PERTURBATIONS", "MIN_GAIN", "PERTURBED_ANGLE", "PERTURBED_DISTANCE"),
    "localization.last_descent": ("NEAR_SCORE",),
    "localization.mirror": ("ENOUGH_EXPLAINED",),
    "localization.search": ("CANDIDATES_PER_START", "POSES_PER_START"),
    "problem.settings": ("FIRST_STARTS",),
    "local_features.matching": ("DISTINCT_RATIO",),
    "local_features.hypotheses": ("MAX_VOTERS", "NUM_CLUSTERS"),
}


class Place(NamedTuple):
    """A prepared scan with its trials."""

    scan_map: ScanMap
    trials: Sequence[Trial]


class Measured(NamedTuple):
    """Results of all trials, in order."""

    found: list[Localization]
    errors_m: list[float]  # nan where there is no truth or the pose is wrong


def move(value: float, name: str, factor: float) -> float:
    """Return a constant times a factor; a cosine's angle is moved, and a whole number by at least 1."""
    if name.startswith("COS_"):
        return math.cos(factor * math.acos(value))
    if not isinstance(value, int):
        return value * factor
    step = max(1, round(abs(factor - 1.0) * value))
    return value + (step if factor > 1.0 else -step)


@contextmanager
def move_constant(module: str, name: str, factor: float) -> Iterator[None]:
    """Move a constant in its module and in all that have imported it."""
    value = getattr(importlib.import_module(f"piccolo.{module}"), name)
    users = [
        vars(user)
        for key, user in list(sys.modules.items())
        if key.startswith("piccolo.") and vars(user).get(name) is value
    ]
    for names in users:
        names[name] = move(value, name, factor)
    try:
        yield
    finally:
        for names in users:
            names[name] = value


def list_places(arguments: Arguments, workers: Workers) -> Iterator[Place]:
    """Yield each scene and each seed's made rooms, prepared, with the first of their trials."""
    scenes = [read_scene(folder) for folder in arguments.scenes]
    of_scenes = []
    for scene in scenes:
        few = replace(scene, queries=scene.queries[: arguments.most])
        cloud, panoramas = next(scene_trials(few, ()))
        _, photos = next(photo_trials(few, (), 1))
        of_scenes.append((cloud, panoramas[: arguments.most] + photos))
    of_rooms = (next(room_trials(seed, workers)) for seed in range(*arguments.seeds))
    for cloud, trials in chain(of_scenes, of_rooms):
        points, colors = cloud
        stream = stream_of_arrays(points.astype(np.float64), colors)
        yield Place(prepare_map(stream, workers, has_features=True), trials[: 2 * arguments.most])


def measure(places: Sequence[Place], workers: Workers) -> Measured:
    """Localize all trials."""
    measured = Measured([], [])
    for scan_map, trials in places:
        for trial in trials:
            found = localize_trial(scan_map, trial, workers)
            measured.found.append(found)
            truth = trial.true_pose
            if truth and found.pose and RIGHT.holds(found.pose, truth):
                measured.errors_m.append(found.pose.distance(truth))
            else:
                measured.errors_m.append(math.nan)
    return measured


def row_of(name: str, measured: Measured, before: Measured) -> dict[str, str]:
    """Return a table's line: what a constant's move does, beside the results before."""
    in_both = ~np.isnan(measured.errors_m) & ~np.isnan(before.errors_m)
    keys = [[(one.status, one.confidence, one.pose) for one in run.found] for run in (measured, before)]
    num_changed = sum(one != other for one, other in zip(*keys, strict=True))
    is_right = ~np.isnan(measured.errors_m)
    is_sure = np.array([one.status == LOCALIZED for one in measured.found])
    return {
        "constant": name,
        "right": f"{is_right.sum()}",
        "localized": f"{is_sure.sum()}",
        "wrong of these": f"{(is_sure & ~is_right).sum()}",
        "median [mm]": f"{1e3 * np.median(np.array(measured.errors_m)[in_both]):.2f}",
        "changed": f"{num_changed}",
    }


def add_arguments(parser: ArgumentParser) -> None:
    """Add all options."""
    option(parser, "--scenes FOLDER ...", "scenes with true poses", default=[])
    option(parser, "--seeds FIRST END", "seeds of synthetic rooms, END excluded", default=[0, 0])
    option(parser, "--most N", "panoramas, and photos, of each place", default=8)
    option(parser, "--threads N", "number of threads", default=num_cores())


def run(arguments: Arguments) -> int:
    """Measure with every constant as it is, then with each of them moved; print the table."""
    workers = Workers(arguments.threads)
    places = list(list_places(arguments, workers))
    before = measure(places, workers)
    rows = [row_of("as they are", before, before)]
    for module, names in CONSTANTS.items():
        for name, factor in product(names, (1.0 - STEP, 1.0 + STEP)):
            with move_constant(module, name, factor):
                rows.append(row_of(f"{module}.{name} x {factor:.1f}", measure(places, workers), before))
            arguments.note(" ".join(rows[-1].values()))
    print(table_of(rows).markdown())
    return 0
