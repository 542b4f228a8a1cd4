#!/usr/bin/env python3
"""Compare results of localize.py with true poses: a table of errors, and what share is correct."""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from piccolo.errors import InputError
from piccolo.files import write_atomically
from piccolo.result import Result
from piccolo.truth import Query, pose_errors, read_truth
from piccolo.verdict import LOCALIZED

EPILOG = """\
example:
  python localize.py --cloud scene/cloud.ply --pano scene/images/*.jpg --out poses.jsonl
  python tools/evaluate.py --truth scene/queries.json --results poses.jsonl

queries.json: {"queries": [{"image", "variant", "R_cam_from_world", "center_world"}]}; a panorama
belongs to the query whose image has the same file name. The table is Markdown, on stdout.
exit codes: 0 done, 2 wrong usage, 3 bad input.
"""


LINES = (0.999, 0.99, 0.95, 0.9, 0.7, 0.5, 0.2, 0.0)


@dataclass(frozen=True)
class Row:
    """One result against the truth."""

    image: str
    variant: str
    result: Result
    position_error: float  # [m], inf without a pose
    rotation_error: float  # [rad], inf without a pose

    @property
    def seconds(self) -> float:
        """Search and refinement, without reading and preparing."""
        return sum(self.result.seconds.get(stage, 0.0) for stage in ("search", "refine"))

    def is_correct(self, max_distance: float, max_angle_deg: float) -> bool:
        """True if both errors are below the lines."""
        return self.position_error < max_distance and np.degrees(self.rotation_error) < max_angle_deg


@dataclass(frozen=True)
class Point:
    """One point of the curve of risk over coverage."""

    confidence: float  # results from here on are accepted
    coverage: float  # share that is accepted
    risk: float  # share of these that is wrong
    num_wrong: int


def compare(result: Result, truth: dict[str, Query]) -> Row:
    """The errors of one result."""
    name = Path(result.pano).name
    if name not in truth:
        raise InputError(f"{name}: found a result without a true pose, wanted one of {sorted(truth)[:3]} ...")
    query = truth[name]
    if result.pose is None:
        return Row(name, query.variant, result, np.inf, np.inf)
    return Row(name, query.variant, result, *pose_errors(result.pose, query.pose))


def print_rows(rows: Sequence[Row]) -> None:
    """One line a panorama."""
    print("| panorama | status | error [m] | error [deg] | confidence | score | margin | loss | seconds |")
    print("|---|---|---:|---:|---:|---:|---:|---:|---:|")
    for row in rows:
        r = row.result
        e = r.evidence
        numbers = [f"{r.confidence:.3f}", *([f"{e.score:.2f}", f"{e.margin:.2f}"] if e else ["-", "-"])]
        numbers.append(f"{r.loss:.3f}" if r.loss is not None else "-")
        errors = f"{row.position_error:.4f} | {np.degrees(row.rotation_error):.3f}"
        print(f"| {row.image} | {r.status} | {errors} | {' | '.join(numbers)} | {row.seconds:.2f} |")


def print_summary(rows: Sequence[Row], max_distance: float, max_angle_deg: float) -> None:
    """One line a variant, and one for all."""
    print(f"\ncorrect: under {max_distance} m and {max_angle_deg} deg; medians are of the correct ones\n")
    print("| variant | queries | correct | localized | wrong of these | mm | deg | s |")
    print("|---|---:|---:|---:|---:|---:|---:|---:|")
    variants = list(dict.fromkeys(row.variant for row in rows))
    for variant in [*variants, *(["all"] if len(variants) > 1 else [])]:
        some = [row for row in rows if variant in (row.variant, "all")]
        correct = [r for r in some if r.is_correct(max_distance, max_angle_deg)]
        localized = [row for row in some if row.result.status == LOCALIZED]
        wrong = sum(row not in correct for row in localized)
        mm = f"{1000 * np.median([r.position_error for r in correct]):.1f}" if correct else "-"
        deg = f"{np.degrees(np.median([r.rotation_error for r in correct])):.3f}" if correct else "-"
        counts = f"{len(some)} | {len(correct)} | {len(localized)} | {wrong}"
        print(f"| {variant} | {counts} | {mm} | {deg} | {np.median([r.seconds for r in some]):.2f} |")


def risk_and_coverage(rows: Sequence[Row], max_distance: float, max_angle_deg: float) -> list[Point]:
    """What is accepted and what is wrong of it, as the line moves down from one confidence to the next."""
    points: list[Point] = []
    by_confidence = sorted(rows, key=lambda row: -row.result.confidence)
    num_wrong = 0
    for k, row in enumerate(by_confidence, 1):
        num_wrong += not row.is_correct(max_distance, max_angle_deg)
        is_last = k == len(rows) or by_confidence[k].result.confidence < row.result.confidence
        if is_last:
            points.append(Point(row.result.confidence, k / len(rows), num_wrong / k, num_wrong))
    return points


def print_risks(points: Sequence[Point]) -> None:
    """The curve at a few confidences."""
    print("\n| accepted from confidence | accepted | wrong of these | wrong share |")
    print("|---:|---:|---:|---:|")
    for line in LINES:
        inside = [point for point in points if point.confidence >= line]
        if inside:
            last = inside[-1]
            print(f"| {line} | {100 * last.coverage:.1f} % | {last.num_wrong} | {100 * last.risk:.2f} % |")


def risk_png(points: Sequence[Point]) -> bytes:
    """The curve as a picture."""
    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.add_subplot()
    coverage, risk = [100 * p.coverage for p in points], [100 * p.risk for p in points]
    axes.step([0.0, *coverage], [risk[0], *risk], where="pre")
    for line in (0.99, 0.9, 0.5):
        inside = [p for p in points if p.confidence >= line]
        if inside:
            axes.plot(100 * inside[-1].coverage, 100 * inside[-1].risk, "o", label=f"confidence {line}")
    axes.set(
        xlabel="accepted [%]",
        ylabel="wrong of the accepted [%]",
        xlim=(0, 100),
        ylim=(0, max(5.0, 1.1 * max(risk))),
    )
    axes.grid(alpha=0.3)
    if axes.get_legend_handles_labels()[0]:
        axes.legend()
    file = BytesIO()
    figure.savefig(file, format="png", dpi=120)
    return file.getvalue()


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--truth", type=Path, required=True, help="queries.json with true poses")
    parser.add_argument("--results", type=Path, required=True, help="JSON lines of localize.py")
    parser.add_argument("--max-distance", type=float, default=0.1, metavar="M", help="(default 0.1)")
    parser.add_argument("--max-angle", type=float, default=5.0, metavar="DEG", help="(default 5)")
    text = "picture: share that is wrong against share that is accepted, as the confidence asked for falls"
    parser.add_argument("--risk", type=Path, metavar="PNG", help=text)
    arguments = parser.parse_args(argv)
    try:
        truth = read_truth(arguments.truth)
        lines = arguments.results.read_text().splitlines()
        rows = [compare(Result.from_json(line), truth) for line in lines if line.strip()]
        if not rows:
            raise InputError(f"{arguments.results}: found no result, wanted JSON lines of localize.py")
        limits = arguments.max_distance, arguments.max_angle
        points = risk_and_coverage(rows, *limits)
        if arguments.risk:
            write_atomically(arguments.risk, risk_png(points))
    except (OSError, InputError) as error:
        print(f"evaluate.py: {error}", file=sys.stderr)
        return 3
    print_rows(rows)
    print_summary(rows, *limits)
    print_risks(points)
    return 0


if __name__ == "__main__":
    sys.exit(main())
