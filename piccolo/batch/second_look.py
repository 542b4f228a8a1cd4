"""A second look at the photos of a batch, with what the others say of their camera, or beside sure ones."""

import json
import math
from bisect import bisect
from collections.abc import Sequence
from dataclasses import replace
from hashlib import sha256
from typing import Any, NamedTuple

from ..confidence.confidence import AMBIGUOUS, LOCALIZED, NOT_LOCALIZED
from ..confidence.focal_length import Consensus
from ..confidence.localization import FocalLength
from ..localization.focal_length import WIDE
from ..localization.judge import follow_consensus
from ..result import Result, localization_of, with_localization

MOST_PICTURES = 200  # beside which a photo is looked at again
LEAST_CONFIDENCE = 0.95  # of these: about the log odds of 3 that frames of walks need
BETTER = 0.7  # others' deviation must be below this fraction of the photo's own
ONE_CAMERA = 1.02  # largest ratio of neighbouring given focal lengths of one camera: focusing changes them
TOLD_CHANGE = 1e-3  # of a confidence: a smaller one is not written again


class Line(NamedTuple):
    """A photo's result in a batch."""

    text: str  # its JSON
    pano: str
    pano_sha256: str | None
    status: str
    is_sure: bool  # others may be localized beside it
    has_camera: bool  # it is no sphere
    beside: dict[str, Any] | None  # of `Beside`
    focal: FocalLength | None = None
    image_size: tuple[int, int] = (0, 0)  # [px]

    @property
    def may_change(self) -> bool:
        """True if other photos may change the result."""
        return self.is_doubtful or self.focal is not None

    @property
    def is_doubtful(self) -> bool:
        """True for a photo of a camera that is not localized, or was not before others were beside it."""
        was_doubtful = self.beside is not None or self.status in (AMBIGUOUS, NOT_LOCALIZED)
        return self.has_camera and was_doubtful


class Look(NamedTuple):
    """A photo to look at again."""

    number: int  # in the batch
    status: str  # so far
    pano: str
    first: str  # JSON of its result without the others; empty if that is to be computed again
    beside: tuple[str, ...]  # JSON of the results of photos that are sure
    asked_sha256: str  # digest of these
    focal: FocalLength | None = None  # as found so far, with what other photos of the camera say


def parse_line(text: str) -> Line:
    """Return a line of results as far as a second look needs it."""
    fields: dict[str, Any] = json.loads(text)
    beside = fields["beside"]
    is_sure = fields["status"] == LOCALIZED and fields["confidence"] >= LEAST_CONFIDENCE and beside is None
    has_camera = bool(fields["camera"])
    digest = fields["pano_sha256"]
    focal = fields["focal_length"] and FocalLength(**fields["focal_length"])
    size = tuple(fields["image_size"] or (0, 0))
    return Line(text, fields["pano"], digest, fields["status"], is_sure, has_camera, beside, focal, size)


def list_looks_by_focal(texts: Sequence[str]) -> list[Look]:
    """List the photos whose focal length others know better, if they are not localized or theirs is off."""
    lines = [parse_line(text) for text in texts]
    looks = []
    for camera in group_by_camera(lines):
        consensus = Consensus([known.opinion for _, known in camera])
        for n, (k, focal) in enumerate(camera):
            line = lines[k]
            others = consensus.opinion(without=n)
            if others is None or focal.others_px is not None:
                continue
            px = focal.given_px * math.exp(others.off)
            std_px = math.sqrt(others.variance) * px
            told = replace(focal, others_px=px, others_std_px=std_px)
            is_off = abs(px - focal.px) > focal.std_px
            if std_px < BETTER * focal.std_px and (is_off or line.status != LOCALIZED):
                looks.append(Look(k, line.status, line.pano, "", (), digest_of([]), told))
    return looks


def list_changed_by_consensus(texts: Sequence[str], min_confidence: float) -> list[tuple[int, str, Result]]:
    """List the results that all photos of a camera change, by number, each with its status before.

    Together they may confirm the focal length given, doubt it, or contradict it.
    """
    lines = [parse_line(text) for text in texts]
    changed = []
    for camera in group_by_camera(lines):
        consensus = Consensus([known.opinion for _, known in camera]).opinion()
        if consensus is None:
            continue
        for k, _ in camera:
            before = Result.from_json(texts[k])
            after = with_localization(
                before, follow_consensus(localization_of(before), consensus, min_confidence)
            )
            after = replace(after, warnings=tuple(dict.fromkeys(after.warnings)))
            is_other = after.status != before.status or after.warnings != before.warnings
            if is_other or abs(after.confidence - before.confidence) > TOLD_CHANGE:
                changed.append((k, before.status, after))
    return changed


def group_by_camera(lines: Sequence[Line]) -> list[list[tuple[int, FocalLength]]]:
    """Return numbers and focal lengths of photos by camera: of one size, source and about what was given.

    Those whose focal length was a mere guess are left out.
    """
    known = [
        (line.image_size, line.focal.source, line.focal.given_px, k, line.focal)
        for k, line in enumerate(lines)
        if line.focal is not None and line.focal.prior_deviation <= WIDE
    ]
    groups: list[list[tuple[int, FocalLength]]] = []
    camera: tuple[object, ...] = ()
    largest = 0.0
    for size, source, px, k, focal in sorted(known, key=lambda one: one[:4]):
        if (size, source) != camera or px > largest:
            groups.append([])
        groups[-1].append((k, focal))
        camera = size, source
        largest = ONE_CAMERA * px
    return groups


def list_looks_beside(texts: Sequence[str]) -> list[Look]:
    """List the photos that are not sure, each with others that are.

    These are the nearest in order: what was taken one after another mostly belongs together. A photo that was
    looked at beside the same photos is done.
    """
    lines = [parse_line(text) for text in texts]
    sure = [k for k, line in enumerate(lines) if line.is_sure]
    looks = []
    for k, line in enumerate(lines):
        if not line.is_doubtful:
            continue
        place = bisect(sure, k)
        around = sure[max(place - MOST_PICTURES, 0) : place + MOST_PICTURES]
        near = [lines[n] for n in sorted(sorted(around, key=lambda n: abs(n - k))[:MOST_PICTURES])]
        asked = digest_of(near)
        if asked != (line.beside["asked_sha256"] if line.beside else digest_of([])):
            first = "" if line.beside and line.beside["photos"] else line.text
            beside = tuple(n.text for n in near)
            looks.append(Look(k, line.status, line.pano, first, beside, asked, line.focal))
    return looks


LISTINGS = (list_looks_by_focal, list_looks_beside)  # in their order


def digest_of(lines: Sequence[Line]) -> str:
    """Return a digest of photos: of their paths and contents."""
    return sha256(json.dumps([(line.pano, line.pano_sha256) for line in lines]).encode()).hexdigest()
