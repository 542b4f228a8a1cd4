"""Second looks: which photos of a batch are localized again, and the focal length of a camera by its photos.

Photos that are unsure, or whose focal length is off, are localized again with the focal length of the others,
then beside photos that are sure, then together with the photos that were taken with them. A look beside sure
photos of the batch takes only matches with these. A look together needs no sure photo, but each photo is
searched once more.
"""

import json
import math
from bisect import bisect
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from hashlib import sha256
from typing import NamedTuple, TypeVar

from ..judge.conclude import follow_consensus
from ..judge.consensus import Consensus
from ..judge.probability import AMBIGUOUS, LOCALIZED, NOT_LOCALIZED
from ..judge.result import Result
from ..judge.result_parts import WIDE, Beside, FocalLength
from ..judge.sure import SURE_CONFIDENCE
from .series import list_series

MOST_PICTURES = 200  # sure photos beside which a photo is localized again
BETTER = 0.7  # the others' deviation of the focal length must be below this fraction of the photo's own
ONE_CAMERA = 1.02  # largest ratio of neighbouring given focal lengths of one camera: focusing changes them
LEAST_WRITTEN_CHANGE = 1e-3  # of a confidence: after a smaller one, a result is not written again
Item = TypeVar("Item")


class Look(NamedTuple):
    """A photo to be localized again."""

    number: int  # in the batch
    pano: str
    first: Result | None  # the result without the others; None if it is to be computed again
    beside: tuple[Result, ...]  # results of sure photos, beside which it is to be localized
    asked_sha256: str  # digest of the photos `beside`, or of the series
    focal: FocalLength | None = None  # as found so far, with that of the other photos of the camera
    series: tuple[Result, ...] = ()  # it and the photos taken with it, if they are to be localized together


class Change(NamedTuple):
    """A result that other photos of the batch have changed."""

    number: int  # in the batch
    before: Result
    after: Result
    is_news: bool  # False if only the confidence has changed, or how the photo was localized


def is_doubtful(result: Result) -> bool:
    """Return True for a photo with `cameras` that is not localized, or was not without others beside it."""
    was_doubtful = result.beside is not None or result.status in (AMBIGUOUS, NOT_LOCALIZED)
    return bool(result.cameras) and was_doubtful


def may_change(result: Result) -> bool:
    """Return True if other photos may change a result."""
    return is_doubtful(result) or result.focal_length is not None


def localize_in_order(
    photos: Sequence[Item],
    localize: Callable[[Item], Result],
    look_again: Callable[[Item, Look], Result],
    min_confidence: float,
) -> Iterator[Result]:
    """Yield the results of photos in order; a result that may still change holds back those behind it."""
    results: list[Result] = []
    num_yielded = 0
    for photo in photos:
        results.append(localize(photo))
        if num_yielded == len(results) - 1 and not may_change(results[-1]):
            num_yielded += 1
            yield results[-1]

    def make_looks(looks: Sequence[Look]) -> Iterator[Result]:
        return (look_again(photos[look.number], look) for look in looks)

    for _ in revise(results, make_looks, min_confidence):
        pass
    yield from results[num_yielded:]


def revise(
    results: list[Result], make_looks: Callable[[Sequence[Look]], Iterable[Result]], min_confidence: float
) -> Iterator[Change]:
    """Localize photos again by the evidence of others, replace their results in the list; yield each change.

    `make_looks` returns the results of looks in their order. A result with an error changes nothing. If it
    returns fewer results, as the work was interrupted, no more looks follow.
    """
    for list_looks in LISTINGS:
        yield from follow_cameras(results, min_confidence)
        looks = list_looks(results)
        num_answers = 0
        for num_answers, after in enumerate(make_looks(looks), 1):
            look = looks[num_answers - 1]
            if after.error is None:
                is_news = look.first is None or names_of(after) not in ((), names_of(look.first))
                change = Change(look.number, results[look.number], after, is_news)
                results[look.number] = after
                yield change
        if num_answers < len(looks):
            return
    yield from follow_cameras(results, min_confidence)


