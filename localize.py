#!/usr/bin/env python3
"""Command line: a coloured scan and 360-degree photos in, camera poses out."""

import argparse
import os
import sys
import traceback
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from piccolo import __version__
from piccolo.cloud import read_cloud
from piccolo.cloud.model import Cloud
from piccolo.errors import InputError
from piccolo.files import check_output, write_atomically
from piccolo.jit import KERNEL_FOLDER, is_first_use
from piccolo.overlay import overlay_png
from piccolo.panorama import read_panorama
from piccolo.paper.method import PaperMap, localize, prepare
from piccolo.pose import Pose
from piccolo.result import LOCALIZED, Result
from piccolo.settings import PaperSettings
from piccolo.stopwatch import Stopwatch
from piccolo.threads import Workers, num_cores
from piccolo.verify import INLIER_RESIDUAL

EXIT_ALL_LOCALIZED, EXIT_SOME_NOT, EXIT_BAD_USAGE, EXIT_BAD_INPUT, EXIT_INTERNAL = range(5)
EXIT_INTERRUPTED = 130
EXIT_BROKEN_PIPE = 141

DESCRIPTION = "Find where in a coloured point cloud 360-degree panoramas were taken."
EPILOG = """\
examples:
  python localize.py --cloud scan.ply --pano query.jpg
  python localize.py --cloud scan.ply --pano query.jpg --out pose.json --overlay overlay.png
  python localize.py --cloud scan.ply --pano photos/*.jpg --out poses.jsonl
  python localize.py --cloud scan.ply --pano query.jpg --gravity unknown --solver lbfgs

output: one JSON object a panorama, one a line, in the order given; messages and progress go to stderr.
exit codes: 0 all localized, 1 some not, 2 wrong usage, 3 bad input, 4 internal error, 130 interrupted.
"""


def build_parser() -> argparse.ArgumentParser:
    """All options, with their defaults from the settings."""
    parser = argparse.ArgumentParser(
        "localize.py",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"piccolo {__version__}")
    files = parser.add_argument_group("files")
    files.add_argument("--cloud", type=Path, required=True, help="coloured scan: PLY, or text x y z r g b")
    files.add_argument("--pano", type=Path, required=True, nargs="+", help="full sphere JPEG or PNG, W = 2 H")
    files.add_argument("--out", type=Path, help="write the JSON here, not to stdout")
    files.add_argument("--overlay", type=Path, help="PNG: panorama, cloud at the pose, checkerboard of both")
    files.add_argument("--scale", type=float, default=1.0, help="metres per unit of the cloud (default 1)")
    add_method_options(parser)
    run = parser.add_argument_group("run")
    run.add_argument("--threads", type=int, default=num_cores(), metavar="N", help="(default all cores)")
    run.add_argument("--quiet", action="store_true", help="nothing on stderr but errors")
    run.add_argument("--debug", action="store_true", help="show the traceback of an error")
    return parser


def add_method_options(parser: argparse.ArgumentParser) -> None:
    """The settings of the preset as options, with their defaults."""
    d = PaperSettings()
    group = parser.add_argument_group("method (preset paper: Kim et al., ICCV 2021, Algorithm 1)")
    group.add_argument("--preset", choices=["paper"], default="paper", help="(default paper)")
    text = "known: camera upright and the cloud's z up; unknown: any rotation (default known)"
    group.add_argument("--gravity", choices=["known", "unknown"], default=d.gravity, help=text)
    group.add_argument("--solver", choices=["adam", "lbfgs"], default=d.solver, help="(default adam)")
    group.add_argument("--no-visibility", action="store_true", help="let the camera see through walls")
    text = "N_r, start rotations (default 8 yaws if gravity is known, 32 of SO(3) if not)"
    group.add_argument("--rotations", type=int, default=d.num_rotations, metavar="N", help=text)
    for option, metavar, default, text in (
        ("--translations", "N", d.num_translations, "N_t, start positions in free space"),
        ("--keep-by-loss", "K1", d.num_by_loss, "poses kept by the loss"),
        ("--keep-by-histogram", "K2", d.num_by_histogram, "poses kept by colour histograms, and refined"),
        ("--iterations", "N", d.num_iterations, "iterations of the solver"),
        ("--histogram-bins", "N", d.histogram_bins, "bins a channel"),
        ("--grid-margin", "SHARE", d.grid_margin, "share of the box left out on each side of the grid"),
        ("--max-points", "N", d.max_points, "points used of a larger cloud"),
    ):
        help_text = f"{text} (default {default})"
        group.add_argument(option, type=type(default), default=default, metavar=metavar, help=help_text)


def settings_from(arguments: argparse.Namespace) -> PaperSettings:
    """The settings that the options ask for."""
    return PaperSettings(
        gravity=arguments.gravity,
        solver=arguments.solver,
        num_translations=arguments.translations,
        num_rotations=arguments.rotations,
        num_by_loss=arguments.keep_by_loss,
        num_by_histogram=arguments.keep_by_histogram,
        num_iterations=arguments.iterations,
        histogram_bins=arguments.histogram_bins,
        grid_margin=arguments.grid_margin,
        max_points=arguments.max_points,
        use_visibility=not arguments.no_visibility,
    )


def check_arguments(arguments: argparse.Namespace) -> None:
    """Refuse values that no file could make right."""
    if arguments.threads < 1:
        raise InputError(f"--threads: found {arguments.threads}, wanted at least 1")
    if not 0.0 < arguments.scale < 1e6:
        raise InputError(f"--scale: found {arguments.scale}, wanted metres per unit, above 0")
    if arguments.overlay and len(arguments.pano) > 1:
        raise InputError(f"--overlay: found {len(arguments.pano)} panoramas, wanted one")


