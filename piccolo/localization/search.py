"""Score every candidate position with every rotation, and keep the distinct best.

All sums are of whole numbers that stay below 2^24: exact in float32 in any order, so that matrix products are
equal on all processors and BLAS libraries.
"""

import math
import threading
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..geometry.pose import Pose
from ..geometry.rotations import Gravity, uniform_rotations, uniform_yaws
from ..geometry.sphere import SEARCH_RINGS, make_grid, whole_areas, wider_cells
from ..geometry.suppression import non_maximum_suppression
from ..jobs.memory import check_memory
from ..jobs.threads import Workers
from ..kernels.jit import F0, F1, kernel
from ..panorama.local_normalization import sample_channels
from ..panorama.texels import Texels
from ..scan_map.scan_map import ScanMap
from ..views.candidate_views import WIDE_RINGS
from .prior import allow_rotations
from .query import Query

EXACT = (1 << 24) - 1  # whole numbers up to this are exact in float32
MOST_LEVEL = 127.5  # of a channel
MOST_ENERGY = 3.0 * MOST_LEVEL**2  # of a cell
ROTATIONS_AT_ONCE = 256  # that a thread averages
Samples = NDArray[np.float32]
BLOCK = 512  # views a matrix product, at most
SCORES_AT_ONCE = 1 << 23  # 32 MB
LOWEST = np.float32(-np.inf)
TURNED_BYTES = 4 * 16  # of a rotation, a cell: channels, validity, energy, and what they are made from
CANDIDATES_PER_START = 2
POSES_PER_START = 12
START_DISTANCE, START_ANGLE = 0.5, math.radians(20.0)  # [m], [rad] starts nearer than both are one


class TurnedPanorama(NamedTuple):
    """Panorama on the cells of the sphere in many rotations; whole numbers."""

    samples: Samples  # (rotations, 3, cells) channels times solid angle
    energy: Samples  # (rotations, cells) squared channels times solid angle, 0 where nothing is shown
    validity: Samples  # (rotations, cells) 1 where the panorama shows something


def to_whole_numbers(values: Samples, most: float, most_other: int, num_terms: int) -> Samples:
    """Scale and round values up to `most`, so that sums of products with numbers up to another are exact."""
    return np.asarray(np.rint(values * whole_scale(most, most_other, num_terms)))


