"""Measure photos that are localized together: turns and bursts of a phone in made-up rooms, and strangers."""

from argparse import ArgumentParser
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from piccolo import CoarseToFineSettings, Photo
from piccolo.cli.command import Arguments, option
from piccolo.cloud.stream import stream_of_arrays
from piccolo.geometry.pose import Pose
from piccolo.judge.result import Result
from piccolo.localization.means import Means
from piccolo.localization.run import localize
from piccolo.photo.camera.model import camera_of_fov
from piccolo.photo.panorama import read_panorama
from piccolo.scan_map.scan_map import ScanMap, prepare_map
from piccolo.system.jobs.threads import Stopwatch, Workers, num_cores
from piccolo.together.group import localize_group
from piccolo.together.members import Shot

from ..synthetic import handheld, layout, world as worlds
from ..synthetic.places import ALIKE_KINDS, make_alike
from .calibration import print_cases
from .claims import Trial
from .confidence import TrialLog, localize_trial, remove_texture

EPILOG = """\
example:
  python tools/benchmark.py groups --seeds 0 3 --kinds furnished plain --out groups.jsonl

In each world a person turns around with a phone, and walks a few steps. With --strangers, photos of another
world and mirrored ones are put among them. Each photo is localized alone and together with the others, and
the whole sphere at the same spot. Writes the trials as JSON lines for tools/benchmark.py calibration, and
prints a table.
"""
KINDS = ("furnished", "plain", *ALIKE_KINDS)
SMALLEST = [3.0, 3.0, 2.3]  # rooms [m]
LARGEST = [9.0, 7.0, 3.2]
CHANGED_THINGS = 0.2  # fraction of them that differs between places that look alike
GROUP_PHOTO = 65.0, 800, 600  # [deg, px, px]
NUM_STRANGERS = 3  # of another world, and as many mirrored ones
POINTS_OF_ROOM = 400_000  # of the scan, as a station a room gives them
SPHERE_WIDTH = 1024  # [px]


class MadeGroup(NamedTuple):
    """Photos of a person in a room, with the sphere at the first of their poses."""

    case: str
    photos: list[Trial]
    sphere: Trial


def make_group_world(kind: str, seed: int) -> worlds.World:
    """Make the world of a kind."""
    if kind in ALIKE_KINDS:
        return worlds.World(seed, make_alike(kind, seed, CHANGED_THINGS))
    rng = np.random.default_rng([seed, 60])
    made = worlds.make_world(seed, rng.uniform(SMALLEST, LARGEST), int(rng.integers(1, 4)))
    return remove_texture(made) if kind == "plain" else made


def make_groups(
    kind: str, seed: int, has_strangers: bool, workers: Workers
) -> tuple[worlds.World, list[MadeGroup]]:
    """Make a world of a kind, with a turn and a burst in one of its rooms."""
    world = make_group_world(kind, seed)
    other = make_group_world(kind, seed + 100_000)
    rng = np.random.default_rng([seed, 61, KINDS.index(kind)])
    made = []
    for name, draw in (("turn", handheld.draw_pan), ("burst", handheld.draw_burst)):
        room = world.rooms[rng.integers(len(world.rooms))]
        poses = draw(room, rng)
        photos = take_group(room, poses, rng, workers)
        case = f"{kind}, {name}"
        if has_strangers:
            case = f"{case} with strangers"
            elsewhere = take_group(other.rooms[0], draw(other.rooms[0], rng)[:NUM_STRANGERS], rng, workers)
            mirrored = [photos[k]._replace(rgb=photos[k].rgb[:, ::-1].copy()) for k in range(NUM_STRANGERS)]
            photos += [trial._replace(true_pose=None) for trial in (*elsewhere, *mirrored)]
        rgb = worlds.photograph(room, poses[0], SPHERE_WIDTH, workers)
        made.append(MadeGroup(case, photos, Trial(f"{case}, sphere", rgb, poses[0])))
    return world, made


def take_group(
    room: layout.Room, poses: Sequence[Pose], rng: np.random.Generator, workers: Workers
) -> list[Trial]:
    """Take the photos of a phone at several poses."""
    camera = camera_of_fov("pinhole", *GROUP_PHOTO)
    photos = handheld.take_photos(room, poses, camera, rng, workers)
    return [Trial("", rgb, pose, focal_px=camera.focal[0]) for rgb, pose in zip(photos, poses, strict=True)]


def localize_each(
    scan_map: ScanMap, photos: Sequence[Trial], workers: Workers
) -> Iterator[tuple[str, Trial, Result]]:
    """Yield the results of photos alone and together."""
    settings = CoarseToFineSettings()
    watch = Stopwatch()
    shots = [Shot(read_panorama(Photo(trial.rgb, focal_px=trial.focal_px)), settings) for trial in photos]
    for k, shot in enumerate(shots):
        alone = localize(scan_map, shot.panorama, settings, Means(settings.effort, workers, watch))
        yield "alone", photos[k], alone
    for trial, one in zip(photos, localize_group(scan_map, shots, workers, watch), strict=True):
        yield "together", trial, one.result


def add_arguments(parser: ArgumentParser) -> None:
    """Add all options."""
    option(parser, "--seeds FIRST END", "seeds of worlds, END excluded", required=True)
    option(parser, "--kinds KIND ...", "kinds of worlds", choices=KINDS, default=list(KINDS))
    option(parser, "--strangers", "put photos of another world, and mirrored ones, among them")
    option(parser, "--out FILE", "write a JSON line per trial", required=True)
    option(parser, "--threads N", "number of threads", default=num_cores())


def run(arguments: Arguments) -> int:
    """Localize the photos of every group, write their lines, print the table."""
    workers = Workers(arguments.threads)
    with arguments.out.open("w") as file:
        log = TrialLog(file)
        for kind in arguments.kinds:
            for seed in range(*arguments.seeds):
                world, groups = make_groups(kind, seed, arguments.strangers, workers)
                points, colors, _ = worlds.scan_world(world, POINTS_OF_ROOM * len(world.rooms), workers)
                scan_map = prepare_map(stream_of_arrays(points.astype(np.float64), colors), workers)
                for case, photos, sphere in groups:
                    scene = f"{kind} {seed}"
                    log.add(scene, sphere, localize_trial(scan_map, sphere, workers))
                    for way, trial, found in localize_each(scan_map, photos, workers):
                        strange = "" if trial.true_pose else ", strangers"
                        log.add(scene, trial._replace(case=f"{case}{strange}, {way}"), found)
                    arguments.note(f"{scene}: {case}")
    return 1 if print_cases("case", log.rows) else 0
