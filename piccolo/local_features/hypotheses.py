"""Pose hypotheses from matches, each ranked by the number of matches that agree with it.

A single match gives a rough pose: the size of its keypoint gives the distance to the point, the direction and
the tangent give the rotation. It is about right if the camera is near the pose at which the map's picture was
drawn. The rough poses with which most other matches agree, in direction, size and tangent, are refined by P3P
within RANSAC (Fischler and Bolles, 1981) on these matches.
"""

import math
from functools import partial
from typing import NamedTuple

import numpy as np

from ..geometry.levenberg_marquardt import COUNT_SUM, GRADIENT, LOSS, MATRIX, levenberg_marquardt
from ..geometry.nearness import MATCHED, VOTED, non_maximum_suppression
from ..geometry.pose import Pose
from ..geometry.robust import inline_geman_mcclure
from ..geometry.vectors import cross, dot, minus, rotate, row
from ..system.arrays import Array, Array32, Int64s
from ..system.jobs.threads import Workers
from ..system.kernels.jit import Scalar, inline_kernel, kernel
from .matching import Matches
from .p3p import p3p

COS_ROUGH = math.cos(math.radians(20.0))  # a match with a smaller error agrees roughly
COS_EXACT = math.cos(math.radians(1.0))  # a match with a smaller error is an inlier
COS_TANGENT = math.cos(math.radians(40.0))  # largest error of the tangent of a match that agrees
SIZE_RATIO = 1.7  # largest ratio of a keypoint's predicted size to its own, or the reverse
LEAST_ANGLE = np.float32(1e-6)  # [rad] a smaller keypoint counts as this
MAX_VOTERS = 1200  # single matches that propose a rough pose, at most
VOTERS_A_TASK = 64  # of these, as many as a thread takes at a time
NUM_CLUSTERS = 48  # rough poses that are refined, at most
FAIR_PART = 0.2  # poses with less than this fraction of the best one's matches are dropped
NUM_TRIPLES = 200  # samples of three matches, for each rough pose
LEAST_MATCHES = 4  # a pose with which fewer agree is dropped
REFINEMENTS = 8  # steps of a refinement, at most
REFINE_SCALE = math.radians(0.5)  # [rad] of the loss
REFINE_TOLERANCE = 1e-7  # [rad + m] a shorter step ends the descent


class MatchedPose(NamedTuple):
    """A pose, and the number of the photo's features that agree with it."""

    pose: Pose
    num_matches: int


@kernel
def angular_equations(
    problem: tuple[Array, Array, float], R_cam_from_map: Array, center_map: Array, sums: Array
) -> None:
    """Write the sums (29,) of the normal equations of angular errors at a pose.

    `problem` holds bearings (N, 3) in the camera's frame, points (N, 3) [m] in the map's, and the scale [rad]
    of Geman and McClure's loss: residuals much larger than this hardly count.
    The residual is u - b, with u the unit ray to the point and b the bearing. At distance r,
    du = w x u - (I - u u^T) d / r. Sums over its rows are products of u and b: no Jacobian is stored.
    """
    bearings, points, scale = problem
    inverse_scale2 = 1.0 / (scale * scale)
    sums[:] = 0.0
    for n in range(len(points)):
        offset = minus(row(points, n), center_map)
        inverse = 1.0 / max(math.sqrt(dot(offset, offset)), 1e-9)
        x, y, z = rotate(R_cam_from_map, offset)
        x *= inverse
        y *= inverse
        z *= inverse
        bx, by, bz = row(bearings, n)
        square = (x - bx) ** 2 + (y - by) ** 2 + (z - bz) ** 2
        loss, w = inline_geman_mcclure(square, inverse_scale2)
        sums[LOSS] += loss
        sums[COUNT_SUM] += 1.0
        v = w * inverse
        along = x * bx + y * by + z * bz
        gradient = (
            w * (z * by - y * bz), w * (x * bz - z * bx), w * (y * bx - x * by),
            v * (bx - along * x), v * (by - along * y), v * (bz - along * z),
        )  # fmt: skip
        q = v * inverse
        matrix = (
            w * (1.0 - x * x), -w * x * y, -w * x * z, 0.0, v * z, -v * y,
            w * (1.0 - y * y), -w * y * z, -v * z, 0.0, v * x,
            w * (1.0 - z * z), v * y, -v * x, 0.0,
            q * (1.0 - x * x), -q * x * y, -q * x * z, q * (1.0 - y * y), -q * y * z, q * (1.0 - z * z),
        )  # fmt: skip
        for m in range(6):
            sums[GRADIENT + m] += gradient[m]
        for m in range(21):
            sums[MATRIX + m] += matrix[m]


