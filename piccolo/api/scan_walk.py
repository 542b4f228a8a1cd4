"""A walk through a scan, frame by frame, and its results: what `Scan.track` returns."""

import json
from dataclasses import asdict, replace
from typing import NamedTuple

import numpy as np

from .. import __version__
from ..geometry.pose import Pose, check_pose
from ..judge.result import Result
from ..judge.result_parts import WalkFrame
from ..localization.place_names import add_places
from ..photo.panorama import Panorama, read_panorama
from ..photo.panorama.facts import read_photo_facts, sha256_of
from ..photo.photo import File, Photo, as_photo
from ..poses.times import check_times
from ..problem.problem import Problem
from ..system.arguments import check_kind
from ..system.arrays import Bytes
from ..system.errors import InputError
from ..system.files.json_file import reading_once
from ..system.jobs.threads import Progress, Stopwatch, no_progress
from ..together.walk.frames import Frame
from ..together.walk.path import believe
from ..together.walk.results import describe_frame, make_localization, make_localizations
from ..together.walk.tracker import Tracker
from .photo_reader import PhotoReader, settings_json

NO_REFINING = "`refine_focal`: not an option of walks; refine the focal length with a single photo"


class Prepared(NamedTuple):
    """A frame that is ready to be tracked."""

    photo: Photo
    blank: Result  # without a pose yet
    panorama: Panorama | None  # None if the frame can't be read
    problem: Problem | None  # None if the frame can't be read


