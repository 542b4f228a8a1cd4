#!/usr/bin/env python3
"""Try the search for up on clouds turned at random: how far off its answers are, and how sure they were."""

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import _checkout  # noqa: F401
import numpy as np
from numpy.typing import NDArray

from piccolo.cli.errors import guarded
from piccolo.cli.progress import shown
from piccolo.cloud import CloudStream, open_cloud, stream_of
from piccolo.cloud.octree import build_octree
from piccolo.cloud.readers.reader import RawCloud
from piccolo.confidence.confidence import check_confidence
from piccolo.errors import InputError
from piccolo.geometry.pose import Array
from piccolo.geometry.rotations import random_rotation
from piccolo.gravity import MIN_CONFIDENCE
from piccolo.gravity.alignment import find_alignment
from piccolo.runtime.threads import Workers, num_cores
from piccolo.scenes.synthetic.buildings import BUILDINGS, make_building

RIGHT, ROUGH = 0.5, 5.0  # [deg]
THINNED = 0.04  # spacing of a scene's points, which the search thins further [m]
EPILOG = """\
examples:
  python tools/evaluate_gravity.py
  python tools/evaluate_gravity.py --seeds 900 910 --kinds room --turns 50
  python tools/evaluate_gravity.py --scenes BENCH/house BENCH/hospital --turns 250

Each cloud is turned by --turns seeded rotations, uniform over all, and aligned as by align_gravity.py.
Seeds make places of each kind; scenes are folders with a cloud.ply whose z is up, thinned to 4 cm once, but
for the first --full turns. A Markdown table on stdout: right is within 0.5 degrees, rough within 5; accepted
is a confidence of --min-confidence or more.
exit codes: 0 no wrong answer was accepted, 1 some were, 2 wrong usage, 3 bad input, 130 interrupted.
"""


@dataclass(frozen=True)
class Answer:
    """How one trial ended."""

    error_deg: float  # between the up found and the true one
    confidence: float


@dataclass(frozen=True)
class Case:
    """A cloud with z up, to be turned."""

    name: str
    points: NDArray[np.floating[Any]]  # (N, 3) [m]
    rotations: list[Array]  # (3, 3) each


def rotations_of(seed: int, count: int) -> list[Array]:
    """Rotations (3, 3) uniform over SO(3)."""
    rng = np.random.default_rng([seed, 70])
    return [random_rotation(rng) for _ in range(count)]


def rotated_cloud(points: NDArray[np.floating[Any]], R: Array) -> CloudStream:
    """Points (N, 3) [m] rotated by R (3, 3), as a file of them would be read."""
    rotated = np.einsum("ij,nj->ni", R, points.astype(np.float64))
    return stream_of(Path("trial"), RawCloud(rotated, np.full(rotated.shape, 128, np.uint8)))


def cases_of(arguments: argparse.Namespace) -> Iterator[Case]:
    """Every cloud with its turns."""
    for kind in arguments.kinds:
        for seed in range(*arguments.seeds):
            yield Case(kind, make_building(kind, seed), rotations_of(seed, arguments.turns))
    for number, folder in enumerate(arguments.scenes):
        rotations = rotations_of(number, arguments.turns)
        cloud = open_cloud([folder / "cloud.ply"])
        full = np.concatenate([points for points, _ in cloud.chunks([])])
        yield Case(f"{folder.name}, whole", full, rotations[: arguments.full])
        thinned = build_octree(cloud.voxels(np.eye(3))).level(THINNED)[:, :3]
        yield Case(folder.name, thinned, rotations[arguments.full :])


def try_turn(points: NDArray[np.floating[Any]], R: Array) -> Answer:
    """Turn the cloud by R (3, 3) and look for up."""
    report, _ = find_alignment(rotated_cloud(points, R), "auto", along_walls=False)
    up, true_up = report.up_scan, R[:, 2]
    sine = float(np.linalg.norm(np.cross(up, true_up)))
    return Answer(float(np.degrees(np.arctan2(sine, up @ true_up))), report.alignment.confidence)


def run(arguments: argparse.Namespace) -> dict[str, list[Answer]]:
    """All answers, case by case."""
    workers = Workers(arguments.threads, shown(arguments.quiet))
    answers: dict[str, list[Answer]] = {}
    for case in cases_of(arguments):
        found = workers.each(partial(try_turn, case.points), case.rotations, case.name)
        answers.setdefault(case.name, []).extend(found)
    return answers


def print_table(answers: dict[str, list[Answer]], min_confidence: float) -> int:
    """One line a case; returns how many wrong answers were accepted."""
    print("| case | trials | right | rough | wrong | accepted | of these wrong | surest wrong |")
    print("|---|---:|---:|---:|---:|---:|---:|---:|")
    total = 0
    for name, rows in answers.items():
        errors = np.array([row.error_deg for row in rows])
        confidences = np.array([row.confidence for row in rows])
        is_wrong, is_accepted = errors > ROUGH, confidences >= min_confidence
        false = int(np.count_nonzero(is_wrong & is_accepted))
        cells = [
            len(rows),
            np.count_nonzero(errors <= RIGHT),
            np.count_nonzero((errors > RIGHT) & ~is_wrong),
            np.count_nonzero(is_wrong),
            np.count_nonzero(is_accepted),
            false,
            f"{confidences[is_wrong].max():.2f}" if is_wrong.any() else "",
        ]
        print(f"| {name} | {' | '.join(map(str, cells))} |")
        total += false
    return total


def check_arguments(arguments: argparse.Namespace) -> None:
    """Refuse values that no cloud could make right."""
    check_confidence(arguments.min_confidence)
    if min(arguments.seeds) < 0 or min(arguments.turns, arguments.threads) < 1 or arguments.full < 0:
        raise InputError("--seeds and --full must be 0 or more, --turns and --threads at least 1")


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    text = "of the made-up places (default 1100 1120, none where --scenes are given)"
    parser.add_argument("--seeds", type=int, nargs=2, metavar=("FIRST", "END"), help=text)
    parser.add_argument(
        "--kinds", nargs="+", choices=BUILDINGS, default=list(BUILDINGS), help="(default all)"
    )
    parser.add_argument("--scenes", type=Path, nargs="*", default=[], metavar="FOLDER")
    parser.add_argument("--turns", type=int, default=1, metavar="N", help="of each cloud (default 1)")
    parser.add_argument("--full", type=int, default=3, metavar="N", help="turns of whole scenes (default 3)")
    parser.add_argument("--min-confidence", type=float, default=MIN_CONFIDENCE, metavar="X")
    parser.add_argument("--threads", type=int, default=num_cores(), metavar="N")
    parser.add_argument("--quiet", action="store_true", help="nothing on stderr but errors")
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    arguments = parser.parse_args(argv)
    arguments.seeds = arguments.seeds or ([0, 0] if arguments.scenes else [1100, 1120])
    return guarded(
        "evaluate_gravity.py",
        arguments.debug,
        lambda: int(print_table(run(arguments), arguments.min_confidence) > 0),
        lambda: check_arguments(arguments),
    )


if __name__ == "__main__":
    sys.exit(main())
