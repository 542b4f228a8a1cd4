"""Measure the status on seeded queries with and without an answer: how often each is called localized."""

import argparse
import json
import math
from collections.abc import Iterator, Sequence
from itertools import chain
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from piccolo.cli.command import option
from piccolo.cli.errors import print_note
from piccolo.cloud import read_cloud
from piccolo.cloud.stream import stream_of_arrays
from piccolo.confidence.localization import Localization
from piccolo.geometry.pose import Pose, is_correct
from piccolo.geometry.rotations import Gravity
from piccolo.geometry.sphere import pixel_rays, solid_angles
from piccolo.jobs.stopwatch import Stopwatch
from piccolo.jobs.threads import Workers, num_cores
from piccolo.localization.localize import localize
from piccolo.localization.settings import CoarseToFineSettings
from piccolo.panorama import read_panorama
from piccolo.photo import Photo
from piccolo.scan_map.scan_map import prepare_map
from piccolo.scene import Scene, read_scene

from ..experiments.reproduce_paper import UPSIDE_DOWN
from ..synthetic.room import PLAIN
from ..synthetic.world import VARIANTS, World, blur, make_query, make_world, scan_world
from .calibration import Case, print_cases
from .photos import Image, change_sensor, cut_photo
from .places import ALIKE_KINDS, CHANGED, REPEATED_KINDS, make_alike, make_repeated

EPILOG = """\
example:
  python tools/benchmark.py confidence --seeds 0 0 --scenes BENCH/house BENCH/hospital --out bench.jsonl

A seed makes rooms, and places that look the same from several positions. Scenes are folders with cloud.ply,
queries.json and images; each panorama is localized in each cloud. With --photos, photos of 55 to 90 degrees
are cut out of the panoramas, processed as by other cameras, and localized in their place. A false answer is
a pose with the status localized that is more than 0.1 m or 5 degrees off. Writes the trials as JSON lines
for tools/benchmark.py calibration, and prints a table.
"""
WIDTH = 1024  # of the panoramas [px]
POINTS_PER_ROOM = 120_000
LEAST_RADIUS = math.radians(8.0)  # of an occluder
MOST_RADIUS = math.radians(28.0)
ASPECT = 0.75  # height by width of a narrow photo
PHOTO_FOVS_DEG = 55.0, 90.0  # of phone photos
Points = tuple[NDArray[np.floating], NDArray[np.uint8]]


class Trial(NamedTuple):
    """One panorama to be localized in a cloud."""

    case: str
    rgb: Image  # (H, W, 3)
    true_pose: Pose | None  # None where the panorama was not taken in this cloud
    gravity: Gravity = "auto"
    is_masked: NDArray[np.bool_] | None = None  # (H, W) what the photo does not show
    focal_px: float | None = None  # of a pinhole photo; None for a sphere


def occlude(rgb: Image, other: Image, fraction: float, rng: np.random.Generator) -> Image:
    """Hide a fraction of the sphere of a photo (H, W, 3) behind round pieces of another."""
    height, width = rgb.shape[:2]
    rays = pixel_rays(width)
    areas = solid_angles(width)[:, None] / (4.0 * math.pi)
    is_hidden = np.zeros((height, width), np.bool_)
    shown = rgb.copy()
    while float((is_hidden * areas).sum()) < fraction:
        direction = rng.normal(size=3) * [1.0, 1.0, 0.4]  # people and things stand around the camera
        radius = rng.uniform(LEAST_RADIUS, MOST_RADIUS)
        is_new = (rays @ (direction / np.linalg.norm(direction)) > math.cos(radius)) & ~is_hidden
        moved = np.roll(other, rng.integers(width), axis=1)[:: int(rng.choice([-1, 1]))]
        shown[is_new] = moved[is_new]
        is_hidden |= is_new
    return shown


def light_unevenly(rgb: Image, stops: float, rng: np.random.Generator) -> Image:
    """Put a photo (H, W, 3) under patches of light that differ by some stops."""
    noise = blur(rng.normal(size=rgb.shape[:2])[..., None], 0.08 * rgb.shape[1])
    gain = 2.0 ** (0.5 * stops * noise / noise.std())
    linear = (rgb / 255.0) ** 2.2 * gain
    return np.asarray(255.0 * linear.clip(0.0, 1.0) ** (1.0 / 2.2), np.uint8)


