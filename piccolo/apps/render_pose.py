"""Render the cloud as a camera at a pose would see it: colours or depth."""

from argparse import ArgumentParser
from contextlib import nullcontext
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..api.opening import open_points
from ..api.result_files import read_results
from ..cli.command import Arguments, check_distinct, check_suffix, checking_options, command, option
from ..cli.options import add_cloud_options
from ..cli.settings_given import cloud_settings_from
from ..geometry.points import LocalCloud
from ..geometry.pose import CAMERA_AXES, Pose, R_cam_from_angles, check_pose, check_transform
from ..photo.camera import Camera, Mount
from ..photo.camera.calibration import read_calibration
from ..photo.panorama.picture import encode_image
from ..system.arrays import Array32
from ..system.errors import InputError
from ..system.files.atomic import (
    check_output,
    check_output_folder,
    is_stream,
    replacing_folder,
    write_atomically,
)
from ..system.files.json_file import read_text
from ..system.jobs.threads import Workers
from ..views.pictures import cut_view, fill_holes, sphere_width_for
from ..views.surfels import render_points

EPILOG = """\
examples:
  python tools/render_pose.py --cloud scan.ply --result pose.json --out seen.png --depth depth.png
  python tools/render_pose.py --cloud scan.ply --at 3 2 1.5 --heading 90 --out east.png

Angles: docs/CONVENTIONS.md, Exports; heading is clockwise from the world's +y. Each point is drawn as a disc
that reaches its nearest neighbours; pixels without a disc are interpolated. --depth is the range along the
ray. PNG: 16 bit, millimetres, 0 without scan, 65535 for 65.535 m and farther. NPY: float32, metres,
inf without scan. --mask-out: white without scan, a mask for --mask of localize.py.
An output - is stdout (PNG). Prints one JSON object per picture to stdout, or to stderr if
stdout is an output.
"""
MAX_WIDTH = 32_768
MIN_WIDTH = 16
MAX_POSE_FILE = 65_536  # [byte] sixteen numbers and some comments
SUFFIXES = {  # of outputs, those of stdout and devices first; "" is a folder
    "--out": (".png", ".jpg", ".jpeg", ""),
    "--depth": (".png", ".npy"),
    "--mask-out": (".png",),
}


class PictureToDraw(NamedTuple):
    """A picture to draw."""

    pano: str  # the panorama's path
    pose: Pose  # of the camera, in the world
    camera: Camera | None  # None for a sphere


def add_arguments(parser: ArgumentParser) -> None:
    """All options."""
    add_cloud_options(parser, "coloured scan as for localize.py, or a map of tools/prepare_map.py")
    group = parser.add_argument_group("pose, one of")
    one = group.add_mutually_exclusive_group(required=True)
    option(one, "--result FILE", "results of localize.py, JSON lines")
    option(one, "--pose FILE", "text file with the 4 x 4 numbers of T_world_from_cam")
    option(one, "--at X Y Z", "position in world coordinates [m]")
    option(group, "--pano NAME", "choose the pose of this panorama (file name), if --result has several")
    for angle in ("heading", "pitch", "roll"):
        option(group, f"--{angle} DEG", f"{angle} with --at (default 0)")
    group = parser.add_argument_group("picture")
    text = ".png or .jpg; for several poses a new folder of .png, named like the photos"
    option(group, "--out FILE", text, required=True)
    option(group, "--width PX", "width of a spherical picture, twice its height", default=2048)
    text = "render the view of this camera (docs/CAMERAS.md; default: that of --result, else a sphere)"
    option(group, "--camera FILE", text)
    option(group, "--depth FILE", "range of each pixel, .png or .npy, see below")
    option(group, "--mask-out PNG", "mask of the pixels without scan, see below")


def check_usage(arguments: Arguments) -> None:
    """Refuse options that make no sense, whatever the files hold."""
    cloud_settings_from(arguments)
    if (arguments.depth or arguments.mask_out) and is_folder(arguments.out):
        raise InputError("--depth, --mask-out: only with a single picture, --out FILE")
    if not MIN_WIDTH <= arguments.width <= MAX_WIDTH or arguments.width % 2:
        raise InputError(f"--width {arguments.width}: wanted an even number, {MIN_WIDTH} to {MAX_WIDTH}")
    for name, path in outputs_of(arguments).items():
        check_suffix(name, path, SUFFIXES[name])
    check_pose_options(arguments)


def check_pose_options(arguments: Arguments) -> None:
    """Refuse options that do not go with where the pose is from."""
    if not arguments.at:
        arguments.refuse_given(("heading", "pitch", "roll"), "only with --at")
    angles = [arguments.heading, arguments.pitch, arguments.roll]
    if not np.isfinite([*(arguments.at or ()), *(angle or 0.0 for angle in angles)]).all():
        raise InputError("--at and angles must be finite numbers")


def outputs_of(arguments: Arguments) -> dict[str, Path | None]:
    """Return the outputs by option."""
    return {name: getattr(arguments, name[2:].replace("-", "_")) for name in SUFFIXES}


def is_folder(path: Path) -> bool:
    """Return True for an output that is to be a folder of pictures."""
    return not path.suffix and not is_stream(path)


def suffix_of(option: str, path: Path) -> str:
    """Return the suffix that says in which format an output is written."""
    return SUFFIXES[option][0] if is_stream(path) else path.suffix.lower()


def check_pictures(arguments: Arguments, poses: list[PictureToDraw]) -> None:
    """Refuse, before any work, what could not be written, or would replace an input."""
    given = (arguments.result, arguments.pose, arguments.camera)
    photos = [Path(shot.pano) for shot in poses]
    check_distinct(outputs_of(arguments), [*arguments.cloud, *filter(None, given), *photos])
    for path in filter(None, outputs_of(arguments).values()):
        (check_output_folder if is_folder(path) else check_output)(path)


