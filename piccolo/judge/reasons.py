"""Reasons that rule out a pose, whatever its probability is, and their words."""

from collections.abc import Mapping
from enum import StrEnum
from typing import NamedTuple


class Reason(StrEnum):
    """Reason that rules out every pose of a photo; its value stands in results."""

    NOWHERE = "nowhere"  # the scan has no position that is allowed by what was told
    WITHIN = "within"  # the pose is in another scan than those told
    NEAR = "near"  # the pose is away from the place told
    HEIGHT = "height"  # the pose is at another height than told
    HEADING = "heading"  # the pose looks elsewhere than told
    CALIBRATION = "calibration"  # the photo contradicts its focal length or another number of its lens
    CAMERA = "camera"  # all photos of the camera together contradict its focal length
    SPHERE = "sphere"  # the panorama does not show the sphere as it claims
    MIRRORED = "mirrored"  # the mirrored photo fits better


class Contradiction(NamedTuple):
    """A pose that contradicts what was told of it."""

    reason: Reason
    found: float | str | None
    told: tuple[float, ...] | str


MIRRORED = "the photo fits the scan better mirrored, left for right: turn it over and try again"
# of poses that contradict what was told
WORDS: Mapping[Reason, str] = {
    Reason.WITHIN: "the pose found is in the scan {found!r}, not in {told}",
    Reason.NEAR: "the pose found is {found:.2f} m from the place given, not within {told[0]:g} m",
    Reason.HEIGHT: "the pose found is {found:.2f} m above the floor, not {told[0]:g} to {told[1]:g} m",
    Reason.HEADING: (
        "the pose found looks {found:.0f} deg away from the heading given, more than {told[0]:g} deg"
    ),
}


def explain(contradiction: Contradiction) -> str:
    """Say in a line how a pose contradicts what was told."""
    return WORDS[contradiction.reason].format(found=contradiction.found, told=contradiction.told)
