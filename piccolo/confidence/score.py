"""How well the cloud at a pose explains a panorama, in terms that a blank wall can't win."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..cloud.soa import PackedPoints
from ..geometry.pose import Pose
from ..geometry.sphere import solid_angles
from ..panorama import Panorama
from ..panorama.local_normalization import normalize_locally
from ..panorama.model import shrink
from ..views.zbuffer import render_view

VIEW_WIDTH = 96  # cells of 3.75 degrees
SIGMA_DEG = 15.0  # of the Gaussian in which contrast is judged


@dataclass(frozen=True)
class Evidence:
    """What a confidence rests on."""

    score: float  # [0, 1] what the photo's blocks explain beyond chance; of preset paper, Agreement.score
    # lead over the best pose elsewhere in what both views show, by what it explains; 1 if there is none;
    # of preset paper, score less that of the best pose elsewhere
    margin: float
    agreement: float  # correlation over what both show, charged where that is under half of the sphere
    explained_fraction: float  # of what the panorama shows, by solid angle, see occlusion.py
    seen_fraction: float  # of the sphere, on which both show anything
    contradicted_fraction: float = 0.0  # of what the panorama shows; what is left was not scanned
    num_matches: int | None = None  # local features of the photo that agree with the pose; None: not asked
    alternative_matches: int | None = None  # the most that agree with a pose elsewhere


@dataclass(frozen=True)
class Agreement:
    """Cloud and panorama compared at a pose, by cells of the sphere."""

    correlation: float  # of locally normalised colours over what both show
    seen_fraction: float  # of the sphere, what both show

    @property
    def value(self) -> float:
        """The correlation; a view of which little is seen is charged below half a sphere."""
        return self.correlation * min(1.0, 2.0 * self.seen_fraction)

    @property
    def score(self) -> float:
        """The correlation times the root of the fraction that both show."""
        return self.correlation * math.sqrt(self.seen_fraction)


def agreement_at(points: PackedPoints, panorama: Panorama, pose: Pose) -> Agreement:
    """How well the cloud at `pose` explains the panorama."""
    small = shrink(panorama, VIEW_WIDTH)
    view = render_view(points, pose, VIEW_WIDTH)
    is_shared = view.is_seen & small.is_valid
    weights = is_shared * (solid_angles(VIEW_WIDTH)[:, None] / (4.0 * math.pi))
    of_view = normalize_locally(view.rgb, is_shared, SIGMA_DEG)
    of_panorama = normalize_locally(small.rgb.astype(np.float32) / np.float32(255.0), is_shared, SIGMA_DEG)

    def total(values: NDArray[np.float32]) -> float:
        return float((weights[..., None] * values).sum(dtype=np.float64))

    energy = math.sqrt(total(of_view**2) * total(of_panorama**2))
    return Agreement(
        correlation=total(of_view * of_panorama) / max(energy, 1e-9), seen_fraction=float(weights.sum())
    )