descend_matches = kernel(levenberg_marquardt(angular_equations))


@inline_kernel
def agreement(m: Matches, j: int, R: Array, t: Array, cos_rough: float) -> Scalar:
    """Return the cosine of a match's error at a pose; -1 if it does not agree.

    The error is the angle between the match's ray and the direction of its point. A match agrees if this
    cosine is at least `cos_rough`, and if size and tangent of the keypoint are about as predicted.
    """
    ray = rotate(R, minus(row(m.points, j), t))
    length = math.sqrt(dot(ray, ray))
    cosine = dot(ray, row(m.rays, j)) / max(length, 1e-9)
    if cosine < cos_rough:
        return -1.0
    ratio = m.sizes[j] / (length * m.angles[j])
    if not 1.0 / SIZE_RATIO < ratio < SIZE_RATIO:
        return -1.0
    return cosine if dot(rotate(R, row(m.tangents, j)), row(m.ray_tangents, j)) > COS_TANGENT else -1.0


@inline_kernel
def write_turned(m: Matches, j: int, R: Array) -> None:
    """Write R_cam_from_map (3, 3), which turns a match's direction and tangent to its ray and ray tangent."""
    cam = (m.rays[j], m.ray_tangents[j], cross(m.rays[j], m.ray_tangents[j]))
    world = (m.directions[j], m.tangents[j], cross(m.directions[j], m.tangents[j]))
    for i in range(3):
        for h in range(3):
            R[i, h] = cam[0][i] * world[0][h] + cam[1][i] * world[1][h] + cam[2][i] * world[2][h]


@inline_kernel
def count_roughly_agreeing(m: Matches, R: Array, t: Array) -> int:
    """Count the photo's features that have a match which roughly agrees with a pose."""
    count = 0
    last = -1
    for i in range(len(m.query)):
        if m.query[i] != last and agreement(m, i, R, t, COS_ROUGH) > 0.0:
            count += 1
            last = m.query[i]
    return count


@kernel
def rough_poses(matches: Matches, voters: Int64s, rotations: Array, centers: Array, votes: Int64s) -> None:
    """Write the rough pose, rotation (n, 3, 3) and centre (n, 3) [m], that each of some matches gives.

    `voters` (n,) are the indices of these matches; `votes` (n,) gets the number of the photo's features that
    roughly agree with each pose.
    """
    m = matches
    for k in range(len(voters)):
        j = voters[k]
        distance = m.sizes[j] / max(m.angles[j], LEAST_ANGLE)
        for i in range(3):
            centers[k, i] = m.points[j, i] - distance * m.directions[j, i]
        write_turned(m, j, rotations[k])
        votes[k] = count_roughly_agreeing(m, rotations[k], centers[k])


@kernel
def count_exact(
    matches: Matches,
    members: Int64s,
    rotations: Array,
    centers: Array,
    counts: Int64s,
) -> None:
    """Write for each pose (n, 3, 3), (n, 3) [m] the number (n,) of the photo's features that are inliers.

    Only the matches at the indices `members` are tested, within the angle of COS_EXACT.
    """
    for n in range(len(counts)):
        count = 0
        last = -1
        for k in range(len(members)):
            j = members[k]
            is_other = matches.query[j] != last
            if is_other and agreement(matches, j, rotations[n], centers[n], COS_EXACT) > 0.0:
                count += 1
                last = matches.query[j]
        counts[n] = count


@kernel
def sample_poses(columns: Array32, rotations: Array, centers: Array) -> int:
    """Write the poses (n, 3, 3), (n, 3) [m] of samples of three matches; return their number n.

    A sample has up to four poses, so n is at most 4 NUM_TRIPLES. `columns` (6, m) are the matches' points [m]
    and rays. The samples are the same in every run.
    """
    num_poses = 0
    bearings = np.empty((3, 3))
    points = np.empty((3, 3))
    state = np.uint32(12345)
    for _ in range(NUM_TRIPLES):
        for i in range(3):
            state = np.uint32(state * np.uint32(1664525) + np.uint32(1013904223))
            drawn = np.int64(state >> np.uint32(8)) % columns.shape[1]
            for c in range(3):
                points[i, c] = columns[c, drawn]
                bearings[i, c] = columns[3 + c, drawn]
        num_poses += p3p(bearings, points, rotations[num_poses:], centers[num_poses:])
    return num_poses