def mask_outside_field(width: int, fov_deg: float, yaw: float) -> NDArray[np.bool_]:
    """Return the mask (H, W) of a sphere outside a level pinhole photo that looks along azimuth `yaw`."""
    x, y, z = np.moveaxis(pixel_rays(width), -1, 0)
    forward = math.cos(yaw) * x + math.sin(yaw) * y
    left = math.cos(yaw) * y - math.sin(yaw) * x
    reach = math.tan(math.radians(fov_deg / 2.0)) * forward
    return np.asarray((forward <= 0.0) | (np.abs(left) > reach) | (np.abs(z) > ASPECT * reach))


def remove_texture(world: World) -> World:
    """Return the rooms with every surface in one colour."""
    plain = [(room, room.materials.copy()) for room in world.rooms]
    for _, materials in plain:
        materials[:, 0] = PLAIN
    return world._replace(rooms=tuple(room._replace(materials=m) for room, m in plain))


def damage_trial(trial: Trial, other: Image, rng: np.random.Generator) -> Iterator[Trial]:
    """Yield a photo half hidden, in uneven light, narrow, and mirrored."""
    for fraction in (0.2, 0.4, 0.6):
        hidden = occlude(trial.rgb, other, fraction, rng)
        yield trial._replace(case=f"{trial.case}, hidden {fraction:.0%}", rgb=hidden)
    lit = occlude(light_unevenly(trial.rgb, 2.0, rng), other, 0.3, rng)
    yield trial._replace(case=f"{trial.case}, uneven light, hidden 30%", rgb=lit)
    for fov_deg in (120.0, 90.0, 65.0):
        outside = mask_outside_field(trial.rgb.shape[1], fov_deg, float(rng.uniform(0.0, 2.0 * np.pi)))
        for gravity in ("known", "unknown"):
            case = f"{trial.case}, {fov_deg:.0f} deg, gravity {gravity}"
            yield Trial(case, trial.rgb, trial.true_pose, gravity, outside)
    mirrored = np.ascontiguousarray(trial.rgb[:, ::-1])
    yield Trial(f"{trial.case}, mirrored", mirrored, None, "unknown")


def make_sceneless(trial: Trial, rng: np.random.Generator) -> Iterator[Trial]:
    """Yield images that show no place, and the photo blurred, which keeps its true pose."""
    rgb = trial.rgb
    yield Trial("black", np.zeros_like(rgb), None)
    yield Trial("white", np.full_like(rgb, 255), None)
    yield Trial("noise", rng.integers(0, 256, rgb.shape, dtype=np.uint8), None)
    yield Trial("cloudy", draw_fractal_noise(rgb.shape, rng), None)
    blurred = np.asarray(blur(rgb.astype(float), 0.02 * rgb.shape[1]), np.uint8)
    yield Trial("blurred", blurred, trial.true_pose)


def draw_fractal_noise(shape: tuple[int, ...], rng: np.random.Generator) -> Image:
    """Draw smooth noise of several scales (H, W, 3), with the contrast of a photo."""
    total = np.zeros(shape)
    for scale in (0.004, 0.015, 0.06):
        noise = blur(rng.normal(size=shape), scale * shape[1])
        total += noise / noise.std()
    return np.asarray((127.0 + 40.0 * total).clip(0, 255), np.uint8)


def turn_over(trial: Trial) -> Trial:
    """Turn the camera over, and search for it as if it were upright."""
    pose = trial.true_pose
    if pose is not None:
        pose = Pose(UPSIDE_DOWN @ pose.R_cam_from_world, pose.center_world)
    return Trial("upside down", np.ascontiguousarray(trial.rgb[::-1, ::-1]), pose, "known")


def thin_points(points: Points, rng: np.random.Generator) -> Points:
    """Draw one of twenty points, in order."""
    count = len(points[0])
    chosen = np.sort(rng.choice(count, int(0.05 * count), replace=False))
    return points[0][chosen], points[1][chosen]


