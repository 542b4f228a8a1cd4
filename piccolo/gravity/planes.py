"""The dominant planes of a cloud by RANSAC, what they are, and up as they agree on it."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..geometry.pose import Array
from .normals import Surfaces, cosines_to

Kind = Literal["floor", "ceiling", "level", "wall", "slanted"]

SEED = 20
MAX_PLANES = 24
MIN_SHARE = 0.01  # of all points, of a dominant plane
NUM_HYPOTHESES = 200  # a plane: a point drawn, with its normal
NUM_JUDGES = 2000  # points drawn that a hypothesis is tried on
TOLERANCE = 0.03  # of an inlier, from the plane [m]
INLIER_ANGLE = np.radians(15.0)  # of its normal
NUM_REFITS = 4
KIND_ANGLE = np.radians(8.0)  # of a plane to level or upright
MIN_STOREY = 1.5  # of the cloud below a ceiling [m]
NEAR = 1.0  # what lies so close above or below tells a floor from a ceiling [m]
AGREE_ANGLE = np.radians(3.0)  # of a plane to level or upright, that has a say in where up is
EVEN = 0.01  # rms distance [m] from which on a plane counts less: ground is uneven, and not level
MAX_CHANGE = np.radians(1.0)  # of up by the planes


@dataclass(frozen=True)
class Plane:
    """Points x with `normal_world @ x = offset`, and how many there are."""

    normal_world: Array  # (3,) unit; of level planes up, else away from the origin
    offset: float  # [m]
    num_inliers: int
    share: float  # of all points looked at, which are spread evenly in space
    rms: float  # distance of the inliers [m]
    kind: Kind = "slanted"


def find_planes(surfaces: Surfaces) -> list[Plane]:
    """The dominant planes, the largest first: RANSAC on flat points, least squares on all inliers."""
    rng = np.random.default_rng(SEED)
    is_left = surfaces.is_flat.copy()
    least = MIN_SHARE * len(is_left)
    planes: list[Plane] = []
    while len(planes) < MAX_PLANES and np.count_nonzero(is_left) > max(least, 3):
        left = np.flatnonzero(is_left)
        found = _fit(surfaces, left, *_draw(surfaces, left, rng))
        if found is None:
            break
        plane, inliers = found
        is_left[inliers] = False
        if plane.num_inliers < least:
            break
        planes.append(plane)
    return sorted(planes, key=lambda plane: -plane.num_inliers)


def _draw(surfaces: Surfaces, left: NDArray[np.int64], rng: np.random.Generator) -> tuple[Array, float]:
    """Normal and offset of the hypothesis that most of the points drawn agree with."""
    drawn, judges = rng.choice(left, NUM_HYPOTHESES), rng.choice(left, NUM_JUDGES)
    normals = surfaces.normals[drawn]
    offsets = np.einsum("hi,hi->h", normals, surfaces.points[drawn])
    distances = np.einsum("hi,ji->hj", normals, surfaces.points[judges]) - offsets[:, None]
    cosines = np.einsum("hi,ji->hj", normals, surfaces.normals[judges])
    agrees = (np.abs(distances) < TOLERANCE) & (np.abs(cosines) > np.cos(INLIER_ANGLE))
    best = int(agrees.sum(axis=1).argmax())
    return normals[best], float(offsets[best])


def _fit(
    surfaces: Surfaces, left: NDArray[np.int64], normal: Array, offset: float
) -> tuple[Plane, NDArray[np.int64]] | None:
    """The plane by least squares on its inliers among the points `left`, and their indices."""
    points, normals = surfaces.points[left], surfaces.normals[left]
    for _ in range(NUM_REFITS):
        distances = cosines_to(points, normal) - offset
        agrees = (np.abs(distances) < TOLERANCE) & (
            np.abs(cosines_to(normals, normal)) > np.cos(INLIER_ANGLE)
        )
        inliers = points[agrees]
        if len(inliers) < 3:
            return None
        middle = inliers.mean(axis=0)
        variances, axes = np.linalg.eigh(np.einsum("ni,nj->ij", inliers - middle, inliers - middle))
        normal, offset = axes[:, 0], float(axes[:, 0] @ middle)
    sign = -1.0 if offset < 0.0 else 1.0
    rms = float(np.sqrt(max(variances[0], 0.0) / len(inliers)))
    plane = Plane(sign * normal, sign * offset, len(inliers), len(inliers) / len(surfaces.points), rms)
    return plane, left[agrees]


def refine_up(up: Array, planes: list[Plane]) -> tuple[Array, float | None]:
    """Up (3,) by least squares on the level and upright planes, and their rms angle to it [rad].

    Even planes, which are built, count more than uneven ones. Without a level plane, or if it would change by
    more than a degree, up stays as it is. No angle where a single plane speaks.
    """
    sines = np.array([plane.normal_world @ up for plane in planes])
    is_level, is_upright = np.abs(sines) > np.cos(AGREE_ANGLE), np.abs(sines) < np.sin(AGREE_ANGLE)
    weights = np.array([plane.share / (1.0 + (plane.rms / EVEN) ** 2) for plane in planes])
    if not is_level.any():
        return up, None
    normals = np.array([plane.normal_world for plane in planes])
    signs = is_upright.astype(float) - is_level
    refined = np.linalg.eigh(np.einsum("n,ni,nj->ij", weights * signs, normals, normals))[1][:, 0]
    refined = refined * np.sign(refined @ up)
    if np.linalg.norm(refined - up) > MAX_CHANGE:
        refined = up
    sines = np.abs(np.einsum("ni,i->n", normals, refined))
    angles = np.where(is_level, np.arccos(np.minimum(sines, 1.0)), np.arcsin(np.minimum(sines, 1.0)))
    speaks = is_level | is_upright
    if np.count_nonzero(speaks) < 2:
        return refined, None
    return refined, float(np.sqrt(np.average(angles[speaks] ** 2, weights=weights[speaks])))


def name_planes(planes: list[Plane], surfaces: Surfaces, up: Array) -> list[Plane]:
    """The planes, the largest first, with their kinds.

    A ceiling has more things within a metre below it than above it. What is level and less than a storey from
    a floor or ceiling twice as large is a table or a platform: `level`.
    """
    named: list[Plane] = []
    found: list[tuple[float, Plane]] = []  # floors and ceilings with their heights
    heights = cosines_to(surfaces.points, up)
    is_upright = np.abs(cosines_to(surfaces.normals, up)) < np.sin(KIND_ANGLE)
    things = np.sort(heights[~surfaces.is_flat | is_upright])
    lowest = float(np.quantile(heights, 0.01))
    for plane in planes:
        sine = float(plane.normal_world @ up)
        if abs(sine) < np.cos(KIND_ANGLE):
            named.append(replace(plane, kind="wall" if abs(sine) < np.sin(KIND_ANGLE) else "slanted"))
            continue
        height, sign = float(np.median(heights[_on(plane, surfaces)])), float(np.sign(sine))
        kind: Kind = "ceiling" if height - lowest > MIN_STOREY and _hangs(things, height) else "floor"
        near = (other for level, other in found if abs(level - height) < MIN_STOREY)
        if any(other.num_inliers > 2 * plane.num_inliers for other in near):
            kind = "level"
        named.append(
            replace(plane, normal_world=sign * plane.normal_world, offset=sign * plane.offset, kind=kind)
        )
        if kind != "level":
            found.append((height, named[-1]))
    return named


def _hangs(things: Array, height: float) -> bool:
    """True if more of the things, at ascending heights (N,), lie just below `height` than just above."""
    ends = np.searchsorted(things, height + np.array([-NEAR, -2.0 * TOLERANCE, 2.0 * TOLERANCE, NEAR]))
    return bool(ends[1] - ends[0] > ends[3] - ends[2])


def _on(plane: Plane, surfaces: Surfaces) -> NDArray[np.bool_]:
    """Which points lie on a plane."""
    distances = cosines_to(surfaces.points, plane.normal_world) - plane.offset
    return np.asarray(np.abs(distances) < TOLERANCE)
