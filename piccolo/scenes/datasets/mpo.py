"""MPO, the Multi-modal Panoramic 3D Outdoor dataset (Jung et al., IROS 2016), as in the PICCOLO paper.

All its true poses are the identity, so each scan is moved at random, and its camera with it.
"""

import math
import zlib
from collections import defaultdict
from pathlib import Path

import numpy as np

from ...errors import InputError
from ...geometry.pose import Pose, yaw_rotation
from .clouds import is_cloud
from .model import CloudPart, Listing, Motion, Plan, Request, Shot

NAME = "mpo"
PICTURES = (".jpg", ".jpeg", ".png", ".tif", ".tiff")
MAX_SHIFT = 3.0  # [m] along each axis
VARIANT = "moved"


def listing(request: Request) -> Listing:
    """Each scan with a picture of the same name beside it."""
    clouds: dict[Path, list[Path]] = defaultdict(list)
    for path in sorted(request.folder.rglob("*")):
        if is_cloud(path):
            clouds[path.with_suffix("")].append(path)
    pictures = {stem: _picture_of(stem) for stem in clouds}
    plans = [_plan(request, stem, clouds[stem], picture) for stem, picture in pictures.items() if picture]
    if not plans:
        raise InputError(f"{request.folder}: found no cloud with a picture of the same name, wanted some")
    num_alone = len(clouds) - len(plans)
    return Listing(tuple(plans), (f"{num_alone} clouds without a picture",) if num_alone else ())


def _picture_of(stem: Path) -> Path | None:
    found = [path for suffix in PICTURES if (path := stem.with_name(stem.name + suffix)).exists()]
    return found[0] if found else None


def _plan(request: Request, stem: Path, clouds: list[Path], picture: Path) -> Plan:
    if len(clouds) > 1:
        raise InputError(f"{clouds[0]}: found {clouds[1].name} beside it, wanted one cloud of this name")
    name = stem.relative_to(request.folder).as_posix()

    def read_shots() -> list[Shot]:
        # The camera is at the scanner's origin, its axes are the scanner's.
        return [Shot(picture.name, {picture.name: picture}, VARIANT, Pose(np.eye(3), np.zeros(3)))]

    source = {"dataset": NAME, "seed": request.seed}
    return Plan(name, (CloudPart(clouds[0]),), read_shots, random_motion(request.seed, name), source=source)


def random_motion(seed: int, name: str) -> Motion:
    """A turn about z by U(0, pi) and a shift by U(0, 3) m along each axis, by seed and name."""
    rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
    return Motion(yaw_rotation(rng.uniform(0.0, math.pi)).T, rng.uniform(0.0, MAX_SHIFT, 3))
