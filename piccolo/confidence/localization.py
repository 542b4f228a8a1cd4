"""What a method finds for one panorama."""

from dataclasses import dataclass

from ..camera import Mount
from ..geometry.pose import Pose
from .alternatives import Hypothesis
from .confidence import NOT_LOCALIZED
from .covariance import PoseCovariance
from .score import Evidence


@dataclass(frozen=True)
class Localization:
    """The best pose for one panorama, in world coordinates, and what speaks for it and against it."""

    status: str = NOT_LOCALIZED
    confidence: float = 0.0
    pose: Pose | None = None  # None if there was no start, and then all that follows
    loss: float | None = None
    evidence: Evidence | None = None
    alternatives: tuple[Hypothesis, ...] = ()  # poses elsewhere, best first
    covariance: PoseCovariance | None = None
    warnings: tuple[str, ...] = ()  # one line each: why there is no pose
    cameras: tuple[Mount, ...] = ()  # refined; none if they stay as they were given
