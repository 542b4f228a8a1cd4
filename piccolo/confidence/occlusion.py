"""The parts of a photo that the scan explains, that contradict it, and that were not scanned.

Photo and scan are compared by local contrast, as the exposure differs. An occluder pollutes mean and
deviation around it: they are computed again over what agrees, of the whole photo first, then more locally.
The agreement of photo and scan is a correlation, which a blank wall can't make high.
"""

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..arrays import Array32, Bytes, Mask
from ..cloud.soa import PackedPoints
from ..geometry.pose import Pose
from ..geometry.sphere import solid_angles
from ..kernels.jit import F0, F1, kernel
from ..panorama import Panorama, local_normalization
from ..panorama.local_normalization import normalize_locally, opponent_channels
from ..panorama.model import resize, shrink
from ..views.zbuffer import View, render_view

WIDTHS = (256, 128, 64)  # [px] of the comparison, cells of 1.4 degrees and more: where the scan is sparse
LEAST_FILLED = 0.75  # of the cells twice as wide in which anything is seen: less is sparse
STATS_WIDTH = 64  # [px] of local means
SIGMA_DEG = 15.0  # of the Gaussian for contrast
VIEW_WIDTH = 96  # [px] of the agreement, cells of 3.75 degrees
SMOOTHING = 0.9  # [cells] of that for the difference
GLOBAL_WEIGHTS = (10.0, 1.0, 0.3)  # round by round, of the whole photo beside a full neighbourhood
FLAT_VARIANCE = np.float32(0.08**2)  # of a channel in [0, 1]: where it is less, a difference counts less
MOST_DIFFERENCE = np.float32(2.0)  # deviations; what differs more counts no more
CONTRADICTING = 0.5  # squared deviations, summed over channels
WEIGHT_SCALE = 1.0  # the same, of Geman and McClure's weights
LEAST_COVERED = 0.3  # of the neighbourhood that both show: less was not scanned
EXPLAINED = 0  # levels of the mask
NOT_SCANNED = 128
CONTRADICTED = 255
LEVEL = 100  # 8-bit level of the thresholds in maps that are enlarged


@dataclass(frozen=True)
class Occlusion:
    """Photo and scan compared at a pose, on a small equirectangular grid."""

    difference: Array32  # (H, W) squared deviations of local contrast, smoothed
    coverage: Array32  # (H, W) fraction of the neighbourhood that both show
    is_valid: Mask  # (H, W) where the photo shows anything

    def fractions(self) -> tuple[float, float]:
        """Return the fractions of the photo, by solid angle, that are explained and that contradict."""
        areas = solid_angles(self.is_valid.shape[1])[:, None] * self.is_valid
        is_compared = areas * (self.coverage > LEAST_COVERED)
        contradicted = float((is_compared * (self.difference > CONTRADICTING)).sum())
        total = max(float(areas.sum()), 1e-9)
        return (float(is_compared.sum()) - contradicted) / total, contradicted / total


def compare_occlusion(points: PackedPoints, panorama: Panorama, pose: Pose) -> Occlusion:
    """Compare photo and scan at a pose."""
    view = _fill_view(points, pose)
    small = resize(panorama, view.depth.shape[1])
    is_shared = view.is_seen & small.is_valid
    of_photo = opponent_channels(small.rgb.astype(np.float32) / np.float32(255.0))
    of_scan = opponent_channels(view.rgb)
    shared = weight = is_shared.astype(np.float32)
    coverage = _smooth(shared)
    for global_weight in GLOBAL_WEIGHTS:
        square = _squared_difference(of_photo, of_scan, is_shared, weight, global_weight)
        difference = _smooth(square * shared)
        difference /= np.maximum(coverage, np.float32(1e-6))
        weight = np.asarray(shared / (1.0 + difference / WEIGHT_SCALE) ** 2, np.float32)
    return Occlusion(difference, coverage, small.is_valid)


