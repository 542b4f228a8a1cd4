"""Which way is up in a cloud, from its own planes.

Every axis that many surfaces face is a candidate, in both senses. For each of these hypotheses the evidence
is added up as log-odds: how much of the cloud lies in a few sheets across it (floors, ceilings), how little
is aslant to it (floors and walls are not), how low the cloud is along it, whether clutter lies at the bottom
of the storeys, whether one sheet carries everything, and the convention that scans have z up.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .errors import InputError
from .pose import Array, exp_so3
from .settings import UpAxis

MAX_POINTS = 40_000  # that are looked at
MIN_POINTS = 300
NUM_NEIGHBORS = 24  # of a normal
MAX_FLATNESS = 0.05  # variance across a flat neighbourhood to the lesser variance along it
NUM_CELLS = 4000  # of the sphere of directions, about 3 deg wide
CELLS_PER_MODE = 12  # neighbouring cells whose votes are one direction's, about 6 deg wide
MAX_MODES = 6
MIN_MODE = 0.02  # share of the flat points
DISTINCT_ANGLE = np.radians(15.0)  # between two candidates
FACING_ANGLE = np.radians(8.0)  # of a normal to the axis, or of a wall to it
INLIER_ANGLES = np.radians([8.0, 4.0, 2.0, 2.0])  # the same while the axis is refined
PRIOR_ANGLE = np.radians(10.0)  # of +z to a direction that the convention speaks for
SNAP_ANGLE = np.radians(0.2)  # of +z to a direction that is called +z itself

BIN = 0.1  # of the histogram of heights, half a sheet's thickness [m]
MAX_BINS = 10_000
MAX_SHEETS = 6
MIN_SHEET = 0.1  # share of the largest sheet: of a floor, furniture may leave little to see
MIN_INNER = (
    0.5  # share of the weaker of the outermost sheets, of a sheet between them: a table is not a floor
)
CLOSE = 4  # bins: sheets closer than this are one that bends
MIN_STOREY = 1.5  # height [m]
FAR = 0.5  # beyond a sheet, further than it bends [m]
MIDDLE = (0.15, 0.5, 0.85)  # of a storey: skirting below, clutter or air, lamps and beams above
CHANCE = 0.15  # share of directions in space that face an axis or stand along it, within FACING_ANGLE
CHANCE_SHARP = 0.25  # share of these that do so within 2 deg

# Log-odds a unit of evidence: chosen by hand, rounded
SHEET_WEIGHT = 2.0  # of the logarithm of the share of the cloud in the sheets
SLANT_WEIGHT = 2.0  # of the logarithm of the share of flat surfaces that are aslant to the axis, against
EXTENT_WEIGHT = 2.0  # of the logarithm of the extent, against
CLUTTER_WEIGHT = 2.0  # of the logarithm of clutter below to clutter above the middle of the storeys
MAX_CLUTTER = 1.2  # beyond which that logarithm says no more
CARRY_WEIGHT = 3.0  # of what stands on all sheets less what hangs below all of them, as a share of both
PRIOR_WEIGHT = 1.5  # of z up
DOUBT = 0.05  # odds that it is none of the hypotheses


@dataclass(frozen=True)
class Up:
    """Which way is up in a cloud, and how far that can be relied on."""

    direction_world: Array  # (3,) unit vector that points up, in the cloud's frame
    confidence: float  # [0, 1] share of the evidence for this direction; below 0.5 it is a mere guess
    reason: str  # one line for a person


@dataclass(frozen=True)
class _Surfaces:
    """A sample of the cloud with what surrounds each point."""

    points: Array  # (M, 3) [m]
    normals: Array  # (M, 3) unit, of either sign
    is_flat: NDArray[np.bool_]  # (M,) the neighbourhood is a plane


@dataclass(frozen=True)
class _Evidence:
    """What speaks for an axis in general, and for one of its senses."""

    axis: Array  # (3,) unit
    sheets: float  # root of the sum of squares of the sheets' shares of all points
    slanted: float  # share of the flat surfaces that neither face the axis nor stand along it
    explained: float  # share of all points that do
    sharpness: float  # share of these that do so within 2 deg
    extent: float  # of the cloud along the axis [m]
    clutter: float  # logarithm of clutter below to clutter above the middle of the storeys
    carried: float  # [-1, 1] what lies above the last sheet less what lies below the first, to both

    @property
    def log_odds(self) -> float:
        """Of the axis pointing up."""
        is_conventional = self.axis[2] > np.cos(PRIOR_ANGLE)
        return float(
            SHEET_WEIGHT * np.log(self.sheets + 0.03)
            - SLANT_WEIGHT * np.log(self.slanted + 0.01)
            - EXTENT_WEIGHT * np.log(self.extent + 0.1)
            + CLUTTER_WEIGHT * np.clip(self.clutter, -MAX_CLUTTER, MAX_CLUTTER)
            + CARRY_WEIGHT * self.carried
            + PRIOR_WEIGHT * is_conventional
        )


def find_up(points: NDArray[np.float32]) -> Up:
    """The direction that points up in a cloud (N, 3) [m], thinned evenly in space (5 to 20 cm).

    By convention scans have z up: this counts for a direction within 10 deg of +z, decides between close
    alternatives and often the sense; within 0.2 deg of it, +z itself is returned. In a frame turned at random
    the convention speaks for a wall or the ground below one time in 25, and sometimes misleads.

    The confidence is the winner's share of the odds of all directions, less where few surfaces are flat or
    they face about it. A bare room turned at random stays below 0.5, for its floor may be its ceiling.

    Raises
    ------
    InputError
        The shape is not (N, 3), or a coordinate is not finite.
    """
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"points: found shape {points.shape}, wanted (N, 3)")
    if not np.isfinite(points).all():
        raise InputError("points: found a coordinate that is not finite, wanted metres")
    if len(points) < MIN_POINTS:
        return Up(np.array([0.0, 0.0, 1.0]), 0.0, f"only {len(points)} points: +z is assumed")
    surfaces = _surfaces(points)
    axes = _candidates(surfaces)
    if not axes:
        return Up(np.array([0.0, 0.0, 1.0]), 0.0, "no direction that flat surfaces share: +z is assumed")
    hypotheses = [_evidence(surfaces, sense * axis) for axis in axes for sense in (1.0, -1.0)]
    return _verdict(hypotheses)


def rotation_to_z_up(direction_world: Array) -> Array:
    """The smallest rotation R (3, 3) with `R @ direction_world = +z` for a unit vector (3,).

    Identity for +z, half a turn about x for -z.
    """
    x, y, z = direction_world
    sine = float(np.hypot(x, y))
    if sine == 0.0:
        return np.diag([1.0, 1.0, 1.0] if z > 0.0 else [1.0, -1.0, -1.0])
    return exp_so3(np.arctan2(sine, z) * np.array([y / sine, -x / sine, 0.0]))


def R_z_from_axis(up: UpAxis) -> Array:
    """The rotation (3, 3) that turns a named axis to z; identity for auto."""
    if up == "auto":
        return np.eye(3)
    axis = (-1.0 if up.startswith("-") else 1.0) * np.eye(3)["xyz".index(up[-1])]
    return np.round(rotation_to_z_up(axis)) + 0.0


def _surfaces(points: NDArray[np.float32]) -> _Surfaces:
    """Normals of an evenly strided sample of the cloud (N, 3), by PCA of the nearest neighbours."""
    stride = -(-len(points) // MAX_POINTS)
    sample = points[::stride].astype(np.float64)
    neighbors = sample[cKDTree(sample).query(sample, NUM_NEIGHBORS)[1]]
    neighbors -= neighbors.mean(axis=1, keepdims=True)
    variances, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", neighbors, neighbors))
    is_flat = (variances[:, 0] < MAX_FLATNESS * variances[:, 1]) & (variances[:, 1] > 0.1 * variances[:, 2])
    return _Surfaces(sample, axes[:, :, 0], is_flat)


def _cosines(vectors: Array, axis: Array) -> Array:
    """Dot products (M,), by einsum: a BLAS may sum in an order that depends on its threads."""
    return np.asarray(np.einsum("ni,i->n", vectors, axis))


def _sphere_cells() -> Array:
    """Directions (NUM_CELLS, 3) evenly over the sphere, a Fibonacci spiral."""
    k = np.arange(NUM_CELLS) + 0.5
    z = 1.0 - 2.0 * k / NUM_CELLS
    azimuth = k * np.pi * (3.0 - np.sqrt(5.0))
    radius = np.sqrt(1.0 - z * z)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=1)


def _candidates(surfaces: _Surfaces) -> list[Array]:
    """Axes that many surfaces face, and those that stand across two such axes."""
    normals = surfaces.normals[surfaces.is_flat]
    cells = _sphere_cells()
    tree = cKDTree(cells)
    nearest = tree.query(np.concatenate([normals, -normals]))[1]
    counts = np.bincount(nearest, minlength=NUM_CELLS)
    votes = counts[tree.query(cells, CELLS_PER_MODE)[1]].sum(axis=1)
    modes: list[Array] = []
    while len(modes) < MAX_MODES and votes.max() > max(MIN_MODE * len(normals), MIN_POINTS // 10):
        axis = cells[votes.argmax()]
        votes[np.abs(_cosines(cells, axis)) > np.cos(DISTINCT_ANGLE)] = 0
        modes.append(axis)
    axes: list[Array] = []
    for axis in [*modes, *_across(modes)]:
        refined = _refine(normals, axis)
        if all(abs(refined @ other) < np.cos(DISTINCT_ANGLE) for other in axes):
            axes.append(refined)
    return axes


def _across(axes: list[Array]) -> Iterator[Array]:
    """Unit vectors perpendicular to any two of `axes` that are not near parallel."""
    for i, a in enumerate(axes):
        for b in axes[:i]:
            normal = np.cross(a, b)
            length = np.linalg.norm(normal)
            if length > 0.5:
                yield normal / length


def _refine(normals: Array, axis: Array) -> Array:
    """`axis` by least squares: parallel to normals that face it, perpendicular to those of walls."""
    for angle in INLIER_ANGLES:
        cosines = np.abs(_cosines(normals, axis))
        facing, along = normals[cosines > np.cos(angle)], normals[cosines < np.sin(angle)]
        spread = np.einsum("ni,nj->ij", along, along) - np.einsum("ni,nj->ij", facing, facing)
        axis = np.linalg.eigh(spread)[1][:, 0]
    return np.asarray(axis)


def _evidence(surfaces: _Surfaces, axis: Array) -> _Evidence:
    """What speaks for `axis` pointing up."""
    cosines = np.abs(_cosines(surfaces.normals, axis))
    faces = surfaces.is_flat & (cosines > np.cos(FACING_ANGLE))
    stands = surfaces.is_flat & (cosines < np.sin(FACING_ANGLE))
    heights = _cosines(surfaces.points, axis)
    num_points, num_explained = len(heights), int(np.count_nonzero(faces | stands))
    low, high = np.quantile(heights, [0.01, 0.99])
    levels, shares = _sheets(heights[faces], num_points)
    sharp = (cosines > np.cos(INLIER_ANGLES[-1])) | (cosines < np.sin(INLIER_ANGLES[-1]))
    above = np.count_nonzero(heights > levels.max() + FAR) if len(levels) else 0
    below = np.count_nonzero(heights < levels.min() - FAR) if len(levels) else 0
    return _Evidence(
        axis=axis,
        sheets=float(np.sqrt(np.sum(shares**2))),
        slanted=1.0 - num_explained / np.count_nonzero(surfaces.is_flat),
        explained=num_explained / num_points,
        sharpness=np.count_nonzero(surfaces.is_flat & sharp) / max(num_explained, 1),
        extent=float(high - low),
        clutter=_clutter(heights[~stands], levels, 0.003 * num_points),
        carried=(above - below) / (above + below + 0.1 * num_points),
    )


def _sheets(heights: Array, num_points: int) -> tuple[Array, Array]:
    """Levels (S,) [m], ascending, of the largest sheets among `heights`, and their shares of all points."""
    if len(heights) == 0:
        return np.empty(0), np.empty(0)
    low, high = np.quantile(heights, [0.001, 0.999])  # strays, however far, cost neither memory nor fineness
    size = max(BIN, float(high - low) / MAX_BINS)
    places = (heights[(heights >= low) & (heights <= high)] - low) / size
    counts = np.bincount(places.astype(np.int64) + 1, minlength=3)
    pairs = (counts[:-1] + counts[1:]).astype(np.float64)  # so that no border of a bin splits a sheet
    found: list[tuple[float, float]] = []
    while len(found) < MAX_SHEETS and pairs.max() > 0:
        k = int(pairs.argmax())
        share = pairs[k] / num_points
        if found and share < MIN_SHEET * found[0][1]:
            break
        found.append((float(low) + k * size, share))
        pairs[max(k - CLOSE, 0) : k + CLOSE + 1] = 0
    found.sort()
    least = MIN_INNER * min(found[0][1], found[-1][1])
    found = [sheet for sheet in found if sheet in (found[0], found[-1]) or sheet[1] > least]
    return np.array([level for level, _ in found]), np.array([share for _, share in found])


def _clutter(heights: Array, levels: Array, softening: float) -> float:
    """Logarithm of the number of `heights` below the middle of their storey to the number above it."""
    if len(levels) < 2:
        return 0.0
    upper_level = np.searchsorted(levels, heights)
    is_between = (upper_level > 0) & (upper_level < len(levels))
    floors, ceilings = levels[upper_level[is_between] - 1], levels[upper_level[is_between]]
    parts = (heights[is_between] - floors) / (ceilings - floors)
    parts = parts[ceilings - floors > MIN_STOREY]
    lower = np.count_nonzero((parts > MIDDLE[0]) & (parts < MIDDLE[1]))
    upper = np.count_nonzero((parts > MIDDLE[1]) & (parts < MIDDLE[2]))
    return float(np.log((lower + softening) / (upper + softening)))


def _verdict(hypotheses: list[_Evidence]) -> Up:
    """The hypothesis that the evidence favours, with its share of the odds."""
    log_odds = np.array([h.log_odds for h in hypotheses])
    odds = np.exp(log_odds - log_odds.max())
    odds /= odds.sum() + DOUBT
    rank = np.argsort(-odds, kind="stable")
    best, second = hypotheses[rank[0]], hypotheses[rank[1]]
    quality = np.clip((best.explained - CHANCE) / CHANCE, 0.0, 1.0)
    quality *= np.clip((best.sharpness - CHANCE_SHARP) / CHANCE_SHARP, 0.0, 1.0)
    rival = "upside down" if best.axis @ second.axis < -0.9 else "another axis"
    reason = (
        f"{best.explained:.0%} of the points are flat across or along it,"
        f" {best.sharpness:.0%} of these sharply;"
        f" clutter below to above {np.exp(best.clutter):.1f} : 1; next is {rival}, {odds[rank[1]]:.0%}"
    )
    direction = np.array([0.0, 0.0, 1.0]) if best.axis[2] > np.cos(SNAP_ANGLE) else best.axis
    return Up(direction, float(odds[rank[0]] * quality), reason)