def follow_cameras(results: list[Result], min_confidence: float) -> Iterator[Change]:
    """Replace results in their list by the focal length of all photos of a camera, and yield each change.

    Together, the photos may confirm the given focal length, make it doubtful, or contradict it.
    """
    for camera in group_by_camera(results):
        consensus = Consensus([known.opinion for _, known in camera]).opinion()
        if consensus is None:
            continue
        for k, _ in camera:
            before = results[k]
            after = follow_consensus(before, consensus, min_confidence)
            after = replace(after, warnings=tuple(dict.fromkeys(after.warnings)))
            is_other = after.status != before.status or after.warnings != before.warnings
            if is_other or abs(after.confidence - before.confidence) > LEAST_WRITTEN_CHANGE:
                results[k] = after
                yield Change(k, before, after, after.status != before.status)


def list_looks_by_focal(results: Sequence[Result]) -> list[Look]:
    """List the photos whose focal length others know better, if they are not localized or it is off."""
    looks = []
    for camera in group_by_camera(results):
        consensus = Consensus([known.opinion for _, known in camera])
        for n, (k, focal) in enumerate(camera):
            others = consensus.opinion(without=n)
            if others is None or focal.others_px is not None:
                continue
            px = focal.given_px * math.exp(others.off)
            std_px = math.sqrt(others.variance) * px
            with_others = replace(focal, others_px=px, others_std_px=std_px)
            is_off = abs(px - focal.px) > focal.std_px
            if std_px < BETTER * focal.std_px and (is_off or results[k].status != LOCALIZED):
                looks.append(Look(k, results[k].pano, None, (), digest_of([]), with_others))
    return looks


def group_by_camera(results: Sequence[Result]) -> list[list[tuple[int, FocalLength]]]:
    """Return numbers and focal lengths of photos by camera.

    Photos are of one camera if size, source and, nearly, the given focal length are the same. Photos whose
    focal length was a mere guess are left out.
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


def list_looks_beside(results: Sequence[Result]) -> list[Look]:
    """List the photos that are not sure, each with others that are.

    The others are those nearest in order, as photos that were taken one after another mostly belong together.
    A photo that has been localized beside the same photos before, with the same series, is left out.
    """
    series = {k: numbers for numbers in list_series(results) for k in numbers}
    sure = [
        k
        for k, result in enumerate(results)
        if result.status == LOCALIZED and result.confidence >= SURE_CONFIDENCE and result.beside is None
    ]
    looks = []
    for k, result in enumerate(results):
        if not is_doubtful(result):
            continue
        place = bisect(sure, k)
        around = sure[max(place - MOST_PICTURES, 0) : place + MOST_PICTURES]
        near = [results[n] for n in sorted(sorted(around, key=lambda n: abs(n - k))[:MOST_PICTURES])]
        asked = digest_of([*near, *(results[n] for n in series.get(k, ()))])
        if result.beside.asked_sha256 != asked if result.beside else near:
            first = None if names_of(result) else result
            looks.append(Look(k, result.pano, first, tuple(near), asked, result.focal_length))
    return looks


def list_looks_together(results: Sequence[Result]) -> list[Look]:
    """List the photos that are still not localized, each with those that were taken with it."""
    looks = []
    for numbers in list_series(results):
        series = tuple(results[k] for k in numbers)
        for k, result in zip(numbers, series, strict=True):
            beside = result.beside or Beside((), digest_of(series))
            if result.status in (AMBIGUOUS, NOT_LOCALIZED) and not beside.is_together:
                looks.append(Look(k, result.pano, result, (), beside.asked_sha256, None, series))
    return looks


def follow(first: Result, found: Result) -> Result:
    """Return the result of a second look, with the photo's own estimate of its focal length from the first.

    Only a photo's estimate from itself alone counts for the focal length of others.
    """
    focal = found.focal_length
    if first.focal_length is not None:
        focal = first.focal_length.update(focal)
    elif focal is not None:
        focal = replace(focal, picture_px=None, picture_std_px=None)
    return replace(found, focal_length=focal, gps_prior=first.gps_prior)


def names_of(result: Result) -> tuple[str, ...]:
    """Return the names of the other photos that have contributed to a result."""
    return result.beside.photos if result.beside else ()


LISTINGS = (list_looks_by_focal, list_looks_beside, list_looks_together)  # in their order


def digest_of(results: Sequence[Result]) -> str:
    """Return a digest of the paths and contents of photos."""
    photos = [(result.pano, result.source.pano_sha256) for result in results]
    return sha256(json.dumps(photos).encode()).hexdigest()
