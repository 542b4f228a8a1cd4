"""Colours made comparable: histograms of what a view and the panorama show of the same directions."""

import numpy as np
from numpy.typing import NDArray

from ..geometry.sphere import solid_angles


def color_histogram(rgb: NDArray[np.float32], counts: NDArray[np.bool_], bins: int) -> NDArray[np.float64]:
    """Share (bins ** 3,) of the solid angle in each colour, of an image (H, W, 3) in [0, 1].

    Only pixels of `counts` (H, W) are counted; all zero if none is.
    """
    level = np.minimum((rgb * bins).astype(np.int64), bins - 1)
    index = (level[..., 0] * bins + level[..., 1]) * bins + level[..., 2]
    weights = counts * solid_angles(rgb.shape[1])[:, None]
    histogram = np.bincount(index.ravel(), weights.ravel(), minlength=bins**3)
    return np.asarray(histogram / max(histogram.sum(), 1e-12))


def histogram_intersection(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Overlap in [0, 1] of two histograms that each sum to 1 (Swain and Ballard, 1991)."""
    return float(np.minimum(a, b).sum())
