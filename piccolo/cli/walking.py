"""The frames of a walk as localize.py --walk and --video name them."""

import argparse
import math
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from ..batch.frame_times import EXIF, NAMES, ORDER, times_of
from ..batch.inputs import is_from_stdin
from ..files.temporary import temporary_folder
from ..panorama.video import frames_of
from ..walk.frames import MAX_ACCELERATION, MAX_SPEED, MAX_STEP, NO_ACCELERATION, Motion
from .errors import UsageError
from .progress import shown

EVERY = re.compile(r"(\d+(?:\.\d+)?)(s|m)")
DEFAULT_EVERY = "0.5s"
ONLY_WITH = ("every", "times", "max_speed", "max_step", "acceleration", "plan")
NOT_WITH = ("jobs", "dask", "overlay", "occlusion_mask", "priors", "refine_focal")


class WalkInput(NamedTuple):
    """A frame of a walk."""

    path: Path
    time: float  # [s] since the first; of frames without times their number
    name: str  # in the results


class WalkInputs(NamedTuple):
    """A walk's frames."""

    frames: list[WalkInput]
    motion: Motion  # how the camera is carried
    min_distance: float  # [m] below which frames are dropped


def add_walk_options(parser: argparse.ArgumentParser) -> None:
    """How frames of a walk are taken, and how the camera is carried."""
    group = parser.add_argument_group("walks")
    text = "the panoramas are frames of one walk, in this order: each is told by those before and after it"
    group.add_argument("--walk", action="store_true", help=text)
    group.add_argument("--video", type=Path, metavar="FILE", help="a walk's video, in place of --pano")
    text = f"of a video, such as 0.5s or 1m: the sharpest frame each time (default {DEFAULT_EVERY})"
    group.add_argument("--every", metavar="STEP", help=text)
    text = f"of the frames: {EXIF}, {NAMES} (the last number in each, seconds), {ORDER}, or a CSV file with "
    text += f"columns name and time [s] (default {EXIF} if it tells them apart, else {ORDER})"
    group.add_argument("--times", metavar="SOURCE", help=text)
    text = f"of the camera [m/s] (default {MAX_SPEED:g})"
    group.add_argument("--max-speed", type=float, metavar="X", help=text)
    text = "from a frame to the next, where only their order is known [m] (default by what is found of them)"
    group.add_argument("--max-step", type=float, metavar="M", help=text)
    text = "the path on the scan from above, coloured by its frames' confidence: .png, .svg, .pdf or .dxf"
    group.add_argument("--plan", type=Path, metavar="FILE", help=text)
    text = "standard deviation of the camera's acceleration, by which the path is smoothed [m/s^2] "
    text += f"(default {MAX_ACCELERATION:g})"
    group.add_argument("--acceleration", type=float, metavar="X", help=text)


def check_walk_options(arguments: argparse.Namespace) -> None:
    """Refuse what does not go together."""
    if arguments.walk or arguments.video is not None:
        _check_walk(arguments)
        return
    if not arguments.pano:
        raise UsageError("the following arguments are required: --pano")
    for name in ONLY_WITH:
        if getattr(arguments, name) is not None:
            raise UsageError(f"--{name.replace('_', '-')}: only with --walk or --video")


def _check_walk(arguments: argparse.Namespace) -> None:
    is_video = arguments.video is not None
    wrong = {
        "--walk, --video: wanted --walk with --pano, or --video alone": is_video == bool(arguments.pano),
        "--walk: found names on stdin, wanted files or folders": is_from_stdin(arguments.pano),
        "--every: only with --video": not is_video and arguments.every is not None,
        "--times, --max-step: not with --video, which knows its times": is_video
        and (arguments.times is not None or arguments.max_step is not None),
    }
    for text, is_so in wrong.items():
        if is_so:
            raise UsageError(text)
    for name in NOT_WITH:
        if getattr(arguments, name) not in (None, False):
            raise UsageError(f"--{name.replace('_', '-')}: not with a walk")


def motion_of(arguments: argparse.Namespace, has_times: bool) -> Motion:
    """How the camera is carried."""
    if has_times and arguments.max_step is not None:
        raise UsageError("--max-step: found times of the frames, wanted --max-speed")
    if not has_times and arguments.max_speed is not None:
        raise UsageError("--max-speed: found no times of the frames, wanted --times or --max-step")
    for name in ("max_speed", "max_step", "acceleration"):
        value = getattr(arguments, name)
        if value is not None and not 0.0 < value < math.inf:
            raise UsageError(f"--{name.replace('_', '-')}: found {value}, wanted a number above 0")
    speed = arguments.max_speed or MAX_SPEED if has_times else arguments.max_step or MAX_STEP
    acceleration = arguments.acceleration or (MAX_ACCELERATION if has_times else NO_ACCELERATION)
    return Motion(speed, acceleration, has_times, not has_times and arguments.max_step is None)


def every_of(text: str, max_speed: float) -> tuple[float, float]:
    """Seconds from frame to frame, and the metres below which frames are dropped, of --every."""
    found = EVERY.fullmatch(text)
    if not found or not 0.0 < float(found[1]) < math.inf:
        raise UsageError(f"--every: found {text!r}, wanted seconds or metres, such as 0.5s or 1m")
    value = float(found[1])
    return (value, 0.0) if found[2] == "s" else (value / max_speed, value)


@contextmanager
def walk_inputs(arguments: argparse.Namespace, panoramas: Sequence[Path]) -> Iterator[WalkInputs]:
    """The frames of a walk; those of a video are files until the end."""
    if arguments.video is None:
        times = times_of(panoramas, arguments.times)
        numbers = times or [float(k) for k in range(len(panoramas))]
        frames = [WalkInput(p, t, str(p)) for p, t in zip(panoramas, numbers, strict=True)]
        yield WalkInputs(frames, motion_of(arguments, times is not None), 0.0)
        return
    motion = motion_of(arguments, True)
    seconds, metres = every_of(arguments.every or DEFAULT_EVERY, motion.max_speed)
    with temporary_folder() as folder:
        found = frames_of(arguments.video, seconds, folder)
        bar = {"desc": "read the video", "unit": " frames", "leave": False}
        frames = [
            WalkInput(f.path, f.time, f"{arguments.video}#t={f.time:.3f}")
            for f in shown(found, arguments.quiet, **bar)
        ]
        yield WalkInputs(frames, motion, metres)
