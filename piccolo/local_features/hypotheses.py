"""Pose hypotheses that matches vote for.

A single match gives a rough pose: its keypoint's size gives the distance of the point, its direction and
tangent give the rotation, if the camera is near the view from which the map has the feature. The poses that
most other matches agree with, in direction, size and tangent, are made exact by P3P within RANSAC (Fischler
and Bolles, 1981) on those matches.
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

COS_ROUGH = math.cos(math.radians(20.0))  # a match whose error is smaller agrees roughly
COS_EXACT = math.cos(math.radians(1.0))
COS_TANGENT = math.cos(math.radians(40.0))
SIZE_RATIO = 1.7  # of a keypoint's size as predicted and as found, at most
LEAST_ANGLE = np.float32(1e-6)  # [rad] of a keypoint
MAX_VOTERS = 1200  # single matches whose poses are tried
TRIPLES_A_TASK = 64  # of them a thread tries at a time
NUM_CLUSTERS = 48  # that are made exact, at most
FAIR_PART = 0.2  # of the best pose's matches
NUM_TRIPLES = 200  # of three matches, a cluster
LEAST_MATCHES = 4  # that agree with a pose
REFINEMENTS = 8  # steps
REFINE_SCALE = math.radians(0.5)  # [rad] of the loss
REFINE_TOLERANCE = 1e-7  # [rad + m] a shorter step ends the descent


class MatchedPose(NamedTuple):
    """A pose, and the number of the photo's features that it puts where the map has them."""

    pose: Pose
    num_matches: int


@kernel
def angular_equations(
    problem: tuple[Array, Array, float], R_cam_from_map: Array, center_map: Array, sums: Array
) -> None:
    """Write the sums (29,) of normal_equations for bearings (N, 3), points (N, 3) [m], scale [rad].

    The scale is that of Geman and McClure's loss: much larger residuals hardly count.
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
    """Return the cosine from a match's ray to its point; -1 below `cos_rough` or if the keypoint differs."""
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
    """Write the rotation (3, 3) that takes a match's direction and tangent to its ray and ray's tangent."""
    cam = (m.rays[j], m.ray_tangents[j], cross(m.rays[j], m.ray_tangents[j]))
    world = (m.directions[j], m.tangents[j], cross(m.directions[j], m.tangents[j]))
    for i in range(3):
        for h in range(3):
            R[i, h] = cam[0][i] * world[0][h] + cam[1][i] * world[1][h] + cam[2][i] * world[2][h]


@inline_kernel
def count_roughly_agreeing(m: Matches, R: Array, t: Array) -> int:
    """Count the photo's features of which a match roughly agrees with a pose."""
    count = 0
    last = -1
    for i in range(len(m.query)):
        if m.query[i] != last and agreement(m, i, R, t, COS_ROUGH) > 0.0:
            count += 1
            last = m.query[i]
    return count


@kernel
def rough_poses(matches: Matches, voters: Int64s, rotations: Array, centers: Array, votes: Int64s) -> None:
    """Write the pose (n, 3, 3), (n, 3) of each voter, a single match, and the number (n,) of its votes."""
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
    """Count for each pose (n, 3, 3), (n, 3) the photo's features that a member agrees with within a degree.

    The counts (n,) are written.
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
    """Write poses (n, 3, 3), (n, 3) of three matches each, at most 4 NUM_TRIPLES; return their number.

    `columns` (6, m) are points and rays of the matches. The samples are the same in every run.
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
    """Write the indices of the matches that agree with a pose; return their number."""
    count = 0
    for j in range(len(matches.query)):
        if agreement(matches, j, R_cam_from_map, center_map, cos_rough) > 0.0:
            members[count] = j
            count += 1
    return count


def find_inliers(matches: Matches, pose: Pose, cos_rough: float) -> Int64s:
    """Return the indices of the matches that agree with a pose."""
    members = np.empty(len(matches.query), np.int64)
    return members[: list_members(matches, pose.R_cam_from_world, pose.center_world, cos_rough, members)]


def count_inliers(matches: Matches, pose: Pose, cos_agree: float = COS_EXACT) -> int:
    """Count the features of the photo that a pose puts where the map has them, within an angle."""
    return len(np.unique(matches.query[find_inliers(matches, pose, cos_agree)]))


def exact_pose(matches: Matches, rough: Pose) -> MatchedPose | None:
    """Return the pose that most matches near a rough one agree with, refined; None if they are too few."""
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
    """Refine a pose on the matches that agree with it."""
    members = find_inliers(matches, pose, COS_EXACT)
    rays = matches.rays[members].astype(np.float64)
    points = matches.points[members].astype(np.float64)
    R = pose.R_cam_from_world.copy()
    t = pose.center_world.copy()
    descend_matches((rays, points, REFINE_SCALE), num_steps, REFINE_TOLERANCE, R, t)
    return Pose(R, t)


def propose_poses(matches: Matches, count: int, workers: Workers) -> list[MatchedPose]:
    """Return at most `count` poses that most matches agree with, best first, in the map's frame.

    Poses with less than FAIR_PART of the best one's matches are left out.
    """
    voters = np.arange(0, len(matches.query), 1 + len(matches.query) // (MAX_VOTERS + 1))
    rotations = np.empty((len(voters), 3, 3))
    centers = np.empty((len(voters), 3))
    votes = np.empty(len(voters), np.int64)

    def vote(lo: int) -> None:
        part = slice(lo, lo + TRIPLES_A_TASK)
        rough_poses(matches, voters[part], rotations[part], centers[part], votes[part])

    list(workers.map(vote, range(0, len(voters), TRIPLES_A_TASK), "vote"))
    order = np.argsort(-votes, kind="stable")
    kept = order[non_maximum_suppression(rotations[order], centers[order], NUM_CLUSTERS, VOTED)]
    rough = [Pose(rotations[k], centers[k]) for k in kept]
    ends = workers.map(partial(exact_pose, matches), rough, "sample")
    found = [end for end in ends if end]
    least = max([LEAST_MATCHES, *(FAIR_PART * f.num_matches for f in found)])
    found = sorted((f for f in found if f.num_matches >= least), key=lambda f: -f.num_matches)
    R = np.array([f.pose.R_cam_from_world for f in found]).reshape(-1, 3, 3)
    t = np.array([f.pose.center_world for f in found]).reshape(-1, 3)
    return [found[k] for k in non_maximum_suppression(R, t, count, MATCHED)]
