"""The public class `Scan`: photos, bundles of photos and walks are localized in it."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from itertools import repeat
from pathlib import Path
from typing import Any

from ..cloud.cloud_settings import CloudSettings
from ..evidence.occlusion import occlusion_mask
from ..geometry.points import PackedPoints
from ..geometry.pose import Gravity, Pose, check_pose
from ..judge.result import Result
from ..judge.result_parts import FocalLength
from ..localization.means import NO_TRACE, Trace
from ..localization.paper import PaperMap
from ..photo.panorama import read_panorama
from ..photo.photo import File, Photo, Prior, as_photo
from ..poses.bundle_adjustment import RelativePoses
from ..problem.accuracy import Accuracy
from ..problem.settings import CoarseToFineSettings
from ..scan_map.open_map import write_map
from ..scan_map.scan_map import ScanMap, check_within
from ..system.arguments import check_kind, check_one_each
from ..system.arrays import Bytes, Floats
from ..system.errors import InputError
from ..system.files.atomic import check_output
from ..system.jobs.threads import Workers
from ..together.coloring.painting import Coloring
from ..together.second_looks import Look, localize_in_order
from ..together.walk.frames import Motion
from ..together.walk.tracker import Tracker
from .photo_reader import PhotoReader, Settings
from .scan_bundle import AskedPosed, localize_posed
from .scan_coloring import color_by
from .scan_group import AskedTogether, localize_photos_together
from .scan_look import Looking, Others
from .scan_photo import Asked, localize_photo
from .scan_walk import Walk

OPTIONS = "prior", "gravity", "accuracy", "min_confidence"  # that methods of Scan share
ONLY_DEFAULT = ("refine_focal", "gravity_vector")  # options of photos that the preset paper does not have
Picture = File | Bytes | Photo  # a path or an array (H, W, 3) is a photo without options


@dataclass(frozen=True, eq=False, repr=False)
class Scan:
    """A scan in which photos can be localized: `open_scan` returns it. Several threads may use it at once.

    Its methods share these options. An option that is None has the value of the `settings` of `open_scan`.

    - `prior`: what is known of the camera's pose; by default nothing.
    - `gravity`: "known" (the camera was upright, or tilted as the photo's file says), "unknown" (any
      rotation), or "auto" (both are tried), which is the default.
    - `accuracy`: the largest errors with which a pose is exact enough; by default 0.1 m and 5 degrees.
    - `min_confidence`: the least probability, of a pose that is called localized, that it is exact enough; by
      default 0.9.
    """

    prepared: ScanMap | PaperMap  # for the method of the settings
    # the path as given; a tuple of paths if several files are one scan; "arrays" for arrays
    name: str | tuple[str, ...]
    cloud_settings: CloudSettings
    settings: Settings  # of photos, where options do not replace them
    workers: Workers
    seconds: dict[str, float]  # [s] spent on reading and preparing the scan, by stage

    def __repr__(self) -> str:
        """Return `Scan(...)` with the scan's name."""
        return f"Scan({self.name!r})"

    @property
    def points(self) -> PackedPoints:
        """Coloured points, to draw the scan: `x`, `y`, `z` (N,) [m] in the frame of `from_world`."""
        return self.prepared.points

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about the scan, one line each."""
        return self.prepared.warnings

    @property
    def reader(self) -> PhotoReader:
        """Reader of photos for the scan."""
        crs_of_files = self.prepared.crs if isinstance(self.prepared, ScanMap) else ""
        digest = self.prepared.scan_sha256 or None
        crs = self.cloud_settings.crs or crs_of_files
        return PhotoReader(self.name, self.cloud_settings, digest, crs, self.warnings)

    def from_world(self, pose: Pose) -> Pose:
        """Transform a pose from the scan's own coordinates to the frame of `points`."""
        return self.prepared.from_world(check_pose(pose, "`pose`"))

    def save(self, path: File) -> None:
        """Write the prepared map to a file, which `open_scan` opens in place of the scan's files.

        Raise InputError if the scan was opened with `PaperSettings`, or is too large to prepare as a whole.
        """
        check_kind("path", path, File)
        if not isinstance(self.prepared, ScanMap):
            raise InputError("save: found a scan of the preset paper, wanted one of the default method")
        check_output(Path(path))
        write_map(self.prepared, Path(path))

    def localize(
        self,
        photo: Picture,
        *,
        prior: Prior | None = None,
        gravity: Gravity | None = None,
        accuracy: Accuracy | None = None,
        min_confidence: float | None = None,
    ) -> Result:
        """Find the position and rotation of the camera that took a photo.

        The `status` of the result is "localized", "ambiguous" or "not_localized": it is no error if a photo
        is not found. Raise InputError for a picture that can't be read, and for an invalid option.

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
        settings = self._change(prior, gravity, accuracy, min_confidence)
        return self.localize_photo(Asked(as_photo(photo), settings))

    def localize_photo(
        self, asked: Asked, focal: FocalLength | None = None, trace: Trace = NO_TRACE
    ) -> Result:
        """Localize a photo by settings of the scan's method, as all methods for single photos do."""
        self.check_options(*asked)
        return localize_photo(self.prepared, self.reader, self.workers, asked, focal, trace)

    def localize_many(
        self,
        photos: Iterable[Picture],
        *,
        prior: Prior | Sequence[Prior | None] | None = None,
        gravity: Gravity | None = None,
        accuracy: Accuracy | None = None,
        min_confidence: float | None = None,
    ) -> Iterator[Result]:
        """Return an iterator over the results of photos, in order; a photo is localized when it is reached.

        Photos in a sequence, such as a list, help each other, as on one command line: a photo of a part of
        the sphere is localized again with the focal length by other photos of its camera, or by its matches
        with photos that are sure. A result that may still change is held back, and so are those after it.
        Photos of any other iterable are localized each on its own.

        `prior` is the same for all photos, or a list with one for each. The status of a photo that can't be
        read is "unreadable", or "failed" if another try may succeed; `error` says why.
        """
        check_kind("photos", photos, Iterable[Picture])
        check_kind("prior", prior, Prior | Sequence[Prior | None] | None)
        may_help = isinstance(photos, Sequence) and isinstance(self.prepared, ScanMap)
        priors: Iterable[Prior | None] = repeat(prior) if prior is None or isinstance(prior, Prior) else prior
        if isinstance(prior, Sequence):
            photos = list(photos)
            check_one_each("prior", prior, len(photos), "photo")
        # refuses invalid options before the first photo is localized
        settings = self._change(None, gravity, accuracy, min_confidence)
        requests = (
            Asked(as_photo(photo), self._change(prior, gravity, accuracy, min_confidence))
            for photo, prior in zip(photos, priors, strict=False)
        )
        if not may_help:
            return map(self.try_photo, requests)
        return self.localize_in_order(list(requests), settings.min_confidence)

    def localize_in_order(self, asked: Sequence[Asked], min_confidence: float) -> Iterator[Result]:
        """Localize photos that help each other; yield the results in order, each when it is final."""
        known: dict[tuple[str, str | None], Asked] = {}  # photos so far, by name and digest
        others = Others(self, lambda result: known[result.pano, result.source.pano_sha256])

        def localize(one: Asked) -> Result:
            result = self.try_photo(one)
            known[result.pano, result.source.pano_sha256] = one
            return result

        def look_again(one: Asked, look: Look) -> Result:
            return self.try_photo(one, partial(self.look_again, look=look, others=others))

        return localize_in_order(asked, localize, look_again, min_confidence)

    def try_photo(self, asked: Asked, localize: Callable[[Asked], Result] | None = None) -> Result:
        """Localize a photo by `localize`, by default on its own; if it can't be read, the result says why.

        Raise InputError for an option that this scan does not have.
        """
        self.check_options(*asked)
        try:
            return localize(asked) if localize else self.localize_photo(asked)
        except Exception as error:
            return self.reader.make_failed(asked.photo, error, asked.settings)

    def look_again(self, asked: Asked, look: Look, others: Others) -> Result:
        """Take a second look at a photo: with the focal length by others, beside others, or together."""
        first = look.first or self.localize_photo(asked, look.focal)
        return self.looking.look(asked, first, look, others)

    @property
    def looking(self) -> Looking:
        """The scan with what second looks need. Raise InputError for the preset paper."""
        scan_map, _ = self.require_default_method("photos beside others", self.settings)
        return Looking(scan_map, self.reader, self.workers)

    def localize_bundle(
        self,
        photos: Iterable[Picture],
        relative_poses: Sequence[Pose] | RelativePoses,
        *,
        prior: Prior | None = None,
        gravity: Gravity | None = None,
        accuracy: Accuracy | None = None,
        min_confidence: float | None = None,
    ) -> list[Result]:
        """Localize photos together whose poses relative to each other are known.

        `relative_poses` has the pose of each photo in any common frame [m]; RelativePoses may have another
        scale. Raise InputError for a photo that can't be read.
        """
        check_kind("photos", photos, Iterable[Picture])
        relative = relative_poses
        if not isinstance(relative, RelativePoses):
            relative = RelativePoses(relative)
        members = [as_photo(photo) for photo in photos]
        check_one_each("relative_poses", relative.poses, len(members), "photo")
        settings = self._change(prior, gravity, accuracy, min_confidence)
        scan_map, settings = self.require_default_method("`relative_poses`", settings)
        for photo in members:
            self.check_options(photo, settings)
        asked = [
            AskedPosed(photo, check_pose(pose, "`relative_poses`"), settings)
            for photo, pose in zip(members, relative.poses, strict=True)
        ]
        return localize_posed(scan_map, self.reader, self.workers, asked, relative.scale)

    def color(
        self,
        photos: Iterable[Picture],
        out: File,
        *,
        prior: Prior | None = None,
        gravity: Gravity | None = None,
        accuracy: Accuracy | None = None,
        min_confidence: float | None = None,
    ) -> Coloring:
        """Localize photos, then again in the scan with the other photos' colours; write the coloured scan.

        The suffix of `out` is .ply, .las, .laz or .e57. Raise InputError if the scan was not read from files.
        """
        check_kind("photos", photos, Iterable[Picture])
        check_kind("out", out, File)
        settings = self._change(prior, gravity, accuracy, min_confidence)
        scan_map, settings = self.require_default_method("color", settings)
        asked = [Asked(as_photo(photo), settings) for photo in photos]

        def localize(colored: ScanMap, one: Asked) -> Result:
            return replace(self, prepared=colored).try_photo(one)

        return color_by(self.name, scan_map, self.cloud_settings, asked, localize, Path(out), self.workers)

    def localize_together(
        self,
        photos: Iterable[Picture],
        *,
        prior: Prior | None = None,
        gravity: Gravity | None = None,
        accuracy: Accuracy | None = None,
        min_confidence: float | None = None,
    ) -> list[Result]:
        """Localize photos together that were taken at one place or on a short way, in any order.

        They are linked by matches with each other. A photo without a link is localized on its own. The result
        of a photo that can't be read says so. `beside` of a result names the photos with which it was found.
        """
        check_kind("photos", photos, Iterable[Picture])
        settings = self._change(prior, gravity, accuracy, min_confidence)
        scan_map, settings = self.require_default_method("photos together", settings)
        asked = [AskedTogether(as_photo(photo), settings) for photo in photos]
        for one in asked:
            self.check_options(one.photo, settings)
        return localize_photos_together(scan_map, self.reader, self.workers, asked)

    def track(
        self,
        *,
        motion: Motion | None = None,
        prior: Prior | None = None,
        gravity: Gravity | None = None,
        accuracy: Accuracy | None = None,
        min_confidence: float | None = None,
    ) -> Walk:
        """Track a camera that is carried through the scan, frame by frame.

        Returns
        -------
        Walk
            `add(frame, time=None)` returns the `Result` of the frame by this frame and earlier ones; `time`
            [s] increases, and is given for all frames or for none. `finish()` returns a list with the result
            of each frame by all frames.
        """
        check_kind("motion", motion, Motion | None)
        settings = self._change(prior, gravity, accuracy, min_confidence)
        scan_map, settings = self.require_default_method("walks", settings)
        check_within(scan_map, settings.prior.within)
        quiet = Workers(self.workers.num_threads, warn=self.workers.warn)
        return Walk(self.reader, Tracker(scan_map, settings, quiet, motion or Motion()))

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
            Time of each frame [s], increasing. Without times only the order is used.
        odometry
            Pose of the camera at each frame in any common frame [m], or None.
        motion, prior, gravity
            As in `track`.

        `walk` of a result says how its pose was found. Raise InputError if times and frames differ in number,
        times do not increase, or an option is invalid.

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
        photos = [as_photo(frame) for frame in frames]
        check_one_each("times", times, len(photos), "frame")
        check_one_each("odometry", odometry, len(photos), "frame")
        nothing = [None] * len(photos)
        poses = [pose and check_pose(pose, "`odometry`") for pose in odometry or nothing]
        for frame, time, pose in zip(photos, nothing if times is None else times, poses, strict=True):
            walk.add(frame, time, odometry=pose)
        return walk.finish()

    def occlusion_mask(self, photo: Picture, pose: Pose) -> Bytes:
        """Return the pixels of a photo that contradict the scan at a pose, such as moved furniture.

        The array (H, W) of uint8 is a full sphere, W = 2 H, also if the photo shows only a part of it: 255
        where the photo contradicts the scan, 0 where the scan explains it, 128 where one shows nothing.
        """
        pose = self.from_world(pose)
        return occlusion_mask(self.points, read_panorama(photo), pose)

    def check_options(self, photo: Photo, settings: Settings) -> None:
        """Raise InputError for options that this scan or its method does not have."""
        if isinstance(self.prepared, ScanMap) and isinstance(settings, CoarseToFineSettings):
            check_within(self.prepared, settings.prior.within)
        elif unknown := [name for name in ONLY_DEFAULT if getattr(photo, name)]:
            raise InputError(f"`{unknown[0]}`: not an option of the preset paper")

    def require_default_method(self, what: str, settings: Settings) -> tuple[ScanMap, CoarseToFineSettings]:
        """Return map and settings of the default method. Raise InputError for another: it has no `what`."""
        if not isinstance(self.prepared, ScanMap) or not isinstance(settings, CoarseToFineSettings):
            raise InputError(f"{what}: not available with the preset paper")
        return self.prepared, settings

    def _change(self, *options: Any) -> Settings:
        """Return the settings of `open_scan`, with the values of OPTIONS that are not None replaced."""
        changes = {name: value for name, value in zip(OPTIONS, options, strict=True) if value is not None}
        settings = self.settings
        if unknown := changes.keys() - {f.name for f in fields(settings)}:
            raise InputError(f"`{min(unknown)}`: not an option of the preset paper")
        return replace(settings, **changes)
