"""A walk through a scan, frame by frame, and its results, as `Scan.track` makes it."""

import json
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .camera import Calibration
from .confidence.localization import Localization
from .files.json_file import reading_once
from .geometry.pose import Pose
from .jobs.stopwatch import Stopwatch
from .jobs.threads import Progress, no_progress
from .localization.query import Query
from .panorama import Panorama, ReadOptions, read_photo
from .panorama.photo import PhotoFacts, photo_of_array, read_photo_facts, sha256_of
from .result import Failure, Result, Source, describe_failure, result_of, unreadable_result
from .scan_map.named_scans import add_places
from .walk.beliefs import believe
from .walk.frames import Frame
from .walk.motion import check_times
from .walk.results import WalkFrame, make_localization, make_localizations, result_alone
from .walk.second_look import finish
from .walk.tracker import Tracker

Picture = str | PathLike[str] | NDArray[np.uint8]


@dataclass(frozen=True)
class WalkAbout:
    """Fields that all results of a walk repeat."""

    cloud: str | tuple[str, ...]
    warnings: tuple[str, ...]
    settings: dict[str, object]


@dataclass(frozen=True)
class Taken:
    """Facts of a frame besides its poses."""

    name: str
    photo: PhotoFacts | None  # None of one that can't be read
    seconds: dict[str, float]
    warnings: tuple[str, ...] = ()
    sha256: str | None = None  # of the file or files
    failure: Failure | None = None  # why it can't be read


@dataclass(frozen=True)
class Kept:
    """A frame as it is kept on disk until the walk is finished."""

    taken: Taken
    frame: Frame


class Prepared(NamedTuple):
    """A frame that is ready to be tracked."""

    picture: Picture
    taken: Taken
    panorama: Panorama | None  # None of one that can't be read
    query: Query | None


def photo_facts(picture: Picture, rig: Calibration | None) -> PhotoFacts:
    """Return the facts of a photo besides its pixels: digest, size, time, place."""
    return (
        photo_of_array(picture) if isinstance(picture, np.ndarray) else read_photo_facts(Path(picture), rig)
    )


