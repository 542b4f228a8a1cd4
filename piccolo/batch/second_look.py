"""A second look at the photos of a batch, with what the others say of their camera, or beside sure ones."""

import json
import math
from bisect import bisect
from collections.abc import Sequence
from dataclasses import replace
from hashlib import sha256
from typing import NamedTuple

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


class Look(NamedTuple):
    """A photo to look at again."""

    number: int  # in the batch
    status: str  # so far
    pano: str
    first: str  # JSON of its result without the others; empty if that is to be computed again
    beside: tuple[str, ...]  # JSON of the results of photos that are sure
    asked_sha256: str  # digest of these
    focal: FocalLength | None = None  # as found so far, with what other photos of the camera say


def is_doubtful(result: Result) -> bool:
    """Return True for a photo of a camera that is not localized, or was not before others were beside it."""
    was_doubtful = result.beside is not None or result.status in (AMBIGUOUS, NOT_LOCALIZED)
    return bool(result.cameras) and was_doubtful


def may_change(text: str) -> bool:
    """Return True if other photos may change the result in a line."""
    result = Result.from_json(text)
    return is_doubtful(result) or result.focal_length is not None


def list_looks_by_focal(texts: Sequence[str]) -> list[Look]:
    """List the photos whose focal length others know better, if they are not localized or theirs is off."""
    results = list(map(Result.from_json, texts))
    looks = []
    for camera in group_by_camera(results):
        consensus = Consensus([known.opinion for _, known in camera])
        for n, (k, focal) in enumerate(camera):
            others = consensus.opinion(without=n)
            if others is None or focal.others_px is not None:
                continue
            px = focal.given_px * math.exp(others.off)
            std_px = math.sqrt(others.variance) * px
            told = replace(focal, others_px=px, others_std_px=std_px)
            is_off = abs(px - focal.px) > focal.std_px
            status = results[k].status
            if std_px < BETTER * focal.std_px and (is_off or status != LOCALIZED):
                looks.append(Look(k, status, results[k].pano, "", (), digest_of([]), told))
    return looks


def list_changed_by_consensus(texts: Sequence[str], min_confidence: float) -> list[tuple[int, str, Result]]:
    """List the results that all photos of a camera change, by number, each with its status before.

    Together they may confirm the focal length given, doubt it, or contradict it.
    """
    results = list(map(Result.from_json, texts))
    changed = []
    for camera in group_by_camera(results):
        consensus = Consensus([known.opinion for _, known in camera]).opinion()
        if consensus is None:
            continue
        for k, _ in camera:
            before = results[k]
            after = with_localization(
                before, follow_consensus(localization_of(before), consensus, min_confidence)
            )
            after = replace(after, warnings=tuple(dict.fromkeys(after.warnings)))
            is_other = after.status != before.status or after.warnings != before.warnings
            if is_other or abs(after.confidence - before.confidence) > TOLD_CHANGE:
                changed.append((k, before.status, after))
    return changed


def group_by_camera(results: Sequence[Result]) -> list[list[tuple[int, FocalLength]]]:
    """Return numbers and focal lengths of photos by camera: of one size, source and about what was given.

    Those whose focal length was a mere guess are left out.
    """
    known = [
        (result.source.image_size or (0, 0), focal.source, focal.given_px, k, focal)
        for k, result in enumerate(results)
        if (focal := result.focal_length) is not None and focal.prior_deviation <= WIDE
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
    results = list(map(Result.from_json, texts))
    sure = [
        k
        for k, result in enumerate(results)
        if result.status == LOCALIZED and result.confidence >= LEAST_CONFIDENCE and result.beside is None
    ]
    looks = []
    for k, result in enumerate(results):
        if not is_doubtful(result):
            continue
        place = bisect(sure, k)
        around = sure[max(place - MOST_PICTURES, 0) : place + MOST_PICTURES]
        near = sorted(sorted(around, key=lambda n: abs(n - k))[:MOST_PICTURES])
        asked = digest_of([results[n] for n in near])
        if asked != (result.beside.asked_sha256 if result.beside else digest_of([])):
            first = "" if result.beside and result.beside.photos else texts[k]
            beside = tuple(texts[n] for n in near)
            looks.append(Look(k, result.status, result.pano, first, beside, asked, result.focal_length))
    return looks


LISTINGS = (list_looks_by_focal, list_looks_beside)  # in their order


def digest_of(results: Sequence[Result]) -> str:
    """Return a digest of photos: of their paths and contents."""
    photos = [(result.pano, result.source.pano_sha256) for result in results]
    return sha256(json.dumps(photos).encode()).hexdigest()