@dataclass(frozen=True)
class Session:
    """One prepared cloud and how to treat the panoramas."""

    arguments: argparse.Namespace
    settings: PaperSettings
    cloud: Cloud
    paper_map: PaperMap
    seconds: dict[str, float]  # spent once, on the cloud

    def say(self, text: str) -> None:
        """A line for the user, on stderr."""
        if not self.arguments.quiet:
            tqdm.write(text, file=sys.stderr)

    def show(self, values: Iterator[Any], total: int, label: str) -> Iterator[Any]:
        """The values under a progress bar that vanishes when they end."""
        bar = tqdm(
            values, label, total, leave=False, disable=self.arguments.quiet, file=sys.stderr, delay=0.5
        )
        return iter(bar)

    def localize(self, pano: Path) -> Result:
        """Read one panorama, localize it, write its overlay if one is asked for."""
        watch = Stopwatch(dict(self.seconds))
        with watch.stage("read"):
            panorama = read_panorama(pano)
        workers = Workers(self.arguments.threads, self.show)
        found = localize(self.paper_map, panorama, self.settings, workers, watch)
        if self.arguments.overlay and found.pose is not None:
            local = Pose(found.pose.R_cam_from_world, found.pose.center_world - self.cloud.origin_world)
            png = overlay_png(self.paper_map.points, panorama, local)
            write_atomically(self.arguments.overlay, png)
        evidence = found.evidence
        return Result(
            status=found.status,
            cloud=str(self.arguments.cloud),
            pano=str(pano),
            pose=found.pose,
            loss=found.loss,
            score=evidence.score if evidence else None,
            margin=found.margin,
            inlier_share=evidence.inlier_share if evidence else None,
            inlier_residual=INLIER_RESIDUAL,
            seconds=watch.seconds,
            settings={"preset": self.arguments.preset, **self.settings.to_json()},
            warnings=self.cloud.warnings,
        )


def open_session(arguments: argparse.Namespace, settings: PaperSettings) -> Session:
    """Read and prepare the cloud, after a look at what is to be written."""
    for output in filter(None, (arguments.out, arguments.overlay)):
        check_output(output, [arguments.cloud, *arguments.pano])
    if is_first_use() and not arguments.quiet:
        text = f"first use: compiling kernels, once (under half a minute), into {KERNEL_FOLDER}"
        print(text, file=sys.stderr, flush=True)
    watch = Stopwatch()
    with watch.stage("read"):
        cloud = read_cloud(arguments.cloud, arguments.scale)
    with watch.stage("prepare"):
        paper_map = prepare(cloud, settings)
    session = Session(arguments, settings, cloud, paper_map, watch.seconds)
    for warning in cloud.warnings:
        session.say(f"warning: {warning}")
    return session


def summary(result: Result) -> str:
    """Two lines for a person."""
    if result.pose is None:
        return f"{result.pano}: {result.status}\n  no start in free space, or nothing of the panorama counts"
    x, y, z = result.pose.center_world
    total = sum(result.seconds.values())
    return (
        f"{result.pano}: {result.status} at ({x:.3f}, {y:.3f}, {z:.3f}) m in {total:.1f} s\n"
        f"  score {result.score:.2f}, margin {result.margin:.2f}, loss {result.loss:.3f}, "
        f"{100.0 * (result.inlier_share or 0.0):.0f} % of the seen directions agree"
    )


def results_of(session: Session) -> Iterator[Result | None]:
    """The result of each panorama in order; None for one that can't be read, after saying why."""
    arguments = session.arguments
    hidden = arguments.quiet or len(arguments.pano) == 1
    for pano in tqdm(arguments.pano, desc="panoramas", unit="", disable=hidden, file=sys.stderr):
        try:
            result = session.localize(pano)
        except (OSError, InputError) as error:
            complain(arguments, error)
            yield None
            continue
        session.say(summary(result))
        yield result


def run(arguments: argparse.Namespace, settings: PaperSettings) -> int:
    """Localize every panorama, write the results, return the exit code."""
    lines: list[str] = []
    is_bad = some_not = False
    for result in results_of(open_session(arguments, settings)):
        is_bad |= result is None
        if result is None:
            continue
        some_not |= result.status != LOCALIZED
        if arguments.out:
            lines.append(result.to_json() + "\n")
        else:
            print(result.to_json(), flush=True)
    if arguments.out and lines:
        write_atomically(arguments.out, "".join(lines).encode())
    if is_bad:
        return EXIT_BAD_INPUT
    return EXIT_SOME_NOT if some_not else EXIT_ALL_LOCALIZED


def complain(arguments: argparse.Namespace, error: BaseException, text: str = "") -> None:
    """One line about an error on stderr, its own words if `text` is empty, and its traceback if --debug."""
    if arguments.debug:
        traceback.print_exception(error)
    tqdm.write(f"localize.py: {text or error}", file=sys.stderr)


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    arguments = build_parser().parse_args(argv)
    try:
        check_arguments(arguments)
        settings = settings_from(arguments)
    except InputError as error:
        complain(arguments, error)
        return EXIT_BAD_USAGE
    try:
        return run(arguments, settings)
    except (
        BrokenPipeError
    ):  # the reader of stdout has gone: say nothing, not even when Python flushes at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_BROKEN_PIPE
    except (OSError, InputError) as error:
        complain(arguments, error)
        return EXIT_BAD_INPUT
    except KeyboardInterrupt as error:
        complain(arguments, error, "interrupted")
        return EXIT_INTERRUPTED
    except Exception as error:  # the last line of defence: a code and one line for the shell, no traceback
        complain(arguments, error, f"internal error: {error!r}; --debug shows where")
        return EXIT_INTERNAL


if __name__ == "__main__":
    sys.exit(main())