def whole_scale(most: float, most_other: int, num_terms: int) -> np.float32:
    """Return the factor by which `to_whole_numbers` multiplies."""
    return np.float32(EXACT // (most_other * num_terms) / most)


def weigh_by_area(samples: Samples, validity: Samples, area: Samples, most_seen: int) -> TurnedPanorama:
    """Weight channels (rotations, 3, cells) [levels] by area, as whole numbers."""
    num_cells = len(area)
    relative = area / area.max()
    energy = np.square(samples).sum(axis=1) * relative
    return TurnedPanorama(
        to_whole_numbers(samples * relative, MOST_LEVEL, 127, 3 * num_cells),
        to_whole_numbers(energy, MOST_ENERGY, most_seen, num_cells),
        validity,
    )


def turn_panorama(texels: Texels, rotations: NDArray[np.float64]) -> tuple[Samples, Samples]:
    """Sample channels (rotations, 3, cells) of the search grid [levels], and validity (rotations, cells)."""
    grid = make_grid(SEARCH_RINGS)
    samples = np.empty((len(rotations), 3, len(grid)), np.float32)
    validity = np.empty((len(rotations), len(grid)), np.float32)
    turns = rotations.astype(np.float32)
    sample_channels(texels.rgbx, texels.width, grid.directions, turns, samples, validity)
    return samples, validity


@kernel
def widen(
    samples: Samples,
    validity: Samples,
    cells: NDArray[np.int32],
    cell_areas: Samples,
    areas: Samples,
    wide_samples: Samples,
    wide_validity: Samples,
) -> None:
    """Write the averages of rounded channels (n, 3, cells) and of validity by area, over wider cells.

    Each cell lies in the wider cell of index `cells` (cells,) and has the area `cell_areas` (cells,); `areas`
    (wider cells,) are the sums of these. Validity is rounded.
    """
    for k in range(len(samples)):
        channels = wide_samples[k]
        valid = wide_validity[k]
        channels[:] = F0
        valid[:] = F0
        for c in range(len(cells)):
            wide = cells[c]
            area = cell_areas[c]
            for i in range(3):
                channels[i, wide] += np.rint(samples[k, i, c]) * area
            valid[wide] += validity[k, c] * area
        for wide in range(len(areas)):
            for i in range(3):
                channels[i, wide] /= areas[wide]
            valid[wide] = np.rint(valid[wide] / areas[wide])


def widen_samples(samples: Samples, validity: Samples, workers: Workers) -> tuple[Samples, Samples]:
    """Average channels of the search grid to (rotations, 3, wide cells) [levels], and validity."""
    cells, areas = wider_cells(WIDE_RINGS)
    cell_areas = whole_areas(SEARCH_RINGS)
    wide = np.empty((len(samples), 3, len(areas)), np.float32)
    is_valid = np.empty((len(samples), len(areas)), np.float32)

    def average(lo: int) -> None:
        part = slice(lo, lo + ROTATIONS_AT_ONCE)
        widen(samples[part], validity[part], cells, cell_areas, areas, wide[part], is_valid[part])

    workers.map(average, range(0, len(samples), ROTATIONS_AT_ONCE), "search")
    return wide, is_valid


@dataclass(frozen=True)
class Starts:
    """Poses in arrays, best first, and the candidate on whose view each descends."""

    R_cam_from_map: NDArray[np.float64]  # (n, 3, 3)
    center_map: NDArray[np.float64]  # (n, 3) [m]
    candidate: NDArray[np.int64]  # (n,)

    def take(self, indices: NDArray[np.int64]) -> "Starts":
        """Select the starts at `indices`, in that order."""
        return Starts(self.R_cam_from_map[indices], self.center_map[indices], self.candidate[indices])

    def poses(self) -> list[Pose]:
        """Return the poses as objects."""
        return [Pose(R, center) for R, center in zip(self.R_cam_from_map, self.center_map, strict=True)]


@kernel
def unpack_views(
    features: NDArray[np.int8],
    seen: NDArray[np.uint8],
    area: Samples,
    values: Samples,
    fractions: Samples,
    energy: Samples,
    total: Samples,
) -> None:
    """Write views' 8-bit channels (n, 3 * cells) and fractions seen (n, cells) as float32, and energies.

    Energies (n, cells) are squared channels times the area (cells,), in whole numbers; `total` (n,) their
    sums.
    """
    num_cells = len(area)
    for i in range(len(features)):
        f = features[i]
        v = values[i]
        for c in range(3 * num_cells):
            v[c] = np.float32(f[c])
        whole_total = F0
        for c in range(num_cells):
            fractions[i, c] = np.float32(seen[i, c])
            square = v[c] * v[c] + v[num_cells + c] * v[num_cells + c]
            square += v[2 * num_cells + c] * v[2 * num_cells + c]
            energy[i, c] = np.rint(square * area[c])
            whole_total += energy[i, c]
        total[i] = whole_total


_local = threading.local()


def thread_block(num_views: int, num_cells: int) -> list[Samples]:
    """Return the calling thread's own arrays for `unpack_views`: allocation costs as much as products."""
    kept: list[Samples] = getattr(_local, "block", [])
    if not kept or len(kept[0]) < num_views or kept[1].shape[1] != num_cells:
        num_rows = max(BLOCK, num_views)
        shapes = (num_rows, 3 * num_cells), (num_rows, num_cells), (num_rows, num_cells), (num_rows,)
        kept = _local.block = [np.empty(shape, np.float32) for shape in shapes]
    return [each[:num_views] for each in kept]


def masked_correlation(
    features: NDArray[np.int8],
    seen: NDArray[np.uint8],
    area: Samples,
    panorama: TurnedPanorama,
    workers: Workers,
) -> Samples:
    """Return the correlation (views, rotations), up to a factor, over the cells that both show.

    Views (views, 3 * cells) are in 8 bits; seen (views, cells) is the fraction seen of each cell.
    """
    weighted = panorama.samples.reshape(len(panorama.samples), -1)
    num_cells = len(area)
    scaled = (area / area.max() * whole_scale(MOST_ENERGY, 1, num_cells)).astype(np.float32)
    scores = np.empty((len(features), len(weighted)), np.float32)
    is_full = bool(panorama.validity.all())
    size = max(min(BLOCK, -(-len(features) // workers.num_threads)), 1)  # so that none is idle

    def correlate(lo: int) -> None:
        some = features[lo : lo + size]
        values, fractions, energy, total = thread_block(len(some), num_cells)
        unpack_views(some, seen[lo : lo + size], scaled, values, fractions, energy, total)
        np.matmul(values, weighted.T, out=scores[lo : lo + size])
        norm = fractions @ panorama.energy.T
        norm *= total[:, None] if is_full else energy @ panorama.validity.T
        np.sqrt(np.maximum(norm, F1, out=norm), out=norm)
        scores[lo : lo + size] /= norm

    workers.map(correlate, range(0, len(scores), size), "search")
    return scores


def best_poses_wide(
    scan_map: ScanMap, samples: Samples, validity: Samples, pool: int, workers: Workers
) -> tuple[NDArray[np.int64], NDArray[np.int64], Samples]:
    """Return the best `pool` poses by the masked correlation of wide views with the averaged panorama.

    The result is as of `best_poses`. Candidates are scored in parts: the scores of a campus in all rotations
    would take a gigabyte.
    """
    area = wider_cells(WIDE_RINGS)[1]
    wide_samples, wide_validity = widen_samples(samples, validity, workers)
    panorama = weigh_by_area(wide_samples, wide_validity, area, 255)
    num_views = views_at_once(len(samples))
    least = LOWEST
    sparse = np.empty(0, np.int64)
    rotation = np.empty(0, np.int64)
    scores = np.empty(0, np.float32)
    for lo in range(0, len(scan_map.sparse), num_views):
        part = slice(lo, lo + num_views)
        features = scan_map.wide_features[part]
        seen = scan_map.wide_seen[part]
        correlation = masked_correlation(features, seen, area, panorama, workers)
        row, turn, values = best_poses(correlation, pool, least)
        sparse = np.concatenate([sparse, row + lo])
        rotation = np.concatenate([rotation, turn])
        scores = np.concatenate([scores, values])
        best = np.lexsort((rotation, sparse, -scores))[:pool]
        sparse = sparse[best]
        rotation = rotation[best]
        scores = scores[best]
        least = scores[-1] if len(best) == pool else LOWEST
    return sparse, rotation, scores


def views_at_once(num_rotations: int) -> int:
    """Return the number of views whose scores are held at a time."""
    return max(SCORES_AT_ONCE // num_rotations, BLOCK)


@kernel
def correlate_pairs(
    features: NDArray[np.int8],
    is_seen: NDArray[np.bool_],
    area: Samples,
    panorama: TurnedPanorama,
    row: NDArray[np.int64],
    rotation: NDArray[np.int64],
    scores: Samples,
) -> None:
    """Write the masked correlation, up to a factor, of each pair of a view's row and a turned panorama.

    Products of whole numbers are summed in float64, exact in any order; the area (cells,) is whole too.
    """
    for k in range(len(scores)):
        f = features[row[k]]
        s = panorama.samples[rotation[k]]
        seen = is_seen[row[k]]
        valid = panorama.validity[rotation[k]]
        energies = panorama.energy[rotation[k]]
        product = view_energy = energy = 0.0
        for c in range(len(area)):
            is_shared = np.float32(seen[c]) * valid[c]
            f0, f1, f2 = np.float32(f[0, c]), np.float32(f[1, c]), np.float32(f[2, c])
            product += is_shared * (f0 * s[0, c] + f1 * s[1, c] + f2 * s[2, c])
            view_energy += np.float64(is_shared * area[c]) * (f0 * f0 + f1 * f1 + f2 * f2)
            energy += is_shared * energies[c]
        scores[k] = product / math.sqrt(max(view_energy * energy, 1.0))


def best_poses(
    scores: Samples, pool: int, least: np.float32 = LOWEST
) -> tuple[NDArray[np.int64], NDArray[np.int64], Samples]:
    """Return candidates, rotations and scores of the best `pool` poses above `least`, best first.

    Of equal scores, the first is taken. A threshold from a sample of the scores keeps the sorted part small.
    """
    flat = scores.ravel()
    pool = min(pool, flat.size)
    threshold = least
    if least == LOWEST or np.count_nonzero(flat > least) > 8 * pool:
        step = max(flat.size // 100_000, 1)
        sample = flat[::step]
        rank = len(sample) - 1 - int(min(2 * pool / step + 20, len(sample) - 1))
        threshold = max(np.partition(sample, rank)[rank] if rank > 0 else LOWEST, least)
    top = np.flatnonzero(flat > threshold)
    if len(top) < pool and threshold > least:  # many score alike: a scan of one colour
        alike = np.flatnonzero(flat == threshold)[: pool - len(top)]
        top = np.concatenate([top, alike])
    top = top[np.lexsort((top, -flat[top]))][:pool]
    row, column = np.divmod(top, scores.shape[1])
    return row, column, flat[top]


def search_poses(query: Query, gravity: Gravity) -> Starts:
    """Search all candidates with all rotations in two stages; return the distinct best.

    The first scores wide cells of the sparse candidates, by matrix products, the second scores fine cells of
    the best poses.
    """
    m = query.scan_map
    settings = query.settings
    if gravity == "known":
        rotations = query.photo.R_cam_from_level @ uniform_yaws(settings.num_yaws)
    else:
        rotations = uniform_rotations(settings.num_rotations)
    rotations = allow_rotations(rotations @ m.R_map_from_world, settings.prior) @ m.R_map_from_world.T
    num_views = min(views_at_once(len(rotations)), len(m.sparse))
    num_bytes = len(rotations) * (len(make_grid(SEARCH_RINGS)) * TURNED_BYTES + 4 * num_views)
    task = f"a search of {len(m.sparse)} positions in {len(rotations)} rotations"
    check_memory(num_bytes, task, "set fewer num_yaws or num_rotations")
    samples, validity = turn_panorama(query.photo.images.search(), rotations)
    num_starts = max(len(m.sparse) // CANDIDATES_PER_START, query.method.min_starts)
    num_starts = min(num_starts, settings.max_starts)
    sparse, turn, _ = best_poses_wide(m, samples, validity, num_starts * POSES_PER_START, query.workers)
    candidate = m.sparse[sparse]
    R = rotations[turn]
    centers = m.centers[candidate]
    kept = non_maximum_suppression(R, centers, num_starts, START_DISTANCE, START_ANGLE)
    candidate = candidate[kept]
    scores = np.empty(len(kept), np.float32)
    used, row_of_turn = np.unique(turn[kept], return_inverse=True)
    panorama = weigh_by_area(samples[used], validity[used], make_grid(SEARCH_RINGS).solid_angle, 1)
    row, views = m.views.at(candidate, query.workers)
    areas = whole_areas(SEARCH_RINGS)
    correlate_pairs(views.features, views.is_seen, areas, panorama, row, row_of_turn, scores)
    order = np.lexsort((turn[kept], candidate, -scores))
    return Starts(R[kept][order], centers[kept][order], candidate[order])
