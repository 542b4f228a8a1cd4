"""Is the pose right? A score that a blank wall can't win, and what speaks for the pose beside it."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from .cloud.packed import PackedPoints
from .panorama import Panorama
from .pose import Pose
from .pyramid import shrink
from .render import render_view
from .sphere import solid_angles

VIEW_WIDTH = 96  # cells of 3.75 degrees
LOCAL_SIGMA = 4.0  # cells: the neighbourhood in which contrast is judged, 15 degrees
EPSILON = 0.03  # contrast below this counts as noise
CLIP = 2.0
INLIER_RESIDUAL = 0.1  # RGB norm below which a direction's colours agree

# Locally normalised correlation is 0.34 to 0.79 at right poses and below 0.25 in wrong basins, the margin to
# the best distinct rival at least 0.21 and at most 0.11 (ENGINE prototypes); the lines lie between.
MIN_SCORE = 0.3
MIN_MARGIN = 0.1


@dataclass(frozen=True)
class Evidence:
    """What a verdict rests on."""

    score: float  # locally normalised correlation of cloud and panorama at the pose, [-1, 1]
    inlier_share: float  # of the sphere's part that both show, the share whose colours agree
    seen_share: float  # share of the sphere on which the cloud shows anything


def opponent_channels(rgb: NDArray[np.float32]) -> NDArray[np.float32]:
    """Luminance and two opponent colours (3, H, W) of an image (H, W, 3)."""
    r, g, b = np.moveaxis(rgb, -1, 0)
    return np.stack([(r + g + b) / 3.0, (r - b) / 2.0, (2.0 * g - r - b) / 4.0])


def _blur(values: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(gaussian_filter(values, LOCAL_SIGMA, mode=("nearest", "wrap")))


def local_contrast(channels: NDArray[np.float32], counts: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Channels (C, H, W) less their local mean, by their local deviation, clipped; 0 where not `counts`."""
    weight = counts.astype(np.float32)
    share = np.maximum(_blur(weight), 1e-3)
    normalized = []
    for values in channels:
        mean = _blur(values * weight) / share
        variance = _blur((values - mean) ** 2 * weight) / share
        normalized.append(np.clip((values - mean) / (np.sqrt(variance) + EPSILON), -CLIP, CLIP) * weight)
    return np.stack(normalized)


def evidence_at(points: PackedPoints, panorama: Panorama, pose: Pose, residual: float) -> Evidence:
    """How well the cloud at `pose` explains the panorama; colours agree within `residual` (RGB norm)."""
    small = shrink(panorama, VIEW_WIDTH)
    rgb = small.rgb.astype(np.float32) / np.float32(255.0)
    view = render_view(points, pose, VIEW_WIDTH)
    counts = view.is_seen & small.is_valid
    weights = counts * solid_angles(VIEW_WIDTH)[:, None]
    of_view = local_contrast(opponent_channels(view.rgb), counts)
    of_panorama = local_contrast(opponent_channels(rgb), counts)
    energy = math.sqrt(float((weights * of_view**2).sum()) * float((weights * of_panorama**2).sum()))
    correlation = float((weights * of_view * of_panorama).sum()) / max(energy, 1e-9)
    agrees = np.linalg.norm(view.rgb - rgb, axis=-1) < residual
    area = max(float(weights.sum()), 1e-9)
    # A view of which little is seen can't be sure: below half of the sphere, the score is charged.
    seen_share = area / (4.0 * math.pi)
    score = correlation * min(1.0, 2.0 * seen_share)
    return Evidence(score, float((weights * agrees).sum()) / area, seen_share)
