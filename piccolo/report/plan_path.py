"""The paths of walks on plans, coloured by how likely their frames are right."""

from collections.abc import Iterator, Sequence
from itertools import groupby, pairwise
from typing import Any, NamedTuple

import cv2
import numpy as np

LEAST_ON_PATH = 0.5  # frames that are less likely right are passed over
EVERY_NUMBER = 20  # of a walk's frames are numbered


class Segment(NamedTuple):
    """From a frame of a walk to the next that is on its path."""

    begin: dict[str, Any]
    end: dict[str, Any]
    confidence: float  # the less of both
    is_gap: bool  # no walking person can have gone there


def segments_of(photos: Sequence[dict[str, Any]]) -> Iterator[Segment]:
    """The paths of the walks among the photos of a plan, from storey to storey not drawn."""
    frames = sorted((p for p in photos if p["walk"] is not None), key=lambda p: (p["walk"], p["time"]))
    for _, walk in groupby(frames, key=lambda p: p["walk"]):
        known = [p for p in walk if p["pose"] and p["confidence"] >= LEAST_ON_PATH]
        for begin, end in pairwise(known):
            if begin["storey"] == end["storey"] or None in (begin["storey"], end["storey"]):
                yield Segment(begin, end, min(begin["confidence"], end["confidence"]), end["gap"])


def color_of(confidence: float) -> tuple[int, int, int]:
    """Red, green, blue: viridis from yellow (0.5) to dark blue (1)."""
    share = (1.0 - np.clip(confidence, LEAST_ON_PATH, 1.0)) / (1.0 - LEAST_ON_PATH)
    level = np.array([[round(255 * share)]], np.uint8)
    blue, green, red = cv2.applyColorMap(level, cv2.COLORMAP_VIRIDIS)[0, 0]
    return int(red), int(green), int(blue)


def is_numbered(number: int, photo: dict[str, Any]) -> bool:
    """True for a photo that stands alone, and for some of a walk's frames."""
    return photo["walk"] is None or number % EVERY_NUMBER == 1
