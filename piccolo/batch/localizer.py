"""Answers to the photos of a batch, in this process or where else the scan is opened.

Photos that are unsure, or off in focal length, get a second look with that of others, or beside sure ones.
"""

import json
import math
from bisect import bisect
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

from .. import __version__
from ..camera import Calibration
from ..cloud.settings import CloudSettings
from ..errors import InputError, is_passing
from ..evidence.focal_length import WIDE
from ..files.atomic import temporary_folder, write_temporary
from ..files.json_file import reading_once
from ..jobs.cluster import find_sent_file
from ..jobs.memory import limit_memory
from ..jobs.processes import WorkerLostError
from ..jobs.threads import Workers
from ..judge.conclude import follow_consensus
from ..judge.consensus import Consensus
from ..judge.probability import AMBIGUOUS, LOCALIZED, NOT_LOCALIZED
from ..judge.result import Result
from ..judge.result_parts import Beside, FocalLength, Source
from ..judge.sure import SURE_CONFIDENCE
from ..localization.means import Step, Trace
from ..opening import open_files
from ..photo import Photo, Vector
from ..photo_reader import Settings, settings_json, unreadable_result
from ..problem.settings import CoarseToFineSettings
from ..scan import Scan
from ..scan_map.map_file import load_map
from ..scan_map.open_map import CachePolicy
from ..second_look import localize_again, place_keypoints
from ..together.beside import SurePhoto
from ..views.pictures import encode_image, overlay_png
from .inputs import PriorTable

BESIDE = "photos beside others"
MOST_PICTURES = 200  # beside which a photo is looked at again
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
    """Return True for a photo with `cameras` that is not localized, or was not without others beside it."""
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
            after = follow_consensus(before, consensus, min_confidence)
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
        if result.status == LOCALIZED and result.confidence >= SURE_CONFIDENCE and result.beside is None
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


class Task(NamedTuple):
    """A photo to be localized."""

    photo: Photo
    settings: Settings
    files: Mapping[str, bytes] | None = None  # what is at its path, where that is not to be seen
    look: Look | None = None  # if it is looked at again

    @contextmanager
    def place(self, folder: Path) -> Iterator[Photo]:
        """Yield the photo at its path here: relative to a folder, or written from the files."""
        if self.files is None:
            yield replace(self.photo, picture=folder / self.photo.path)
            return
        with temporary_folder() as temporary:
            for name, content in self.files.items():
                path = temporary / name
                path.parent.mkdir(parents=True, exist_ok=True)
                write_temporary(path, content)
            yield replace(self.photo, picture=temporary / self.photo.path.name)


def files_of(pano: Path) -> dict[str, bytes]:
    """Return the content of a photo's file, or of all files in its folder; none of what can't be read."""
    with suppress(OSError):
        paths = sorted(pano.rglob("*")) if pano.is_dir() else [pano]
        return {str(path.relative_to(pano.parent)): path.read_bytes() for path in paths if path.is_file()}
    return {}


class Answer(NamedTuple):
    """A result, and the pictures that go with it."""

    result: Result
    warnings: tuple[str, ...] = ()  # of the photo, without those of the scan
    overlay: bytes | None = None  # PNG
    occlusion_mask: bytes | None = None  # PNG
    steps: tuple[Step, ...] = ()  # of the search


