"""Animate a descent on the sampling loss: a checkerboard of panorama and cloud at each pose on the way."""

from argparse import ArgumentParser
from collections.abc import Sequence
from dataclasses import replace
from io import BytesIO
from typing import NamedTuple

import cv2
import numpy as np
import PIL.Image

from piccolo import InputError, Pose
from piccolo.arrays import Bytes
from piccolo.cli.command import Arguments, check_outputs, check_suffix, checking_options, command, option
from piccolo.cli.options import cloud_settings_from
from piccolo.cloud.soa import PackedPoints
from piccolo.errors import import_optional
from piccolo.files.atomic import write_atomically
from piccolo.geometry.pose import pose_errors, step
from piccolo.jobs.threads import Workers
from piccolo.optimize.refine import DescentSettings, Equations, Refined, make_sampling_loss, refine
from piccolo.panorama import Panorama, read_panorama
from piccolo.panorama.model import shrink
from piccolo.panorama.texels import Texels, pack_texels
from piccolo.scan_map.open_map import open_points
from piccolo.views.pictures import checkerboard, fill_holes, resize_rgb
from piccolo.views.surfels import make_surfels, render_surfels, visible_indices

from ..synthetic.walk_frames import writing_video
from .loss_surface import add_photo_options, read_known_poses

EPILOG = """\
example:
  python tools/animate_descent.py --cloud scan.ply --pano a.jpg --truth queries.json --out descent.gif

The descent begins 0.3 m and 8 degrees from the true pose, or else from the one found. Prints one JSON object
to stdout.
"""
PANORAMA_WIDTH = 1024  # [px]
DESCENT = DescentSettings(solver="adam")
START_DISTANCE = 0.3  # [m] from the pose
START_ANGLE_DEG = 8.0
FRAME_WIDTH = 512
TEXT_HEIGHT = 24
MAX_SURFELS = 150_000  # about one a pixel
MAX_FRAMES = 60  # if there are more poses, this many are drawn, evenly spaced
FRAMES_PER_S = 8
NUM_LAST = 12  # repetitions of the last frame


class Iterate(NamedTuple):
    """A pose on the way of a descent."""

    iteration: int
    pose: Pose
    loss: float


def perturb_pose(pose: Pose, distance: float, angle_deg: float) -> Pose:
    """Move a pose by `distance` [m] and turn it by `angle_deg`, each in a random direction (fixed seed)."""
    rng = np.random.default_rng(0)
    turn, move = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    return step(pose, np.concatenate([np.radians(angle_deg) * turn, distance * move]))


def refine_with_history(
    points: PackedPoints, texels: Texels, start: Pose, settings: DescentSettings
) -> tuple[Refined, list[Iterate]]:
    """Return the result of `refine`, and its iterates except those that line search or damping rejected."""
    loss = make_sampling_loss(texels)
    history: list[Iterate] = []
    num_tried = 0
    least = np.inf
    part = points  # those that are seen, found anew some times during the descent

    def equations(seen: PackedPoints, pose: Pose) -> Equations:
        nonlocal num_tried, least, part
        found = loss.equations(seen, pose)
        least = least if seen is part else np.inf
        part = seen
        if settings.solver == "adam" or found[0] <= least:
            history.append(Iterate(num_tried, pose, found[0]))
        num_tried += 1
        least = min(found[0], least)
        return found

    refined = refine(points, replace(loss, equations=equations), start, settings)
    return refined, [*history, Iterate(num_tried, refined.pose, refined.loss)]


def draw_frames(
    points: PackedPoints, panorama: Panorama, history: Sequence[Iterate], width: int, workers: Workers
) -> list[Bytes]:
    """Draw an image for each pose, with iteration and loss on top; the last one is repeated."""
    at_start = visible_indices(points, history[0].pose.center_world)
    at_end = visible_indices(points, history[-1].pose.center_world)
    surfels = make_surfels(points.take(np.union1d(at_start, at_end)).subsample(MAX_SURFELS), workers)
    photo = resize_rgb(panorama, width)
    chosen = np.unique(np.linspace(0, len(history) - 1, min(MAX_FRAMES, len(history))).astype(int))

    def frame(k: int) -> Bytes:
        view = render_surfels(surfels, history[k].pose, width, Workers(1))
        bar = np.zeros((TEXT_HEIGHT, width, 3), np.uint8)
        text = f"iteration {history[k].iteration}   loss {history[k].loss:.4f}"
        cv2.putText(bar, text, (6, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
        return np.concatenate([bar, checkerboard(photo, fill_holes(view.rgb, view.is_seen))])

    frames = list(workers.map(frame, chosen.tolist(), "frames"))
    return [*frames, *[frames[-1]] * NUM_LAST]


def encode_gif(frames: Sequence[Bytes]) -> bytes:
    """Encode frames as an animated GIF."""
    file = BytesIO()
    first, *others = map(PIL.Image.fromarray, frames)
    duration = 1000 // FRAMES_PER_S
    first.save(file, "GIF", save_all=True, append_images=others, duration=duration, loop=0)
    return file.getvalue()


def add_arguments(parser: ArgumentParser) -> None:
    """All options."""
    add_photo_options(parser)
    option(parser, "--out FILE", "write the animation here, .gif or .mp4 (extra video)", required=True)


@command(__file__, __doc__, EPILOG, add_arguments)
def main(arguments: Arguments) -> int:
    """Read, descend, draw, write."""
    with checking_options():
        cloud_settings = cloud_settings_from(arguments)
        check_suffix("--out", arguments.out, (".gif", ".mp4"))
        if not (arguments.result or arguments.truth):
            raise InputError("--result, --truth: found none of them, wanted one or both")
    outputs = {"--out": arguments.out}
    inputs = [*arguments.cloud, arguments.pano, arguments.result, arguments.truth]
    check_outputs(outputs, filter(None, inputs))
    is_video = arguments.out.suffix.lower() == ".mp4"
    if is_video:
        import_optional("--out", "av", "video")  # now: where it is missing, the work would be lost

    workers = arguments.workers()
    panorama = shrink(read_panorama(arguments.pano), PANORAMA_WIDTH)
    cloud = open_points(arguments.cloud, cloud_settings, workers)
    arguments.warn(cloud.warnings)
    known = read_known_poses(arguments, cloud)
    goal = known.get("true") or known["found"]
    start = perturb_pose(goal, START_DISTANCE, START_ANGLE_DEG)
    texels = pack_texels(panorama.rgb, panorama.is_valid)
    refined, history = refine_with_history(cloud.points, texels, start, DESCENT)
    frames = draw_frames(cloud.points, panorama, history, FRAME_WIDTH, workers)
    if is_video:
        height, width = frames[0].shape[:2]
        with writing_video(arguments.out, FRAMES_PER_S, (width, height)) as add:
            for frame in frames:
                add(frame)
    else:
        write_atomically(arguments.out, encode_gif(frames))
    line: dict[str, object] = {"out": str(arguments.out), "frames": len(frames)}
    for label, pose in (("start", start), ("end", refined.pose)):
        distance, angle = pose_errors(pose, goal)
        line |= {f"{label}_distance": round(distance, 6), f"{label}_deg": round(float(np.degrees(angle)), 6)}
    line["loss"] = refined.loss if np.isfinite(refined.loss) else None
    arguments.report(outputs, line)
    return 0
