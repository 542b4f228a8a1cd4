"""The parts of a photo that the scan explains, that contradict it, and that were not scanned.

Photo and scan are compared by local contrast, as the exposure differs. An occluder pollutes the local mean
and deviation around it, so that these are computed again over the cells that agree. The agreement of photo
and scan is a correlation, which a blank wall can't make high.
"""

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.points import PackedPoints
from ..geometry.pose import Pose
from ..geometry.robust import geman_mcclure
from ..geometry.sphere import solid_angles
from ..photo.panorama import Panorama, local_normalization
from ..photo.panorama.local_normalization import normalize_locally, opponent_channels
from ..photo.panorama.panorama import resize, shrink
from ..system.arrays import Array32, Bytes, Mask
from ..system.kernels.jit import F0, F1, kernel
from ..views.zbuffer import View, render_view

OCCLUSION_WIDTHS = (
    256,
    128,
    64,
)  # [px] of the comparison, cells of 1.4 degrees, and of more where the scan is sparse
LEAST_FILLED_SHARE = 0.75  # filled cells, as a share of filled cells twice as wide: less is sparse
OCCLUSION_STATS_WIDTH = 64  # [px] of local means
SIGMA_DEG = 15.0  # of the Gaussian for contrast
AGREEMENT_WIDTH = 96  # [px] of the agreement, cells of 3.75 degrees
NUM_STATISTICS_ROUNDS = 3  # of statistics over the cells that agree
FLAT_VARIANCE = np.float32(0.08**2)  # of a channel in [0, 1]: where it varies less, a difference counts less
CONTRADICTING = 0.8  # squared deviations, summed over channels; also the scale of Geman and McClure's weights
CELL_AROUND = np.ones((3, 3), np.uint8)  # of a cell: an edge may be displaced by one
EXPLAINED = 0  # levels of the mask
NOT_SCANNED = 128
CONTRADICTED_LEVEL = 255
EDGE_LEVEL = 127  # level of a cell's edge in an enlarged mask


@dataclass(frozen=True)
class Occlusion:
    """Photo and scan compared at a pose, on a small equirectangular grid."""

    is_valid: Mask  # (H, W) where the photo shows anything
    is_compared: Mask  # (H, W) where the scan shows something too, in the cell or next to it
    is_contradicted: Mask  # (H, W) where both are compared and differ

    def fractions(self) -> tuple[float, float]:
        """Return the fractions of the photo, by solid angle, that are explained and that contradict."""
        areas = solid_angles(self.is_valid.shape[1])[:, None] * self.is_valid
        total = max(float(areas.sum()), 1e-9)
        contradicted = float((areas * self.is_contradicted).sum()) / total
        return float((areas * self.is_compared).sum()) / total - contradicted, contradicted


def compare_occlusion(points: PackedPoints, panorama: Panorama, pose: Pose) -> Occlusion:
    """Compare photo and scan at a pose."""
    view = _fill_view(points, pose)
    small = resize(panorama, view.depth.shape[1])
    is_shared = view.is_seen & small.is_valid
    of_photo = opponent_channels(small.rgb.astype(np.float32) / np.float32(255.0))
    of_scan = opponent_channels(view.rgb)
    shared = weight = is_shared.astype(np.float32)
    difference = np.empty_like(weight)
    is_seen = is_shared[..., None]
    for _ in range(NUM_STATISTICS_ROUNDS):
        photo = _statistics(of_photo, weight)
        scan = _statistics(of_scan, weight)
        contrast = (of_scan - scan[..., :3]) * scan[..., 3:]
        low = _extreme(np.where(is_seen, contrast, np.float32(9.0)), cv2.erode)
        high = _extreme(np.where(is_seen, contrast, np.float32(-9.0)), cv2.dilate)
        write_squares(of_photo, photo, scan, low, high, difference)
        weight = shared * geman_mcclure(difference, 1.0 / CONTRADICTING)[1]
    is_compared = small.is_valid & _extreme(is_shared.view(np.uint8), cv2.dilate).astype(bool)
    return Occlusion(small.is_valid, is_compared, is_compared & (difference > CONTRADICTING))


