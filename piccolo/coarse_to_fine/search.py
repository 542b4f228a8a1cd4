"""Score every candidate position with every rotation, and keep the diverse best."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ..geometry.sphere_grid import SEARCH_RINGS, averaging, make_tiling
from ..panorama.local_normalization import sample_channels
from ..panorama.texels import Texels
from ..runtime.jit import F0, kernel
from .scan_map import WIDE_RINGS, ScanMap

BLOCK = 2048  # views a matrix product
Samples = NDArray[np.float32]


def turn_panorama(texels: Texels, rotations: NDArray[np.float64]) -> tuple[Samples, Samples]:
    """Channels (rotations, 3, cells) of the search tiling, in levels, and validity (rotations, cells)."""
    tiling = make_tiling(SEARCH_RINGS)
    samples = np.empty((len(rotations), 3, len(tiling)), np.float32)
    validity = np.empty((len(rotations), len(tiling)), np.float32)
    turns = rotations.astype(np.float32)
    sample_channels(texels.rgbx, texels.width, tiling.directions, turns, samples, validity)
    return samples, validity


def masked_correlation(
    features: NDArray[np.int8],
    seen: Callable[[int, int], Samples],
    area: Samples,
    samples: Samples,
    validity: Samples,
) -> Samples:
    """Correlation (views, rotations) over the cells that both show.

    Views (views, 3 * cells) in 8 bits; seen(lo, hi) is the share seen of each cell (hi - lo, cells).
    The panorama has samples (rotations, 3, cells) and validity (rotations, cells).
    """
    weighted = (samples * area).reshape(len(samples), -1)
    energy = np.square(samples).sum(axis=1) * area
    is_full = bool(validity.all())
    scores = np.empty((len(features), len(samples)), np.float32)
    for lo in range(0, len(scores), BLOCK):
        view = features[lo : lo + BLOCK].astype(np.float32)
        share = seen(lo, lo + BLOCK)
        norm = share @ energy.T
        view_energy = np.square(view).reshape(len(view), 3, -1).sum(axis=1)
        if is_full:
            norm *= (view_energy @ area)[:, None]
        else:
            norm *= (view_energy * area) @ validity.T
        np.sqrt(np.maximum(norm, 1e-12, out=norm), out=norm)
        np.matmul(view, weighted.T, out=scores[lo : lo + BLOCK])
        scores[lo : lo + BLOCK] /= norm
    return scores


def score_poses(scan_map: ScanMap, samples: Samples, validity: Samples) -> Samples:
    """Masked correlation (candidates, rotations) of all views with the turned panorama."""
    features = scan_map.features.reshape(len(scan_map.features), -1)

    def seen(lo: int, hi: int) -> Samples:
        return scan_map.is_seen[lo:hi].astype(np.float32)

    return masked_correlation(features, seen, make_tiling(SEARCH_RINGS).solid_angle, samples, validity)


def score_poses_wide(scan_map: ScanMap, samples: Samples, validity: Samples) -> Samples:
    """The same over wide cells for the sparse candidates: (sparse, rotations)."""
    matrix, area = averaging(WIDE_RINGS), make_tiling(WIDE_RINGS).solid_angle
    wide_samples, wide_validity = samples @ matrix / area, validity @ matrix / area

    def seen(lo: int, hi: int) -> Samples:
        return scan_map.wide_seen[lo:hi] * np.float32(1 / 255)

    return masked_correlation(scan_map.wide_features, seen, area, wide_samples, wide_validity)


@kernel
def correlate_pairs(features, is_seen, area, samples, validity, candidate, rotation, scores):
    """Write the masked correlation of each pair of a view and a turned panorama."""
    for k in range(len(scores)):
        f, s = features[candidate[k]], samples[rotation[k]]
        seen, valid = is_seen[candidate[k]], validity[rotation[k]]
        product = view_energy = energy = F0
        for c in range(len(area)):
            w = area[c] * np.float32(seen[c]) * valid[c]
            f0, f1, f2 = np.float32(f[0, c]), np.float32(f[1, c]), np.float32(f[2, c])
            product += w * (f0 * s[0, c] + f1 * s[1, c] + f2 * s[2, c])
            view_energy += w * (f0 * f0 + f1 * f1 + f2 * f2)
            energy += w * (s[0, c] * s[0, c] + s[1, c] * s[1, c] + s[2, c] * s[2, c])
        scores[k] = product / math.sqrt(max(view_energy * energy, np.float32(1e-12)))


@kernel
def suppress(rotations, centers, min_distance, min_trace, kept):  # noqa: C901  # one loop nest
    """Write the indices of the poses, best first, that are near none kept before; returns how many."""
    R, t = rotations, centers
    count = 0
    near2 = np.float32(min_distance * min_distance)
    x, y, z = (
        np.empty(len(kept), np.float32),
        np.empty(len(kept), np.float32),
        np.empty(len(kept), np.float32),
    )
    for k in range(len(t)):
        tx, ty, tz = np.float32(t[k, 0]), np.float32(t[k, 1]), np.float32(t[k, 2])
        is_new = True
        for m in range(count):
            dx, dy, dz = x[m] - tx, y[m] - ty, z[m] - tz
            if dx * dx + dy * dy + dz * dz < near2:
                trace = 0.0
                for i in range(3):
                    for j in range(3):
                        trace += R[k, i, j] * R[kept[m], i, j]
                if trace > min_trace:
                    is_new = False
                    break
        if is_new:
            kept[count] = k
            x[count], y[count], z[count] = tx, ty, tz
            count += 1
            if count == len(kept):
                break
    return count


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


def best_poses(scores: Samples, pool: int) -> tuple[NDArray[np.int64], NDArray[np.int64], Samples]:
    """Candidates, rotations and scores of the best `pool` poses, best first."""
    flat = scores.ravel()
    pool = min(pool, flat.size)
    step = max(flat.size // 100_000, 1)
    sample = np.sort(flat[::step])
    # A threshold from a sample that lets about twice the pool through; a smaller share if it was unlucky.
    indices = np.empty(flat.size if step == 1 else 8 * pool, np.int64)
    rank = len(sample) - 1 - int(min(2 * pool / step + 20, len(sample) - 1))
    threshold = sample[rank] if step > 1 else -np.inf
    top = indices[: min(count_above(flat, threshold, indices), len(indices))]
    top = top[np.lexsort((top, -flat[top]))][:pool]
    return *np.divmod(top, scores.shape[1]), flat[top]


def pick_distinct(
    rotations: NDArray[np.float64],
    centers: NDArray[np.float64],
    count: int,
    min_distance: float,
    min_angle_deg: float,
) -> NDArray[np.int64]:
    """Indices of the first `count` poses (n, 3, 3), (n, 3), best first, that are near none before."""
    kept = np.empty(count, np.int64)
    min_trace = 1 + 2 * math.cos(math.radians(min_angle_deg))
    return kept[: suppress(rotations, centers, min_distance, min_trace, kept)]
