"""The parts of a photo's result: evidence, alternatives, its camera, its place in a walk."""

import math
from dataclasses import dataclass, replace

from ..geometry.pose import Pose
from .consensus import Opinion

WIDE = 0.05  # a focal length with a larger deviation is a guess: k1 is fitted too


@dataclass(frozen=True)
class Evidence:
    """The measurements from which a confidence is computed."""

    score: float  # [0, 1] what the photo's blocks explain beyond chance; of preset paper, Agreement.score
    # lead over the best pose elsewhere, as a share of the area that this pose explains, over what both views
    # show; 1 if there is no pose elsewhere; of preset paper, score less that of the best pose elsewhere
    margin: float
    agreement: float  # correlation over what both show, reduced if that is less than half of the sphere
    explained_fraction: float  # of the area that the panorama shows, by solid angle (see Occlusion)
    seen_fraction: float  # fraction of the sphere where panorama and scan both show something
    contradicted_fraction: float = 0.0  # of the area that the panorama shows; the rest of it was not scanned
    num_matches: int | None = None  # local features of the photo that agree with the pose; None: not counted
    alternative_matches: int | None = None  # the most that agree with a pose elsewhere


@dataclass(frozen=True)
class Alternative:
    """Another pose of a photo, at another place, in world coordinates."""

    pose: Pose
    score: float  # as in Evidence
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
    picture_px: float | None = None  # by the photo and the scan alone; None if they do not determine it
    picture_std_px: float | None = None
    doubt: float = 0.0  # probability that the given one is wrong and has pulled this one along
    source: str = ""  # of the given one: the option, or EXIF
    others_px: float | None = None  # by other photos of the camera, where used in place of the given one
    others_std_px: float | None = None

    @property
    def prior_deviation(self) -> float:
        """Standard deviation of the logarithm of the given focal length."""
        return self.given_std_px / self.given_px

    @property
    def is_guess(self) -> bool:
        """True if the given focal length is hardly more than a guess."""
        return self.prior_deviation > WIDE

    @property
    def opinion(self) -> Opinion | None:
        """The opinion of the photo alone; None if it has none."""
        if self.picture_px is None or self.picture_std_px is None:
            return None
        off = math.log(self.picture_px / self.given_px)
        return Opinion(off, (self.picture_std_px / self.picture_px) ** 2)

    def update(self, found: "FocalLength | None") -> "FocalLength":
        """Return the focal length of a later fit, with the given one and the photo's own estimate kept."""
        return self if found is None else replace(self, px=found.px, std_px=found.std_px, doubt=found.doubt)


@dataclass(frozen=True)
class SphereGeometry:
    """The part of the sphere that a panorama shows, and where its horizon lies."""

    width_deg: float  # 360 of a whole sphere
    height_deg: float  # 180 of a whole sphere
    horizon_deg: float  # below the picture's middle
    std_deg: tuple[float, float, float]  # deviations of these

    def explain(self) -> str:
        """Return a line that says which part of the sphere the panorama shows."""
        shown = f"the panorama shows {self.width_deg:.1f} x {self.height_deg:.1f} of 360 x 180 degrees"
        horizon = abs(self.horizon_deg)
        side = "below" if self.horizon_deg > 0.0 else "above"
        return f"{shown}, its horizon {horizon:.1f} deg {side} the middle: taken as that"


@dataclass(frozen=True)
class Source:
    """The scan and the photo of a result; None where that is not known."""

    cloud_sha256: str | None = None  # of the scan's file; if several, of their sorted digests, one a line
    pano_sha256: str | None = None  # of the photo's file; if cube faces, of their digests in order
    image_size: tuple[int, int] | None = None  # width and height of the picture as it is stored [px]
    capture_time: str | None = None  # by EXIF, ISO 8601, with the offset from UTC if EXIF has it


@dataclass(frozen=True)
class Beside:
    """The photos beside which a photo was localized again, or with which it was localized together."""

    photos: tuple[str, ...]  # paths of the photos that show the same, those with the most matches first
    asked_sha256: str  # digest of all photos that might have shown the same
    is_together: bool = False  # it was localized together with photos that were taken with it


@dataclass(frozen=True)
class Gap:
    """A part of a walk that is too long for its time: a lift, a cut, a camera in a pocket."""

    distance: float  # [m]
    seconds: float


@dataclass(frozen=True)
class Alone:
    """The result of a frame that was localized without the other frames."""

    status: str
    confidence: float
    pose: Pose | None  # in the world


@dataclass(frozen=True)
class WalkFrame:
    """A frame's place in a walk."""

    time: float  # [s] from the walk's beginning; of frames without times their number
    frame: int  # from 0
    how: str  # where its pose comes from: "alone", "tracked", "near", or "none"
    alone: Alone | None  # None if it was not localized without the other frames
    gap: Gap | None  # before the frame; None if there is none, or the frames have no times
