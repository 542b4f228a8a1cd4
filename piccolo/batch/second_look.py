"""A second look at the photos of a batch that are not sure, beside others that are."""

import json
from collections.abc import Sequence
from typing import Any, NamedTuple

from ..confidence.confidence import AMBIGUOUS, LOCALIZED, NOT_LOCALIZED
from .localizer import MOST_PICTURES


class Line(NamedTuple):
    """A photo's result in a batch."""

    text: str  # its JSON
    status: str
    beside: list[str] | None  # as in `Result`
    is_pinhole: bool  # it has a camera: it is no sphere

    @property
    def is_sure(self) -> bool:
        """True if others may be localized beside it."""
        return self.status == LOCALIZED and not self.beside

    def is_to_do(self, is_again: bool) -> bool:
        """Return True if it may be surer beside others; `is_again` if these are others than before."""
        is_doubtful = self.is_pinhole and self.status in (AMBIGUOUS, NOT_LOCALIZED)
        return is_doubtful and (self.beside is None or is_again)


class Look(NamedTuple):
    """A photo to look at again."""

    number: int  # in the batch
    status: str  # so far
    first: str  # JSON of its result
    beside: tuple[str, ...]  # JSON of the results of photos that are sure


def parse_line(text: str) -> Line:
    """Return a line of results as far as a second look needs it."""
    fields: dict[str, Any] = json.loads(text)
    return Line(text, fields["status"], fields["beside"], bool(fields["camera"]))


def list_looks(texts: Sequence[str], is_again: bool) -> list[Look]:
    """List the photos to look at again among results in order, each with others that are sure.

    These are the nearest in order: what was taken one after another mostly belongs together. `is_again` if
    there are others than when the last ones were looked at.
    """
    lines = [parse_line(text) for text in texts]
    sure = [k for k, line in enumerate(lines) if line.is_sure]
    looks = []
    for k, line in enumerate(lines) if sure else ():
        if line.is_to_do(is_again):
            near = sorted(sorted(sure, key=lambda n: abs(n - k))[:MOST_PICTURES])
            looks.append(Look(k, line.status, line.text, tuple(lines[n].text for n in near)))
    return looks