@dataclass(frozen=True)
class Localizer:
    """A scan and the options for its photos, which answer tasks; pickled for other processes."""

    paths: tuple[Path, ...]  # of the scan
    settings: Settings  # for which the scan is prepared
    cloud_settings: CloudSettings
    photo: Photo  # the options of all photos; its picture is none
    cache: CachePolicy
    priors: PriorTable | None = None
    num_threads: int = 1
    max_memory: float | None = None  # [10^9 byte], of a process
    makes_overlays: bool = False
    makes_occlusion_masks: bool = False
    is_traced: bool = False
    folder: Path = Path()  # which paths are relative to
    map_name: str | None = None  # of a map's file: absolute, or as a cluster's workers have been sent it
    sends_photos: bool = False

    @property
    def name(self) -> str | tuple[str, ...]:
        """The scan's path as given, or the paths of its files."""
        return str(self.paths[0]) if len(self.paths) == 1 else tuple(map(str, self.paths))

    def ask(self, pano: Path) -> tuple[Photo, Settings]:
        """Return a photo and its settings, with its own row of the table of priors if it has one."""
        photo = replace(self.photo, picture=pano)
        settings = self.settings
        if self.priors is None or not isinstance(settings, CoarseToFineSettings):
            return photo, settings
        photo, prior = self.priors.apply(photo, settings.prior)
        return photo, replace(settings, prior=prior)

    def task(self, pano: Path, calibration: Calibration | None = None) -> Task:
        """Return what is to be done for a photo; its calibration counts if no option gives one."""
        photo, settings = self.ask(pano)
        if calibration is not None and photo.camera is None and photo.rig is None:
            photo = photo.with_calibration(calibration)
        return Task(photo, settings, files_of(pano) if self.sends_photos else None)

    def expect(
        self, cloud_sha256: str, more: Mapping[str, Any] | None = None
    ) -> Callable[[Path], Mapping[str, Any]]:
        """Return a function of a photo's path: the fields that say how its line was made, with `more`."""

        @lru_cache
        def make_fields(settings: Settings, gravity_vector: Vector | None) -> Mapping[str, Any]:
            scan = {"cloud_sha256": cloud_sha256, "cloud": self.name}
            photo = replace(self.photo, gravity_vector=gravity_vector)
            repeated = settings_json(settings, self.cloud_settings, photo) | dict(more or {})
            return dict(json.loads(json.dumps({**scan, "settings": repeated, "version": __version__})))

        def expect(pano: Path) -> Mapping[str, Any]:
            photo, settings = self.ask(pano)
            return make_fields(settings, photo.gravity_vector)

        return expect

    def open(self) -> Callable[[Task], Answer]:
        """Open the scan in this process; return what answers tasks."""
        return self.answer_in(self.open_here())

    def open_here(self) -> Scan:
        """Open the scan with a process's own threads and memory."""
        limit_memory(self.max_memory)
        return self.open_scan(Workers(self.num_threads))

    def answer_in(self, scan: Scan) -> Callable[[Task], Answer]:
        """Return what answers tasks in an opened scan."""
        return partial(self.answer, scan, lru_cache(MOST_PICTURES)(partial(self.place_keypoints, scan)))

    def open_scan(self, workers: Workers) -> Scan:
        """Read and prepare the scan."""
        if self.map_name:
            path = Path(self.map_name)
            scan_map = load_map(path if path.is_absolute() else find_sent_file(self.map_name))
            return Scan(scan_map, self.name, self.cloud_settings, self.settings, workers, {})
        paths = [self.folder / path for path in self.paths]
        scan = open_files(paths, self.cloud_settings, self.settings, self.cache, workers)
        return replace(scan, name=self.name)

    def answer(self, scan: Scan, place_keypoints: Callable[[str], SurePhoto | None], task: Task) -> Answer:
        """Localize one photo, and make the pictures asked for; of one that can't be read say why.

        `place_keypoints` returns a photo that is sure by its result's JSON.
        """
        name = task.photo.name
        trace = Trace(self.is_traced)
        with task.place(self.folder) as photo, reading_once():
            try:
                if task.look is None:
                    found = scan.localize_photo(photo, task.settings, trace=trace)
                else:
                    found = look_again(scan, photo, task.settings, task.look, place_keypoints)
                overlay, mask = self._pictures(scan, photo, found)
            except Exception as error:
                return Answer(scan.reader.make_failed(photo, error, task.settings, name))
        warnings = tuple(warning.replace(photo.name, name) for warning in found.warnings)
        result = replace(found, pano=name, warnings=warnings)
        return Answer(result, warnings[len(scan.warnings) :], overlay, mask, tuple(trace.steps))

    def place_keypoints(self, scan: Scan, line: str) -> SurePhoto | None:
        """Return a photo that is sure, by the JSON of its result; None if it is another or none any more."""
        result = Result.from_json(line)
        photo, settings = self.ask(Path(result.pano))
        try:
            photo = replace(photo, picture=self.folder / photo.path)
            scan_map, settings = scan.require_default_method(BESIDE, settings)
            return place_keypoints(scan_map, scan.reader, scan.workers, photo, result, settings)
        except (OSError, InputError) as error:
            if is_passing(error):
                raise
        return None

    def give_up(self, task: Task, error: WorkerLostError, cloud_sha256: str | None) -> Answer:
        """Return the answer to a task whose workers were lost."""
        name = task.photo.name
        settings = settings_json(task.settings, self.cloud_settings, task.photo)
        about = {"settings": settings, "source": Source(cloud_sha256)}
        return Answer(unreadable_result(f"{name}: {error}", self.name, name, is_passing=True, **about))

    def _pictures(self, scan: Scan, photo: Photo, result: Result) -> tuple[bytes | None, bytes | None]:
        """Overlay and occlusion mask as PNG, where they are asked for and there is a pose."""
        overlay = mask = None
        pose = result.best_pose
        if pose is None:
            return overlay, mask
        photo = photo.with_refined_camera(result.cameras)
        if self.makes_overlays:
            local = scan.prepared.from_world(pose)
            overlay = overlay_png(scan.prepared.points, scan.reader.read(photo), local, scan.workers)
        if self.makes_occlusion_masks:
            mask = encode_image(scan.occlusion_mask(photo, pose), ".png")
        return overlay, mask


def look_again(
    scan: Scan,
    photo: Photo,
    settings: Settings,
    look: Look,
    place_keypoints: Callable[[str], SurePhoto | None],
) -> Result:
    """Localize a photo again: with the focal length that others tell, or beside others."""

    def list_pictures() -> dict[str, SurePhoto]:
        found = ((json.loads(line)["pano"], place_keypoints(line)) for line in look.beside)
        return {name: picture for name, picture in found if picture}

    first = Result.from_json(look.first) if look.first else scan.localize_photo(photo, settings, look.focal)
    if not look.beside:
        return replace(first, beside=None)
    scan_map, settings = scan.require_default_method(BESIDE, settings)
    found, names = localize_again(scan_map, scan.reader, scan.workers, photo, first, list_pictures, settings)
    return replace(found, beside=Beside(names, look.asked_sha256))
