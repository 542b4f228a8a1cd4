"""Measure the status on seeded queries with and without an answer: how often each is called localized."""

import json
from argparse import ArgumentParser
from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from typing import TextIO

import cv2
import numpy as np

from piccolo import CoarseToFineSettings, Photo
from piccolo.cli.command import Arguments, option
from piccolo.cloud.stream import open_cloud, stream_of_arrays
from piccolo.geometry.pose import Pose
from piccolo.judge.result import Result
from piccolo.localization.means import Means
from piccolo.localization.run import localize
from piccolo.photo.panorama import read_panorama
from piccolo.problem.accuracy import PAPER_ACCURACY, Accuracy
from piccolo.problem.method import METHOD, Method
from piccolo.scan_map.scan_map import ScanMap, prepare_map
from piccolo.system.arrays import Bytes, Values
from piccolo.system.jobs.threads import Stopwatch, Workers, num_cores

from ..scene import Scene, document_of_pose, read_scene
from ..synthetic import world as worlds
from ..synthetic.layout import PLAIN
from ..synthetic.outdoors import PLACE_KINDS
from ..synthetic.places import ALIKE_KINDS, CHANGED, make_alike
from .calibration import Case, print_cases
from .claims import Points, Trial, claim_trials
from .outdoor_trials import outdoor_trials

EPILOG = """\
example:
  python tools/benchmark.py confidence --seeds 0 0 --scenes BENCH/house BENCH/hospital --out bench.jsonl

A seed makes rooms, and places that look the same from several positions. Scenes are folders with cloud.ply,
queries.json and images; each panorama is localized in each cloud. With --photos, photos of 55 to 90 degrees
are cut out of the panoramas, processed as by other cameras, and localized in their place. With --outdoors,
seeds make yards, streets and church fronts instead, each scanned in two ways, with photos and panoramas
taken there and photos of another. A false answer is a pose with the status localized that is farther off than
--accuracy or 5 degrees. Writes the trials as JSON lines for tools/benchmark.py calibration, and prints a
table.
"""
WIDTH = 1024  # of the panoramas [px]
POINTS_PER_ROOM = 120_000
PHOTO_FOVS_DEG = 55.0, 90.0  # of phone photos
POINT_NOISE = 0.05  # [m]
JPEG_QUALITY = 10
FOVS_DEG = (90.0, 120.0, 65.0)  # of narrow photos