class Walk:
    """A camera tracked through a scan: `add` frames in order; `finish` uses all frames together."""

    def __init__(self, tracker: Tracker, read_options: ReadOptions, about: WalkAbout) -> None:
        self.tracker = tracker
        tracker.read = self._panorama
        self.read_options = read_options
        self.about = about
        self.pictures: list[Picture] = []
        self.taken: list[Taken] = []

    def add(
        self,
        frame: Picture,
        time: float | None = None,
        name: str | None = None,
        odometry: Pose | None = None,
    ) -> Result:
        """Localize a frame, by it and the frames before.

        A frame that can't be read has a result that says so. `time` [s] counts from any beginning, and is
        given for all frames or for none; `name` replaces the path in the result. `odometry` is the camera's
        pose in any frame that all poses of an odometry share [m].
        """
        return self.follow(self.prepare(frame, name), time, odometry)

    def prepare(self, frame: Picture, name: str | None = None) -> Prepared:
        """Read a frame and prepare what does not depend on other frames; another thread may do it.

        Of a live camera, one thread prepares frames and another follows them. Two cores do most with a scan
        that was opened with one thread.
        """
        watch = Stopwatch()
        name = name or ("array" if isinstance(frame, np.ndarray) else str(frame))
        with reading_once():
            try:
                with watch.stage("read"):
                    panorama = replace(read_photo(frame, self.read_options), focal_prior=None)  # as exact
                    photo = photo_facts(frame, self.read_options.rig)
            except Exception as error:
                text, is_passing = describe_failure(error)
                if isinstance(frame, np.ndarray):
                    raise
                failure = Failure(text.replace(str(frame), name), is_passing)
                digest = self._digest(frame)
                return Prepared(frame, Taken(name, None, watch.seconds, (), digest, failure), None, None)
        with watch.stage("prepare"):
            query = self.tracker.prepare(panorama)
        warnings = tuple(warning.replace(str(frame), name) for warning in panorama.warnings)
        taken = Taken(name, photo, watch.seconds, warnings, photo.sha256)
        return Prepared(frame, taken, panorama, query)

    def follow(self, prepared: Prepared, time: float | None = None, odometry: Pose | None = None) -> Result:
        """Localize a prepared frame, as `add` does."""
        number = len(self.taken)
        picture, taken, panorama, query = prepared
        when = float(number) if time is None else float(time)
        if self.tracker.frames:
            check_times([self.tracker.frames[-1].time, when])
        elif time is None:
            self.tracker.forget_times()
            self.about.settings["walk"] = self.tracker.motion.to_settings()
        watch = Stopwatch(taken.seconds)
        if panorama is None or query is None:
            self.tracker.accept(Frame(when, odometry=odometry))
        else:
            with watch.stage("track"):
                self.tracker.add(panorama, query, when, odometry)
        self.pictures.append(picture)
        self.taken.append(taken)
        return self._now(self.tracker.frames[-1], number)

    def last_to_json(self) -> str:
        """Return what is known of the last frame on one line, for `restore`."""
        from msgspec import to_builtins  # noqa: PLC0415  # only walks with a file wait for it

        kept = Kept(self.taken[-1], self.tracker.frames[-1])
        return json.dumps(to_builtins(kept, enc_hook=np.ndarray.tolist))  # of any name: msgspec's is of UTF-8

    def restore(self, line: bytes, picture: Path, time: float, name: str) -> bool:
        """Take the next frame from a line of `last_to_json`, if it is of this picture, unchanged.

        Raises ValueError if it is no such line.
        """
        from msgspec import convert  # noqa: PLC0415  # only walks with a file wait for it

        kept = convert(json.loads(line), Kept, dec_hook=lambda _, rows: np.array(rows))
        taken = kept.taken
        found = taken.name, kept.frame.time, taken.sha256
        is_same = found == (name, time, self._digest(picture))
        if not is_same or (taken.failure and taken.failure.is_passing):
            return False
        self.pictures.append(picture)
        self.taken.append(taken)
        self.tracker.accept(kept.frame)
        return True

    def finish(self, show: Progress = no_progress) -> list[Result]:
        """Return the result of each frame, given all frames."""
        path, beliefs = finish(self.tracker, show)
        found = make_localizations(self.tracker, path, beliefs)
        return [
            self._result(taken, add_places(self.tracker.scan_map, f), walk)
            for taken, (f, walk) in zip(self.taken, found, strict=True)
        ]

    def _now(self, frame: Frame, number: int) -> Result:
        path = self.tracker.lattice.filter_path()
        found = make_localization(self.tracker, frame, believe(self.tracker.frames, path, number))
        walk = WalkFrame(frame.time, number, frame.how, result_alone(frame), None)
        return self._result(self.taken[number], add_places(self.tracker.scan_map, found), walk)

    def _panorama(self, k: int) -> Panorama | None:
        """Return the picture of an earlier frame; None if it can't be read, or is another now."""
        picture = self.pictures[k]
        taken = self.taken[k]
        with reading_once():
            is_same = isinstance(picture, np.ndarray) or self._digest(picture) == taken.sha256
            if taken.failure is not None or not is_same:
                return None
            return replace(read_photo(picture, self.read_options), focal_prior=None)

    def _digest(self, picture: str | PathLike[str]) -> str | None:
        return sha256_of(Path(picture), self.read_options.rig)

    def _result(self, taken: Taken, found: Localization, walk: WalkFrame | None) -> Result:
        """Return the result of a frame; a frame that can't be read keeps its place in the walk."""
        about = self.about
        photo = taken.photo
        digest = self.tracker.scan_map.scan_sha256 or None
        if photo is None:
            text, is_passing = taken.failure or ("", False)
            more = {"settings": about.settings, "source": Source(digest, taken.sha256)}
            return unreadable_result(text, about.cloud, taken.name, is_passing, walk=walk, **more)
        return result_of(
            found,
            cloud=about.cloud,
            pano=taken.name,
            seconds=taken.seconds,
            settings=about.settings,
            warnings=about.warnings + taken.warnings,
            source=Source(digest, photo.sha256, photo.image_size, photo.capture_time),
            walk=walk,
        )
