"""Reasons that rule out a pose, whatever its probability is, and the warnings that explain them."""

from collections.abc import Mapping
from enum import StrEnum
from typing import NamedTuple


class Reason(StrEnum):
    """Reason that rules out every pose of a photo; its value stands in results."""

    NOWHERE = "nowhere"  # the scan has no position that the prior allows
    WITHIN = "within"  # the pose is in another scan than the given ones
    NEAR = "near"  # the pose is away from the given place
    HEIGHT = "height"  # the pose is at another height than the given one
    HEADING = "heading"  # the pose looks in another direction than the given one
    CALIBRATION = "calibration"  # the photo contradicts its focal length or another number of its lens
    CAMERA = "camera"  # all photos of the camera together contradict its focal length
    SPHERE = "sphere"  # the panorama does not show the sphere as it claims
    MIRRORED = "mirrored"  # the mirrored photo fits better


class Contradiction(NamedTuple):
    """A value of a pose that contradicts the given one."""

    reason: Reason
    found: float | str | None
    given: tuple[float, ...] | str


MIRRORED = "the photo fits the scan better mirrored, left for right: turn it over and try again"
# warnings of poses that contradict prior knowledge
WORDS: Mapping[Reason, str] = {
    Reason.WITHIN: "the pose found is in the scan {found!r}, not in {given}",
    Reason.NEAR: "the pose found is {found:.2f} m from the place given, not within {given[0]:g} m",
    Reason.HEIGHT: "the pose found is {found:.2f} m above the floor, not {given[0]:g} to {given[1]:g} m",
    Reason.HEADING: (
        "the pose found looks {found:.0f} deg away from the heading given, more than {given[0]:g} deg"
    ),
}


def explain(contradiction: Contradiction) -> str:
    """Return a line that says how a pose contradicts prior knowledge."""
    return WORDS[contradiction.reason].format(found=contradiction.found, given=contradiction.given)
