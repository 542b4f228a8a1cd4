"""Scenes with one thing changed: fewer points, the cloud turned, the camera upside down.

Each writes what differs into a folder and leaves the scene itself as it is.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from zlib import crc32

import cv2
import numpy as np
from numpy.typing import NDArray

from ...cloud import read_cloud
from ...cloud.ply_writer import vertex_rows, write_ply
from ...errors import InputError
from ...files.atomic import write_atomically
from ...geometry.pose import Array, Pose
from ...geometry.rotations import random_rotation
from ...panorama import read_panorama
from ..datasets.model import RigidTransform
from ..scene import CLOUD_NAME, Query, Scene

# A transformed copy of a scene; the folder, which is there, is for its files alone.
SceneTransform = Callable[[Scene, Path], Scene]
UPSIDE_DOWN = np.diag([1.0, -1.0, -1.0])  # half a turn about the view axis


def identity(scene: Scene, folder: Path) -> Scene:
    """The scene itself."""
    return scene


def with_fraction(fraction: float) -> SceneTransform:
    """A transform that keeps a fraction of the points, drawn at random."""
    return lambda scene, folder: _thinned(scene, folder, lambda count: max(1, round(fraction * count)))


def with_count(num_points: int) -> SceneTransform:
    """A transform that keeps a number of points, drawn at random; InputError where there are fewer."""
    return lambda scene, folder: _thinned(scene, folder, lambda _: num_points)


def _thinned(scene: Scene, folder: Path, num_kept: Callable[[int], int]) -> Scene:
    cloud = read_cloud(scene.cloud)
    count = num_kept(len(cloud.points))
    if count > len(cloud.points):
        raise InputError(f"{scene.cloud}: found {len(cloud.points)} points, wanted at least {count}")
    chosen = np.sort(_rng(scene).choice(len(cloud.points), count, replace=False))
    points = cloud.points[chosen].astype(np.float64) + cloud.origin_world
    return replace(scene, cloud=_written(folder, points, cloud.colors[chosen]))


def with_random_rotation(scene: Scene, folder: Path) -> Scene:
    """The cloud turned by a rotation drawn from all of SO(3), the true poses with it."""
    cloud = read_cloud(scene.cloud)
    turn = RigidTransform(random_rotation(_rng(scene)), np.zeros(3))
    points = turn.of_points(cloud.points.astype(np.float64) + cloud.origin_world)
    queries = tuple(replace(query, pose=turn.of_pose(query.pose)) for query in scene.queries)
    return replace(scene, cloud=_written(folder, points, cloud.colors), queries=queries)


def _written(folder: Path, points: Array, colors: NDArray[np.uint8]) -> Path:
    path = folder / CLOUD_NAME
    write_ply(path, vertex_rows(points, colors))
    return path


def flipped(scene: Scene, folder: Path) -> Scene:
    """Every picture taken with the camera upside down: turned by half a turn about the view axis.

    They are PNG under the scene's own names, so that results of both can be compared by name.
    """
    names = [scene.name_of(query) for query in scene.queries]
    depth = max(Path(name).parts.count("..") for name in names) if names else 0
    inner = folder.joinpath(*["in"] * depth)  # so deep that no name leads out of the folder
    inner.mkdir(parents=True, exist_ok=True)
    queries = []
    for name, query in zip(names, scene.queries, strict=True):
        image = inner / name
        image.parent.mkdir(parents=True, exist_ok=True)
        panorama = read_panorama(query.image)
        bgra = cv2.cvtColor(panorama.rgb, cv2.COLOR_RGB2BGRA)
        bgra[..., 3] = np.where(panorama.is_valid, 255, 0)  # transparent where it shows nothing
        write_atomically(image, bytes(cv2.imencode(".png", bgra[::-1, ::-1])[1]))
        pose = Pose(UPSIDE_DOWN @ query.pose.R_cam_from_world, query.pose.center_world)
        queries.append(Query(image, query.variant, pose))
    return Scene(scene.name, inner, scene.cloud, tuple(queries))


def _rng(scene: Scene) -> np.random.Generator:
    """A generator seeded by the scene's name: the same draw whatever else is run."""
    return np.random.default_rng([crc32(scene.name.encode()), len(scene.queries)])
