"""The case of a photo: all that the judge reads, as values."""

from typing import NamedTuple

from ..geometry.pose import Pose
from ..geometry.pose_gaussian import PoseGaussian
from ..photo.camera import Mount
from ..system.arrays import Array
from .candidate import Selection
from .probability import Mirrored, Standing
from .reasons import Contradiction
from .result_parts import Evidence, FocalLength, SphereGeometry


class Errors(NamedTuple):
    """The errors of the pose of a photo; its fields are None where the points do not fix it."""

    gaussian: PoseGaussian | None  # the pose in the map with its covariance
    # largest deviation of the position if focal length and stitching were exact, as an angle [rad]
    std_of_fit: float | None

    def widen(self, common: Array) -> "Errors":
        """Return the errors with a further one (6, 6) that photos have in common, as of a focal length."""
        return self._replace(gaussian=self.gaussian and self.gaussian.widen(common))


UNKNOWN_ERRORS = Errors(None, None)


class Measured(NamedTuple):
    """Measurements of the best candidate."""

    pose: Pose  # in the map
    errors: Errors
    loss: float
    evidence: Evidence
    contradicted: tuple[Contradiction, ...]  # prior knowledge that the pose contradicts


class Geometry(NamedTuple):
    """The geometry of a photo, as found by comparing it with the scan."""

    cameras: tuple[Mount, ...]  # as found
    doubt: float  # probability that the given geometry is wrong and has pulled the pose along
    conflict: float  # deviations between the picture and the given geometry
    std: float  # [m] of the position by the errors of the geometry
    focal_length: FocalLength | None = None  # of a photo whose focal length was fitted
    worst_correction: str = ""  # the correction of its lens in which the picture contradicts most
    sphere: SphereGeometry | None = None  # of a panorama that is not as it claims


class Case(NamedTuple):
    """All that the judge reads of a photo."""

    found: Selection  # with the alternatives that are reported
    standings: tuple[Standing, ...]  # evidence for the best pose and each alternative
    measured: Measured
    geometry: Geometry | None = None  # None if it was not compared with the scan
    mirrored: Mirrored | None = None  # None if the mirrored photo was not searched

    @property
    def is_mirrored(self) -> bool:
        """True if the mirrored photo fits better."""
        return self.mirrored is not None and self.mirrored.fits_better