@kernel
def list_members(
    matches: Matches, R_cam_from_map: Array, center_map: Array, cos_rough: float, members: Int64s
) -> int:
    """Write the indices of the matches that agree with a pose, as in `agreement`; return their number."""
    count = 0
    for j in range(len(matches.query)):
        if agreement(matches, j, R_cam_from_map, center_map, cos_rough) > 0.0:
            members[count] = j
            count += 1
    return count


def find_inliers(matches: Matches, pose: Pose, cos_rough: float) -> Int64s:
    """Return the indices (n,) of the matches that agree with a pose in the map, as in `agreement`."""
    members = np.empty(len(matches.query), np.int64)
    return members[: list_members(matches, pose.R_cam_from_world, pose.center_world, cos_rough, members)]


def count_inliers(matches: Matches, pose: Pose, cos_agree: float = COS_EXACT) -> int:
    """Count the photo's features that agree with a pose in the map, within the angle of a cosine."""
    return len(np.unique(matches.query[find_inliers(matches, pose, cos_agree)]))


def exact_pose(matches: Matches, rough: Pose) -> MatchedPose | None:
    """Return the pose near a rough one with which most matches agree, refined; None if too few agree."""
    members = find_inliers(matches, rough, COS_ROUGH)
    if len(members) < LEAST_MATCHES:
        return None
    columns = np.ascontiguousarray(np.hstack([matches.points[members], matches.rays[members]]).T)
    rotations = np.empty((4 * NUM_TRIPLES, 3, 3))
    centers = np.empty((4 * NUM_TRIPLES, 3))
    counts = np.empty(sample_poses(columns, rotations, centers), np.int64)
    count_exact(matches, members, rotations, centers, counts)
    if max(counts, default=0) < LEAST_MATCHES:
        return None
    best = np.argmax(counts)
    pose = Pose(rotations[best], centers[best])
    for _ in range(2):
        pose = refine_on(matches, pose, REFINEMENTS)
    return MatchedPose(pose, count_inliers(matches, pose))


def refine_on(matches: Matches, pose: Pose, num_steps: int) -> Pose:
    """Refine a pose on its inliers, the matches that agree with it within a degree."""
    members = find_inliers(matches, pose, COS_EXACT)
    rays = matches.rays[members].astype(np.float64)
    points = matches.points[members].astype(np.float64)
    R = pose.R_cam_from_world.copy()
    t = pose.center_world.copy()
    descend_matches((rays, points, REFINE_SCALE), num_steps, REFINE_TOLERANCE, R, t)
    return Pose(R, t)


def propose_poses(matches: Matches, count: int, workers: Workers) -> list[MatchedPose]:
    """Return at most `count` poses in the map, those with which most matches agree, best first.

    Poses with less than FAIR_PART of the best one's matches are left out.
    """
    voters = np.arange(0, len(matches.query), 1 + len(matches.query) // (MAX_VOTERS + 1))
    rotations = np.empty((len(voters), 3, 3))
    centers = np.empty((len(voters), 3))
    votes = np.empty(len(voters), np.int64)

    def vote(lo: int) -> None:
        part = slice(lo, lo + VOTERS_A_TASK)
        rough_poses(matches, voters[part], rotations[part], centers[part], votes[part])

    list(workers.map(vote, range(0, len(voters), VOTERS_A_TASK), "vote"))
    order = np.argsort(-votes, kind="stable")
    kept = order[non_maximum_suppression(rotations[order], centers[order], NUM_CLUSTERS, VOTED)]
    rough = [Pose(rotations[k], centers[k]) for k in kept]
    refined = [one for one in workers.map(partial(exact_pose, matches), rough, "sample") if one]
    least = max([LEAST_MATCHES, *(FAIR_PART * one.num_matches for one in refined)])
    ranked = sorted((one for one in refined if one.num_matches >= least), key=lambda one: -one.num_matches)
    R = np.array([one.pose.R_cam_from_world for one in ranked]).reshape(-1, 3, 3)
    t = np.array([one.pose.center_world for one in ranked]).reshape(-1, 3)
    return [ranked[k] for k in non_maximum_suppression(R, t, count, MATCHED)]
