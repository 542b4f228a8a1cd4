"""The panorama turned many ways, on the cells of a search, in whole numbers.

All sums are of whole numbers that stay below 2^24: exact in float32 in any order, so that matrix products
come out the same whatever the processor and its BLAS.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..geometry.sphere import SEARCH_RINGS, make_grid, whole_areas, wider_cells
from ..jobs.threads import Workers
from ..kernels.jit import F0, kernel
from ..panorama.local_normalization import sample_channels
from ..panorama.texels import Texels
from ..views.candidate_views import WIDE_RINGS

EXACT = (1 << 24) - 1  # whole numbers up to this are exact in float32
MOST_LEVEL = 127.5  # of a channel
MOST_ENERGY = 3.0 * MOST_LEVEL**2  # of a cell
ROTATIONS_AT_ONCE = 256  # that a thread averages
Samples = NDArray[np.float32]


class TurnedPanorama(NamedTuple):
    """The panorama on the cells of the sphere, turned many ways; whole numbers."""

    samples: Samples  # (rotations, 3, cells) channels times solid angle
    energy: Samples  # (rotations, cells) squared channels times solid angle, 0 where nothing is shown
    validity: Samples  # (rotations, cells) 1 where the panorama shows something


def whole(values: Samples, most: float, most_other: int, num_terms: int) -> Samples:
    """Values up to `most`, scaled and rounded: sums of products with numbers up to another are exact."""
    return np.asarray(np.rint(values * whole_scale(most, most_other, num_terms)))


def whole_scale(most: float, most_other: int, num_terms: int) -> np.float32:
    """The factor for `whole`."""
    return np.float32(EXACT // (most_other * num_terms) / most)


def turned(samples: Samples, validity: Samples, area: Samples, most_seen: int) -> TurnedPanorama:
    """Channels (rotations, 3, cells) [levels] and validity (rotations, cells) by area, as whole numbers."""
    num_cells = len(area)
    relative = area / area.max()
    energy = np.square(samples).sum(axis=1) * relative
    return TurnedPanorama(
        whole(samples * relative, MOST_LEVEL, 127, 3 * num_cells),
        whole(energy, MOST_ENERGY, most_seen, num_cells),
        validity,
    )


def turn_panorama(texels: Texels, rotations: NDArray[np.float64]) -> tuple[Samples, Samples]:
    """Channels (rotations, 3, cells) of the search grid, in levels, and validity (rotations, cells)."""
    grid = make_grid(SEARCH_RINGS)
    samples = np.empty((len(rotations), 3, len(grid)), np.float32)
    validity = np.empty((len(rotations), len(grid)), np.float32)
    turns = rotations.astype(np.float32)
    sample_channels(texels.rgbx, texels.width, grid.directions, turns, samples, validity)
    return samples, validity


@kernel
def widen(samples, validity, cells, cell_areas, areas, wide_samples, wide_validity):
    """Write the averages of rounded channels (n, 3, cells) and of validity by area, over wider cells.

    `cells` and `cell_areas` (cells,) tell the wider cell of each and its part of that cell's, of `areas`.
    Validity is rounded.
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


def widened(samples: Samples, validity: Samples, workers: Workers) -> tuple[Samples, Samples]:
    """Averages (rotations, 3, wide cells) [levels] of channels of the search grid, and of validity."""
    cells, areas = wider_cells(WIDE_RINGS)
    parts = cells, whole_areas(SEARCH_RINGS), areas
    wide = np.empty((len(samples), 3, len(areas)), np.float32)
    is_valid = np.empty((len(samples), len(areas)), np.float32)

    def average(lo: int) -> None:
        part = slice(lo, lo + ROTATIONS_AT_ONCE)
        widen(samples[part], validity[part], *parts, wide[part], is_valid[part])

    workers.map(average, range(0, len(samples), ROTATIONS_AT_ONCE), "search")
    return wide, is_valid
