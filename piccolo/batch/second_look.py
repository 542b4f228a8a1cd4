"""A second look at the photos of a batch that are not sure, beside others that are."""

import json
from bisect import bisect
from collections.abc import Sequence
from hashlib import sha256
from typing import Any, NamedTuple

from ..confidence.confidence import AMBIGUOUS, LOCALIZED, NOT_LOCALIZED

MOST_PICTURES = 200  # beside which a photo is looked at again
LEAST_CONFIDENCE = 0.95  # of these: about the log odds of 3 that frames of walks need


class Line(NamedTuple):
    """A photo's result in a batch."""

    text: str  # its JSON
    pano: str
    pano_sha256: str | None
    status: str
    is_sure: bool  # others may be localized beside it
    has_camera: bool  # it is no sphere
    beside: dict[str, Any] | None  # of `Beside`

    @property
    def is_doubtful(self) -> bool:
        """True if it may be surer beside others, or was not sure before it was looked at beside others."""
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


def parse_line(text: str) -> Line:
    """Return a line of results as far as a second look needs it."""
    fields: dict[str, Any] = json.loads(text)
    beside = fields["beside"]
    is_sure = fields["status"] == LOCALIZED and fields["confidence"] >= LEAST_CONFIDENCE and beside is None
    has_camera = bool(fields["camera"])
    digest = fields["pano_sha256"]
    return Line(text, fields["pano"], digest, fields["status"], is_sure, has_camera, beside)


def list_looks(texts: Sequence[str]) -> list[Look]:
    """List the photos to look at again among results in order, each with others that are sure.

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
            looks.append(Look(k, line.status, line.pano, first, tuple(n.text for n in near), asked))
    return looks


def digest_of(lines: Sequence[Line]) -> str:
    """Return a digest of photos: of their paths and contents."""
    return sha256(json.dumps([(line.pano, line.pano_sha256) for line in lines]).encode()).hexdigest()
