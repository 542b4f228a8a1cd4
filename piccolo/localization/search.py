"""Score every candidate position with every rotation, and keep the distinct best."""

from dataclasses import dataclass
from functools import cache

import numpy as np

from ..geometry.nearness import non_maximum_suppression
from ..geometry.pose import Pose, R_cam_from_angles, multiply, uniform_rotations, uniform_yaws
from ..geometry.sphere import SEARCH_RINGS, make_grid, whole_areas, wider_cells
from ..photo.panorama.local_normalization import sample_channels
from ..photo.panorama.texels import Texels
from ..problem.method import Method
from ..problem.prior import allow_rotations
from ..problem.problem import Problem
from ..problem.profile import Tilts
from ..problem.settings import Effort
from ..scan_map.scan_map import ScanMap
from ..system.arrays import Array, Int32s, Int64s
from ..system.jobs.memory import check_memory
from ..system.jobs.threads import Workers
from ..system.kernels.jit import F0, kernel
from ..views.candidate_views import WIDE_RINGS
from .correlation import VIEWS_A_PRODUCT, Samples, correlate_pairs, masked_correlation, weigh_by_area

ROTATIONS_AT_ONCE = 256  # rotations that a thread averages at a time
SCORES_AT_ONCE = 1 << 23  # 32 MB
LOWEST = np.float32(-np.inf)
TURNED_BYTES = 4 * 16  # a cell and rotation: channels, validity, energy, and the arrays they are made from
MIN_STARTS = 1000
PITCHES_DEG = (-27.0, -18.0, -9.0, 0.0, 9.0, 18.0, 27.0)  # tilts of a camera that is held about level
NUM_LEVEL_YAWS = 40


def turn_panorama(texels: Texels, rotations: Array) -> tuple[Samples, Samples]:
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
    cells: Int32s,
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
    """Poses in arrays, best first, each with the candidate position on whose view it descends."""

    R_cam_from_map: Array  # (n, 3, 3)
    center_map: Array  # (n, 3) [m]
    candidate: Int64s  # (n,)

    def take(self, indices: Int64s) -> "Starts":
        """Select the starts at `indices`, in that order."""
        return Starts(self.R_cam_from_map[indices], self.center_map[indices], self.candidate[indices])

    def poses(self) -> list[Pose]:
        """Return the poses as objects."""
        return [Pose(R, center) for R, center in zip(self.R_cam_from_map, self.center_map, strict=True)]


def best_poses_wide(
    scan_map: ScanMap,
    samples: Samples,
    validity: Samples,
    pool: int,
    num_views: int,
    workers: Workers,
    is_centered: bool = False,
) -> tuple[Int64s, Int64s, Samples]:
    """Return the best `pool` poses by the masked correlation of wide views with the averaged panorama.

    It returns what `best_poses` returns. `num_views` candidates are scored at a time: the scores of a campus
    in all rotations would take a gigabyte.
    """
    area = wider_cells(WIDE_RINGS)[1]
    wide_samples, wide_validity = widen_samples(samples, validity, workers)
    if is_centered:
        wide_samples *= wide_validity[:, None]
    panorama = weigh_by_area(wide_samples, wide_validity, area, 255)
    least = LOWEST
    sparse = np.empty(0, np.int64)
    rotation = np.empty(0, np.int64)
    scores = np.empty(0, np.float32)
    for lo in range(0, len(scan_map.sparse), num_views):
        part = slice(lo, lo + num_views)
        features = scan_map.wide_features[part]
        seen = scan_map.wide_seen[part]
        correlation = masked_correlation(features, seen, panorama, workers, is_centered)
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
    return max(SCORES_AT_ONCE // num_rotations, VIEWS_A_PRODUCT)


def best_poses(scores: Samples, pool: int, least: np.float32 = LOWEST) -> tuple[Int64s, Int64s, Samples]:
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


def search_poses(problem: Problem, tilts: Tilts, effort: Effort, workers: Workers) -> Starts:
    """Search the sparse candidates with all rotations in two stages; return the distinct best.

    The first stage scores all poses on wide cells, by matrix products; the second scores the best of them on
    the cells of the search grid. Some profiles skip the second, and subtract the means in the first.
    """
    m = problem.scan_map
    rotations = list_rotations(problem, tilts, effort)
    num_views = min(views_at_once(len(rotations)), len(m.sparse))
    num_bytes = len(rotations) * (len(make_grid(SEARCH_RINGS)) * TURNED_BYTES + 4 * num_views)
    task = f"a search of {len(m.sparse)} positions in {len(rotations)} rotations"
    check_memory(num_bytes, task, "set fewer num_yaws or num_rotations")
    samples, validity = turn_panorama(problem.photo.images.search(), rotations)
    profile = problem.profile
    most = effort.max_starts
    num_starts = thin_starts(profile.method, len(m.sparse), most) if profile.thins_starts else most
    pool = num_starts * profile.method.poses_per_start
    sparse, turn, _ = best_poses_wide(m, samples, validity, pool, num_views, workers, profile.subtracts_means)
    candidate = m.sparse[sparse]
    R = rotations[turn]
    centers = m.centers[candidate]
    kept = non_maximum_suppression(R, centers, num_starts, profile.starts_apart)
    candidate = candidate[kept]
    if not profile.scores_again:
        return Starts(R[kept], centers[kept], candidate)
    scores = np.empty(len(kept), np.float32)
    used, row_of_turn = np.unique(turn[kept], return_inverse=True)
    panorama = weigh_by_area(samples[used], validity[used], make_grid(SEARCH_RINGS).solid_angle, 1)
    row, views = m.views.at(candidate, workers)
    areas = whole_areas(SEARCH_RINGS)
    correlate_pairs(views.features, views.is_seen, areas, panorama, row, row_of_turn, scores)
    order = np.lexsort((turn[kept], candidate, -scores))
    return Starts(R[kept][order], centers[kept][order], candidate[order])


def thin_starts(method: Method, num_candidates: int, most: int) -> int:
    """Return the number of poses from which descents begin: fewer if there are few candidates."""
    return min(max(num_candidates // method.candidates_per_start, MIN_STARTS), most)


@cache
def level_rotations() -> Array:
    """Return the rotations (N, 3, 3), camera from level, of cameras that are held about level."""
    headings = 360.0 / NUM_LEVEL_YAWS * np.arange(NUM_LEVEL_YAWS)
    tilted = [R_cam_from_angles(heading, pitch, 0.0) for pitch in PITCHES_DEG for heading in headings]
    rotations = np.stack(tilted)
    rotations.flags.writeable = False  # it is kept for the next photo
    return rotations


def list_rotations(problem: Problem, tilts: Tilts, effort: Effort) -> Array:
    """Return the rotations (N, 3, 3), camera from map, to search: upright, about level, or all."""
    R_map_from_world = problem.scan_map.R_map_from_world
    if problem.rotations is not None:
        rotations = problem.rotations
    elif tilts == "known":
        rotations = multiply(problem.photo.R_cam_from_level, uniform_yaws(effort.num_yaws))
    elif tilts == "level":
        rotations = multiply(problem.photo.R_cam_from_level, level_rotations())
    else:
        rotations = uniform_rotations(effort.num_rotations)
    allowed = allow_rotations(multiply(rotations, R_map_from_world), problem.prior)
    return multiply(allowed, R_map_from_world.T)
