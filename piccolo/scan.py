"""The public class `Scan`: photos and walks are localized in it."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, TypedDict, Unpack

import numpy as np
from numpy.typing import NDArray

from .arguments import check_arguments, check_one_each
from .camera.files import open_calibration, read_rig
from .cloud.soa import PackedPoints
from .errors import InputError
from .files.atomic import check_output
from .geometry.pose import Pose, check_pose
from .geometry.rotations import Gravity
from .localization.bundle_adjustment import RelativeScale
from .opened_scan import File, OpenedScan, Settings, make_failed_result, make_prior, replace_settings
from .optimize.refine import Solver
from .panorama import ReadOptions
from .panorama.model import Projection
from .result import Result
from .scan_map.open_map import write_map
from .scan_map.prior import Prior
from .scan_map.scan_map import ScanMap
from .scan_walk import Walk
from .walk.motion import MAX_ACCELERATION, Motion

Image = NDArray[np.uint8]  # (H, W, 3) RGB
Mask = NDArray[np.bool_]  # (H, W)
READ_FIELDS = {f.name for f in fields(ReadOptions)}
PRIOR_FIELDS = {f.name for f in fields(Prior)}
SETTINGS_FIELDS = {"gravity", "solver", "min_confidence"}


class ReadingOptions(TypedDict, total=False):
    """Options for reading a photo, which `Scan.localize` explains; None is the default."""

    mask_nadir_deg: float | None
    fov_deg: float | None
    projection: Projection | None
    focal_px: float | None
    camera: File | None
    rig: File | None
    gravity_vector: tuple[float, float, float] | None
    cube_order: str | None


class PhotoOptions(ReadingOptions, total=False):
    """Options for localizing a photo, which `Scan.localize` explains; None is the default."""

    use_gps: bool | None
    gravity: Gravity | None
    solver: Solver | None
    near_world: tuple[float, float, float | None] | None
    radius: float | None
    height: tuple[float, float] | None
    heading_deg: float | None
    heading_tolerance_deg: float | None
    within: Sequence[str] | None
    min_confidence: float | None


class Scan:
    """A scan in which photos can be localized: `open_scan` returns it. Several threads may use it at once."""

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
        return self._opened.points

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about the scan, one line each."""
        return self._opened.warnings

    def from_world(self, pose: Pose) -> Pose:
        """Transform a pose from the scan's own coordinates to the frame of `points`."""
        return self._opened.from_world(check_pose(pose, "`pose`"))

    def save(self, path: File) -> None:
        """Write the prepared map to the file `path`, which `open_scan` opens in place of the scan's files.

        Raises InputError for a scan opened with `PaperSettings`, or too large to be prepared as a whole.
        """
        check_arguments(Scan.save, locals())
        if not isinstance(self._opened.prepared, ScanMap):
            raise InputError("save: found a scan of the preset paper, wanted one of the default method")
        check_output(Path(path))
        write_map(self._opened.prepared, Path(path), self._opened.workers)

    def localize(
        self,
        panorama: File | Image,
        *,
        mask: File | Mask | None = None,
        refine_focal: bool | None = None,
        **options: Unpack[PhotoOptions],
    ) -> Result:
        """Find the position and rotation of the camera that took a photo.

        An option that is None has the default given here, or else that of the `settings` of `open_scan`.

        Parameters
        ----------
        panorama
            Path of a picture (JPEG, PNG, TIFF, WebP, HEIC) or of a folder of six cube faces; or an array
            (H, W, 3), RGB in uint8, which is a full equirectangular sphere, W = 2 H, or of a given camera.
        mask
            **White is ignored**, in a picture of the photo's size, or in a folder of masks named like the
            photos. For an array photo, a mask (H, W) whose True is ignored. COLMAP, OpenSfM and nerfstudio
            ignore black: invert their masks.
        mask_nadir_deg
            Half angle [deg] of the cap about camera -z that is ignored, 0 by default. Only for files.
        fov_deg
            Horizontal field of view [deg], by default from the file's metadata: of a part of the sphere about
            the horizon (only for files), or of a pinhole or fisheye picture, as `projection` says.
        projection
            By default "pinhole" if EXIF has a focal length and W is not 2 H, else "equirectangular".
        focal_px
            Focal length [px] of a pinhole photo in its own pixels, known to 1 %; by default EXIF's.
        camera
            Calibration: COLMAP's cameras.txt, OpenSfM's camera_models.json, or JSON of docs/CAMERAS.md; or a
            folder with NAME.camera.json or NAME.json for each photo.
        rig
            Calibration of several cameras; `panorama` is the folder of the pictures of one instant.
        gravity_vector
            Direction of gravity in camera axes (+x image centre, +y left, +z up), of any length; (0, 0, -1)
            is an upright camera. By default from the file's metadata.
        refine_focal
            The focal length is known within 20 % only, and is estimated with the pose (False by default).
        cube_order
            Order of six cube faces in one picture, such as "rludfb" (right, left, up, down, front, back).
        use_gps
            Search near the file's GPS position first, if the scan's coordinate system is known (default).
        gravity
            "known": the camera was upright, or as metadata or `gravity_vector` say; "unknown": any rotation;
            "auto" (default): both are tried.
        solver
            Solver of the last descent, "gauss-newton" by default.
        near_world, radius
            The camera is within `radius` [m] of `near_world` [m]; a z of None is any height.
        height
            Least and greatest height of the camera above the floor [m].
        heading_deg, heading_tolerance_deg
            Heading [deg] of the image centre, clockwise from the scan's +y, and its largest error (20).
        within
            Names of the scans in the map that the camera may be in, by default all.
        min_confidence
            Least confidence of a pose that is called localized, 0.9 by default.

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
        """
        read_options, settings, is_masked = self._parse(check_arguments(Scan.localize, locals()))
        return self._opened.localize_query(panorama, read_options, settings, is_masked)

    def localize_many(
        self,
        panoramas: Iterable[File | Image],
        relative_poses: Sequence[Pose] | None = None,
        *,
        relative_scale: RelativeScale = "metres",
        mask: File | Mask | None = None,
        refine_focal: bool | None = None,
        **options: Unpack[PhotoOptions],
    ) -> Iterator[Result]:
        """Return an iterator over the results of photos, in order; each is computed when it is asked for.

        `panoramas` and the options are as in `localize`; all photos have the same options. The status of a
        photo that can't be read is "unreadable", or "failed" if another try may succeed; `error` says why.

        With `relative_poses`, one of each photo in any common frame [m], such as that of a phone's tracker,
        the photos are localized together; one that can't be read is an InputError then. The scale of their
        positions is fitted: within 1 % of metres, or freely if `relative_scale` is "unknown", as of COLMAP.
        """
        read_options, settings, is_masked = self._parse(check_arguments(Scan.localize_many, locals()))
        self._opened.check_options(read_options, settings)
        if relative_poses is not None:
            photos = list(panoramas)
            check_one_each("relative_poses", relative_poses, len(photos), "photo")
            together = self._opened.localize_bundle
            scale = relative_scale
            return iter(together(photos, relative_poses, read_options, settings, is_masked, scale))

        def localize(panorama: File | Image) -> Result:
            try:
                return self._opened.localize_query(panorama, read_options, settings, is_masked)
            except Exception as error:
                return make_failed_result(self._opened, panorama, error, read_options, settings)

        return map(localize, panoramas)

    def track(
        self,
        *,
        max_speed: float | None = None,
        max_acceleration: float = MAX_ACCELERATION,
        mask: File | None = None,
        **options: Unpack[PhotoOptions],
    ) -> Walk:
        """Track a camera that is carried through the scan, frame by frame.

        Parameters
        ----------
        max_speed
            Largest speed of the camera [m/s], 2 by default. If frames have no times, it is the largest
            distance [m] between consecutive frames, 5 by default.
        max_acceleration
            Standard deviation of the acceleration along each axis [m/s^2]: less smooths the path more.
        mask
            Path of a mask of all frames, as in `localize`, like all other options.

        Returns
        -------
        Walk
            `add(frame, time=None)` returns the `Result` of the frame, from this frame and earlier ones;
            `time` [s] increases, and is given for all frames or for none. `finish()` returns a list with the
            result of each frame, from all frames.
        """
        return self._track(check_arguments(Scan.track, locals()))

    def localize_walk(
        self,
        frames: Iterable[File | Image],
        times: Sequence[float] | NDArray[np.floating[Any]] | None = None,
        *,
        odometry: Sequence[Pose | None] | None = None,
        max_speed: float | None = None,
        max_acceleration: float = MAX_ACCELERATION,
        mask: File | None = None,
        **options: Unpack[PhotoOptions],
    ) -> list[Result]:
        """Localize the frames of a walk together: each frame restricts the poses of the others.

        Parameters
        ----------
        frames
            Photos in the order in which they were taken, each as in `localize`.
        times
            Time of each frame [s], increasing. Without times only the order counts.
        odometry
            Pose of the camera at each frame in any common frame [m], or None.
        max_speed, max_acceleration
            As in `track`.
        mask
            Path of a mask of all frames, as in `localize`, like all other options.

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
        given = check_arguments(Scan.localize_walk, locals())
        for name in ("frames", "times", "odometry"):
            given.pop(name, None)
        walk = self._track(given)
        taken = list(frames)
        check_one_each("times", times, len(taken), "frame")
        check_one_each("odometry", odometry, len(taken), "frame")
        nothing = [None] * len(taken)
        poses = [pose and check_pose(pose, "`odometry`") for pose in odometry or nothing]
        for frame, time, pose in zip(taken, nothing if times is None else times, poses, strict=True):
            walk.add(frame, time, odometry=pose)
        return walk.finish()

    def occlusion_mask(
        self,
        panorama: File | Image,
        pose: Pose,
        *,
        mask: File | Mask | None = None,
        refine_focal: bool | None = None,
        **options: Unpack[ReadingOptions],
    ) -> NDArray[np.uint8]:
        """Return the pixels of a photo that contradict the scan at a pose, such as moved furniture.

        The array (H, W) of uint8 is a full sphere, W = 2 H, also for a photo of a part of it: 255 where the
        photo contradicts the scan, 0 where the scan explains it, 128 where one of them shows nothing. The
        options are those of `localize`.
        """
        read_options, _, is_masked = self._parse(check_arguments(Scan.occlusion_mask, locals()))
        return self._opened.occlusion_mask(panorama, pose, read_options, is_masked)

    def _track(self, given: dict[str, Any]) -> Walk:
        motion = Motion(given.pop("max_speed", None), given.pop("max_acceleration"))
        read_options, settings, _ = self._parse(given)
        return Walk(self._opened, read_options, settings, motion)

    def _parse(self, given: Mapping[str, Any]) -> tuple[ReadOptions, Settings, Mask | None]:
        """Return the options as objects, and the mask if it is an array."""
        reading = {name: given[name] for name in READ_FIELDS & given.keys()}
        mask = reading.pop("mask", None)
        is_masked = mask if isinstance(mask, np.ndarray) else None
        if mask is not None and is_masked is None:
            reading["mask"] = Path(mask)
        if "camera" in given and "rig" in given:
            raise InputError("`camera`, `rig`: found both, wanted one of them")
        if "camera" in given:
            reading["calibration"] = open_calibration(Path(given["camera"]))
        if "rig" in given:
            reading["calibration"] = read_rig(Path(given["rig"]))
        opened = self._opened
        settings = {name: given[name] for name in SETTINGS_FIELDS & given.keys()}
        if prior := {name: given[name] for name in PRIOR_FIELDS & given.keys()}:
            settings["prior"] = known = make_prior(prior, opened.settings)
            if "heading_tolerance_deg" in prior and known.heading_deg is None:
                raise InputError("`heading_tolerance_deg`: only with `heading_deg`")
        read_options = ReadOptions(labels=opened.cloud_settings.labels, **reading)
        return read_options, replace_settings(opened.settings, settings), is_masked
