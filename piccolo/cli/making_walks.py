"""Buildings of make_room.py, and the walks through them."""

import argparse
import itertools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..files.atomic import write_atomically
from ..jobs.threads import Workers
from ..scenes import scene as scenes
from ..scenes.export.formats import tum_lines, write_lines
from ..scenes.export.video import writing_video
from ..scenes.synthetic.office import Office, make_office
from ..scenes.synthetic.walk_frames import BAD_KINDS, WalkOptions, frames_of
from ..scenes.synthetic.walking import Walker
from ..views.pictures import encode_image
from .command import option
from .errors import UsageError

OF_WALKS = ("visit", "people", "blur", "bad_frames", "video")  # options that nothing else takes
MAX_LENGTH = 100_000.0  # [m]
QUALITY = 95  # of JPEGs


def add_walk_options(parser: argparse.ArgumentParser) -> None:
    """What makes a building of the rooms, and walks through it."""
    group = parser.add_argument_group("buildings and walks")
    option(
        group,
        "--storeys N",
        "a building: corridors, halls and stairs join the rooms (1 with --walk)",
        default=0,
    )
    option(group, "--twins FRACTION", "of a building's rooms that are exact copies of others", default=0.0)
    option(
        group, "--walk M", "in place of panoramas, a walk of this length through a building [m]", default=0.0
    )
    option(group, "--walks N", "of each variant, which are clean or photo", default=1)
    option(
        group, "--visit ROOM ...", "go there first, by number from 0; then to others at random", default=[]
    )
    option(group, "--frame-rate HZ", "frames a second", default=2.0)
    option(group, "--people N", "who walk the same way", default=0)
    option(group, "--blur", "of the camera's motion while the shutter is open")
    option(group, "--bad-frames FRACTION", f"that are {', '.join(BAD_KINDS)}", default=0.0)
    option(group, "--video", "FOLDER/VARIANT_walk_K.mp4 too")


def check_walk_usage(arguments: argparse.Namespace) -> None:
    """Refuse options that do not go together, and walks that can't be made."""
    is_building = bool(arguments.storeys or arguments.walk)
    if arguments.twins and not is_building:
        raise UsageError("--twins: goes with --storeys or --walk")
    if is_building and "change" in arguments.variants:
        raise UsageError("--variants: found change, which a building has not")
    if arguments.walk:
        _check_walk(arguments)
    elif given := [name for name in OF_WALKS if getattr(arguments, name)]:
        raise UsageError(f"--{given[0].replace('_', '-')}: goes with --walk")


def _check_walk(arguments: argparse.Namespace) -> None:
    if not 0.0 < arguments.walk <= MAX_LENGTH:
        raise UsageError(f"--walk: found {arguments.walk}, wanted up to {MAX_LENGTH:g} m")
    if arguments.labels or arguments.camera:
        raise UsageError("--labels, --camera: not with --walk")
    if missing := [room for room in arguments.visit if not 0 <= room < arguments.rooms]:
        raise UsageError(f"--visit: found room {missing[0]}, wanted 0 to {arguments.rooms - 1}")
    for variant in arguments.variants:
        walk_options(arguments, variant)


def building_of(arguments: argparse.Namespace, seed: int) -> Office | None:
    """The building that was asked for, if one was."""
    if not (arguments.storeys or arguments.walk):
        return None
    size = np.array(arguments.size)
    return make_office(seed, size, arguments.rooms, max(1, arguments.storeys), arguments.twins)


def walk_options(arguments: argparse.Namespace, variant: str) -> WalkOptions:
    """How walks of a variant are taken."""
    rest = arguments.people, arguments.blur, arguments.bad_frames, arguments.width
    return WalkOptions(arguments.frame_rate, variant, *rest)


def write_walks(
    arguments: argparse.Namespace, office: Office, folder: Path, workers: Workers
) -> list[scenes.Query]:
    """Write the frames, poses and videos of all walks."""
    walker = Walker(office)
    queries: list[scenes.Query] = []
    for variant, number in itertools.product(dict.fromkeys(arguments.variants), range(arguments.walks)):
        name, options = f"{variant}_walk_{number}", walk_options(arguments, variant)
        rng = np.random.default_rng([office.world.seed, 53, number])
        walk = walker.walk(arguments.walk, arguments.visit, rng)
        frames = frames_of(office, walk, options, number, Workers(workers.num_threads))
        rows = []
        with _video(arguments, folder / f"{name}.mp4") as add:
            for k, frame in enumerate(workers.show(frames, walk.num_frames(options.rate), name)):
                image = folder / "images" / f"{name}_{k:05}.jpg"
                write_atomically(image, encode_image(frame.rgb, ".jpg", QUALITY))
                add(frame.rgb)
                about = {"walk": name, "time": frame.time, "is_answerable": frame.kind not in BAD_KINDS}
                queries.append(scenes.Query(image, frame.kind, frame.pose, **about))
                rows.append((repr(frame.time), frame.pose))
        write_lines(folder / f"{name}_poses.tum", tum_lines(rows, "optical"))
    return queries


@contextmanager
def _video(arguments: argparse.Namespace, path: Path) -> Iterator[Callable[[NDArray[np.uint8]], object]]:
    """What takes the frames of a video; if none was asked for they go nowhere."""
    if not arguments.video:
        yield lambda rgb: None
        return
    with writing_video(path, arguments.frame_rate, (arguments.width, arguments.width // 2)) as add:
        yield add