def _fill_view(points: PackedPoints, pose: Pose) -> View:
    """Render the scan at a pose on the smallest cells that its points fill."""
    view = render_view(points, pose, WIDTHS[0])
    for width in WIDTHS[1:]:
        wider = view.is_seen.reshape(width // 2, 2, width, 2).any(axis=(1, 3))
        if view.is_seen.mean() >= LEAST_FILLED * wider.mean():
            break
        view = render_view(points, pose, width)
    return view


def occlusion_mask(points: PackedPoints, panorama: Panorama, pose: Pose) -> Bytes:
    """Draw the comparison (H, W) at the panorama's size: EXPLAINED, NOT_SCANNED or CONTRADICTED.

    Masked pixels count as not scanned.
    """
    small = compare_occlusion(points, panorama, pose)
    shape = panorama.is_valid.shape

    def exceeds(values: Array32, threshold: float) -> Mask:
        levels = np.clip(values * np.float32(LEVEL / threshold), 0.0, 255.0).astype(np.uint8)
        return _enlarge(levels, shape) > LEVEL

    mask = np.full(shape, NOT_SCANNED, np.uint8)
    is_compared = exceeds(small.coverage, LEAST_COVERED) & panorama.is_valid
    is_contradicted = exceeds(small.difference, CONTRADICTING)
    mask[is_compared & is_contradicted] = CONTRADICTED
    mask[is_compared & ~is_contradicted] = EXPLAINED
    return mask


def _squared_difference(
    of_photo: Array32, of_scan: Array32, is_shared: Mask, weight: Array32, global_weight: float
) -> Array32:
    """Return the squared differences (H, W) of the photo's contrast from the scan's range within one cell.

    An edge that is displaced by less than a cell, or blurred, makes no difference.
    """
    photo, scan = (_statistics(c, weight, global_weight) for c in (of_photo, of_scan))
    contrast = (of_scan - scan[..., :3]) * scan[..., 3:]
    low = _extreme(contrast, is_shared, cv2.erode, 9.0)
    high = _extreme(contrast, is_shared, cv2.dilate, -9.0)
    squares = np.empty(is_shared.shape, np.float32)
    write_squares(of_photo, photo, scan, low, high, squares)
    return squares


@kernel
def write_squares(
    channels: Array32, photo: Array32, scan: Array32, low: Array32, high: Array32, squares: Array32
) -> None:
    """Write the squared distances (H, W) of the photo's contrast from a range (H, W, 3), `low` to `high`.

    They are summed over the photo's channels (H, W, 3), normalised by its statistics (H, W, 6). In flat
    surroundings, of the photo or of the scan (H, W, 6), they count less.
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
                outside = min(outside, MOST_DIFFERENCE)
                total += outside * outside
            squares[i, j] = total


def _statistics(channels: Array32, weight: Array32, global_weight: float) -> Array32:
    """Return local means and 1 / deviations (H, W, 6) of channels (H, W, 3), mixed with the global ones."""
    moments = np.empty((STATS_WIDTH // 2, STATS_WIDTH, 7), np.float32)
    local_normalization.block_moments(channels, weight, moments)
    total = (moments * solid_angles(STATS_WIDTH)[:, None, None]).sum(axis=(0, 1))
    # what blur_sphere makes of full blocks: the integral of exp((cosine - 1) / sigma^2)
    full = global_weight * math.tau * math.radians(SIGMA_DEG) ** 2 * weight.size / moments[..., 0].size
    sums = local_normalization.blur_sphere(moments, SIGMA_DEG)
    sums += (full * total / max(total[0], 1e-9)).astype(np.float32)
    local_normalization.finish_statistics(sums)
    return _enlarge(sums[..., 1:], weight.shape)


def _smooth(values: Array32) -> Array32:
    """Smooth a map (H, W) by a narrow Gaussian on the sphere: rows, wider at the poles, then columns."""
    height, width = values.shape
    cosine = np.cos((0.5 - (np.arange(height) + 0.5) / height) * math.pi)
    frequency = np.arange(width // 2 + 1) * math.tau / width
    gains = np.exp(-0.5 * (frequency * SMOOTHING / cosine[:, None]) ** 2)
    rows = np.fft.irfft(np.fft.rfft(values.astype(np.float64), axis=1) * gains, n=width, axis=1)
    kernel = cv2.getGaussianKernel(2 * math.ceil(3.0 * SMOOTHING) + 1, SMOOTHING)
    columns = cv2.sepFilter2D(rows, cv2.CV_64F, np.ones(1), kernel, borderType=cv2.BORDER_REFLECT)
    return np.maximum(columns, 0.0).astype(np.float32)


def _extreme(channels: Array32, is_shared: Mask, of: Any, unseen: float) -> Array32:
    """Return the extreme (H, W, 3), by cv2.erode or cv2.dilate, of a cell and its eight neighbours."""
    seen = np.where(is_shared[..., None], channels, np.float32(unseen))
    padded = np.concatenate([seen[:, -1:], seen, seen[:, :1]], axis=1)
    return np.asarray(of(padded, np.ones((3, 3), np.uint8))[:, 1:-1])


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
    seen_fraction: float  # of the sphere, what both show

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
    small = shrink(panorama, VIEW_WIDTH)
    view = render_view(points, pose, VIEW_WIDTH)
    is_shared = view.is_seen & small.is_valid
    weights = is_shared * (solid_angles(VIEW_WIDTH)[:, None] / (4.0 * math.pi))
    of_view = normalize_locally(view.rgb, is_shared, SIGMA_DEG)
    of_panorama = normalize_locally(small.rgb.astype(np.float32) / np.float32(255.0), is_shared, SIGMA_DEG)

    def total(values: Array32) -> float:
        return float((weights[..., None] * values).sum(dtype=np.float64))

    energy = math.sqrt(total(of_view**2) * total(of_panorama**2))
    correlation = total(of_view * of_panorama) / max(energy, 1e-9)
    return Agreement(correlation=correlation, seen_fraction=float(weights.sum()))
