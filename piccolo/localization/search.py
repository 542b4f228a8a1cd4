"""Score every candidate position with every rotation, and keep the distinct best.

All sums are of whole numbers: exact in any order (turned_panorama.py).
"""

import math
import threading
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..geometry.rotations import Gravity, uniform_rotations, uniform_yaws
from ..geometry.sphere import SEARCH_RINGS, make_grid, whole_areas, wider_cells
from ..geometry.suppression import non_maximum_suppression
from ..jobs.memory import check_memory
from ..jobs.threads import Workers
from ..kernels.jit import F0, F1, kernel
from ..scan_map.scan_map import ScanMap
from ..views.candidate_views import WIDE_RINGS
from .prior import allowed_rotations
from .query import Query
from .starts import START_ANGLE, START_DISTANCE, Starts
from .turned_panorama import MOST_ENERGY, Samples, TurnedPanorama, turn_panorama, turned, whole_scale, widened

BLOCK = 512  # views a matrix product, at most
SCORES_AT_ONCE, LOWEST = 1 << 23, np.float32(-np.inf)  # 32 MB
TURNED_BYTES = 4 * 16  # of a rotation, a cell: channels, validity, energy, and what they are made from
CANDIDATES_PER_START, POSES_PER_START = 2, 12


@kernel
def unpack_views(features, seen, area, values, fractions, energy, total):
    """Write views' 8-bit channels (n, 3 * cells) and what is seen (n, cells) as float32, and their energies.

    Energies (n, cells) are squared channels by the area (cells,), in whole numbers; (n,) their totals.
    """
    num_cells = len(area)
    for i in range(len(features)):
        f, s, v, e = features[i], seen[i], values[i], energy[i]
        for c in range(3 * num_cells):
            v[c] = np.float32(f[c])
        whole_total = F0
        for c in range(num_cells):
            fractions[i, c] = np.float32(s[c])
            square = v[c] * v[c] + v[num_cells + c] * v[num_cells + c]
            square += v[2 * num_cells + c] * v[2 * num_cells + c]
            e[c] = np.rint(square * area[c])
            whole_total += e[c]
        total[i] = whole_total


class Unpacked(NamedTuple):
    """A block of views, and their energies beside each rotation's, as one thread needs them."""

    values: Samples  # (views, 3 * cells)
    fractions: Samples  # (views, cells)
    energy: Samples  # (views, cells)
    total: Samples  # (views,)


_local = threading.local()


def thread_block(num_views: int, num_cells: int) -> Unpacked:
    """The calling thread's own block, kept for the next: fresh memory costs as much as the products."""
    block: Unpacked | None = getattr(_local, "block", None)
    if block is None or len(block.total) < num_views or block.energy.shape[1] != num_cells:
        num_rows = max(BLOCK, num_views)
        shapes = (num_rows, 3 * num_cells), (num_rows, num_cells), (num_rows, num_cells), (num_rows,)
        block = _local.block = Unpacked(*(np.empty(shape, np.float32) for shape in shapes))
    return Unpacked(*(each[:num_views] for each in block))


