#!/usr/bin/env python3
"""Try the search for up on clouds turned at random: how far off its answers are, and how sure they were."""

import argparse
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import _checkout  # noqa: F401
import numpy as np
from numpy.typing import NDArray

from piccolo.cli.command import check_least, command, option
from piccolo.cli.errors import UsageError, checking_options
from piccolo.cli.progress import progress_bar
from piccolo.cloud import CloudStream, open_cloud, stream_of
from piccolo.cloud.octree import build_octree
from piccolo.cloud.readers.reader import RawCloud
from piccolo.confidence.confidence import check_confidence
from piccolo.geometry.pose import Array
from piccolo.geometry.rotations import random_rotation
from piccolo.gravity import MIN_CONFIDENCE
from piccolo.gravity.alignment import find_alignment
from piccolo.gravity.up import Z_UP_LOG_ODDS
from piccolo.runtime.threads import Workers, num_cores
from piccolo.scenes.synthetic.buildings import BUILDINGS

RIGHT, ROUGH = 0.5, 5.0  # [deg]
THINNED = 0.04  # spacing of a scene's points, which the search thins further [m]
EPILOG = """\
example:
  python tools/evaluate_gravity.py --scenes BENCH/house BENCH/hospital --turns 250

Each cloud is turned by --turns seeded rotations, uniform over all, and aligned as by align_gravity.py
--assume-nothing; --as-scanned takes it as it is, and z for up unless the evidence is a thousand to one.
Seeds make places of each kind; scenes are folders with a cloud.ply whose z is up, thinned to 4 cm once, but
for the first --full turns. A Markdown table on stdout: right is within 0.5 degrees, rough within 5; accepted
is a confidence of --min-confidence or more.
"""
Points = NDArray[np.floating[Any]]


def rotations_of(seed: int, count: int) -> list[Array]:
    """Rotations (3, 3) uniform over SO(3)."""
    rng = np.random.default_rng([seed, 70])
    return [random_rotation(rng) for _ in range(count)]


def rotated_cloud(points: Points, R: Array) -> CloudStream:
    """Points (N, 3) [m] rotated by R (3, 3), as a file of them would be read."""
    rotated = np.einsum("ij,nj->ni", R, points.astype(np.float64))
    return stream_of(Path("trial"), RawCloud(rotated, np.full(rotated.shape, 128, np.uint8)))


def cases_of(arguments: argparse.Namespace) -> Iterator[tuple[str, Points, list[Array]]]:
    """Names of clouds with z up, their points (N, 3) [m] and the rotations (3, 3) to turn them by."""
    for kind in arguments.kinds:
        for seed in range(*arguments.seeds):
            yield kind, BUILDINGS[kind](seed), rotations_of(seed, arguments.turns)
    for number, folder in enumerate(arguments.scenes):
        rotations = rotations_of(number, arguments.turns)
        cloud = open_cloud([folder / "cloud.ply"])
        full = np.concatenate([points for points, _ in cloud.chunks([])])
        yield f"{folder.name}, whole", full, rotations[: arguments.full]
        thinned = build_octree(cloud.voxels(np.eye(3))).level(THINNED)[:, :3]
        yield folder.name, thinned, rotations[arguments.full :]


def try_turn(points: Points, R: Array, z_up_log_odds: float) -> tuple[float, float]:
    """Angle [deg] between found and true up of the cloud turned by R (3, 3), and the confidence."""
    cloud = rotated_cloud(points, R)
    report, _ = find_alignment(cloud, "auto", along_walls=False, z_up_log_odds=z_up_log_odds)
    up, true_up = report.up_scan, R[:, 2]
    sine = float(np.linalg.norm(np.cross(up, true_up)))
    return float(np.degrees(np.arctan2(sine, up @ true_up))), report.alignment.confidence


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """All options."""
    text = "of the made-up places (default 1100 1120, none where --scenes are given)"
    option(parser, "--seeds FIRST END", text)
    option(parser, "--kinds", nargs="+", choices=BUILDINGS, default=list(BUILDINGS))
    option(parser, "--scenes FOLDER ...", default=[])
    option(parser, "--turns N", "of each cloud", default=1)
    option(parser, "--as-scanned", "no turns, and z is up by convention")
    option(parser, "--full N", "turns of whole scenes", default=3)
    option(parser, "--min-confidence X", default=MIN_CONFIDENCE)
    option(parser, "--threads N", default=num_cores())


def print_table(answers: dict[str, list[tuple[float, float]]], min_confidence: float) -> int:
    """Angles [deg] and confidences by name as a Markdown table; returns how many wrong ones were accepted."""
    print("| case | trials | right | rough | wrong | accepted | of these wrong | surest wrong |")
    print("|---|---:|---:|---:|---:|---:|---:|---:|")
    num_false = 0
    for name, rows in answers.items():
        errors, confidences = np.array(rows).reshape(-1, 2).T
        is_wrong, is_accepted = errors > ROUGH, confidences >= min_confidence
        is_rough = (errors > RIGHT) & ~is_wrong
        masks = (errors <= RIGHT, is_rough, is_wrong, is_accepted, is_wrong & is_accepted)
        counts = [len(rows), *(int(np.count_nonzero(mask)) for mask in masks)]
        surest = f"{confidences[is_wrong].max():.2f}" if is_wrong.any() else ""
        print(f"| {name} | {' | '.join(map(str, counts))} | {surest} |")
        num_false = counts[-1]  # of all, which come last
    return num_false


@command(__file__, __doc__, EPILOG, add_arguments, "0 no wrong answer was accepted, 1 some were")
def main(arguments: argparse.Namespace) -> int:
    """Try all clouds, print one line for each name; returns the exit code."""
    arguments.seeds = arguments.seeds or ([0, 0] if arguments.scenes else [1100, 1120])
    with checking_options():
        check_confidence(arguments.min_confidence)
    if min(arguments.seeds) < 0:
        raise UsageError(f"--seeds: found {arguments.seeds}, wanted 0 or more")
    check_least(arguments, turns=1, threads=1, full=0)
    workers = Workers(arguments.threads, progress_bar(arguments.quiet))
    answers: dict[str, list[tuple[float, float]]] = {}
    for name, points, rotations in cases_of(arguments):
        attempt = partial(try_turn, points, z_up_log_odds=Z_UP_LOG_ODDS if arguments.as_scanned else 0.0)
        answers.setdefault(name, []).extend(
            workers.map(attempt, [np.eye(3)] if arguments.as_scanned else rotations, name)
        )
    answers["all"] = [row for rows in answers.values() for row in rows]
    num_false = print_table(answers, arguments.min_confidence)
    return int(num_false > 0)


if __name__ == "__main__":
    raise SystemExit(main())
