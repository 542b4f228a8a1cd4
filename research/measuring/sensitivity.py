"""Move the numbers by which the method decides by a fifth, one at a time, and measure what changes."""

import math
from argparse import ArgumentParser
from collections.abc import Iterator, Sequence
from dataclasses import fields, replace
from itertools import chain, product
from typing import NamedTuple

import numpy as np

from piccolo.cli.command import Arguments, option
from piccolo.cloud.stream import stream_of_arrays
from piccolo.geometry.nearness import RIGHT
from piccolo.judge.probability import LOCALIZED
from piccolo.judge.result import Result
from piccolo.problem.method import METHOD, Method
from piccolo.scan_map.scan_map import ScanMap, prepare_map
from piccolo.system.jobs.threads import Workers, num_cores

from ..evaluation.tables import table_of
from ..scene import read_scene
from .claims import Trial
from .confidence import localize_trial, photo_trials, room_trials, scene_trials

EPILOG = """\
example:
  python tools/benchmark.py sensitivity --scenes BENCH/house BENCH/hospital --seeds 900 902 --most 8

Of each scene the first --most panoramas and as many phone photos cut out of them, and of each seed's made
rooms the first --most trials, are localized with every number of the method as it is, then a fifth smaller
and larger.
Prints a table: right, localized, wrong of these, the median error of those right in both, and how many
results changed at all. piccolo/problem/method.py has the numbers.
"""
STEP = 0.2


class Place(NamedTuple):
    """A prepared scan with its trials."""

    scan_map: ScanMap
    trials: Sequence[Trial]


class Measured(NamedTuple):
    """Results of all trials, in order."""

    found: list[Result]
    errors_m: list[float]  # nan where there is no truth or the pose is wrong


def move(method: Method, name: str, factor: float) -> Method:
    """Return a method with one of its numbers times a factor; a whole number is moved by at least 1."""
    value = getattr(method, name)
    if not isinstance(value, int):
        return replace(method, **{name: value * factor})
    step = max(1, round(abs(factor - 1.0) * value))
    return replace(method, **{name: value + (step if factor > 1.0 else -step)})


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
        yield Place(prepare_map(stream, workers), trials[: 2 * arguments.most])


def measure(places: Sequence[Place], workers: Workers, method: Method = METHOD) -> Measured:
    """Localize all trials."""
    measured = Measured([], [])
    for scan_map, trials in places:
        for trial in trials:
            found = localize_trial(scan_map, trial, workers, method)
            measured.found.append(found)
            truth = trial.true_pose
            if truth and found.best_pose and RIGHT.holds(found.best_pose, truth):
                measured.errors_m.append(found.best_pose.distance(truth))
            else:
                measured.errors_m.append(math.nan)
    return measured


def row_of(name: str, measured: Measured, before: Measured) -> dict[str, str]:
    """Return a table's line: what a number's move does, beside the results before."""
    in_both = ~np.isnan(measured.errors_m) & ~np.isnan(before.errors_m)
    keys = [[(one.status, one.confidence, one.best_pose) for one in run.found] for run in (measured, before)]
    num_changed = sum(one != other for one, other in zip(*keys, strict=True))
    is_right = ~np.isnan(measured.errors_m)
    is_sure = np.array([one.status == LOCALIZED for one in measured.found])
    return {
        "number": name,
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
    """Measure with every number as it is, then with each of them moved; print the table."""
    workers = Workers(arguments.threads)
    places = list(list_places(arguments, workers))
    before = measure(places, workers)
    rows = [row_of("as they are", before, before)]
    for field, factor in product(fields(Method), (1.0 - STEP, 1.0 + STEP)):
        moved = measure(places, workers, move(METHOD, field.name, factor))
        rows.append(row_of(f"{field.name} x {factor:.1f}", moved, before))
        arguments.note(" ".join(rows[-1].values()))
    print(table_of(rows).markdown())
    return 0
