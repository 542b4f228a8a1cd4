"""MPO, the Multi-modal Panoramic 3D Outdoor dataset (Jung et al., IROS 2016), as in the PICCOLO paper.

All its true poses are the identity, so each scan and its camera get a random rigid transform.
"""

import math
import zlib
from collections import defaultdict
from pathlib import Path

import numpy as np

from ...errors import InputError
from ...geometry.pose import Pose, yaw_rotation
from .files import is_cloud
from .model import CloudPart, ConvertOptions, PosedPanorama, RigidTransform, SceneList, SceneSpec

NAME = "mpo"
PICTURES = (".jpg", ".jpeg", ".png", ".tif", ".tiff")
MAX_SHIFT = 3.0  # [m] along each axis
VARIANT = "moved"


def list_scenes(options: ConvertOptions) -> SceneList:
    """Each scan with a picture of the same name beside it."""
    clouds: dict[Path, list[Path]] = defaultdict(list)
    for path in sorted(options.folder.rglob("*")):
        if is_cloud(path):
            clouds[path.with_suffix("")].append(path)
    specs = []
    for stem, found in clouds.items():
        pictures = [path for suffix in PICTURES if (path := stem.with_name(stem.name + suffix)).exists()]
        specs += [_scene_spec(options, stem, found, picture) for picture in pictures[:1]]
    if not specs:
        raise InputError(f"{options.folder}: found no cloud with a picture of the same name")
    num_alone = len(clouds) - len(specs)
    return SceneList(tuple(specs), (f"{num_alone} clouds without a picture",) if num_alone else ())


def _scene_spec(options: ConvertOptions, stem: Path, clouds: list[Path], picture: Path) -> SceneSpec:
    if len(clouds) > 1:
        raise InputError(f"{clouds[0]}: found {clouds[1].name} beside it; leave one cloud of this name")
    name = stem.relative_to(options.folder).as_posix()
    pose = Pose(np.eye(3), np.zeros(3))  # the camera is at the scanner's origin, its axes are the scanner's
    panorama = PosedPanorama(picture.name, {picture.name: picture}, VARIANT, pose)
    transform = random_transform(options.seed, name)
    source = {"dataset": NAME, "seed": options.seed}
    return SceneSpec(name, (CloudPart(clouds[0]),), lambda: [panorama], transform, source=source)


def random_transform(seed: int, name: str) -> RigidTransform:
    """A turn about z by U(0, pi) and a shift by U(0, 3) m along each axis, by seed and name."""
    rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
    return RigidTransform(yaw_rotation(rng.uniform(0.0, math.pi)).T, rng.uniform(0.0, MAX_SHIFT, 3))
