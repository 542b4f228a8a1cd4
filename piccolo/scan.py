"""The public class `Scan`: photos and walks are localized in it."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import fields, replace
from itertools import repeat
from pathlib import Path
from typing import Any

from .arguments import check_kind, check_one_each
from .arrays import Bytes, Floats
from .cloud.soa import PackedPoints
from .errors import InputError
from .files.atomic import check_output
from .geometry.pose import Gravity, Pose, check_pose
from .opened_scan import OpenedScan, Settings, make_failed_result
from .photo import File, Photo, Prior, as_photo
from .result import Result
from .scan_map.open_map import write_map
from .scan_map.scan_map import ScanMap
from .scan_walk import Walk
from .together.bundle_adjustment import RelativeScale
from .together.walk.frames import Motion

Picture = File | Bytes | Photo  # a path or an array (H, W, 3) is a photo without options


class Scan:
    """A scan in which photos can be localized: `open_scan` returns it. Several threads may use it at once.

    Its methods share the options `prior` (by default nothing is known), `gravity` ("known": the camera was
    upright, or as the photo says; "unknown": any rotation; "auto": both are tried) and `min_confidence`, the
    least confidence of a pose that is called localized. One that is None is that of the `settings` of
    `open_scan`, by default "auto" and 0.9.
    """

    def __init__(self, opened: OpenedScan) -> None:
        self._opened = opened

    def __repr__(self) -> str:
        """Return `Scan(...)` with the scan's name."""
        return f"Scan({self.name!r})"

    @property
    def name(self) -> str | tuple[str, ...]:
        """Path of the scan as given; a tuple of paths if several files are one scan; "arrays" for arrays."""
        return self._opened.name

    @property
    def seconds(self) -> dict[str, float]:
        """Time [s] spent on reading and preparing the scan, by stage."""
        return self._opened.seconds

    @property
    def points(self) -> PackedPoints:
        """Coloured points, to draw the scan: `x`, `y`, `z` (N,) [m] in the frame of `from_world`."""
        return self._opened.prepared.points

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about the scan, one line each."""
        return self._opened.warnings

    def from_world(self, pose: Pose) -> Pose:
        """Transform a pose from the scan's own coordinates to the frame of `points`."""
        return self._opened.prepared.from_world(check_pose(pose, "`pose`"))

    def save(self, path: File) -> None:
        """Write the prepared map to the file `path`, which `open_scan` opens in place of the scan's files.

        Raises InputError for a scan opened with `PaperSettings`, or too large to be prepared as a whole.
        """
        check_kind("path", path, File)
        if not isinstance(self._opened.prepared, ScanMap):
            raise InputError("save: found a scan of the preset paper, wanted one of the default method")
        check_output(Path(path))
        write_map(self._opened.prepared, Path(path), self._opened.workers)

    def localize(
        self,
        photo: Picture,
        *,
        prior: Prior | None = None,
        gravity: Gravity | None = None,
        min_confidence: float | None = None,
    ) -> Result:
        """Find the position and rotation of the camera that took a photo.

        Returns
        -------
        Result
            Its `status` is "localized", "ambiguous" or "not_localized"; not to be found is no error.

        Raises
        ------
        InputError
            The picture can't be read, or an option is invalid.

        Examples
        --------
        >>> import piccolo
        >>> scan = piccolo.open_scan("room/cloud.ply")
        >>> result = scan.localize("room/images/clean_0.jpg", gravity="known")
        >>> result.status, result.pose.center_world.round(2)
        ('localized', array([2.6 , 3.17, 1.21]))
        >>> photo = piccolo.Photo("room/images/clean_0.jpg", mask_nadir_deg=20.0)
        >>> scan.localize(photo, prior=piccolo.Prior(height=(1.0, 1.5))).status
        'localized'
        """
        return self._opened.localize(as_photo(photo), self._change(prior, gravity, min_confidence))

    def localize_many(
        self,
        photos: Iterable[Picture],
        *,
        prior: Prior | Sequence[Prior | None] | None = None,
        gravity: Gravity | None = None,
        min_confidence: float | None = None,
    ) -> Iterator[Result]:
        """Return an iterator over the results of photos, in order; each is computed when it is asked for.

        `prior` is one of all photos, or a list with one of each. The status of a photo that can't be read is
        "unreadable", or "failed" if another try may succeed; `error` says why.
        """
        check_kind("photos", photos, Iterable[Picture])
        check_kind("prior", prior, Prior | Sequence[Prior | None] | None)
        priors: Iterable[Prior | None] = repeat(prior) if prior is None or isinstance(prior, Prior) else prior
        if isinstance(prior, Sequence):
            photos = list(photos)
            check_one_each("prior", prior, len(photos), "photo")
        self._change(None, gravity, min_confidence)  # refused before the first photo is asked for

        def localize(picture: Picture, prior: Prior | None) -> Result:
            photo = as_photo(picture)
            settings = self._change(prior, gravity, min_confidence)
            self._opened.check_options(photo, settings)
            try:
                return self._opened.localize(photo, settings)
            except Exception as error:
                return make_failed_result(self._opened, photo, error, settings)

        return map(localize, photos, priors)

    def localize_bundle(
        self,
        photos: Iterable[Picture],
        relative_poses: Sequence[Pose],
        *,
        relative_scale: RelativeScale = "metres",
        prior: Prior | None = None,
        gravity: Gravity | None = None,
        min_confidence: float | None = None,
    ) -> list[Result]:
        """Localize photos together whose poses relative to each other are known.

        `relative_poses` has one of each photo, in any common frame [m], such as that of a phone's tracker.
        The scale of their positions is fitted: within 1 % of metres, or freely if `relative_scale` is
        "unknown", as of COLMAP. Raises InputError for a photo that can't be read.
        """
        check_kind("photos", photos, Iterable[Picture])
        check_kind("relative_poses", relative_poses, Sequence[Pose])
        check_kind("relative_scale", relative_scale, RelativeScale)
        given = [as_photo(photo) for photo in photos]
        check_one_each("relative_poses", relative_poses, len(given), "photo")
        settings = self._change(prior, gravity, min_confidence)
        return self._opened.localize_bundle(given, relative_poses, settings, relative_scale)

    def track(
        self,
        *,
        motion: Motion | None = None,
        prior: Prior | None = None,
        gravity: Gravity | None = None,
        min_confidence: float | None = None,
    ) -> Walk:
        """Track a camera that is carried through the scan, frame by frame.

        Returns
        -------
        Walk
            `add(frame, time=None)` returns the `Result` of the frame, from this frame and earlier ones;
            `time` [s] increases, and is given for all frames or for none. `finish()` returns a list with the
            result of each frame, from all frames.
        """
        check_kind("motion", motion, Motion | None)
        return Walk(self._opened, self._change(prior, gravity, min_confidence), motion or Motion())

    def localize_walk(
        self,
        frames: Iterable[Picture],
        times: Sequence[float] | Floats | None = None,
        *,
        odometry: Sequence[Pose | None] | None = None,
        motion: Motion | None = None,
        prior: Prior | None = None,
        gravity: Gravity | None = None,
    ) -> list[Result]:
        """Localize the frames of a walk together: each frame restricts the poses of the others.

        Parameters
        ----------
        frames
            Photos in the order in which they were taken.
        times
            Time of each frame [s], increasing. Without times only the order counts.
        odometry
            Pose of the camera at each frame in any common frame [m], or None.
        motion, prior, gravity
            As in `track`.

        Returns
        -------
        list of Result
            One for each frame, in order; `walk` says how its pose was found.

        Raises
        ------
        InputError
            Times and frames differ in number, times do not increase, or an option is invalid.

        Examples
        --------
        >>> import piccolo
        >>> scan = piccolo.open_scan("room/cloud.ply")
        >>> frames = ["room/images/clean_0.jpg", "room/images/clean_1.jpg"]
        >>> [result.status for result in scan.localize_walk(frames, times=[0.0, 5.0])]
        ['localized', 'localized']
        """
        walk = self.track(motion=motion, prior=prior, gravity=gravity)
        check_kind("frames", frames, Iterable[Picture])
        check_kind("times", times, Sequence[float] | Floats | None)
        check_kind("odometry", odometry, Sequence[Pose | None] | None)
        taken = [as_photo(frame) for frame in frames]
        check_one_each("times", times, len(taken), "frame")
        check_one_each("odometry", odometry, len(taken), "frame")
        nothing = [None] * len(taken)
        poses = [pose and check_pose(pose, "`odometry`") for pose in odometry or nothing]
        for frame, time, pose in zip(taken, nothing if times is None else times, poses, strict=True):
            walk.add(frame, time, odometry=pose)
        return walk.finish()

    def occlusion_mask(self, photo: Picture, pose: Pose) -> Bytes:
        """Return the pixels of a photo that contradict the scan at a pose, such as moved furniture.

        The array (H, W) of uint8 is a full sphere, W = 2 H, also for a photo of a part of it: 255 where the
        photo contradicts the scan, 0 where the scan explains it, 128 where one of them shows nothing.
        """
        return self._opened.occlusion_mask(as_photo(photo), pose)

    def _change(self, prior: Prior | None, gravity: Gravity | None, min_confidence: float | None) -> Settings:
        """Return the settings of `open_scan` with options that are not None in place of its own."""
        options: dict[str, Any] = {"prior": prior, "gravity": gravity, "min_confidence": min_confidence}
        given = {name: value for name, value in options.items() if value is not None}
        settings = self._opened.settings
        if unknown := given.keys() - {f.name for f in fields(settings)}:
            raise InputError(f"`{min(unknown)}`: not an option of the preset paper")
        return replace(settings, **given)
