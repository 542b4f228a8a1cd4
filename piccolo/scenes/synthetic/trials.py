"""Seeded trials of a result's status: queries with a true pose, and queries that have none."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...geometry.pose import Pose
from ...geometry.rotations import Gravity
from ...runtime.threads import Workers
from .room import REPEATED_KINDS, make_repeated
from .world import VARIANTS, World, blur, make_query, make_world, random_size, scan_world

WIDTH = 1024  # of the panoramas [px]
POINTS_PER_ROOM = 120_000
SPARSE_FRACTION = 0.05
WALL_DEPTH = 0.15  # [m]
BLUR = 0.02  # of the width: blurred beyond recognition
Image = NDArray[np.uint8]
Points = tuple[NDArray[np.floating], NDArray[np.uint8]]


class Trial(NamedTuple):
    """One panorama to be localized in a cloud."""

    case: str
    rgb: Image  # (H, W, 3)
    true_pose: Pose | None  # None where the panorama was not taken in this cloud
    gravity: Gravity = "auto"


def without_scene(rgb: Image, rng: np.random.Generator) -> Iterator[tuple[str, Image]]:
    """Images of the same size that show no place."""
    yield "black", np.zeros_like(rgb)
    yield "white", np.full_like(rgb, 255)
    yield "noise", rng.integers(0, 256, rgb.shape, dtype=np.uint8)
    yield "cloudy", fractal_noise(rgb.shape, rng)
    yield "blurred", np.asarray(blur(rgb.astype(float), BLUR * rgb.shape[1]), np.uint8)


def fractal_noise(shape: tuple[int, ...], rng: np.random.Generator) -> Image:
    """Smooth noise of several scales (H, W, 3), with the contrast of a photo."""
    total = np.zeros(shape)
    for scale in (0.004, 0.015, 0.06):
        noise = blur(rng.normal(size=shape), scale * shape[1])
        total += noise / noise.std()
    return np.asarray((127.0 + 40.0 * total).clip(0, 255), np.uint8)


def upside_down(trial: Trial) -> Trial:
    """The same panorama held by a camera turned over, searched as if it were upright."""
    rgb = np.ascontiguousarray(trial.rgb[::-1, ::-1])
    if trial.true_pose is None:
        return Trial("upside down", rgb, None, "known")
    turn = np.diag([1.0, -1.0, -1.0])  # half a turn about the image centre: columns and rows run backwards
    pose = Pose(turn @ trial.true_pose.R_cam_from_world, trial.true_pose.center_world)
    return Trial("upside down", rgb, pose, "known")


def room_trials(seed: int, workers: Workers) -> Iterator[tuple[Points, list[Trial]]]:
    """Clouds of one to three rooms, whole, thinned and cut down, each with its trials."""
    rng = np.random.default_rng([seed, 50])
    size = random_size(rng)
    world = make_world(seed, size, int(rng.integers(1, 4)))
    other = make_world(seed + 100_000, size, 1)  # of the same shape
    cloud = scan_world(world, POINTS_PER_ROOM * len(world.rooms), workers)[:2]
    right = [_trial(world, variant, variant, workers) for variant in VARIANTS]
    trials = [*right, Trial("elsewhere", _trial(other, "", "clean", workers).rgb, None)]
    trials.append(Trial("elsewhere", _trial(other, "", "photo", workers).rgb, None))
    for name, rgb in without_scene(right[0].rgb, rng):  # a blurred panorama keeps its true pose
        trials.append(Trial(name, rgb, right[0].true_pose if name == "blurred" else None))
    trials.append(upside_down(right[0]))
    yield cloud, trials
    sparse = np.sort(rng.choice(len(cloud[0]), int(SPARSE_FRACTION * len(cloud[0])), replace=False))
    thin = Trial("sparse", right[0].rgb, right[0].true_pose), Trial("sparse, elsewhere", trials[4].rgb, None)
    yield (cloud[0][sparse], cloud[1][sparse]), list(thin)
    wall = np.flatnonzero(cloud[0][:, 0] < cloud[0][:, 0].min() + WALL_DEPTH)
    yield (cloud[0][wall], cloud[1][wall]), [Trial("one wall", r.rgb, r.true_pose) for r in right[:2]]


def repeated_trials(seed: int, workers: Workers) -> Iterator[tuple[Points, list[Trial]]]:
    """A place that looks the same from several positions, of each kind."""
    rng = np.random.default_rng([seed, 51])
    for kind in REPEATED_KINDS:
        world = World(seed, make_repeated(kind, seed, random_size(rng)))
        cloud = scan_world(world, POINTS_PER_ROOM * len(world.rooms), workers)[:2]
        yield cloud, [_trial(world, kind, "clean", workers, index) for index in range(2)]


def _trial(world: World, case: str, variant: str, workers: Workers, index: int = 0) -> Trial:
    query = make_query(world, index, variant, WIDTH, workers)
    return Trial(case, query.rgb, query.pose)
