"""Rotate a coloured scan so that z is up, and write the cloud and the 4 x 4 transform."""

from argparse import ArgumentParser
from pathlib import Path

import numpy as np

from ..api.opening import prepare_scan
from ..api.values import LOCALIZED, CoarseToFineSettings
from ..cli.command import Arguments, check_outputs, check_suffix, checking_options, command, option
from ..cli.options import add_cloud_options
from ..cli.settings_given import cloud_settings_from
from ..cloud.cloud_settings import CloudSettings, R_z_from_axis
from ..cloud.gravity import MAX_LEAN, dot_products, find_up, level, wall_yaw
from ..cloud.octree import build_octree
from ..cloud.stream import CloudStream, open_cloud
from ..cloud.writers import describe_unit, write_transformed
from ..geometry.pose import orthonormal, rotation_to_z, yaw_rotation
from ..photo.panorama import read_panorama
from ..system.arrays import Array
from ..system.files.atomic import is_stream, write_atomically
from ..system.jobs.threads import Stopwatch, Workers, num_cores

EXIT_UNKNOWN = 1
EPILOG = """\
examples:
  python tools/align_gravity.py --cloud scan.ply --out aligned.ply --assume-nothing --pano photo.jpg
  python tools/align_gravity.py --cloud room/cloud.ply --yaw-walls --out aligned/cloud.ply

The dominant planes give the vertical; of its two directions, the one closer to the file's up axis (z, in glTF
y) or to --up is up. The axis may be up to 15 degrees off. If the scan may have any orientation,
--assume-nothing decides by furniture and free space, and --pano by a photo. If up remains unknown, nothing is
written. Otherwise the cloud is written as binary PLY in the unit of the scan (of several, in metres), with
the transform next to it: aligned.txt, four rows of four numbers, as CloudCompare reads them
(docs/CONVENTIONS.md). A single PLY file keeps its other properties and faces. Prints one JSON object to
stdout; without --out, this is all.
"""


def add_arguments(parser: ArgumentParser) -> None:
    """All options."""
    add_cloud_options(parser, "coloured scan as for localize.py")
    option(parser, "--out FILE", "write the rotated cloud to this PLY file; - is stdout")
    text = "also rotate about z, as little as possible, to align the dominant walls with x and y"
    option(parser, "--yaw-walls", text)
    option(parser, "--assume-nothing", "the scan may have any orientation: find up from its contents")
    option(parser, "--pano FILE", "localize this upright photo in the scan, and take its up direction")


def check_up_options(a: Arguments) -> None:
    """Refuse options that do not go together."""
    if a.up != "auto":
        a.refuse_given(("assume_nothing", "pano"), "not with --up")
    check_suffix("--out", a.out, (".ply",))


def find_known_up(
    arguments: Arguments, cloud: CloudStream, evident: Array | None, reason: str
) -> tuple[Array | None, str]:
    """Return the direction (3,) that is up, None if that is not known, and why.

    By a named axis, but for the file's own (`auto`) where plain evidence (3,), for a reason, is against it.
    """
    if not arguments.assume_nothing:
        named = R_z_from_axis(arguments.up, cloud.up)[2]
        if arguments.up == "auto" and evident is not None and evident @ named < np.cos(MAX_LEAN):
            return None, f"the floors do not face {cloud.up} ({reason})"
        return named, "up is the named axis"
    scanners = cloud.station_axes
    if len(scanners) and dot_products(scanners, scanners[0]).min() > np.cos(MAX_LEAN):
        return scanners[0], "the scanners stood upright"
    return evident, reason


def find_up_by_photo(photo: Path, cloud: CloudStream, axis: Array) -> tuple[Array | None, str]:
    """Return up (3,) by a photo, localized in the scan turned by its vertical; None if it isn't; and why."""
    workers = Workers(num_cores(), cloud.show)
    settings = CoarseToFineSettings(gravity="unknown")
    scan = prepare_scan(
        cloud, cloud.label, CloudSettings(), settings, workers, Stopwatch(), rotation_to_z(axis)
    )
    result = scan.localize(photo)
    up = result.pose.R_cam_from_world[2] if result.pose and result.status == LOCALIZED else None
    return up, f"{photo} is {result.status}"


def find_transform(arguments: Arguments, cloud: CloudStream) -> tuple[Array, dict[str, object], str]:
    """Return the transform (4, 4) in the scan's unit; what is known of it; why it can't be relied on.

    It is the least turn that makes z up, and with --yaw-walls the least further one about z, about the middle
    of the cloud's box in whole metres.
    """
    voxels = cloud.voxels(np.eye(3))
    axis, sense, reason, planes = find_up(build_octree(voxels))
    if arguments.pano:
        up, reason = find_up_by_photo(arguments.pano, cloud, axis)
    else:
        up, reason = find_known_up(arguments, cloud, sense * axis if sense else None, reason)
    arguments.warn(voxels.warnings)
    doubt = "" if up is not None else f"up is not known: {reason}"
    R = np.eye(3) if up is None else rotation_to_z(level(planes, up))
    yaw = wall_yaw(planes, R) if arguments.yaw_walls else None
    if arguments.yaw_walls and yaw is None:
        doubt = doubt or "--yaw-walls: no wall is among the dominant planes"
    R = orthonormal(R if yaw is None else yaw_rotation(-yaw) @ R) + 0.0
    report = {
        "status": "uncertain" if doubt else "aligned",
        "explanation": reason,
        "up_scan": None if up is None else R[2].tolist(),
        "tilt_deg": None if up is None else float(np.degrees(np.arccos(min(R[2, 2], 1.0)))),
        "yaw_deg": None if yaw is None else float(np.degrees(yaw)),
    }
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = (voxels.origin - np.einsum("ij,j->i", R, voxels.origin) + 0.0) / cloud.scale
    return T, report, doubt


@command(__file__, __doc__, EPILOG, add_arguments, "0 done, 1 up is not known")
def main(arguments: Arguments) -> int:
    """Find a transform, write what is sure; returns the exit code."""
    with checking_options():
        check_up_options(arguments)
        settings = cloud_settings_from(arguments)
    out = arguments.out
    transform = out.with_suffix(".txt") if out and not is_stream(out) else None
    outputs = {"--out": out, "its .txt": transform}
    check_outputs(outputs, [*arguments.cloud, *filter(None, [arguments.pano])])
    if arguments.pano:
        read_panorama(arguments.pano)  # refused before the cloud is read
    cloud = open_cloud(arguments.cloud, settings, arguments.progress())
    T, report, doubt = find_transform(arguments, cloud)

    def write_transform() -> None:
        if transform:
            lines = (" ".join(map(repr, row)) + "\n" for row in T.tolist())
            write_atomically(transform, "".join(lines).encode())

    if out and not doubt:
        arguments.warn(write_transformed(cloud, T, out, write_transform))
        arguments.warn(describe_unit(cloud, out))
    report |= {"cloud": list(map(str, arguments.cloud)), "out": str(out) if out and not doubt else None}
    report |= {"T_aligned_from_scan": T.tolist(), "metres_per_unit": cloud.scale}
    arguments.report(outputs, report)
    return arguments.error(doubt, EXIT_UNKNOWN) if doubt else 0
