"""Make a synthetic furnished room from a seed: a coloured scan, and panoramas with true poses."""

import itertools
import json
from argparse import ArgumentParser
from contextlib import nullcontext
from pathlib import Path

import numpy as np

from piccolo.apps.export.formats import tum_lines
from piccolo.cli.command import Arguments, UsageError, check_folder_name, checking_options, command, option
from piccolo.cloud.writers import vertex_rows, writing_ply
from piccolo.photo.camera import Calibration
from piccolo.photo.camera.calibration import read_cameras
from piccolo.photo.panorama.picture import encode_image
from piccolo.system.errors import import_optional
from piccolo.system.files.atomic import write_atomically, write_lines
from piccolo.system.jobs.threads import Workers

from .. import scene as scenes
from . import world as worlds
from .office import Office, make_office
from .walk_frames import BAD_KINDS, WalkOptions, frames_of, writing_video
from .walking import Walker
from .world import World

QUALITY = {"photo": 70}  # of a variant's JPEGs; else 95
WALK_QUALITY = 95
ROOM_POINTS = 300_000  # of all rooms side by side
# of each part of a building; with 30,000 the better scanned of exact twins was called sure
PART_POINTS = 120_000
MIN_POINTS = 1000  # a room, so that they show it
MAX_LENGTH = 100_000.0  # [m]
OF_WALKS = ("people", "blur", "bad_frames", "video")  # options that nothing else takes
EPILOG = """\
examples:
  python tools/make_room.py --out room --seed 3
  python tools/make_room.py --out photos --camera cameras.txt
  python tools/make_room.py --out flats --rooms 16 --points 2000000 --panoramas 4 --variants clean photo
  python tools/make_room.py --out walk --rooms 64 --storeys 2 --twins 0.3 --walk 300 --people 3 --blur

Writes FOLDER/cloud.ply, FOLDER/images/VARIANT_K.jpg and FOLDER/queries.json with the true poses.
Variants are clean: as scanned; tilt: camera in any orientation; photo: other exposure, white balance, gamma,
blur and noise; change: furniture moved and added. With --labels, points have labels, and each panorama has a
label image, FOLDER/labels/VARIANT_K.png. With --camera, queries.json contains the camera of each picture for
evaluate.py; the pictures of a rig are a folder. Prints one JSON object per scene to stdout.
With --storeys, the rooms lie along corridors of identical doors, between halls with stairs. With --walk, a
person carries the camera through the building: FOLDER/images/VARIANT_walk_K_FRAME.jpg, with walk and time in
queries.json, and FOLDER/VARIANT_walk_K_poses.tum (optical axes). --bad-frames adds frames that are black,
mirrored or taken elsewhere, each kind a variant, with "answerable": false: they must not be localized.
"""


def add_arguments(parser: ArgumentParser) -> None:
    """All options."""
    option(parser, "--out FOLDER", "folder of the scene; created if missing", required=True)
    option(parser, "--seed N", "seed; equal seeds give equal files", default=0)
    text = f"number of points (default {ROOM_POINTS}; in a building {PART_POINTS} per room and corridor part)"
    option(parser, "--points N", text)
    option(parser, "--panoramas N", "number of panoramas of each variant", default=3)
    text = "variants of the panoramas, see below"
    option(parser, "--variants", text, nargs="+", choices=worlds.VARIANTS, default=["clean"])
    option(parser, "--width PX", "width of the panoramas", default=2048)
    text = "take the pictures with this calibrated camera or rig (docs/CAMERAS.md) instead of panoramas"
    option(parser, "--camera FILE", text)
    option(parser, "--size X Y Z", "size of a room [m]", default=[6.0, 5.0, 2.7])
    option(parser, "--rooms N", "number of rooms, at most 256", default=1)
    option(parser, "--labels", "also write semantic labels of points and pixels, for reproduce_paper.py")
    text = "write N scenes, FOLDER/000 and so on, with consecutive seeds from --seed"
    option(parser, "--scenes N", text, default=0)
    group = parser.add_argument_group("buildings and walks")
    text = "number of storeys of a building, where corridors, halls and stairs join the rooms (1 with --walk)"
    option(group, "--storeys N", text, default=0)
    text = "fraction of a building's rooms that are exact copies of others"
    option(group, "--twins FRACTION", text, default=0.0)
    text = "make walks of this length [m] through a building instead of single panoramas"
    option(group, "--walk M", text, default=0.0)
    option(group, "--walks N", "number of walks of each variant (clean or photo)", default=1)
    option(group, "--frame-rate HZ", "frames per second", default=2.0)
    option(group, "--people N", "number of people who walk along with the camera", default=0)
    option(group, "--blur", "add motion blur")
    option(group, "--bad-frames FRACTION", f"fraction of bad frames: {', '.join(BAD_KINDS)}", default=0.0)
    option(group, "--video", "also write FOLDER/VARIANT_walk_K.mp4")


def is_building(arguments: Arguments) -> bool:
    """Return True if the rooms are to be joined."""
    return bool(arguments.storeys or arguments.walk)


def check_usage(arguments: Arguments) -> None:
    """Refuse options that do not go together."""
    arguments.check_least(panoramas=0, seed=0, scenes=0, storeys=0, walks=1)
    if arguments.twins and not is_building(arguments):
        raise UsageError("--twins: only with --storeys or --walk")
    if is_building(arguments) and "change" in arguments.variants:
        raise UsageError("--variants: found change, wanted others in a building")
    if arguments.labels and arguments.camera:
        raise UsageError("--labels: not with --camera")
    if not arguments.walk:
        arguments.refuse_given([name for name in OF_WALKS if getattr(arguments, name)], "only with --walk")
    if not 0.0 <= arguments.walk <= MAX_LENGTH:
        raise UsageError(f"--walk: found {arguments.walk}, wanted up to {MAX_LENGTH:g} m")
    if arguments.walk and (arguments.labels or arguments.camera):
        raise UsageError("--labels, --camera: not with --walk")
    for variant in arguments.variants if arguments.walk else ():
        walk_options(arguments, variant)  # refuses what can't be made