def _fill_view(points: PackedPoints, pose: Pose) -> View:
    """Render the scan at a pose on the smallest cells that its points fill."""
    view = render_view(points, pose, OCCLUSION_WIDTHS[0])
    for width in OCCLUSION_WIDTHS[1:]:
        wider = view.is_seen.reshape(width // 2, 2, width, 2).any(axis=(1, 3))
        if view.is_seen.mean() >= LEAST_FILLED_SHARE * wider.mean():
            break
        view = render_view(points, pose, width)
    return view


def occlusion_mask(points: PackedPoints, panorama: Panorama, pose: Pose) -> Bytes:
    """Draw the comparison (H, W) at the panorama's size: EXPLAINED, NOT_SCANNED or CONTRADICTED_LEVEL.

    Masked pixels count as not scanned.
    """
    small = compare_occlusion(points, panorama, pose)
    shape = panorama.is_valid.shape

    def enlarge(cells: Mask) -> Mask:
        return _enlarge(cells.view(np.uint8) * np.uint8(255), shape) > EDGE_LEVEL

    mask = np.full(shape, NOT_SCANNED, np.uint8)
    is_compared = enlarge(small.is_compared) & panorama.is_valid
    is_contradicted = enlarge(small.is_contradicted)
    mask[is_compared & is_contradicted] = CONTRADICTED_LEVEL
    mask[is_compared & ~is_contradicted] = EXPLAINED
    return mask


@kernel
def write_squares(
    channels: Array32, photo: Array32, scan: Array32, low: Array32, high: Array32, squares: Array32
) -> None:
    """Write the squared distances (H, W) of the photo's contrast from a range (H, W, 3), `low` to `high`.

    The range is that of the scan within one cell, so that an edge displaced by less makes no difference.
    The squares are summed over the photo's channels (H, W, 3), normalised by its statistics (H, W, 6). They
    count less in flat surroundings, by the statistics of the photo or of the scan (H, W, 6).
    """
    for i in range(squares.shape[0]):
        for j in range(squares.shape[1]):
            total = F0
            for c in range(3):
                value = (channels[i, j, c] - photo[i, j, c]) * photo[i, j, 3 + c]
                outside = max(low[i, j, c] - value, value - high[i, j, c], F0)
                per_deviation = min(photo[i, j, 3 + c], scan[i, j, 3 + c])
                variance = F1 / (per_deviation * per_deviation)
                outside *= math.sqrt(variance / (variance + FLAT_VARIANCE))
                total += outside * outside
            squares[i, j] = total


def _statistics(channels: Array32, weight: Array32) -> Array32:
    """Return local means and 1 / deviations (H, W, 6) of channels (H, W, 3), half of them the global ones."""
    moments = np.empty((OCCLUSION_STATS_WIDTH // 2, OCCLUSION_STATS_WIDTH, 7), np.float32)
    local_normalization.block_moments(channels, weight, moments)
    total = (moments * solid_angles(OCCLUSION_STATS_WIDTH)[:, None, None]).sum(axis=(0, 1))
    # what blur_sphere makes of full blocks: the integral of exp((cosine - 1) / sigma^2)
    full = math.tau * math.radians(SIGMA_DEG) ** 2 * weight.size / moments[..., 0].size
    sums = local_normalization.blur_sphere(moments, SIGMA_DEG)
    sums += (full * total / max(total[0], 1e-9)).astype(np.float32)
    local_normalization.finish_statistics(sums)
    return _enlarge(sums[..., 1:], weight.shape)


def _extreme(values: NDArray[Any], of: Any) -> NDArray[Any]:
    """Return the extreme (H, W, ...), by cv2.erode or cv2.dilate, of a cell and its eight neighbours."""
    padded = np.concatenate([values[:, -1:], values, values[:, :1]], axis=1)
    return np.asarray(of(padded, CELL_AROUND)[:, 1:-1])


def _enlarge(small: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    """Enlarge a map (h, w, ...) to a shape (H, W), bilinearly; columns wrap."""
    border = math.ceil(shape[1] / small.shape[1])
    padded = np.concatenate([small[:, -1:], small, small[:, :1]], axis=1)
    size = (shape[1] + 2 * border, shape[0])
    enlarged = cv2.resize(padded, size, interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(enlarged[:, border : border + shape[1]])


@dataclass(frozen=True)
class Agreement:
    """Agreement of cloud and panorama at a pose, on cells of the sphere."""

    correlation: float  # of locally normalised colours over what both show
    seen_fraction: float  # fraction of the sphere that both show

    @property
    def value(self) -> float:
        """The correlation, reduced if less than half of the sphere is seen."""
        return self.correlation * min(1.0, 2.0 * self.seen_fraction)

    @property
    def score(self) -> float:
        """The correlation times the root of the fraction that both show."""
        return self.correlation * math.sqrt(self.seen_fraction)


def measure_agreement(points: PackedPoints, panorama: Panorama, pose: Pose) -> Agreement:
    """Measure the agreement of the panorama with the cloud seen from `pose`."""
    small = shrink(panorama, AGREEMENT_WIDTH)
    view = render_view(points, pose, AGREEMENT_WIDTH)
    is_shared = view.is_seen & small.is_valid
    weights = is_shared * (solid_angles(AGREEMENT_WIDTH)[:, None] / (4.0 * math.pi))
    of_view = normalize_locally(view.rgb, is_shared, SIGMA_DEG)
    of_panorama = normalize_locally(small.rgb.astype(np.float32) / np.float32(255.0), is_shared, SIGMA_DEG)

    def total(values: Array32) -> float:
        return float((weights[..., None] * values).sum(dtype=np.float64))

    energy = math.sqrt(total(of_view**2) * total(of_panorama**2))
    correlation = total(of_view * of_panorama) / max(energy, 1e-9)
    return Agreement(correlation=correlation, seen_fraction=float(weights.sum()))
