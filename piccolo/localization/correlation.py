"""Correlation of views with a photo turned to many rotations.

All sums are of whole numbers that stay below 2^24: exact in float32 in any order, so that matrix products are
equal on all processors and BLAS libraries.
"""

import math
import threading
from typing import NamedTuple

import numpy as np

from ..system.arrays import Array32, Bytes, Int8s, Int64s, Mask
from ..system.jobs.threads import Workers
from ..system.kernels.jit import F0, F1, kernel

EXACT = (1 << 24) - 1  # whole numbers up to this are exact in float32
MOST_LEVEL = 127.5  # largest value of a channel
MOST_ENERGY = 3.0 * MOST_LEVEL**2  # largest sum of squared channels of a cell
VIEWS_A_PRODUCT = 512  # views a matrix product, at most
LEAST_SEEN = 0.3  # fraction of what a photo shows that a view must see to be compared with it
ALL_SEEN = np.float32(255.0)  # the number that stands for a view's cell that is seen wholly
FLAT_VIEW = 6.0  # [levels] a smaller deviation counts as this
Samples = Array32


class TurnedPanorama(NamedTuple):
    """Panorama on the cells of the sphere in many rotations; whole numbers."""

    samples: Samples  # (rotations, 3, cells) channels times solid angle
    energy: Samples  # (rotations, cells) squared channels times solid angle, 0 where nothing is shown
    validity: Samples  # (rotations, cells) 1 where the panorama shows something
    area: Samples  # (cells,) solid angles, relative to the largest
    most_seen: int  # the number that stands for a view's cell that is seen wholly: 255, or 1 of a mask


def to_whole_numbers(values: Samples, most: float, most_other: int, num_terms: int) -> Samples:
    """Scale and round values of at most `most`, so that sums of `num_terms` products are exact.

    They are products with whole numbers of at most `most_other`.
    """
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
        relative,
        most_seen,
    )


@kernel
def unpack_views(
    features: Int8s,
    seen: Bytes,
    area: Samples,
    is_centered: bool,
    values: Samples,
    fractions: Samples,
    energy: Samples,
    total: Samples,
) -> None:
    """Write views' 8-bit channels (n, 3 * cells) and fractions seen (n, cells) as float32, and energies.

    Energies (n, cells) are squared channels times the area (cells,), in whole numbers; `total` (n,) their
    sums. The channels of a cell are its mean times the fraction seen. For centred correlations the energy is
    the square of the mean times that fraction.
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
            if is_centered and seen[i, c] > 0:
                square *= ALL_SEEN / fractions[i, c]
            energy[i, c] = np.rint(square * area[c])
            whole_total += energy[i, c]
        total[i] = whole_total


_local = threading.local()


def thread_block(num_views: int, num_cells: int) -> list[Samples]:
    """Return the calling thread's own arrays for `unpack_views`: allocation costs as much as products."""
    kept: list[Samples] = getattr(_local, "block", [])
    if not kept or len(kept[0]) < num_views or kept[1].shape[1] != num_cells:
        num_rows = max(VIEWS_A_PRODUCT, num_views)
        shapes = (num_rows, 3 * num_cells), (num_rows, num_cells), (num_rows, num_cells), (num_rows,)
        kept = _local.block = [np.empty(shape, np.float32) for shape in shapes]
    return [each[:num_views] for each in kept]


