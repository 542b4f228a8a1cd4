"""Turn a coloured scan so that z is up: find up from its planes, write the cloud and the 4 x 4 transform."""

import argparse
import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from ..cloud import CloudStream, open_cloud
from ..cloud.ply_writer import write_transformed
from ..confidence.confidence import check_confidence
from ..errors import InputError
from ..gravity import MIN_CONFIDENCE
from ..gravity.alignment import Alignment, AlignmentReport, find_alignment, read_alignment
from ..gravity.up import Z_UP_LOG_ODDS
from ..panorama import read_panorama
from ..runtime.atomic import is_stream, write_atomically
from ..runtime.threads import Workers, num_cores
from ..scenes.scene import QUERIES_NAME, Query, read_scene, write_queries
from .command import command, option, print_warnings
from .errors import checking_options, print_error
from .options import add_cloud_options, cloud_settings_from
from .outputs import check_outputs, check_suffix, print_report
from .progress import progress_bar
from .up_by_photo import settle_by_photo

EXIT_ALIGNED, EXIT_UNCERTAIN = 0, 1
Outputs = tuple[list[Path], tuple[Query, ...]]  # files of the transform, JSON and text; poses to be turned
EPILOG = f"""\
examples:
  python tools/align_gravity.py --cloud scan.e57 --out aligned.ply --yaw-walls
  python tools/align_gravity.py --cloud scan.e57 --out aligned.ply --assume-nothing --pano photo.jpg
  python tools/align_gravity.py --cloud room/cloud.ply --queries room/queries.json --out aligned/cloud.ply
  python tools/align_gravity.py --cloud aligned.ply --apply aligned.json --inverse --out as_scanned.ply

Writes the cloud as binary PLY in the unit of the scan, and beside it the transform: aligned.json, and
aligned.txt with four rows of four numbers, as CloudCompare reads them (docs/CONVENTIONS.md). One PLY file
keeps its other properties and faces, its normals are turned; all else becomes x y z and red green blue.
One JSON object on stdout: status, up, yaw, planes, transform. Without --out nothing else is written.
Nothing is written either where the confidence is below --min-confidence (default {MIN_CONFIDENCE}).
A z that is square to the scan's levels is up by convention. A scan that was turned needs --assume-nothing, by
which a room without furniture may be upside down, and roofs and fronts mislead: --pano tells, and the poses
of scanners in E57 and PTX files do. If you know the axis, give it by --up. The explanation has the log-odds
cue by cue (docs/CONVENTIONS.md), "hypotheses" those of each direction.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """All options."""
    add_cloud_options(parser, "coloured scan, as for localize.py")
    group = parser.add_argument_group("files")
    option(group, "--out FILE", "the turned cloud, a PLY file; - is stdout")
    text = "a .json (default --out's name, where it has one), and a .txt written beside it"
    option(group, "--transform FILE", text)
    option(group, "--queries FILE", "true poses in the scan, to be turned with it and written beside --out")
    option(group, "--transform-only", "write no file, only the report on stdout")
    group = parser.add_argument_group("method")
    option(group, "--yaw-walls", "also turn about z, least, so that the dominant walls are along x and y")
    assumption = group.add_mutually_exclusive_group()
    text = "the file's z is up unless the evidence against it is a thousand to one (default)"
    option(assumption, "--assume-z-up", text)
    option(assumption, "--assume-nothing", "the scan may lie in any way: its own evidence alone decides")
    text = "upright photo taken in the scan: localized under one up and no other, it decides"
    option(group, "--pano FILE", text)
    option(group, "--min-confidence X", f"write nothing below this confidence (default {MIN_CONFIDENCE})")
    option(group, "--apply FILE", "apply this transform instead of finding one")
    option(group, "--inverse", "apply the inverse of --apply")


def check_search(arguments: argparse.Namespace) -> None:
    """Refuse options of the search for up where it does not take place."""
    assuming = {"--assume-z-up": arguments.assume_z_up, "--assume-nothing": arguments.assume_nothing,
                "--pano": arguments.pano is not None}  # fmt: skip
    searching = {"--yaw-walls": arguments.yaw_walls, "--min-confidence": arguments.min_confidence is not None,
                 "--up": arguments.up != "auto", "--transform-only": arguments.transform_only}  # fmt: skip
    wrong = [name for name, is_given in (searching | assuming).items() if is_given]
    if arguments.apply and wrong:
        raise InputError(f"{wrong[0]} can't be combined with --apply, which searches for nothing")
    if arguments.up != "auto" and any(assuming.values()):
        raise InputError(f"{wrong[-1]} can't be combined with --up {arguments.up}, which is taken as it is")


def check_arguments(arguments: argparse.Namespace) -> None:
    """Refuse options that do not go together, and values that no file could make right."""
    cloud_settings_from(arguments)
    if arguments.min_confidence is not None:
        check_confidence(arguments.min_confidence)
    if arguments.inverse and not arguments.apply:
        raise InputError("--inverse needs --apply")
    check_search(arguments)
    for name in ("apply", "queries"):
        if getattr(arguments, name) and not arguments.out:
            raise InputError(f"--{name} needs --out")
    check_suffix("--out", arguments.out, (".ply",))
    if arguments.transform and arguments.transform.suffix != ".json":
        raise InputError(f"--transform {arguments.transform}: wanted a name that ends with .json")
    if arguments.queries and is_stream(arguments.out):
        raise InputError(f"--queries: nothing can be written beside --out {arguments.out}, wanted a file")


def outputs_of(arguments: argparse.Namespace) -> Outputs:
    """What is to be written beside the cloud; refused if it can't be."""
    path = arguments.transform
    if arguments.out and not arguments.apply and not is_stream(arguments.out):
        path = path or arguments.out.with_suffix(".json")
    text = path and path.with_suffix(".txt")
    queries = arguments.out.with_name(QUERIES_NAME) if arguments.queries else None
    outputs = {"--out": arguments.out, "--transform": path, "its .txt": text, "the poses": queries}
    inputs = [*arguments.cloud, *filter(None, (arguments.apply, arguments.queries, arguments.pano))]
    inputs += [arguments.queries / QUERIES_NAME] if arguments.queries else []
    check_outputs(outputs, inputs)
    transforms = [path, text] if path and text else []
    return transforms, read_scene(arguments.queries).queries if arguments.queries else ()