class Walk:
    """A camera tracked through a scan: `add` frames in order; `finish` uses all frames together."""

    def __init__(self, reader: PhotoReader, tracker: Tracker) -> None:
        self.reader = reader
        self.tracker = tracker
        self.tracker.read = self._read_again
        self.more_settings: dict[str, object] = {}  # that results list too
        self.photos: list[Photo] = []
        self.blanks: list[Result] = []  # of the frames so far, without poses
        self.has_times = True  # the frames are given with times

    def settings_of(self, photo: Photo) -> dict[str, object]:
        """Return the settings of a frame in the form of a result's JSON."""
        settings = settings_json(self.tracker.settings, self.reader.cloud_settings, photo)
        motion = self.tracker.motion
        return {**settings, "walk": {**asdict(motion), "max_speed": motion.speed}, **self.more_settings}

    def key_of(self, photo: Photo) -> dict[str, object]:
        """Return settings, scan and version, which must be the same if an interrupted walk is continued."""
        settings = json.loads(json.dumps(self.settings_of(photo)))
        digest = self.tracker.scan_map.scan_sha256 or None
        return {"settings": settings, "cloud_sha256": digest, "version": __version__}

    def add(
        self,
        frame: File | Bytes | Photo,
        time: float | None = None,
        name: str | None = None,
        odometry: Pose | None = None,
    ) -> Result:
        """Localize a frame by this frame and those before.

        The result of a frame that can't be read says so. `time` [s] counts from any moment, and is given for
        all frames or for none; `name` replaces the path in the result. `odometry` is the camera's pose [m] in
        a frame of reference that is the same for the whole walk. Raise InputError for a focal length that is
        to be refined.
        """
        check_kind("time", time, float | None)
        check_kind("name", name, str | None)
        return self.follow(self.prepare(frame, name), time, odometry)

    def prepare(self, frame: File | Bytes | Photo, name: str | None = None) -> Prepared:
        """Read a frame and do the work that does not depend on other frames; another thread may call this.

        For a live camera, one thread prepares frames and another follows them. On two cores this is fastest
        with a scan that was opened with one thread.
        """
        watch = Stopwatch()
        photo = as_photo(frame)
        name = name or photo.name
        settings = self.tracker.settings
        if photo.refine_focal:
            raise InputError(NO_REFINING)
        with reading_once():
            try:
                with watch.stage("read"):
                    panorama = self._read(photo, name)
                    facts = read_photo_facts(photo)
            except Exception as error:
                if isinstance(photo.picture, np.ndarray):
                    raise
                failed = self.reader.make_failed(photo, error, settings, name)
                return Prepared(photo, failed, None, None)
        with watch.stage("prepare"):
            problem = self.tracker.prepare(panorama)
        blank = self.reader.make_blank(photo, panorama, facts, settings, watch.seconds)
        return Prepared(photo, replace(blank, pano=name), panorama, problem)

    def follow(self, prepared: Prepared, time: float | None = None, odometry: Pose | None = None) -> Result:
        """Localize a prepared frame, as `add` does."""
        number = len(self.blanks)
        photo, blank, panorama, problem = prepared
        odometry = None if odometry is None else check_pose(odometry, "`odometry`")
        if number and self.has_times != (time is not None):
            raise InputError(f"`time`: found {time} at frame {number}, wanted it of all frames or of none")
        self.has_times = time is not None
        when = float(number) if time is None else float(time)
        if self.tracker.frames:
            check_times([self.tracker.frames[-1].time, when])
        elif time is None:
            self.tracker.forget_times()
        if panorama is None or problem is None:
            self.tracker.accept(Frame(when, odometry=odometry))
        else:
            with Stopwatch(blank.seconds).stage("track"):
                self.tracker.add(panorama, problem, when, odometry)
        self.photos.append(photo)
        self.blanks.append(replace(blank, settings=self.settings_of(photo)))
        belief = believe(self.tracker.frames, self.tracker.lattice.filter_path(), number)
        found = make_localization(self.tracker, self.tracker.frames[number], belief)
        return self._result(self.blanks[-1], found, describe_frame(self.tracker.frames, number, None))

    def last_to_json(self) -> str:
        """Return the state of the last frame in one line of text, for `restore`."""
        from msgspec import to_builtins  # noqa: PLC0415  # imported only for walks with a file

        kept = self.blanks[-1].to_json(), self.tracker.frames[-1]
        return json.dumps(to_builtins(kept, enc_hook=np.ndarray.tolist))  # msgspec's is UTF-8 only

    def restore(self, text: str, photo: Photo) -> None:
        """Restore the next frame, a photo's, from a text of `last_to_json`, or raise ValueError."""
        from msgspec import convert  # noqa: PLC0415  # imported only for walks with a file

        kept = tuple[str, Frame]
        blank, frame = convert(json.loads(text), kept, dec_hook=lambda _, rows: np.array(rows))
        self.photos.append(photo)
        self.blanks.append(replace(Result.from_json(blank), settings=self.settings_of(photo)))
        self.tracker.accept(frame)

    def finish(self, show: Progress = no_progress) -> list[Result]:
        """Return the result of each frame by all frames."""
        found = make_localizations(self.tracker, show)
        return [self._result(blank, *parts) for blank, parts in zip(self.blanks, found, strict=True)]

    def _result(self, blank: Result, found: Result, walk: WalkFrame) -> Result:
        """Return the result of a frame; a frame that can't be read has no pose, but keeps its place."""
        blank = replace(blank, walk=walk)
        return blank if blank.error else add_places(self.tracker.scan_map, found).complete(blank)

    def _read(self, photo: Photo, name: str) -> Panorama:
        """Read a photo; its warnings use `name`, and its focal length is taken as exact."""
        panorama = read_panorama(photo)
        path = name if isinstance(photo.picture, np.ndarray) else photo.name
        warnings = tuple(warning.replace(path, name) for warning in panorama.warnings)
        return replace(panorama, focal_prior=None, warnings=warnings)

    def _read_again(self, k: int) -> Panorama | None:
        """Read the photo of an earlier frame again; None if it can't be read, or its file has changed."""
        photo = self.photos[k]
        blank = self.blanks[k]
        if blank.error is not None:
            return None
        with reading_once():
            is_array = isinstance(photo.picture, np.ndarray)
            is_same = is_array or sha256_of(photo.path, photo.instant) == blank.source.pano_sha256
            return self._read(photo, blank.pano) if is_same else None
