"""Turn a coloured scan so that z is up: find up, write the cloud and the 4 x 4 transform."""

import argparse
import json
from dataclasses import replace

import numpy as np

from ..cloud import CloudStream, open_cloud
from ..cloud.ply_writer import write_transformed
from ..cloud.settings import CloudSettings
from ..confidence.confidence import LOCALIZED
from ..errors import InputError
from ..files.atomic import is_stream, write_atomically
from ..geometry.pose import Array, move, rotation_to_z
from ..gravity.alignment import find_alignment
from ..jobs.threads import Workers, num_cores
from ..localization.settings import CoarseToFineSettings
from ..panorama import read_panorama
from ..scan import Scan
from ..scan_map.scan_map import prepare_map
from ..scenes.scene import QUERIES_NAME, read_scene, write_queries
from .command import command, option, print_warnings
from .errors import checking_options, print_error
from .options import add_cloud_options, cloud_settings_from
from .outputs import check_outputs, check_suffix, print_report
from .progress import progress_bar
from .transform_file import read_transform

EXIT_UNKNOWN = 1
Found = tuple[Array, dict[str, object], str]
EPILOG = """\
examples:
  python tools/align_gravity.py --cloud scan.ply --out aligned.ply --assume-nothing --pano photo.jpg
  python tools/align_gravity.py --cloud room/cloud.ply --queries room/queries.json --out aligned/cloud.ply
  python tools/align_gravity.py --cloud aligned.ply --apply aligned.txt --inverse --out as_scanned.ply

Planes find the vertical. Which end of it is up says the axis of the file (z, in glTF y) or --up, from which
it may be 15 degrees off. Of a scan that may lie in any way, --assume-nothing finds up where furniture and
free ways make it plain, and --pano by a photo. Where up isn't known nothing is written. Else the cloud is
written as binary PLY in the unit of the scan, and beside it the transform: aligned.txt, four rows of four
numbers, as CloudCompare reads them (docs/CONVENTIONS.md). One PLY file keeps its other properties and faces.
One JSON object on stdout; without --out nothing else is written.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """All options."""
    add_cloud_options(parser, "coloured scan, as for localize.py")
    option(parser, "--out FILE", "the turned cloud, a PLY file; - is stdout")
    option(parser, "--queries FILE", "true poses in the scan, to be turned with it and written beside --out")
    option(parser, "--yaw-walls", "also turn about z, least, so that the dominant walls are along x and y")
    option(parser, "--assume-nothing", "the scan may lie in any way: its own evidence alone decides")
    option(parser, "--pano FILE", "upright photo taken in the scan, which is localized: its up decides")
    option(parser, "--apply FILE", "apply this transform, four rows of four numbers, instead of finding one")
    option(parser, "--inverse", "apply the inverse of --apply")


def check_arguments(a: argparse.Namespace) -> None:
    """Refuse options that do not go together."""
    is_told = a.apply or a.up != "auto"
    refusals = {
        "--apply needs --out": a.apply and not a.out,
        "--queries needs --out": a.queries and not a.out,
        "--inverse needs --apply": a.inverse and not a.apply,
        "--yaw-walls can't be combined with --apply": a.apply and a.yaw_walls,
        "--up can't be combined with --apply": a.apply and a.up != "auto",
        "--assume-nothing can't be combined with --apply or --up": is_told and a.assume_nothing,
        "--pano can't be combined with --apply or --up": is_told and a.pano,
        f"--queries: nothing can be written beside --out {a.out}": a.queries and a.out and is_stream(a.out),
    }
    for text in (text for text, is_wrong in refusals.items() if is_wrong):
        raise InputError(text)
    check_suffix("--out", a.out, (".ply",))


def given(arguments: argparse.Namespace, cloud: CloudStream) -> Found:
    """The transform of --apply, as `find` returns it; the cloud is read for its box."""
    T = read_transform(arguments.apply, "T_aligned_from_scan")
    for _ in cloud.chunks([]):
        pass
    return np.asarray(np.linalg.inv(T)) if arguments.inverse else T, {"status": "applied"}, ""


def find(arguments: argparse.Namespace, cloud: CloudStream) -> Found:
    """The transform (4, 4) in the scan's unit; what is known of it; why it can't be relied on, if so."""

    def up_by_photo(axis: Array) -> tuple[Array | None, str]:
        workers = Workers(num_cores(), cloud.show)
        scan_map = prepare_map(cloud, workers, rotation_to_z(axis))
        settings = CoarseToFineSettings(gravity="unknown")
        result = Scan(scan_map, cloud.label, CloudSettings(), settings, workers, {}).localize(arguments.pano)
        up = result.pose.R_cam_from_world[2] if result.pose and result.status == LOCALIZED else None
        return up, f"{arguments.pano} is {result.status}"

    up = None if arguments.assume_nothing else arguments.up
    found = find_alignment(cloud, up, up_by_photo if arguments.pano else None, arguments.yaw_walls)
    print_warnings(arguments, found.warnings)
    T = found.T_aligned_from_scan
    is_known = found.up_scan is not None
    doubt = "" if is_known else f"up is not known: {found.reason}"
    if arguments.yaw_walls and found.yaw is None:
        doubt = doubt or "--yaw-walls: no wall is among the dominant planes"
    report = {
        "status": "uncertain" if doubt else "aligned",
        "explanation": found.reason,
        "up_scan": T[2, :3].tolist() if is_known else None,
        "tilt_deg": float(np.degrees(np.arccos(min(T[2, 2], 1.0)))) if is_known else None,
        "yaw_deg": None if found.yaw is None else float(np.degrees(found.yaw)),
    }
    T[:3, 3] /= cloud.scale
    return T, report, doubt


@command(__file__, __doc__, EPILOG, add_arguments, "0 done, 1 up is not known")
def main(arguments: argparse.Namespace) -> int:
    """Find a transform or take the one given, write what is sure; returns the exit code."""
    with checking_options():
        check_arguments(arguments)
        settings = cloud_settings_from(arguments)
    out = arguments.out
    queries = read_scene(arguments.queries).queries if arguments.queries else ()
    transform = out.with_suffix(".txt") if out and not arguments.apply and not is_stream(out) else None
    poses = out.with_name(QUERIES_NAME) if queries else None
    outputs = {"--out": out, "its .txt": transform, "the poses": poses}
    inputs = [path for path in (arguments.apply, arguments.pano, arguments.queries) if path]
    check_outputs(outputs, [*arguments.cloud, *inputs, *(path / QUERIES_NAME for path in inputs)])
    if arguments.pano:
        read_panorama(arguments.pano)  # refused before the cloud is read
    cloud = open_cloud(arguments.cloud, settings, progress_bar(arguments.quiet))
    T, report, doubt = (given if arguments.apply else find)(arguments, cloud)

    def write_others() -> None:
        if transform:
            lines = (" ".join(map(repr, row)) + "\n" for row in T.tolist())
            write_atomically(transform, "".join(lines).encode())
        if queries:
            moved = [replace(query, pose=move(query.pose, T, cloud.scale)) for query in queries]
            write_queries(out.parent, moved, cloud=out.name)

    if out and not doubt:
        print_warnings(arguments, write_transformed(cloud, T, out, write_others))
    report |= {"cloud": list(map(str, arguments.cloud)), "out": str(out) if out and not doubt else None}
    report |= {"T_aligned_from_scan": T.tolist(), "metres_per_unit": cloud.scale}
    print_report(arguments, outputs, json.dumps(report, allow_nan=False))
    return print_error(arguments, doubt, EXIT_UNKNOWN) if doubt else 0
