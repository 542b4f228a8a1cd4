"""A scan that photos are localized in: what `import piccolo` gives."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from os import PathLike
from pathlib import Path
from typing import Any, TypedDict, Unpack

import numpy as np
from numpy.typing import NDArray

from .camera import Calibration
from .camera.files import read_calibration, read_rig
from .cloud.settings import CloudSettings
from .cloud.soa import PackedPoints
from .confidence.confidence import LOCALIZED
from .confidence.occlusion import occlusion_mask
from .errors import InputError
from .files.json_file import reading_once
from .geometry.pose import Pose
from .geometry.rotations import Gravity
from .jobs.stopwatch import Stopwatch
from .jobs.threads import Workers
from .localization.localize import has_guessed_focal, localize, localize_guessed
from .localization.settings import CoarseToFineSettings
from .optimize.refine import Solver
from .panorama import ReadOptions, read_photo
from .panorama.model import Projection
from .panorama.photo import PhotoFacts
from .paper.localize import PaperMap
from .paper.localize import localize as localize_by_paper
from .paper.settings import PaperSettings
from .result import Result, Source, result_of
from .scan_map.named_scans import check_within, with_places
from .scan_map.prior import GpsPrior, Prior, gps_prior
from .scan_map.scan_map import ScanMap
from .scan_walk import Walk, WalkAbout, photo_facts
from .walk.frames import MAX_ACCELERATION, MAX_SPEED, Motion
from .walk.tracker import Tracker

LABELS_WARNING = "labels: the confidence was learnt on colours, and is a rough guide only"
File = str | PathLike[str]
Settings = CoarseToFineSettings | PaperSettings


class QueryOptions(TypedDict, total=False):
    """Options of `Scan.localize` about a photo; all may be left out."""

    mask: File | NDArray[np.bool_]  # what is to be ignored: white pixels of a picture, True of an array
    mask_nadir_deg: float  # the cap of this half angle about the camera's down axis is ignored
    fov_deg: float  # horizontal field of view of a picture that is a part of the sphere
    projection: Projection  # of the picture: "equirectangular", "pinhole" or "fisheye"
    focal_px: float  # focal length of a pinhole photo [px]
    camera: File  # calibration of the camera, see docs/CAMERAS.md
    rig: File  # the same of several cameras; the panorama is the folder of one instant's pictures
    gravity_vector: tuple[float, float, float]  # down, in the camera's axes
    refine_focal: bool  # the focal length is a first guess
    cube_order: str  # the picture is six cube faces in this order, such as "rludfb"
    use_gps: bool  # a GPS position in the file narrows the search (default), or not
    gravity: Gravity  # "known": upright camera, "unknown": any rotation, "auto": both are tried
    solver: Solver  # of the last descent
    near_world: tuple[float, float, float]  # [m] the camera is within `radius` of this
    radius: float  # [m]
    height: tuple[float, float]  # [m] least and most above the floor
    heading_deg: float  # of the image centre, clockwise from the cloud's +y
    heading_tolerance_deg: float
    within: tuple[str, ...]  # names of the map's scans that the camera may be in
    min_confidence: float  # below it a pose is not called localized


READ_FIELDS = {f.name for f in fields(ReadOptions)}
PRIOR_FIELDS = {f.name for f in fields(Prior)}


def parse_options(
    options: QueryOptions, settings: Settings, cloud_settings: CloudSettings
) -> tuple[ReadOptions, Settings, NDArray[np.bool_] | None]:
    """Return options of a photo as objects, beside the settings of all; and the mask, if it is an array."""
    known = QueryOptions.__annotations__
    if unknown := sorted(options.keys() - known.keys()):
        raise TypeError(f"found no option {unknown[0]!r}, wanted one of {', '.join(known)}")
    given: dict[str, Any] = dict(options)
    is_masked = given.pop("mask") if isinstance(given.get("mask"), np.ndarray) else None
    if "mask" in given:
        given["mask"] = Path(given["mask"])
    if prior := {name: given.pop(name) for name in PRIOR_FIELDS & given.keys()}:
        given["prior"] = _make_prior(prior, settings)
    if "camera" in given and "rig" in given:
        raise InputError("camera, rig: wanted only one of them")
    if "camera" in given:
        given["calibration"] = read_calibration(Path(given.pop("camera")))
    if "rig" in given:
        given["calibration"] = read_rig(Path(given.pop("rig")))
    reading = {k: given.pop(k) for k in READ_FIELDS & given.keys()}
    return ReadOptions(labels=cloud_settings.labels, **reading), replace(settings, **given), is_masked


def _make_prior(given: dict[str, Any], settings: Settings) -> Prior:
    """Return the prior of some options; InputError if the method has none, or they mean nothing."""
    if not isinstance(settings, CoarseToFineSettings):
        raise InputError(f"{min(given)}: not an option of the preset paper")
    within = given.get("within", ())
    if isinstance(within, str):
        raise InputError(f"within: found the text {within!r}, wanted a list of names")
    return Prior(**given | {"within": tuple(within)})


@dataclass(frozen=True)
class Scan:
    """A prepared scan. `open_scan` makes one; it may be used from several threads at once."""

    prepared: ScanMap | PaperMap = field(repr=False)
    name: str | tuple[str, ...]  # path as given, or the paths of several files that are one scan
    cloud_settings: CloudSettings
    settings: Settings  # of photos that say nothing else
    workers: Workers
    seconds: dict[str, float]  # spent once, on the scan

    @property
    def points(self) -> PackedPoints:
        """Coloured points of the scan, in the frame of `from_world`, for pictures."""
        return self.prepared.points

    @property
    def warnings(self) -> tuple[str, ...]:
        """Lines that the user should read about the scan."""
        return self.prepared.warnings

    def from_world(self, pose: Pose) -> Pose:
        """A pose of the world in the frame of `points`."""
        return self.prepared.from_world(pose)

    def localize(self, panorama: File | NDArray[np.uint8], **options: Unpack[QueryOptions]) -> Result:
        """Find where a 360-degree photo was taken.

        Parameters
        ----------
        panorama
            Path of a picture (JPEG, PNG, TIFF, WebP, HEIC) or of a folder of six cube faces; or an
            equirectangular image (H, W, 3), W = 2 H, RGB in 8 bits.
        **options
            See QueryOptions; what is not given is as in `settings`.

        Returns
        -------
        Result
            Its `status` is "localized", "ambiguous" or "not_localized"; a photo that can't be found is a
            result too.

        Raises
        ------
        InputError
            The picture can't be read, or an option means nothing.

        Examples
        --------
        >>> scan = open_scan("room/cloud.ply")
        >>> result = scan.localize("room/images/clean_0.jpg", gravity="known")
        >>> result.status, result.pose.center_world.round(2)
        ('localized', array([2.6 , 3.17, 1.21]))
        """
        parsed = parse_options(options, self.settings, self.cloud_settings)
        return self.localize_query(panorama, *parsed)

    def localize_many(
        self, panoramas: Iterable[File | NDArray[np.uint8]], **options: Unpack[QueryOptions]
    ) -> Iterator[Result]:
        """Yield the result of each panorama in order, as it comes; options as in `localize`."""
        for panorama in panoramas:
            yield self.localize(panorama, **options)

    def track(
        self,
        max_speed: float | None = None,
        max_acceleration: float = MAX_ACCELERATION,
        **options: Unpack[QueryOptions],
    ) -> Walk:
        """Follow a camera that is carried through the scan: `add` each frame as it comes.

        Parameters
        ----------
        max_speed
            [m/s] at which it is carried at most (2 by default); where frames have no times, [m] from one to
            the next, by default as the poses found of them tell.
        max_acceleration
            [m/s^2] standard deviation along each axis; it smooths the path of `finish`.
        **options
            As in `localize`, of all frames; not `refine_focal`, and `mask` as a path.
        """
        read_options, settings, is_masked = parse_options(options, self.settings, self.cloud_settings)
        if is_masked is not None:
            raise InputError("mask: found an array, wanted the path of a picture in a walk")
        speed = MAX_SPEED if max_speed is None else max_speed
        motion = Motion(speed, max_acceleration, is_guess=max_speed is None)
        return self.walk(read_options, settings, motion)

    def localize_walk(
        self,
        frames: Iterable[File | NDArray[np.uint8]],
        times: Sequence[float] | None = None,
        max_speed: float | None = None,
        max_acceleration: float = MAX_ACCELERATION,
        **options: Unpack[QueryOptions],
    ) -> list[Result]:
        """Return the results of a walk's frames, in order, each of which narrows the others.

        `times` [s] rise; without them only the order counts. The others are as in `track`.
        """
        walk = self.track(max_speed, max_acceleration, **options)
        taken = list(frames)
        if times is not None and len(times) != len(taken):
            raise InputError(f"times: found {len(times)} of {len(taken)} frames, wanted one of each")
        for k, frame in enumerate(taken):
            walk.add(frame, None if times is None else times[k])
        return walk.finish()

    def walk(self, read_options: ReadOptions, settings: Settings, motion: Motion) -> Walk:
        """Return a walk with all options as objects, as `track` does."""
        if not isinstance(self.prepared, ScanMap) or not isinstance(settings, CoarseToFineSettings):
            raise InputError("walks: not of the preset paper")
        if read_options.refine_focal:
            raise InputError("--refine-focal: not an option of walks; refine it with one photo")
        check_within(self.prepared, settings.prior.within)
        quiet = Workers(self.workers.num_threads, warn=self.workers.warn)
        tracker = Tracker(self.prepared, settings, quiet, motion)
        repeated = settings_json(settings, self.cloud_settings, read_options)
        about = WalkAbout(self.name, self.warnings, {**repeated, "walk": asdict(motion)})
        return Walk(tracker, read_options, about)

    def occlusion_mask(
        self, panorama: File | NDArray[np.uint8], pose: Pose, read_options: ReadOptions | None = None
    ) -> NDArray[np.uint8]:
        """Return the pixels of a photo that contradict the scan at a pose: (H, W), of the full sphere.

        255 where it contradicts, 0 where the scan explains it, 128 where one of them shows nothing.
        """
        picture = read_photo(panorama, read_options or ReadOptions(labels=self.cloud_settings.labels))
        return occlusion_mask(self.points, picture, self.from_world(pose))

    def localize_query(
        self,
        panorama: File | NDArray[np.uint8],
        read_options: ReadOptions,
        settings: Settings,
        is_masked: NDArray[np.bool_] | None = None,
        calibration: Calibration | None = None,
    ) -> Result:
        """Localize a photo, all options as objects; apart a mask that is an array, and the photo's camera."""
        watch = Stopwatch()
        repeated = settings_json(settings, self.cloud_settings, read_options)
        if calibration is not None and read_options.calibration is None:
            read_options = replace(read_options, calibration=calibration)
        with watch.stage("read"), reading_once():
            picture = read_photo(panorama, read_options, is_masked)
            photo = photo_facts(panorama, read_options.rig)
        gps = None
        if isinstance(self.prepared, ScanMap) and isinstance(settings, CoarseToFineSettings):
            check_within(self.prepared, settings.prior.within)
            attempts: list[tuple[CoarseToFineSettings, GpsPrior | None]] = [(settings, None)]
            if read_options.use_gps and (gps := self.gps_prior_of(photo, settings)):
                near = replace(settings, prior=gps.applied_to(settings.prior))
                attempts = [(near, gps), (settings, replace(gps, is_used=False))]
            run = localize_guessed if has_guessed_focal(picture) else localize
            for tried, gps in attempts:  # noqa: B007  near the GPS position, or else anywhere
                found = run(self.prepared, picture, tried, self.workers, watch)
                if found.status == LOCALIZED:
                    break
            found = with_places(self.prepared, found)
        elif isinstance(self.prepared, PaperMap) and isinstance(settings, PaperSettings):
            if read_options.refine_focal:
                raise InputError("--refine-focal: not an option of the preset paper")
            found = localize_by_paper(self.prepared, picture, settings, self.workers, watch)
        else:
            raise InputError("settings: of another method than the one that the scan was prepared for")
        digest = self.prepared.scan_sha256 or None
        return result_of(
            found,
            cloud=self.name,
            pano="array" if isinstance(panorama, np.ndarray) else str(panorama),
            seconds=watch.seconds,
            settings=repeated,
            warnings=self.warnings + picture.warnings + ((LABELS_WARNING,) if read_options.labels else ()),
            source=Source(digest, photo.sha256, photo.image_size, photo.capture_time),
            gps_prior=gps,
            cameras=found.cameras or picture.cameras,
        )

    def gps_prior_of(self, photo: PhotoFacts, settings: CoarseToFineSettings) -> GpsPrior | None:
        """The photo's GPS position in the scan; None if it has none, or a position is given anyway."""
        crs = self.cloud_settings.crs or getattr(self.prepared, "crs", "")
        if photo.gps is None or not crs or settings.prior.near_world is not None:
            return None
        return gps_prior(photo.gps, crs, self.cloud_settings.scale)


def settings_json(
    settings: Settings, cloud_settings: CloudSettings, read_options: ReadOptions
) -> dict[str, object]:
    """Return the settings that a result repeats."""
    how = {k: str(v) if isinstance(v, Path) else v for k, v in asdict(read_options).items()}
    return {**settings.to_json(), "cloud": asdict(cloud_settings), "panorama": how}