def walk_options(arguments: Arguments, variant: str) -> WalkOptions:
    """Return the options of walks of a variant."""
    a = arguments
    return WalkOptions(a.frame_rate, variant, a.people, a.blur, a.bad_frames, a.width)


def write_photos(
    arguments: Arguments, world: World, folder: Path, cameras: Calibration | None, workers: Workers
) -> list[scenes.Query]:
    """Write single photos, of each variant as many; those of a rig are a folder."""
    queries = []
    for v, k in itertools.product(dict.fromkeys(arguments.variants), range(arguments.panoramas)):
        image = folder / "images" / (f"{v}_{k}" if cameras and cameras.is_rig else f"{v}_{k}.jpg")
        labels = None
        if cameras is not None:
            pictures, pose = worlds.make_photos(world, k, v, cameras, workers)
        else:
            query = worlds.make_query(world, k, v, arguments.width, workers)
            pictures = [("", query.rgb)]
            pose = query.pose
            if arguments.labels:
                labels = folder / "labels" / f"{v}_{k}.png"
                labels.parent.mkdir(exist_ok=True)
                write_atomically(labels, encode_image(worlds.make_labels(world, k, query, workers), ".png"))
        for name, rgb in pictures:
            path = image / name
            path.parent.mkdir(exist_ok=True)
            write_atomically(path, encode_image(rgb, path.suffix, QUALITY.get(v, 95)))
        queries.append(scenes.Query(image, v, pose, labels, cameras.mounts if cameras else ()))
    return queries


def write_walks(arguments: Arguments, office: Office, folder: Path, workers: Workers) -> list[scenes.Query]:
    """Write the frames, poses and videos of all walks."""
    walker = Walker(office)
    queries: list[scenes.Query] = []
    for variant, number in itertools.product(dict.fromkeys(arguments.variants), range(arguments.walks)):
        name = f"{variant}_walk_{number}"
        options = walk_options(arguments, variant)
        rng = np.random.default_rng([office.world.seed, 53, number])
        walk = walker.walk(arguments.walk, rng)
        frames = frames_of(office, walk, options, number, Workers(workers.num_threads))
        rows = []
        size = (arguments.width, arguments.width // 2)
        video = writing_video(folder / f"{name}.mp4", arguments.frame_rate, size)
        with video if arguments.video else nullcontext() as add:
            for k, frame in enumerate(workers.show(frames, walk.num_frames(options.rate), name)):
                image = folder / "images" / f"{name}_{k:05}.jpg"
                write_atomically(image, encode_image(frame.rgb, ".jpg", WALK_QUALITY))
                if add is not None:
                    add(frame.rgb)
                about = {"walk": name, "time": frame.time, "is_answerable": frame.kind not in BAD_KINDS}
                queries.append(scenes.Query(image, frame.kind, frame.pose, **about))
                rows.append((repr(frame.time), frame.pose))
        write_lines(folder / f"{name}_poses.tum", tum_lines(rows, "optical"))
    return queries


def write_scene(
    arguments: Arguments, seed: int, folder: Path, cameras: Calibration | None, workers: Workers
) -> dict[str, object]:
    """Make and write one scene; returns what was written."""
    office = None
    size = np.array(arguments.size)
    with checking_options():
        if arguments.width < 128 or arguments.width % 2:
            raise UsageError(f"--width: found {arguments.width}, wanted an even number of at least 128")
        if is_building(arguments):
            office = make_office(seed, size, arguments.rooms, max(1, arguments.storeys), arguments.twins)
        world = office.world if office else worlds.make_world(seed, size, arguments.rooms)
        usual = PART_POINTS * len(world.rooms) if office else ROOM_POINTS
        num_points = usual if arguments.points is None else arguments.points
        if num_points < MIN_POINTS * len(world.rooms):
            raise UsageError(f"--points: found {num_points}, wanted at least {MIN_POINTS} per room")
    (folder / "images").mkdir(parents=True, exist_ok=True)
    points, colors, labels = worlds.scan_world(world, num_points, workers)
    rows = vertex_rows(points, colors, label=labels.astype(np.int32) if arguments.labels else None)
    with writing_ply(folder / scenes.CLOUD_NAME) as writer:
        writer.add(rows)
    if office is not None and arguments.walk:
        queries = write_walks(arguments, office, folder, workers)
    else:
        queries = write_photos(arguments, world, folder, cameras, workers)
    source: dict[str, object] = {}
    if office is not None:
        corners = [room.corner.tolist() for room in world.rooms[: office.num_rooms]]
        source["source"] = {"corners": corners, "copies": office.copies.tolist()}
    scenes.write_queries(folder, queries, **source)
    return {"folder": str(folder), "points": len(points), "queries": len(queries), "seed": seed}


@command(__file__, __doc__, EPILOG, add_arguments)
def main(arguments: Arguments) -> int:
    """Make and write all scenes."""
    check_folder_name("--out", arguments.out)
    cameras = read_cameras(arguments.camera) if arguments.camera else None
    with checking_options():
        check_usage(arguments)
        if cameras is not None:
            worlds.check_cameras(cameras)
    if arguments.video:
        import_optional("--video", "av", "video")
    workers = arguments.workers()
    for number in range(max(1, arguments.scenes)):
        folder = arguments.out / f"{number:03}" if arguments.scenes else arguments.out
        line = write_scene(arguments, arguments.seed + number, folder, cameras, workers)
        print(json.dumps(line), flush=True)
    return 0