def damage_trial(trial: Trial, other: Bytes, rng: np.random.Generator) -> Iterator[Trial]:
    """Yield a panorama after each kind of damage, which is then its case; pieces of `other` hide it."""
    rgb = trial.rgb
    height, width = rgb.shape[:2]

    def change(case: str, rgb: Values) -> Trial:
        return trial._replace(case=case, rgb=np.asarray(rgb, np.uint8))

    for fraction in (0.2, 0.4, 0.6):
        yield change(f"{fraction:.0%} hidden by objects", worlds.occlude(rgb, other, fraction, rng))
    lit = worlds.light_unevenly(rgb, 2.0, rng)
    yield change("uneven light (2 stops), 30% hidden", worlds.occlude(lit, other, 0.3, rng))
    yield change("night", worlds.take_at_night(rgb, rng))
    noisy = worlds.compress(rgb + rng.normal(0.0, 15.0, rgb.shape), JPEG_QUALITY)
    yield change(f"noise and JPEG quality {JPEG_QUALITY}", noisy)
    yield change("blurred by 1 deg (one sigma)", worlds.blur(rgb, width / 360.0))
    yield change("256 x 128 pixels", cv2.resize(rgb, (256, 128), interpolation=cv2.INTER_AREA))
    for fov_deg in FOVS_DEG:
        is_outside = worlds.mask_outside_field(width, fov_deg, float(rng.uniform(0.0, 2.0 * np.pi)))
        yield trial._replace(case=f"masked outside of {fov_deg:g} deg", is_masked=is_outside)
    is_behind = np.broadcast_to(np.abs(np.arange(width) - width // 2) >= width // 4, (height, width))
    yield trial._replace(case="half of the sphere masked", is_masked=is_behind)
    yield change("mirrored", np.ascontiguousarray(rgb[:, ::-1]))._replace(true_pose=None)


def make_sceneless(trial: Trial, rng: np.random.Generator) -> Iterator[Trial]:
    """Yield images that show no place, and the photo blurred, which keeps its true pose."""
    rgb = trial.rgb
    yield Trial("black", np.zeros_like(rgb), None)
    yield Trial("white", np.full_like(rgb, 255), None)
    yield Trial("noise", rng.integers(0, 256, rgb.shape, dtype=np.uint8), None)
    yield Trial("cloudy", worlds.draw_fractal_noise(rgb.shape, rng), None)
    yield Trial("blurred", worlds.blur(rgb, 0.02 * rgb.shape[1]).astype(np.uint8), trial.true_pose)


def turn_over(trial: Trial) -> Trial:
    """Turn the camera over, and search for it as if it were upright."""
    pose = trial.true_pose
    if pose is not None:
        pose = Pose(worlds.UPSIDE_DOWN @ pose.R_cam_from_world, pose.center_world)
    return Trial("upside down", np.ascontiguousarray(trial.rgb[::-1, ::-1]), pose, "known")


def thin_points(points: Points, rng: np.random.Generator) -> Points:
    """Draw one of twenty points, in order."""
    count = len(points[0])
    chosen = np.sort(rng.choice(count, int(0.05 * count), replace=False))
    return points[0][chosen], points[1][chosen]


def add_point_noise(points: Points, rng: np.random.Generator) -> Points:
    """Move each point by a Gaussian."""
    return points[0] + rng.normal(0.0, POINT_NOISE, points[0].shape), points[1]


DAMAGED_SCANS: dict[str, Callable[[Points, np.random.Generator], Points]] = {
    "scan thinned to 5%": thin_points,
    "scan with 5 cm noise": add_point_noise,
}


def remove_texture(world: worlds.World) -> worlds.World:
    """Return the rooms with every surface in one colour."""
    plain = [(room, room.materials.copy()) for room in world.rooms]
    for _, materials in plain:
        materials[:, 0] = PLAIN
    return world._replace(rooms=tuple(room._replace(materials=m) for room, m in plain))


def room_trials(seed: int, workers: Workers) -> Iterator[tuple[Points, list[Trial]]]:
    """Yield clouds of one to three rooms, whole, thinned and cut down, each with its trials."""
    rng = np.random.default_rng([seed, 50])
    size = rng.uniform([3.5, 3.0, 2.3], [9.0, 7.0, 3.4])  # [m] from a box room to a hall
    world = worlds.make_world(seed, size, int(rng.integers(1, 4)))
    other = worlds.make_world(seed + 100_000, size, 1)  # of the same shape
    if seed % 3 == 2:  # a third of the rooms
        world = remove_texture(world)
        other = remove_texture(other)
    cloud = worlds.scan_world(world, POINTS_PER_ROOM * len(world.rooms), workers)[:2]
    right = [_make_trial(world, variant, variant, workers) for variant in worlds.VARIANTS]
    elsewhere = [_make_trial(other, "elsewhere", variant, workers) for variant in ("clean", "photo")]
    trials = [*right, *(trial._replace(true_pose=None) for trial in elsewhere)]
    trials += make_sceneless(right[0], rng)
    trials.append(turn_over(right[0]))
    another = _make_trial(other, "another place", "clean", workers, 1)._replace(true_pose=None)
    for trial in (right[0], another):
        damaged = damage_trial(trial, _make_trial(other, "", "clean", workers, 2).rgb, rng)
        trials += [one._replace(case=f"{trial.case}, {one.case}") for one in damaged]
    yield cloud, trials
    thin = [right[0]._replace(case="sparse"), trials[4]._replace(case="sparse, elsewhere")]
    yield thin_points(cloud, rng), thin
    wall = np.flatnonzero(cloud[0][:, 0] < cloud[0][:, 0].min() + 0.15)
    yield (cloud[0][wall], cloud[1][wall]), [r._replace(case="one wall") for r in right[:2]]


def alike_trials(seed: int, kinds: Sequence[str], workers: Workers) -> Iterator[tuple[Points, list[Trial]]]:
    """Yield places alike to a degree: photos of them, one half hidden, and one of another such place."""
    for kind in kinds:
        rng = np.random.default_rng([seed, 53, ALIKE_KINDS.index(kind)])
        elsewhere = worlds.World(seed, make_alike(kind, seed + 100_000, 0.2))
        for changed in CHANGED:
            world = worlds.World(seed, make_alike(kind, seed, changed))
            cloud = worlds.scan_world(world, POINTS_PER_ROOM * max(3, len(world.rooms)), workers)[:2]
            case = f"{kind}, {changed:.0%} changed"
            trials = [_make_trial(world, case, "clean", workers, index) for index in range(4)]
            another = _make_trial(elsewhere, f"{kind}, elsewhere", "clean", workers, 1)
            another = another._replace(true_pose=None)
            hidden = worlds.occlude(trials[0].rgb, another.rgb, 0.3, rng)
            trials += [trials[0]._replace(case=f"{case}, hidden 30%", rgb=hidden), another]
            yield cloud, trials


def _make_trial(world: worlds.World, case: str, variant: str, workers: Workers, index: int = 0) -> Trial:
    query = worlds.make_query(world, index, variant, WIDTH, workers)
    return Trial(case, query.rgb, query.pose)


def scene_trials(scene: Scene, others: Sequence[Scene]) -> Iterator[tuple[Points, list[Trial]]]:
    """Try every panorama of every scene in one scene's cloud; its own also spoilt, and in a thinned cloud."""
    cloud = open_cloud([scene.cloud]).read()
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
    cloud = open_cloud([scene.cloud]).read()
    rng = np.random.default_rng([len(scene.queries), 54])
    trials = []
    for one in (scene, *others):
        for query in (query for query in one.queries for _ in range(number)):
            fov_deg = rng.uniform(*PHOTO_FOVS_DEG)
            photo = worlds.cut_photo(read_panorama(query.image).rgb, query.pose, fov_deg, rng)
            case = f"{fov_deg // 10:.0f}0 deg" if one is scene else "elsewhere"
            true_pose = photo.pose if one is scene else None
            rgb = worlds.change_sensor(photo.rgb, rng, rng)
            trials.append(Trial(case, rgb, true_pose, focal_px=photo.focal_px))
    yield (cloud.points + cloud.origin_world, cloud.colors), trials


def seed_trials(arguments: Arguments, seed: int, workers: Workers) -> Iterator[tuple[Points, list[Trial]]]:
    """Return the clouds that a seed makes, each with its trials."""
    if arguments.outdoors:
        return outdoor_trials(seed, arguments.outdoors, workers)
    rooms = room_trials(seed, workers)
    if not arguments.claims:
        return chain(rooms, alike_trials(seed, arguments.kinds, workers))
    points, trials = next(rooms)
    return claim_trials(points, trials[:2], np.random.default_rng([seed, 55]))


def all_trials(arguments: Arguments, workers: Workers) -> Iterator[tuple[str, Points, list[Trial]]]:
    """Yield the name of a scene, its points, its trials."""
    for seed in range(*arguments.seeds):
        for points, trials in seed_trials(arguments, seed, workers):
            yield f"seed {seed}", points, trials
    scenes = [read_scene(folder) for folder in arguments.scenes]
    for scene in scenes:
        others = [other for other in scenes if other is not scene]
        number = arguments.photos
        if arguments.claims:
            points, own = next(scene_trials(scene, ()))
            spheres = [trial for trial in own if trial.case == "clean"][:2]
            for changed, trials in claim_trials(points, spheres, np.random.default_rng(55)):
                yield scene.name, changed, trials
            continue
        of_scene = photo_trials(scene, others, number) if number else scene_trials(scene, others)
        for points, trials in of_scene:
            yield scene.name, points, trials


def localize_trial(
    scan_map: ScanMap,
    trial: Trial,
    workers: Workers,
    method: Method = METHOD,
    accuracy: Accuracy = PAPER_ACCURACY,
) -> Result:
    """Localize the photo of a trial."""
    settings = CoarseToFineSettings(gravity=trial.gravity, method=method, accuracy=accuracy)
    photo = Photo(trial.rgb, focal_px=trial.focal_px, camera=trial.calibration, mask=trial.is_masked)
    return localize(scan_map, read_panorama(photo), settings, Means(settings.effort, workers, Stopwatch()))


def trial_line(scene: str, trial: Trial, found: Result) -> dict[str, object]:
    """Return what tools/benchmark.py calibration reads of a trial."""
    poses = [found.best_pose, *(a.pose for a in found.alternatives)] if found.best_pose else []
    others = (alternative.probability for alternative in found.alternatives)
    probabilities = [found.confidence, *others, found.probability_none]
    return {
        "case": trial.case,
        "scene": scene,
        "truth": trial.true_pose and document_of_pose(trial.true_pose),
        "status": found.status,
        "probabilities": probabilities,
        "sound": float(found.belief.sound_places[0]) if poses else 0.0,
        "poses": list(map(document_of_pose, poses)),
        "standings": [list(standing) for standing in found.standings],
        "covariance": found.covariance and found.covariance.matrix.tolist(),
        "std_of_fit": found.std_of_fit,
    }


class TrialLog:
    """Trials that are written as they come, with their cases for the table."""

    def __init__(self, file: TextIO, accuracy: Accuracy = PAPER_ACCURACY) -> None:
        self.file = file
        self.nearness = accuracy.nearness  # of right poses
        self.rows: list[Case] = []

    def add(self, scene: str, trial: Trial, found: Result) -> Case:
        """Write the line of a trial."""
        truth = trial.true_pose
        is_right = bool(truth and found.best_pose and self.nearness.holds(found.best_pose, truth))
        self.rows.append((trial.case, found.status, is_right))
        self.file.write(json.dumps(trial_line(scene, trial, found)) + "\n")
        self.file.flush()
        return self.rows[-1]


def add_arguments(parser: ArgumentParser) -> None:
    """Add all options."""
    option(parser, "--seeds FIRST END", "seeds of synthetic rooms, END excluded", required=True)
    text = "kinds of places that look alike"
    option(parser, "--kinds KIND ...", text, choices=ALIKE_KINDS, default=list(ALIKE_KINDS))
    option(parser, "--scenes FOLDER ...", "scenes with true poses", default=[])
    option(parser, "--photos N", "cut so many photos out of each panorama of the scenes", default=0)
    option(parser, "--claims", "try photos and scans that say something wrong of their own geometry instead")
    text = "try photos and panoramas of places outdoors instead, scanned by stations, a car, stereo pictures"
    option(parser, "--outdoors KIND ...", text, choices=PLACE_KINDS, default=[])
    option(parser, "--accuracy METRES", "how exact a pose must be", type=float, default=PAPER_ACCURACY.metres)
    option(parser, "--ignore-colors", "localize by the shape of the scans alone")
    option(parser, "--out FILE", "write a JSON line per trial", required=True)
    option(parser, "--threads N", "number of threads", default=num_cores())


def run(arguments: Arguments) -> int:
    """Localize every trial, write its line, print the table."""
    workers = Workers(arguments.threads)
    with arguments.out.open("w") as file:
        accuracy = Accuracy(arguments.accuracy)
        log = TrialLog(file, accuracy)
        for scene, (points, colors), trials in all_trials(arguments, workers):
            cloud = stream_of_arrays(points.astype(np.float64), None if arguments.ignore_colors else colors)
            scan_map = prepare_map(cloud, workers)
            for trial in trials:
                found = localize_trial(scan_map, trial, workers, accuracy=accuracy)
                case, status, is_right = log.add(scene, trial, found)
                arguments.note(f"{scene}: {case}: {status}, {'right' if is_right else 'wrong'}")
    return 1 if print_cases("case", log.rows) else 0