def write(args: argparse.Namespace, outputs: Outputs, cloud: CloudStream, alignment: Alignment) -> None:
    """Write the cloud and what goes with it, the cloud's name last."""
    (transforms, queries), out = outputs, args.out

    def write_others() -> None:
        for path, text in zip(transforms, (alignment.to_json(), alignment.to_text()), strict=False):
            write_atomically(path, text.encode())
        if out and queries:
            move = alignment.in_unit(1.0).transform_pose
            moved = [replace(query, pose=move(query.pose)) for query in queries]
            write_queries(out.parent, moved, cloud=out.name)

    if out is None:
        write_others()
    else:
        print_warnings(args, write_transformed(cloud, alignment.T_aligned_from_scan, out, write_others))


def report_of(arguments: argparse.Namespace, status: str, alignment: Alignment) -> dict[str, object]:
    """The part of the JSON report that finding and applying have in common."""
    return {
        "status": status,
        "cloud": [str(path) for path in arguments.cloud],
        "out": str(arguments.out) if arguments.out and status != "uncertain" else None,
        **alignment.numbers(),
    }


def evidence_of(report: AlignmentReport) -> dict[str, object]:
    """The evidence for the JSON report: up, yaw and planes in the scan's frame and unit."""
    x, y, z = report.up_scan
    scale = report.alignment.metres_per_unit
    rms_angle = report.plane_rms_angle
    planes = []
    for normal, offset, num_inliers, fraction, rms, kind in report.planes:
        place = {"kind": kind, "normal_scan": normal.tolist(), "offset": offset / scale}
        planes.append({**place, "num_inliers": num_inliers, "fraction": fraction, "rms": rms / scale})
    return {
        "up_scan": report.up_scan.tolist(),
        "tilt_deg": float(np.degrees(np.arctan2(np.hypot(x, y), z))),
        "plane_rms_angle_deg": None if rms_angle is None else float(np.degrees(rms_angle)),
        "yaw_deg": None if report.yaw is None else float(np.degrees(report.yaw)),
        "planes": planes,
        "hypotheses": [
            {"up_scan": up.tolist(), "probability": probability, "evidence": evidence}
            for up, probability, evidence in report.hypotheses
        ],
    }


def align(arguments: argparse.Namespace) -> int:
    """Find the alignment, write what is sure enough; returns the exit code."""
    outputs = outputs_of(arguments)
    if arguments.pano:
        read_panorama(arguments.pano)  # refused before the cloud is read
    show = progress_bar(arguments.quiet)
    cloud = open_cloud(arguments.cloud, cloud_settings_from(arguments), show)
    settle = None
    if arguments.pano:
        workers = Workers(num_cores(), show)
        settle = partial(settle_by_photo, cloud=cloud, pano=arguments.pano, workers=workers)
    log_odds = 0.0 if arguments.assume_nothing else Z_UP_LOG_ODDS
    found, warnings = find_alignment(cloud, arguments.up, arguments.yaw_walls, log_odds, settle)
    print_warnings(arguments, warnings)
    alignment = found.alignment
    least = MIN_CONFIDENCE if arguments.min_confidence is None else arguments.min_confidence
    doubt = ""
    if alignment.confidence < least:
        doubt = f"confidence {alignment.confidence:.2f} is below {least:g}: {alignment.explanation}"
    elif arguments.yaw_walls and found.yaw is None:
        doubt = "--yaw-walls: no wall is among the dominant planes"
    if not doubt:
        write(arguments, outputs, cloud, alignment)
    report = report_of(arguments, "uncertain" if doubt else "aligned", alignment)
    text = json.dumps({**report, **evidence_of(found)}, allow_nan=False)
    print_report(arguments, {"--out": arguments.out}, text)
    return print_error(arguments, doubt, EXIT_UNCERTAIN) if doubt else EXIT_ALIGNED


def apply(arguments: argparse.Namespace) -> int:
    """Apply the transform of a file to the cloud; returns the exit code."""
    outputs = outputs_of(arguments)
    given = read_alignment(arguments.apply)
    settings = cloud_settings_from(arguments)
    if arguments.units is None and arguments.scale is None:
        settings = replace(settings, scale=given.metres_per_unit)
    alignment = (given.inverse() if arguments.inverse else given).in_unit(settings.scale)
    cloud = open_cloud(arguments.cloud, settings, progress_bar(arguments.quiet))
    for _ in cloud.chunks([]):  # for its box
        pass
    write(arguments, outputs, cloud, alignment)
    text = json.dumps(report_of(arguments, "applied", alignment), allow_nan=False)
    print_report(arguments, {"--out": arguments.out}, text)
    return EXIT_ALIGNED


@command(__file__, __doc__, EPILOG, add_arguments, "0 done, 1 not sure enough")
def main(arguments: argparse.Namespace) -> int:
    """Find an alignment or apply one; returns the exit code."""
    if arguments.transform_only:
        arguments.out = arguments.transform = arguments.queries = None
    with checking_options():
        check_arguments(arguments)
    return apply(arguments) if arguments.apply else align(arguments)
