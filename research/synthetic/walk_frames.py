"""Pictures by a camera that is carried through a building: blur, people in the way, useless frames."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

import numpy as np

from piccolo import InputError, Pose
from piccolo.system.arrays import Bytes
from piccolo.system.errors import import_optional
from piccolo.system.files.atomic import replacing_by_library
from piccolo.system.jobs.threads import Workers

from .layout import CHECKS, PLAIN, STRIPES, Room, RoomBuilder, join_rooms
from .office import Office
from .walking import Walk
from .world import change_light, make_query, make_world, photograph

BAD_KINDS = ("black", "mirrored", "elsewhere")
WALK_VARIANTS = ("clean", "photo")
SHUTTER = 1.0 / 30.0  # how long it is open [s]
NUM_EXPOSURES = 8  # poses meanwhile
DISTANCES = (1.5, 6.0)  # of people before and after the camera [s]
ASIDE = 0.25  # of people off the way, at most [m]
LEAST_DISTANCE = 0.8  # of a person from the camera [m]
MAX_PEOPLE = 20
LAMP = np.array([0.0, 0.5, 2.4])  # above a person's feet [m]
BODY = ((0.4, (0.2, 0.32, 0.8)), (1.12, (0.26, 0.46, 0.64)), (1.6, (0.2, 0.18, 0.26)))  # height, size [m]


@dataclass(frozen=True)
class WalkOptions:
    """Settings of a walk."""

    rate: float = 2.0  # frames a second
    variant: str = "clean"  # one of WALK_VARIANTS
    num_people: int = 0  # who walk the same way
    is_blurred: bool = False  # by the camera's motion while the shutter is open
    bad_fraction: float = 0.0  # of frames that show nothing of the place
    width: int = 1024  # [px]

    def __post_init__(self) -> None:
        """Refuse what means nothing."""
        if self.variant not in WALK_VARIANTS:
            wanted = " or ".join(WALK_VARIANTS)
            raise InputError(f"`variants`: found {self.variant}, wanted {wanted} in a walk")
        if not 0.1 <= self.rate <= 120.0:
            raise InputError(f"`frame_rate`: found {self.rate}, wanted 0.1 to 120 per second")
        if not 0.0 <= self.bad_fraction <= 1.0:
            raise InputError(f"`bad_frames`: found {self.bad_fraction}, wanted 0 to 1")
        if not 0 <= self.num_people <= MAX_PEOPLE:
            raise InputError(f"`people`: found {self.num_people}, wanted 0 to {MAX_PEOPLE}")


class Frame(NamedTuple):
    """One picture of a walk."""

    rgb: Bytes  # (H, W, 3)
    pose: Pose  # of the camera, whatever the picture shows
    time: float  # [s] from the walk's beginning
    kind: str  # the walk's variant, or one of BAD_KINDS


def frames_of(
    office: Office, walk: Walk, options: WalkOptions, number: int, workers: Workers
) -> Iterator[Frame]:
    """Yield the frames of walk `number` in a building, one after another."""
    seed = office.world.seed
    times = [k / options.rate for k in range(walk.num_frames(options.rate))]
    rng = np.random.default_rng([seed, 54, number])
    kinds = _kinds(len(times), options, rng)
    people = [Person(walk, rng) for _ in range(options.num_people)]
    elsewhere = make_world(seed + 1_000_003, office.world.rooms[0].size, num_rooms=8)
    for k, (time, kind) in enumerate(zip(times, kinds, strict=True)):
        pose = walk.pose(time)
        if kind == "black":
            rgb = rng.integers(0, 4, (options.width // 2, options.width, 3), np.uint8)
        elif kind == "elsewhere":
            rgb = make_query(elsewhere, k, "clean", options.width, workers).rgb
        else:
            present = [part for person in people if (part := person.at(time)) is not None]
            meanwhile = _exposures(walk, time) if options.is_blurred else []
            room = join_rooms([office.world.rooms[0], *present])
            rgb = photograph(room, pose, options.width, workers, meanwhile)
        if options.variant == "photo" and kind != "black":
            light = np.random.default_rng([seed, 55, number])  # one for the whole walk
            rgb = change_light(rgb, light, np.random.default_rng([seed, 56, number, k]))
        yield Frame(rgb[:, ::-1].copy() if kind == "mirrored" else rgb, pose, time, kind)


def _kinds(count: int, options: WalkOptions, rng: np.random.Generator) -> list[str]:
    """Draw the kind of each frame: a fraction is bad, with about as many of each bad kind."""
    kinds = [options.variant] * count
    for k, frame in enumerate(rng.permutation(count)[: round(options.bad_fraction * count)]):
        kinds[frame] = BAD_KINDS[k % len(BAD_KINDS)]
    return kinds


def _exposures(walk: Walk, time: float) -> list[Pose]:
    """Return the poses of the camera while the shutter is open."""
    moments = time + SHUTTER * (np.arange(NUM_EXPOSURES) + 0.5 - NUM_EXPOSURES / 2) / NUM_EXPOSURES
    return [walk.pose(float(moment)) for moment in np.clip(moments, 0.0, walk.duration)]


class Person:
    """Somebody who walks a camera's way, some seconds before or after it."""

    def __init__(self, walk: Walk, rng: np.random.Generator) -> None:
        self.walk = walk
        self.delay = float(rng.uniform(*DISTANCES) * rng.choice([-1.0, 1.0]))
        self.aside = float(rng.uniform(-ASIDE, ASIDE))
        self.rng = rng
        b = RoomBuilder(rng, np.zeros(3))
        self.paints = [b.paint(p, 0.1, 0.9) for p in ((PLAIN,), (STRIPES, CHECKS, PLAIN), (PLAIN,))]

    def at(self, time: float) -> Room | None:
        """Return the boxes of legs, trunk and head, and their lamp; None if the person is not there."""
        moment = time - self.delay
        if not 0.0 <= moment <= self.walk.duration:
            return None
        yaw = self.walk.yaw(moment)
        feet = self.walk.foot(moment) + self.aside * np.array([-np.sin(yaw), np.cos(yaw), 0.0])
        if np.linalg.norm(feet[:2] - self.walk.foot(time)[:2]) < LEAST_DISTANCE:
            return None
        b = RoomBuilder(self.rng, feet)
        for (z, size), paint in zip(BODY, self.paints, strict=True):
            b.put([0.0, 0.0, z], size, paint, yaw)
        return b.room(np.zeros(3), feet + LAMP)


@contextmanager
def writing_video(path: Path, rate: float, size: tuple[int, int]) -> Iterator[Callable[[Bytes], None]]:
    """Yield a function that takes frames (H, W, 3) of an MP4 (H.264), `rate` a second; W and H are even."""
    av = import_optional("video", "av", "video")
    with replacing_by_library(path) as file, av.open(str(file), "w", format="mp4") as container:
        stream = container.add_stream("libx264", Fraction(rate).limit_denominator(1001))
        stream.width, stream.height = size
        stream.pix_fmt = "yuv420p"
        stream.options = {"crf": "18"}  # nothing to be seen is lost

        def add(rgb: Bytes) -> None:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(rgb, format="rgb24")))

        yield add
        container.mux(stream.encode())
