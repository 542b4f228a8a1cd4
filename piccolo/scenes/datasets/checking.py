"""Do the poses of a scene fit its pictures? A wrong convention shows at once: another one fits better."""

import itertools
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...cloud import open_cloud
from ...cloud.octree import build_octree
from ...cloud.soa import PackedPoints, pack_points
from ...confidence.score import VIEW_WIDTH, agreement_at
from ...geometry.pose import Array, Pose
from ...panorama import Panorama, read_panorama
from ...panorama.resize import shrink
from ...runtime.threads import Show, Workers, unseen
from ..scene import Query, Scene
from .poses import AXES

VOXEL_SIZE = 0.08  # [m] enough for views of a few degrees
MIN_SCORE = 0.1  # other views of the same place may have as much, but seldom more than the right one
AS_GIVEN = "as given"


@dataclass(frozen=True)
class Fit:
    """How a panorama fits the cloud at its pose."""

    image: str  # as queries.json has it
    score: float  # of piccolo/verify.py at the pose, [-1, 1]
    best_score: float  # of all the ways in which the pose might be meant
    best: str  # that way in words

    @property
    def is_good(self) -> bool:
        """True if the pose fits, and no other convention fits better."""
        return self.best == AS_GIVEN and self.score >= MIN_SCORE


@dataclass(frozen=True)
class Check:
    """How some panoramas of a scene fit."""

    fits: tuple[Fit, ...]

    @property
    def is_passed(self) -> bool:
        """True if more than half of them fit."""
        return 2 * sum(fit.is_good for fit in self.fits) > len(self.fits)

    @property
    def advice(self) -> str:
        """What is wrong, for the user."""
        (best, count), *_ = Counter(fit.best for fit in self.fits).most_common()
        scores = ", ".join(f"{fit.score:.2f}" for fit in self.fits)
        text = f"the poses don't fit the pictures: scores {scores}, wanted {MIN_SCORE} and more"
        if best != AS_GIVEN and 2 * count > len(self.fits):
            found = np.median([fit.best_score for fit in self.fits if fit.best == best])
            return f"{text}; {found:.2f} if {best}"
        return f"{text}; no other axes fit better"


def check_scene(scene: Scene, num_queries: int, workers: Workers, show: Show = unseen) -> Check:
    """Hold some panoramas of a scene, spread over the list, against its cloud at their poses."""
    voxels = open_cloud([scene.cloud], show=show).voxels(np.eye(3))
    nodes = build_octree(voxels).level(VOXEL_SIZE)
    points = pack_points(nodes[:, :3], np.round(nodes[:, 3:] * 255.0).astype(np.uint8))
    chosen = spread(scene.queries, num_queries)

    def fit(query: Query) -> Fit:
        pose = Pose(query.pose.R_cam_from_world, query.pose.center_world - voxels.origin)
        panorama = shrink(read_panorama(query.image), VIEW_WIDTH)  # once for all readings
        return _fit(scene.name_of(query), points, panorama, pose, voxels.origin)

    return Check(tuple(workers.each(fit, chosen, f"{scene.name}: check")))


def spread(queries: Sequence[Query], count: int) -> list[Query]:
    """Up to `count` of the queries, evenly spaced."""
    indices = np.linspace(0, len(queries) - 1, min(count, len(queries))).round().astype(int)
    return [queries[k] for k in indices]


def _fit(image: str, points: PackedPoints, panorama: Panorama, pose: Pose, origin: Array) -> Fit:
    scores = {
        words: agreement_at(points, panorama, other).score for words, other in readings(pose, origin).items()
    }
    best = max(scores, key=lambda words: scores[words])
    return Fit(image, scores[AS_GIVEN], scores[best], best)


def readings(pose: Pose, origin: Array) -> dict[str, Pose]:
    """The pose by each way in which it might be meant; positions are less `origin` (3,).

    The camera's axes in any order and sign; and the rotation, or the whole transform, of a camera with known
    axes taken the other way.
    """
    ways = {"": pose}
    for axes, other_from_cam in AXES.items():
        R = other_from_cam @ pose.R_cam_from_world
        turned = other_from_cam.T @ R.T
        position = -R @ (pose.center_world + origin) - origin
        ways[f"the rotation in {axes} axes is taken the other way"] = Pose(turned, pose.center_world)
        ways[f"the transform in {axes} axes is taken the other way"] = Pose(turned, position)
    poses = {}
    for words, way in ways.items():
        for turn in axis_turns():
            named = "" if np.array_equal(turn, np.eye(3)) else f"the camera's x, y, z are {axes_named(turn)}"
            text = " and ".join(part for part in (words, named) if part) or AS_GIVEN
            poses[text] = Pose(turn @ way.R_cam_from_world, way.center_world)
    return poses


def axis_turns() -> list[Array]:
    """The 24 rotations (3, 3) that take axes to axes, the identity among them."""
    turns = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            turn = np.diag(signs) @ np.eye(3)[list(order)]
            if np.linalg.det(turn) > 0.0:
                turns.append(turn)
    return turns


def axes_named(turn: Array) -> str:
    """A rotation by axis_turns in words: what its rows are of the axes given."""
    return ", ".join(f"{'-' if row.sum() < 0 else ''}{'xyz'[int(np.abs(row).argmax())]}" for row in turn)
