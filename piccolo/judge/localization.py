"""Results of a method for one panorama."""

import math
from dataclasses import dataclass, replace

from ..camera import Mount
from ..geometry.pose import Pose
from ..geometry.pose_gaussian import PoseGaussian
from .belief import NOTHING, Belief, decide
from .consensus import Opinion
from .pose_covariance import PoseCovariance
from .probability import NOT_LOCALIZED, Standing


@dataclass(frozen=True)
class Evidence:
    """The measurements that a confidence rests on."""

    score: float  # [0, 1] what the photo's blocks explain beyond chance; of preset paper, Agreement.score
    # lead over the best pose elsewhere in what both views show, divided by what this pose explains there; 1
    # if there is no pose elsewhere; of preset paper, score less that of the best pose elsewhere
    margin: float
    agreement: float  # correlation over what both show, charged where that is under half of the sphere
    explained_fraction: float  # of what the panorama shows, by solid angle, see Occlusion
    seen_fraction: float  # of the sphere, on which both show anything
    contradicted_fraction: float = 0.0  # of what the panorama shows; what is left was not scanned
    num_matches: int | None = None  # local features of the photo that agree with the pose; None: not asked
    alternative_matches: int | None = None  # the most that agree with a pose elsewhere


@dataclass(frozen=True)
class Alternative:
    """A pose elsewhere that was found too, in world coordinates."""

    pose: Pose
    score: float  # as of Evidence
    num_matches: int | None = None  # local features that agree with it
    probability: float = 0.0  # that it is right
    scan: str | None = None  # name of the scan in which it lies, of a map that names its scans


@dataclass(frozen=True)
class FocalLength:
    """A focal length estimated from a photo and the scan, and its prior."""

    px: float  # across
    std_px: float
    given_px: float
    given_std_px: float
    picture_px: float | None = None  # by the photo and the scan alone; None if they tell nothing
    picture_std_px: float | None = None
    doubt: float = 0.0  # probability that what was given is wrong and has pulled this along
    source: str = ""  # of what was given: the option, or EXIF
    others_px: float | None = None  # by other photos of the camera, where that was taken for the one given
    others_std_px: float | None = None

    @property
    def prior_deviation(self) -> float:
        """Standard deviation of the logarithm of what was given."""
        return self.given_std_px / self.given_px

    @property
    def opinion(self) -> Opinion | None:
        """The opinion of the photo alone; None if it has none."""
        if self.picture_px is None or self.picture_std_px is None:
            return None
        off = math.log(self.picture_px / self.given_px)
        return Opinion(off, (self.picture_std_px / self.picture_px) ** 2)

    def update(self, found: "FocalLength | None") -> "FocalLength":
        """Return this with what a later fit found; what was given and what the photo said alone stay."""
        return self if found is None else replace(self, px=found.px, std_px=found.std_px, doubt=found.doubt)


@dataclass(frozen=True)
class SphereGeometry:
    """The part of the sphere that a panorama shows, and where its horizon lies."""

    width_deg: float  # 360 of a whole sphere
    height_deg: float  # 180 of a whole sphere
    horizon_deg: float  # below the picture's middle
    std_deg: tuple[float, float, float]  # deviations of these

    def explain(self) -> str:
        """Say in a line what the panorama shows."""
        shown = f"the panorama shows {self.width_deg:.1f} x {self.height_deg:.1f} of 360 x 180 degrees"
        horizon = abs(self.horizon_deg)
        side = "below" if self.horizon_deg > 0.0 else "above"
        return f"{shown}, its horizon {horizon:.1f} deg {side} the middle: taken as that"


@dataclass(frozen=True)
class Localization:
    """The best pose for one panorama, in world coordinates, and the evidence for and against it."""

    status: str = NOT_LOCALIZED
    belief: Belief = NOTHING  # in the pose and the alternatives
    pose: Pose | None = None  # None, as are loss to covariance, if nothing was searched
    loss: float | None = None
    evidence: Evidence | None = None
    alternatives: tuple[Alternative, ...] = ()  # poses elsewhere, best first
    covariance: PoseCovariance | None = None
    warnings: tuple[str, ...] = ()  # one line each: why there is no pose, or to doubt it
    cameras: tuple[Mount, ...] = ()  # of a photo whose focal length was fitted: the camera found
    focal_length: FocalLength | None = None  # of such a photo
    sphere: SphereGeometry | None = None  # of a panorama that is not as it claims
    scan: str | None = None  # as of Alternative
    storey: int | None = None  # of the pose, 1 the lowest; None where no floor was found
    height_above_floor: float | None = None  # [m] of the pose, above the floor there
    # not in results:
    gaussian: PoseGaussian | None = None  # pose and covariance, in the map
    std_of_fit: float | None = None  # [m] largest deviation if focal length and stitching were exact
    standings: tuple[Standing, ...] = ()  # evidence for the pose and each alternative

    @property
    def confidence(self) -> float:
        """Probability of the best pose; 0 if there is none."""
        best, *others = self.belief.probabilities.tolist()
        return float(best) if others else 0.0

    @property
    def probability_none(self) -> float:
        """Probability that no pose listed is right."""
        return float(self.belief.probabilities[-1])

    def take_belief(self, belief: Belief, min_confidence: float) -> "Localization":
        """Return this with what is believed of its pose and its alternatives, and the status that follows."""
        status, probabilities = decide(belief, min_confidence)
        pairs = zip(self.alternatives, probabilities[1:-1].tolist(), strict=True)
        others = tuple(replace(alternative, probability=p) for alternative, p in pairs)
        return replace(self, status=status, belief=belief, alternatives=others)
