#!/usr/bin/env python3
"""Measure the status on seeded queries with and without an answer: how often each is called localized."""

import argparse
import json
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path

import _checkout  # noqa: F401
import numpy as np

from piccolo.cli.command import command, option
from piccolo.cli.errors import print_note
from piccolo.cloud import CloudStream, read_cloud, stream_of
from piccolo.cloud.readers.reader import RawCloud
from piccolo.cloud.settings import IN_METRES
from piccolo.coarse_to_fine.settings import CoarseToFineSettings
from piccolo.confidence.confidence import AMBIGUOUS, LOCALIZED
from piccolo.geometry.pose import is_correct
from piccolo.geometry.rotations import Gravity
from piccolo.panorama import AS_STORED, read_panorama
from piccolo.paper.settings import PaperSettings
from piccolo.result import Result
from piccolo.runtime.stopwatch import Stopwatch
from piccolo.runtime.threads import Workers, num_cores
from piccolo.scan import Settings, scan_of
from piccolo.scenes.scene import Scene, read_scene
from piccolo.scenes.synthetic.trials import (
    SPARSE_FRACTION,
    Points,
    Trial,
    repeated_trials,
    room_trials,
    upside_down,
    without_scene,
)

EPILOG = """\
example:
  python tools/evaluate_confidence.py --seeds 0 0 --scenes BENCH/house BENCH/hospital --out bench.jsonl

Seeds make rooms, and places that look the same from several positions; scenes are folders with cloud.ply,
queries.json and images, each panorama tried in each cloud. A false answer is a pose called localized that is
over 0.1 m or 5 degrees off. Each trial is a line {"case", "scene", "truth", "result"}; a table on stdout.
"""


def cloud_of(points: Points) -> CloudStream:
    """Points as a stream, as if read from a file."""
    return stream_of(Path("trial"), RawCloud(points[0].astype(np.float64), points[1]))


def scene_trials(scene: Scene, others: Sequence[Scene]) -> Iterator[tuple[CloudStream, list[Trial]]]:
    """Every panorama of every scene in one scene's cloud; its own also spoilt, and in a thinned cloud."""
    cloud = read_cloud(scene.cloud)
    rng = np.random.default_rng([len(scene.queries), 52])
    own = [Trial(query.variant, read_panorama(query.image).rgb, query.pose) for query in scene.queries]
    upright = [trial for trial in own if trial.case == "clean"]
    spoilt = [Trial(name, rgb, t.true_pose if name == "blurred" else None)
              for t in upright[:2] for name, rgb in without_scene(t.rgb, rng)]  # fmt: skip
    foreign = [query.image for other in others for query in other.queries]
    elsewhere = [Trial("elsewhere", read_panorama(image).rgb, None) for image in foreign]
    points_world = cloud.points + cloud.origin_world
    yield cloud_of((points_world, cloud.colors)), [*own, *elsewhere, *spoilt, *map(upside_down, upright)]
    sparse = np.sort(rng.choice(len(points_world), int(SPARSE_FRACTION * len(points_world)), replace=False))
    thinned = cloud_of((points_world[sparse], cloud.colors[sparse]))
    yield thinned, [Trial("sparse", t.rgb, t.true_pose) for t in upright]


def all_trials(
    arguments: argparse.Namespace, workers: Workers
) -> Iterator[tuple[str, CloudStream, list[Trial]]]:
    """Name of a scene, its cloud, its trials."""
    for seed in range(*arguments.seeds):
        for points, trials in chain(room_trials(seed, workers), repeated_trials(seed, workers)):
            yield f"seed {seed}", cloud_of(points), trials
    scenes = [read_scene(folder) for folder in arguments.scenes]
    for scene in scenes:
        others = [other for other in scenes if other is not scene]
        for cloud, trials in scene_trials(scene, others):
            yield scene.name, cloud, trials


def settings_of(preset: str, gravity: Gravity) -> Settings:
    """The settings of a trial; the paper's method takes `auto` as `known`."""
    if preset == "paper":
        return PaperSettings(gravity="known" if gravity == "auto" else gravity)
    return CoarseToFineSettings(gravity=gravity)


def results_of(arguments: argparse.Namespace) -> Iterator[tuple[str, Trial, Result]]:
    """Localize every trial; the scene's name, the trial and its result."""
    workers = Workers(arguments.threads)
    for name, cloud, trials in all_trials(arguments, workers):
        settings = settings_of(arguments.preset, "auto")
        scan = scan_of(cloud, name, IN_METRES, settings, workers, Stopwatch())
        for trial in trials:
            settings = settings_of(arguments.preset, trial.gravity)
            yield name, trial, scan.localize_query(trial.rgb, AS_STORED, settings)


def print_table(counts: dict[str, list[tuple[str, bool]]]) -> int:
    """One line a case; returns the number of false answers."""
    print("| case | trials | correct | localized | ambiguous | false |")
    print("|---|---:|---:|---:|---:|---:|")
    for case, rows in counts.items():
        statuses, is_right = zip(*rows, strict=True)
        numbers = len(rows), sum(is_right), statuses.count(LOCALIZED), statuses.count(AMBIGUOUS)
        print(f"| {case} | {' | '.join(map(str, numbers))} | {rows.count((LOCALIZED, False))} |")
    return sum(rows.count((LOCALIZED, False)) for rows in counts.values())


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """All options."""
    option(parser, "--seeds FIRST END", required=True)
    option(parser, "--scenes FOLDER ...", default=[])
    option(parser, "--out FILE", "JSON lines, written as they come", required=True)
    option(parser, "--preset", choices=["default", "paper"], default="default")
    option(parser, "--threads N", default=num_cores())


@command(__file__, __doc__, EPILOG, add_arguments, "0 no false answer, 1 some")
def main(arguments: argparse.Namespace) -> int:
    """Localize every trial, write its line, print the table."""
    counts: dict[str, list[tuple[str, bool]]] = {}
    with arguments.out.open("w") as file:
        for scene, trial, result in results_of(arguments):
            pose, names = trial.true_pose, ("R_cam_from_world", "center_world")
            ok = pose is not None and is_correct(result.pose, pose)
            counts.setdefault(trial.case, []).append((result.status, ok))
            truth = pose and {name: getattr(pose, name).tolist() for name in names}
            line = {"case": trial.case, "scene": scene, "truth": truth}
            file.write(json.dumps(line | {"result": json.loads(result.to_json())}) + "\n")
            file.flush()
            print_note(arguments, f"{scene}: {trial.case}: {result.status}, {'right' if ok else 'wrong'}")
    return 1 if print_table(counts) else 0


if __name__ == "__main__":
    raise SystemExit(main())