def masked_correlation(
    features: Int8s, seen: Bytes, panorama: TurnedPanorama, workers: Workers, is_centered: bool = False
) -> Samples:
    """Return the correlation (views, rotations), up to a factor, over the cells that both show.

    Views (views, 3 * cells) are in 8 bits; seen (views, cells) is the fraction seen of each cell. If
    `is_centered`, the means over these cells are subtracted (`center_correlation`).
    """
    weighted = panorama.samples.reshape(len(panorama.samples), -1)
    num_cells = len(panorama.area)
    scaled = (panorama.area * whole_scale(MOST_ENERGY, 1, num_cells)).astype(np.float32)
    scores = np.empty((len(features), len(weighted)), np.float32)
    is_full = bool(panorama.validity.all())
    size = max(min(VIEWS_A_PRODUCT, -(-len(features) // workers.num_threads)), 1)  # so that none is idle

    def correlate(lo: int) -> None:
        some = features[lo : lo + size]
        values, fractions, energy, total = thread_block(len(some), num_cells)
        unpack_views(some, seen[lo : lo + size], scaled, is_centered, values, fractions, energy, total)
        np.matmul(values, weighted.T, out=scores[lo : lo + size])
        norm = fractions @ panorama.energy.T
        if is_centered:
            seen_energy = energy @ panorama.validity.T
            center_correlation(values, fractions, seen_energy, norm, panorama, scores[lo : lo + size])
            return
        norm *= total[:, None] if is_full else energy @ panorama.validity.T
        np.sqrt(np.maximum(norm, F1, out=norm), out=norm)
        scores[lo : lo + size] /= norm

    workers.map(correlate, range(0, len(scores), size), "search")
    return scores


def center_correlation(
    values: Samples,
    fractions: Samples,
    view_energy: Samples,
    photo_energy: Samples,
    panorama: TurnedPanorama,
    scores: Samples,
) -> None:
    """Turn sums of products (views, rotations) into correlations with the means subtracted.

    `values` and `fractions` are those of `unpack_views`, energies (views, rotations) sums of squares. On a
    part of the sphere the channels' means are not 0, and any two plain surfaces would correlate. All sums and
    means are over the same cells: those that both show.
    """
    num_cells = len(panorama.area)
    num_views = len(values)
    area_scale = whole_scale(1.0, 255, num_cells)
    shown = panorama.validity * np.rint(panorama.area * area_scale)
    weight = fractions @ shown.T
    of_view = values.reshape(3 * num_views, num_cells) @ shown.T
    by_channel = panorama.samples.transpose(1, 0, 2).reshape(-1, num_cells)
    of_photo = fractions @ by_channel.T
    units = (
        whole_scale(MOST_LEVEL, 127, 3 * num_cells),
        whole_scale(MOST_ENERGY, 1, num_cells),
        whole_scale(MOST_ENERGY, panorama.most_seen, num_cells) * ALL_SEEN,
        area_scale,
    )
    subtract_means(
        of_view.reshape(num_views, 3, -1),
        of_photo.reshape(num_views, 3, -1),
        view_energy,
        photo_energy,
        weight,
        np.maximum(shown.sum(axis=1), F1),
        units,
        scores,
    )


@kernel
def subtract_means(
    of_view: Samples,
    of_photo: Samples,
    view_energy: Samples,
    photo_energy: Samples,
    weight: Samples,
    shown_area: Samples,
    units: tuple[np.float32, np.float32, np.float32, np.float32],
    scores: Samples,
) -> None:
    """Write correlations from sums over the shared cells, see `center_correlation`.

    `of_view` and `of_photo` (views, 3, rotations) are sums of the channels, `units` the factors that made
    whole numbers: of samples, view and photo energies, and areas. Deviations below FLAT_VIEW count as that.
    The correlation is multiplied by the root of the fraction that a view sees of what the photo shows, and is
    0 if that is less than LEAST_SEEN.
    """
    per_sample, per_view, per_photo, per_area = units
    least = np.float32(FLAT_VIEW * FLAT_VIEW)
    for i in range(len(scores)):
        for r in range(scores.shape[1]):
            seen = weight[i, r] / (shown_area[r] * ALL_SEEN)
            area = max(weight[i, r] / (per_area * ALL_SEEN), np.float32(1e-3))
            product = scores[i, r] / per_sample
            of_squares = view_energy[i, r] / per_view
            squares = photo_energy[i, r] / per_photo
            for k in range(3):
                total = of_view[i, k, r] / per_area
                total_of_photo = of_photo[i, k, r] / (per_sample * ALL_SEEN)
                product -= total * total_of_photo / area
                of_squares -= total * total / area
                squares -= total_of_photo * total_of_photo / area
            norm = math.sqrt(max(of_squares, least * area) * max(squares, least * area))
            scores[i, r] = product / norm * math.sqrt(min(seen, F1)) if seen > np.float32(LEAST_SEEN) else F0


@kernel
def correlate_pairs(
    features: Int8s,
    is_seen: Mask,
    area: Samples,
    panorama: TurnedPanorama,
    row: Int64s,
    rotation: Int64s,
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