def masked_correlation(
    features: NDArray[np.int8],
    seen: NDArray[np.uint8],
    area: Samples,
    panorama: TurnedPanorama,
    workers: Workers,
) -> Samples:
    """Correlation (views, rotations), up to a factor, over the cells that both show.

    Views (views, 3 * cells) in 8 bits; seen (views, cells) is how much of each cell is seen.
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

    list(workers.map(correlate, range(0, len(scores), size), "search"))
    return scores


def best_poses_wide(
    scan_map: ScanMap, samples: Samples, validity: Samples, pool: int, workers: Workers
) -> tuple[NDArray[np.int64], NDArray[np.int64], Samples]:
    """As `best_poses`, by the masked correlation of wide views with the turned panorama, its cells averaged.

    Of some candidates at a time: scores of all are a gigabyte where a campus meets all rotations.
    """
    area = wider_cells(WIDE_RINGS)[1]
    panorama = turned(*widened(samples, validity, workers), area, 255)
    num_views, least = views_at_once(len(samples)), LOWEST
    sparse, rotation, scores = np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, np.float32)
    for lo in range(0, len(scan_map.sparse), num_views):
        part = slice(lo, lo + num_views)
        views = scan_map.wide_features[part], scan_map.wide_seen[part]
        row, turn, values = best_poses(masked_correlation(*views, area, panorama, workers), pool, least)
        sparse, rotation = np.concatenate([sparse, row + lo]), np.concatenate([rotation, turn])
        scores = np.concatenate([scores, values])
        best = np.lexsort((rotation, sparse, -scores))[:pool]
        sparse, rotation, scores = sparse[best], rotation[best], scores[best]
        least = scores[-1] if len(best) == pool else LOWEST
    return sparse, rotation, scores


def views_at_once(num_rotations: int) -> int:
    """How many views' scores are held at a time."""
    return max(SCORES_AT_ONCE // num_rotations, BLOCK)


@kernel
def correlate_pairs(features, is_seen, area, panorama, row, rotation, scores):
    """Write the masked correlation, up to a factor, of each pair of a view's row and a turned panorama.

    Whole numbers in float64, exact in any order. The area (cells,) is in whole numbers too.
    """
    for k in range(len(scores)):
        f, s = features[row[k]], panorama.samples[rotation[k]]
        seen, valid = is_seen[row[k]], panorama.validity[rotation[k]]
        energies = panorama.energy[rotation[k]]
        product = view_energy = energy = 0.0
        for c in range(len(area)):
            is_shared = np.float32(seen[c]) * valid[c]
            f0, f1, f2 = np.float32(f[0, c]), np.float32(f[1, c]), np.float32(f[2, c])
            product += is_shared * (f0 * s[0, c] + f1 * s[1, c] + f2 * s[2, c])
            view_energy += np.float64(is_shared * area[c]) * (f0 * f0 + f1 * f1 + f2 * f2)
            energy += is_shared * energies[c]
        scores[k] = product / math.sqrt(max(view_energy * energy, 1.0))


@kernel
def count_above(flat, threshold, indices):
    """Write the indices of the values above the threshold, as many as fit. Returns how many there are."""
    count = 0
    for i in range(len(flat)):
        if flat[i] > threshold:
            if count < len(indices):
                indices[count] = i
            count += 1
    return count


def best_poses(
    scores: Samples, pool: int, least: np.float32 = LOWEST
) -> tuple[NDArray[np.int64], NDArray[np.int64], Samples]:
    """Candidates, rotations and scores of the best `pool` poses that have more than `least`, best first."""
    flat = scores.ravel()
    pool = min(pool, flat.size)
    top = np.empty(min(8 * pool, flat.size), np.int64)
    count = count_above(flat, least, top) if least > LOWEST else flat.size + 1
    if count > len(top):
        threshold = max(likely_threshold(flat, pool), least)
        count = count_above(flat, threshold, top)
        if count > len(top):
            top = np.empty(count, np.int64)
            count_above(flat, threshold, top)
        if count < pool and threshold > least:  # many fit alike: a scan of one colour
            alike = np.flatnonzero(flat == threshold)[: pool - count]
            top, count = np.concatenate([top[:count], alike]), count + len(alike)
    top = top[:count]
    top = top[np.lexsort((top, -flat[top]))][:pool]
    return *np.divmod(top, scores.shape[1]), flat[top]


def likely_threshold(flat: Samples, pool: int) -> np.float32:
    """A value of a sample that lets about twice the pool through; a smaller share if it was unlucky."""
    step = max(flat.size // 100_000, 1)
    sample = flat[::step]
    rank = len(sample) - 1 - int(min(2 * pool / step + 20, len(sample) - 1))
    return np.float32(np.partition(sample, rank)[rank]) if rank > 0 else LOWEST


def search_poses(query: Query, gravity: Gravity) -> Starts:
    """The distinct best of all candidates with all rotations, in two stages.

    Wide cells of the sparse candidates, as matrix products; then fine cells of the poses that are left.
    """
    m, settings = query.scan_map, query.settings
    least = max(len(m.sparse) // CANDIDATES_PER_START, query.method.min_starts)
    num_starts = min(least, settings.max_starts)
    if gravity == "known":
        rotations = query.R_cam_from_level @ uniform_yaws(settings.num_yaws)
    else:
        rotations = uniform_rotations(settings.num_rotations)
    rotations = allowed_rotations(rotations @ m.R_map_from_world, settings.prior) @ m.R_map_from_world.T
    num_views = min(views_at_once(len(rotations)), len(m.sparse))
    num_bytes = len(rotations) * (len(make_grid(SEARCH_RINGS)) * TURNED_BYTES + 4 * num_views)
    what = f"a search of {len(m.sparse)} positions in {len(rotations)} rotations"
    check_memory(num_bytes, what, "set fewer num_yaws or num_rotations")
    samples, validity = turn_panorama(query.images.search, rotations)
    pool = num_starts * POSES_PER_START
    sparse, rotation, _ = best_poses_wide(m, samples, validity, pool, query.workers)
    R, centers = rotations[rotation], m.centers[m.sparse[sparse]]
    kept = non_maximum_suppression(R, centers, num_starts, START_DISTANCE, START_ANGLE)
    return rescored(query, m.sparse[sparse[kept]], rotations, rotation[kept], samples, validity)


def rescored(
    query: Query,
    candidate: NDArray[np.int64],
    rotations: NDArray[np.float64],
    rotation: NDArray[np.int64],
    samples: Samples,
    validity: Samples,
) -> Starts:
    """Some candidates (n,) and rotations (n,) of all (rotations, 3, 3) as starts, by their fine views."""
    area, scores = make_grid(SEARCH_RINGS).solid_angle, np.empty(len(candidate), np.float32)
    used, turn = np.unique(rotation, return_inverse=True)
    panorama = turned(samples[used], validity[used], area, 1)
    row, views = query.scan_map.views.at(candidate, query.workers)
    correlate_pairs(views.features, views.is_seen, whole_areas(SEARCH_RINGS), panorama, row, turn, scores)
    order = np.lexsort((rotation, candidate, -scores))
    candidate, R = candidate[order], rotations[rotation[order]]
    return Starts(R, query.scan_map.centers[candidate], candidate, scores[order].astype(np.float64))