def poses_from(arguments: Arguments) -> list[PictureToDraw]:
    """Return poses asked for, named by the panorama's path, the pose's file or "at", with their cameras."""
    given = read_calibration(arguments.camera).mounts if arguments.camera else ()
    if len(given) > 1:
        raise InputError(f"{arguments.camera}: found {len(given)} cameras, wanted one")
    if arguments.at:
        angles = [angle or 0.0 for angle in (arguments.heading, arguments.pitch, arguments.roll)]
        pose = check_pose(Pose(R_cam_from_angles(*angles), np.array(arguments.at)), "--at")
        return [shot_of("at", pose, given)]
    if arguments.pose:
        return [shot_of(str(arguments.pose), read_pose_matrix(arguments.pose), given)]
    results = read_results([arguments.result])
    found = [shot_of(r.pano, r.best_pose, given or r.cameras) for r in results if r.best_pose]
    if arguments.pano:
        found = [shot for shot in found if Path(shot.pano).name == Path(arguments.pano).name]
    if not found:
        raise InputError(f"{arguments.result}: no pose" + (f" of {arguments.pano}" if arguments.pano else ""))
    if len(found) > 1 and not is_folder(arguments.out):
        raise InputError(f"{arguments.result}: {len(found)} poses, wanted one: --pano NAME, or --out FOLDER")
    return found


def read_pose_matrix(path: Path) -> Pose:
    """Return the pose of T_world_from_cam, 4 x 4 numbers in a text file; comments begin with #."""
    wanted = "wanted the 4 x 4 numbers of T_world_from_cam"
    lines = read_text(path, wanted, MAX_POSE_FILE).splitlines()
    rows = [line.replace(",", " ").split() for line in lines if line.split("#")[0].strip()]
    try:
        T = np.array(rows, dtype=np.float64)
    except ValueError as error:  # words, lines of several lengths
        raise InputError(f"{path}: found {error}, {wanted}") from error
    if T.shape != (4, 4):
        raise InputError(f"{path}: found {' x '.join(map(str, T.shape))} numbers, {wanted}")
    if not np.allclose(T[3], [0.0, 0.0, 0.0, 1.0]):
        raise InputError(f"{path}: the last row is not 0 0 0 1, {wanted}")
    return check_transform(T, str(path), CAMERA_AXES["piccolo"])


def shot_of(pano: str, pose: Pose, mounts: tuple[Mount, ...]) -> PictureToDraw:
    """Return the picture of a pose by its one camera, if it has one; a rig's is the sphere."""
    return (
        PictureToDraw(pano, mounts[0].pose(pose), mounts[0].camera)
        if len(mounts) == 1
        else PictureToDraw(pano, pose, None)
    )


def depth_file(depth: Array32, suffix: str) -> bytes:
    """Depth (H, W) [m] as the file that the suffix names."""
    if suffix == ".png":
        millimetres = np.minimum(np.rint(depth * 1000.0), 65535.0)
        return encode_image(np.where(np.isfinite(depth), millimetres, 0.0).astype(np.uint16), suffix)
    file = BytesIO()
    np.save(file, depth)
    return file.getvalue()


def draw_pictures(
    arguments: Arguments, cloud: LocalCloud, poses: list[PictureToDraw], workers: Workers
) -> None:
    """Write the pictures; one JSON line each."""
    is_many = is_folder(arguments.out)
    names = [f"{Path(shot.pano).stem}.png" for shot in poses] if is_many else [arguments.out.name]
    suffix = ".png" if is_many else suffix_of("--out", arguments.out)
    if len(set(names)) < len(names):
        raise InputError(f"{arguments.out}: panoramas of the same name; choose one with --pano")

    def write(folder: Path, name: str, shot: PictureToDraw) -> dict[str, object]:
        camera = shot.camera and shot.camera.scale_to_width(arguments.width)
        width = sphere_width_for(camera) if camera else arguments.width
        view = render_points(cloud.points, cloud.from_world(shot.pose), width, workers)
        view = view._replace(rgb=fill_holes(view.rgb, view.is_seen))
        view = cut_view(view, camera) if camera else view
        seen_fraction = round(float(view.is_seen.mean()), 6)
        if arguments.depth:
            write_atomically(arguments.depth, depth_file(view.depth, suffix_of("--depth", arguments.depth)))
        if arguments.mask_out:
            nothing = np.where(view.is_seen, 0, 255).astype(np.uint8)
            write_atomically(arguments.mask_out, encode_image(nothing, ".png"))
        write_atomically(folder / name, encode_image(view.rgb, suffix))
        out = arguments.out / name if is_many else arguments.out
        return {"out": str(out), "pano": shot.pano, "width": arguments.width, "seen_fraction": seen_fraction}

    with replacing_folder(arguments.out) if is_many else nullcontext(arguments.out.parent) as folder:
        lines = [write(folder, name, shot) for name, shot in zip(names, poses, strict=True)]
    for line in lines:
        arguments.report(outputs_of(arguments), line)


@command(__file__, __doc__, EPILOG, add_arguments)
def main(arguments: Arguments) -> int:
    """Read, draw, write."""
    with checking_options():
        check_usage(arguments)
    poses = poses_from(arguments)
    check_pictures(arguments, poses)

    workers = arguments.workers()
    cloud = open_points(arguments.cloud, cloud_settings_from(arguments), workers)
    arguments.warn(cloud.warnings)
    draw_pictures(arguments, cloud, poses, workers)
    return 0
