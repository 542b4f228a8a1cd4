"""Checks that the poses of a scene fit its panoramas, and finds the convention that fits better if not."""

from collections import Counter
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from piccolo.arrays import Array
from piccolo.cloud.octree import build_octree
from piccolo.cloud.settings import IN_COLORS
from piccolo.cloud.soa import pack_points
from piccolo.cloud.stream import open_cloud
from piccolo.confidence.occlusion import VIEW_WIDTH, measure_agreement
from piccolo.geometry.pose import Pose
from piccolo.jobs.threads import Workers
from piccolo.panorama import read_panorama
from piccolo.panorama.model import shrink

from ..scene import Query, Scene
from .model import AXES

MIN_SCORE = 0.1  # other views of the same place may have as much, but seldom more than the right one
AS_GIVEN = "as given"


class ConventionCheck(NamedTuple):
    """The fit of a panorama to the cloud at its pose, by this convention and by others."""

    image: str  # as queries.json has it
    score: float  # of the pose as given, [-1, 1], by confidence/occlusion.py
    best_score: float  # the highest score by any convention
    best: str  # that convention in words


class Check(NamedTuple):
    """The checks of some panoramas of a scene."""

    panoramas: tuple[ConventionCheck, ...]

    @property
    def is_passed(self) -> bool:
        """True if more than half of them fit, and no other convention fits better."""
        num_good = sum(check.best == AS_GIVEN and check.score >= MIN_SCORE for check in self.panoramas)
        return 2 * num_good > len(self.panoramas)

    @property
    def advice(self) -> str:
        """A line for the user that says what is wrong."""
        (best, count), *_ = Counter(check.best for check in self.panoramas).most_common()
        scores = ", ".join(f"{check.score:.2f}" for check in self.panoramas)
        text = f"the poses don't fit the panoramas: scores {scores}, wanted {MIN_SCORE} or more"
        if best != AS_GIVEN and 2 * count > len(self.panoramas):
            found = np.median([check.best_score for check in self.panoramas if check.best == best])
            return f"{text}; {found:.2f} if {best}"
        return f"{text}; no other axes fit better"


def check_scene(scene: Scene, num_queries: int, workers: Workers) -> Check:
    """Score some panoramas of a scene, evenly spaced over the list, against its cloud at their poses."""
    voxels = open_cloud([scene.cloud], IN_COLORS, workers.show).voxels(np.eye(3))
    nodes = build_octree(voxels).level(0.08)  # [m] enough for views of a few degrees
    points = pack_points(nodes[:, :3], np.round(nodes[:, 3:] * 255.0).astype(np.uint8))

    def check(query: Query) -> ConventionCheck:
        pose = Pose(query.pose.R_cam_from_world, query.pose.center_world - voxels.origin)
        panorama = shrink(read_panorama(query.image), VIEW_WIDTH)  # once for all variants
        variants = convention_variants(pose, voxels.origin)
        scores = {
            words: measure_agreement(points, panorama, variant).score for words, variant in variants.items()
        }
        best = max(scores, key=lambda words: scores[words])
        return ConventionCheck(scene.name_of(query), scores[AS_GIVEN], scores[best], best)

    count = len(scene.queries)
    spaced = np.linspace(0, count - 1, min(num_queries, count)).round().astype(int)  # evenly
    chosen = [scene.queries[k] for k in spaced]
    return Check(tuple(workers.map(check, chosen, f"{scene.name}: check")))


def convention_variants(pose: Pose, origin: Array) -> dict[str, Pose]:
    """Return the pose under each convention that may have been mixed up, by its name.

    The camera's axes in any order and sign; and the rotation, or the whole transform, of a camera with known
    axes inverted. Positions are less `origin`.
    """
    inverted = {"": pose}
    for axes, other_from_cam in AXES.items():
        R = other_from_cam @ pose.R_cam_from_world
        R_inverted = other_from_cam.T @ R.T
        position = -R @ (pose.center_world + origin) - origin
        inverted[f"the rotation in {axes} axes is inverted"] = Pose(R_inverted, pose.center_world)
        inverted[f"the transform in {axes} axes is inverted"] = Pose(R_inverted, position)
    poses = {}
    for words, variant in inverted.items():
        for turn in axis_rotations():
            is_same = np.array_equal(turn, np.eye(3))
            named = "" if is_same else f"the camera's x, y, z are {describe_axes(turn)}"
            text = " and ".join(filter(None, (words, named))) or AS_GIVEN
            poses[text] = Pose(turn @ variant.R_cam_from_world, variant.center_world)
    return poses


def axis_rotations() -> Array:
    """Return the 24 rotations (24, 3, 3) that take axes to axes, one of them the identity."""
    return np.asarray(np.round(Rotation.create_group("O").as_matrix()))


def describe_axes(turn: Array) -> str:
    """Return a rotation of axis_rotations in words: the given axis, with its sign, in each row."""
    return ", ".join(f"{'-' if row.sum() < 0 else ''}{'xyz'[int(np.abs(row).argmax())]}" for row in turn)
