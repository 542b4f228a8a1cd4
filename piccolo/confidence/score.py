"""Is the pose right? A score that a blank wall can't win, and what speaks for the pose beside it."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from ..cloud.soa import PackedPoints
from ..geometry.pose import Pose
from ..geometry.sphere import solid_angles
from ..panorama import Panorama
from ..panorama.resize import shrink
from ..render.zbuffer import render_view

VIEW_WIDTH = 96  # cells of 3.75 degrees
LOCAL_SIGMA = 4.0  # cells: the neighbourhood in which contrast is judged, 15 degrees
EPSILON = 0.03  # contrast below this counts as noise
CLIP = 2.0
AGREEING = 1.0  # deviations of local contrast by which two colours that agree may differ


@dataclass(frozen=True)
class Evidence:
    """What a verdict rests on."""

    score: float  # locally normalised correlation of cloud and panorama at the pose, [-1, 1]
    margin: float  # score less that of the best pose elsewhere, or less 0 if there is none above
    agreement: float  # correlation over what both show, charged where that is under half of the sphere
    explained_share: float  # of what the panorama shows, by solid angle, the share explained
    inlier_share: float  # of what both show, the share that agrees
    seen_share: float  # of the sphere, the share on which the cloud shows anything
    residual_p20: float  # 20th percentile of the colours' difference (RGB norm) over what both show
    rival_share: float = (
        0.0  # score of the best rival that is a bottom of the loss too, as a share of the own
    )
    halves_distance: float | None = None  # between the poses that two halves of the points lead to [m]
    halves_angle: float | None = None  # [rad]


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


def evidence_at(points: PackedPoints, panorama: Panorama, pose: Pose) -> Evidence:
    """How well the cloud at `pose` explains the panorama, by cells of the sphere; no rival is known yet."""
    small = shrink(panorama, VIEW_WIDTH)
    rgb = small.rgb.astype(np.float32) / np.float32(255.0)
    view = render_view(points, pose, VIEW_WIDTH)
    counts = view.is_seen & small.is_valid
    weights = counts * solid_angles(VIEW_WIDTH)[:, None]
    of_view = local_contrast(opponent_channels(view.rgb), counts)
    of_panorama = local_contrast(opponent_channels(rgb), counts)
    energy = math.sqrt(float((weights * of_view**2).sum()) * float((weights * of_panorama**2).sum()))
    correlation = float((weights * of_view * of_panorama).sum()) / max(energy, 1e-9)
    agreeing = float((weights * (np.linalg.norm(of_view - of_panorama, axis=0) < AGREEING)).sum())
    area = max(float(weights.sum()), 1e-9)
    shown = max(float((small.is_valid * solid_angles(VIEW_WIDTH)[:, None]).sum()), 1e-9)
    # A view of which little is seen can't be sure: below half of the sphere, the score is charged.
    seen_share = area / (4.0 * math.pi)
    score = correlation * min(1.0, 2.0 * seen_share)
    residuals = np.linalg.norm(view.rgb - rgb, axis=-1)
    return Evidence(
        score=score,
        margin=max(score, 0.0),
        agreement=score,
        explained_share=agreeing / shown,
        inlier_share=agreeing / area,
        seen_share=seen_share,
        residual_p20=_weighted_percentile(residuals, weights, 20.0) if counts.any() else math.sqrt(3.0),
    )


def _weighted_percentile(values: NDArray[np.float32], weights: NDArray[np.float64], percent: float) -> float:
    return float(np.percentile(values.ravel(), percent, weights=weights.ravel(), method="inverted_cdf"))
