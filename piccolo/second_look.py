"""A second look at one photo of a scan that is not sure, beside others that are."""

from collections.abc import Callable, Mapping
from dataclasses import replace

from .files.json_file import reading_once
from .geometry.nearness import CONFIRMED
from .jobs.threads import Stopwatch, Workers
from .judge.result import Result
from .localization.localize import has_guessed_focal
from .localization.places import add_places
from .panorama.photo import read_photo_facts
from .photo import Photo
from .photo_reader import PhotoReader
from .problem.problem import prepare_problem
from .problem.settings import CoarseToFineSettings
from .scan_map.scan_map import ScanMap
from .together.beside import SurePhoto, localize_beside, place_sure


def place_keypoints(
    scan_map: ScanMap,
    reader: PhotoReader,
    workers: Workers,
    photo: Photo,
    result: Result,
    settings: CoarseToFineSettings,
) -> SurePhoto | None:
    """Return the keypoints of a photo that is localized; None if it is another photo now."""
    with reading_once():
        picture = reader.read(photo.with_refined_camera(result.cameras))
        digest = read_photo_facts(photo).sha256
    if digest != result.source.pano_sha256 or result.best_pose is None:
        return None
    problem = prepare_problem(picture, scan_map, settings.prior, settings.gravity, settings.method)
    return place_sure(problem, result.best_pose, result.covariance, result.confidence, workers)


def localize_again(
    scan_map: ScanMap,
    reader: PhotoReader,
    workers: Workers,
    photo: Photo,
    first: Result,
    list_pictures: Callable[[], Mapping[str, SurePhoto]],
    settings: CoarseToFineSettings,
) -> tuple[Result, tuple[str, ...]]:
    """Localize a photo that is not sure, beside others that are; return also the names of these.

    `list_pictures` returns those that are asked, by name. If none shows the same, the result is the first
    one. A photo whose focal length is a guess is not looked at.
    """
    watch = Stopwatch(dict(first.seconds))
    focal = first.focal_length
    picture, facts = reader.take(photo, watch, focal)
    if has_guessed_focal(picture) or scan_map.has_shape or facts.sha256 != first.source.pano_sha256:
        return first, ()
    known = [pose for pose in (first.best_pose, *(a.pose for a in first.alternatives)) if pose]
    poses = [scan_map.from_world(pose) for pose in known]
    with watch.stage("read"):
        pictures = list_pictures()
    found, names = localize_beside(scan_map, picture, poses, pictures, settings, workers, watch)
    is_surer = found.confidence > first.confidence
    is_other = first.best_pose and found.best_pose and not CONFIRMED.holds(found.best_pose, first.best_pose)
    if not names or not (is_surer or is_other):
        return first, ()
    if focal is not None:
        found = replace(found, focal_length=focal.update(found.focal_length))
    elif found.focal_length is not None:  # only what a photo says alone counts for others
        alone = replace(found.focal_length, picture_px=None, picture_std_px=None)
        found = replace(found, focal_length=alone)
    blank = reader.make_blank(photo, picture, facts, settings, watch.seconds)
    found = add_places(scan_map, found).complete(blank)
    return replace(found, gps_prior=first.gps_prior), names