def draw_size(rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw the size (3,) of a room [m], from a box room to a hall."""
    return rng.uniform([3.5, 3.0, 2.3], [9.0, 7.0, 3.4])


def room_trials(seed: int, workers: Workers) -> Iterator[tuple[Points, list[Trial]]]:
    """Yield clouds of one to three rooms, whole, thinned and cut down, each with its trials."""
    rng = np.random.default_rng([seed, 50])
    size = draw_size(rng)
    world = make_world(seed, size, int(rng.integers(1, 4)))
    other = make_world(seed + 100_000, size, 1)  # of the same shape
    if seed % 3 == 2:  # a third of the rooms
        world = remove_texture(world)
        other = remove_texture(other)
    cloud = scan_world(world, POINTS_PER_ROOM * len(world.rooms), workers)[:2]
    right = [_make_trial(world, variant, variant, workers) for variant in VARIANTS]
    elsewhere = [_make_trial(other, "elsewhere", variant, workers) for variant in ("clean", "photo")]
    trials = [*right, *(trial._replace(true_pose=None) for trial in elsewhere)]
    trials += make_sceneless(right[0], rng)
    trials.append(turn_over(right[0]))
    another = _make_trial(other, "another place", "clean", workers, 1)._replace(true_pose=None)
    for trial in (right[0], another):
        trials += damage_trial(trial, _make_trial(other, "", "clean", workers, 2).rgb, rng)
    yield cloud, trials
    thin = [right[0]._replace(case="sparse"), trials[4]._replace(case="sparse, elsewhere")]
    yield thin_points(cloud, rng), thin
    wall = np.flatnonzero(cloud[0][:, 0] < cloud[0][:, 0].min() + 0.15)
    yield (cloud[0][wall], cloud[1][wall]), [r._replace(case="one wall") for r in right[:2]]


def repeat_trials(seed: int, workers: Workers) -> Iterator[tuple[Points, list[Trial]]]:
    """Yield a place of each kind that looks the same from several positions, with its trials."""
    rng = np.random.default_rng([seed, 51])
    for kind in REPEATED_KINDS:
        world = World(seed, make_repeated(kind, seed, draw_size(rng)))
        cloud = scan_world(world, POINTS_PER_ROOM * len(world.rooms), workers)[:2]
        yield cloud, [_make_trial(world, kind, "clean", workers, index) for index in range(2)]


def alike_trials(seed: int, kinds: Sequence[str], workers: Workers) -> Iterator[tuple[Points, list[Trial]]]:
    """Yield places alike to a degree: photos of them, one half hidden, and one of another such place."""
    for kind in kinds:
        rng = np.random.default_rng([seed, 53, ALIKE_KINDS.index(kind)])
        elsewhere = World(seed, make_alike(kind, seed + 100_000, 0.2))
        for changed in CHANGED:
            world = World(seed, make_alike(kind, seed, changed))
            cloud = scan_world(world, POINTS_PER_ROOM * max(3, len(world.rooms)), workers)[:2]
            case = f"{kind}, {changed:.0%} changed"
            trials = [_make_trial(world, case, "clean", workers, index) for index in range(4)]
            another = _make_trial(elsewhere, f"{kind}, elsewhere", "clean", workers, 1)
            another = another._replace(true_pose=None)
            hidden = occlude(trials[0].rgb, another.rgb, 0.3, rng)
            trials += [trials[0]._replace(case=f"{case}, hidden 30%", rgb=hidden), another]
            yield cloud, trials


def _make_trial(world: World, case: str, variant: str, workers: Workers, index: int = 0) -> Trial:
    query = make_query(world, index, variant, WIDTH, workers)
    return Trial(case, query.rgb, query.pose)


def scene_trials(scene: Scene, others: Sequence[Scene]) -> Iterator[tuple[Points, list[Trial]]]:
    """Try every panorama of every scene in one scene's cloud; its own also spoilt, and in a thinned cloud."""
    cloud = read_cloud(scene.cloud)
    rng = np.random.default_rng([len(scene.queries), 52])
    own = [Trial(query.variant, read_panorama(query.image).rgb, query.pose) for query in scene.queries]
    upright = [trial for trial in own if trial.case == "clean"]
    spoilt = [spoilt for trial in upright[:2] for spoilt in make_sceneless(trial, rng)]
    foreign = [query.image for other in others for query in other.queries]
    elsewhere = [Trial("elsewhere", read_panorama(image).rgb, None) for image in foreign]
    points = (cloud.points + cloud.origin_world, cloud.colors)
    yield points, [*own, *elsewhere, *spoilt, *map(turn_over, upright)]
    yield thin_points(points, rng), [trial._replace(case="sparse") for trial in upright]


def photo_trials(scene: Scene, others: Sequence[Scene], number: int) -> Iterator[tuple[Points, list[Trial]]]:
    """Cut `number` photos out of each panorama of every scene, and try them in one scene's cloud."""
    cloud = read_cloud(scene.cloud)
    rng = np.random.default_rng([len(scene.queries), 54])
    trials = []
    for one in (scene, *others):
        for query in (query for query in one.queries for _ in range(number)):
            fov_deg = rng.uniform(*PHOTO_FOVS_DEG)
            photo = cut_photo(read_panorama(query.image).rgb, query.pose, fov_deg, rng)
            case = f"{fov_deg // 10:.0f}0 deg" if one is scene else "elsewhere"
            true_pose = photo.pose if one is scene else None
            rgb = change_sensor(photo.rgb, rng)
            trials.append(Trial(case, rgb, true_pose, focal_px=photo.focal_px))
    yield (cloud.points + cloud.origin_world, cloud.colors), trials


def all_trials(arguments: argparse.Namespace, workers: Workers) -> Iterator[tuple[str, Points, list[Trial]]]:
    """Yield the name of a scene, its points, its trials."""
    for seed in range(*arguments.seeds):
        alike = alike_trials(seed, arguments.kinds, workers)
        for points, trials in chain(room_trials(seed, workers), repeat_trials(seed, workers), alike):
            yield f"seed {seed}", points, trials
    scenes = [read_scene(folder) for folder in arguments.scenes]
    for scene in scenes:
        others = [other for other in scenes if other is not scene]
        number = arguments.photos
        of_scene = photo_trials(scene, others, number) if number else scene_trials(scene, others)
        for points, trials in of_scene:
            yield scene.name, points, trials


def trial_line(scene: str, trial: Trial, found: Localization) -> dict[str, object]:
    """Return what tools/benchmark.py calibration reads of a trial."""
    poses = [found.pose, *(a.pose for a in found.alternatives)] if found.pose else []
    others = (alternative.probability for alternative in found.alternatives)
    probabilities = [found.confidence, *others, found.probability_none]
    return {
        "case": trial.case,
        "scene": scene,
        "truth": trial.true_pose and pose_json(trial.true_pose),
        "status": found.status,
        "probabilities": probabilities,
        "poses": [pose_json(pose) for pose in poses],
        "standings": [list(standing) for standing in found.standings],
        "covariance": found.covariance and found.covariance.matrix.tolist(),
        "std_of_fit": found.std_of_fit,
    }


def pose_json(pose: Pose) -> dict[str, object]:
    """Return a pose as JSON has it."""
    return {name: array.tolist() for name, array in vars(pose).items()}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add all options."""
    option(parser, "--seeds FIRST END", "seeds of synthetic rooms, END excluded", required=True)
    text = "kinds of places that look alike"
    option(parser, "--kinds KIND ...", text, choices=ALIKE_KINDS, default=list(ALIKE_KINDS))
    option(parser, "--scenes FOLDER ...", "scenes with true poses", default=[])
    option(parser, "--photos N", "cut so many photos out of each panorama of the scenes", default=0)
    option(parser, "--ignore-colors", "localize by the shape of the scans alone")
    option(parser, "--out FILE", "write a JSON line per trial", required=True)
    option(parser, "--threads N", "number of threads", default=num_cores())


def run(arguments: argparse.Namespace) -> int:
    """Localize every trial, write its line, print the table."""
    workers = Workers(arguments.threads)
    rows: list[Case] = []
    with arguments.out.open("w") as file:
        for scene, (points, colors), trials in all_trials(arguments, workers):
            cloud = stream_of_arrays(points.astype(np.float64), None if arguments.ignore_colors else colors)
            scan_map = prepare_map(cloud, workers, has_features=False)
            for trial in trials:
                settings = CoarseToFineSettings(gravity=trial.gravity)
                photo = read_panorama(Photo(trial.rgb, focal_px=trial.focal_px, mask=trial.is_masked))
                found = localize(scan_map, photo, settings, workers, Stopwatch())
                truth = trial.true_pose
                ok = truth is not None and is_correct(found.pose, truth)
                rows.append((trial.case, found.status, ok))
                file.write(json.dumps(trial_line(scene, trial, found)) + "\n")
                file.flush()
                print_note(arguments, f"{scene}: {trial.case}: {found.status}, {'right' if ok else 'wrong'}")
    return 1 if print_cases("case", rows) else 0
