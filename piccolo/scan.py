"""A scan that photos are localized in: `import piccolo` gives it."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .arguments import check_arguments
from .camera.files import read_calibration, read_rig
from .cloud.soa import PackedPoints
from .errors import InputError
from .geometry.pose import Pose
from .geometry.rotations import Gravity
from .localization.settings import CoarseToFineSettings
from .opened_scan import File, OpenedScan, Settings, make_failed_result
from .optimize.refine import Solver
from .panorama import ReadOptions
from .panorama.model import Projection
from .result import Result
from .scan_map.open_map import write_map
from .scan_map.prior import Prior
from .scan_map.scan_map import ScanMap
from .scan_walk import Walk
from .walk.frames import MAX_ACCELERATION, MAX_SPEED, Motion

Image = NDArray[np.uint8]  # (H, W, 3) RGB
Mask = NDArray[np.bool_]  # (H, W)
READ_FIELDS = {f.name for f in fields(ReadOptions)}
PRIOR_FIELDS = {f.name for f in fields(Prior)}
SETTINGS_FIELDS = {"gravity", "solver", "min_confidence"}


class Scan:
    """A prepared scan. `open_scan` makes one; it may be used from several threads at once."""

    def __init__(self, opened: OpenedScan) -> None:
        self._opened = opened

    def __repr__(self) -> str:
        """Return the scan's name."""
        return f"Scan({self.name!r})"

    @property
    def name(self) -> str | tuple[str, ...]:
        """Path as given, or the paths of several files that are one scan."""
        return self._opened.name

    @property
    def seconds(self) -> dict[str, float]:
        """Seconds spent on the scan, by stage."""
        return self._opened.seconds

    @property
    def points(self) -> PackedPoints:
        """Coloured points of the scan, in the frame of `from_world`, for pictures."""
        return self._opened.points

    @property
    def warnings(self) -> tuple[str, ...]:
        """Lines that the user should read about the scan."""
        return self._opened.warnings

    def from_world(self, pose: Pose) -> Pose:
        """Return a pose of the world in the frame of `points`."""
        return self._opened.from_world(pose)

    def save(self, path: File) -> None:
        """Write the prepared map, which `open_scan` opens in place of the scan's files.

        Raises InputError for the preset paper, and for a part of a scan too large to prepare as a whole.
        """
        check_arguments(Scan.save, locals())
        if not isinstance(self._opened.prepared, ScanMap):
            raise InputError("save: found a scan of the preset paper, wanted one of the default method")
        write_map(self._opened.prepared, Path(path), self._opened.workers)

    def localize(  # noqa: PLR0913  options by name
        self,
        panorama: File | Image,
        *,
        mask: File | Mask | None = None,
        mask_nadir_deg: float | None = None,
        fov_deg: float | None = None,
        projection: Projection | None = None,
        focal_px: float | None = None,
        camera: File | None = None,
        rig: File | None = None,
        gravity_vector: tuple[float, float, float] | None = None,
        refine_focal: bool | None = None,
        cube_order: str | None = None,
        use_gps: bool | None = None,
        gravity: Gravity | None = None,
        solver: Solver | None = None,
        near_world: tuple[float, float, float | None] | None = None,
        radius: float | None = None,
        height: tuple[float, float] | None = None,
        heading_deg: float | None = None,
        heading_tolerance_deg: float | None = None,
        within: Sequence[str] | None = None,
        min_confidence: float | None = None,
    ) -> Result:
        """Find where a 360-degree photo was taken.

        An option that is None is as in the settings of `open_scan`, or as the photo's file says.

        Parameters
        ----------
        panorama
            Path of a picture (JPEG, PNG, TIFF, WebP, HEIC) or of a folder of six cube faces; or an
            equirectangular image (H, W, 3), W = 2 H, RGB in 8 bits.
        mask
            White pixels of a picture, or True of an array, are ignored. Masks of COLMAP, OpenSfM and
            nerfstudio are the other way round (black is ignored): invert them.
        mask_nadir_deg
            The cap of this half angle about the camera's down axis is ignored.
        fov_deg
            Horizontal field of view of a picture that is a part of the sphere.
        projection
            Of the picture.
        focal_px
            Focal length of a pinhole photo [px].
        camera
            Calibration of the camera, see docs/CAMERAS.md.
        rig
            Calibration of several cameras; `panorama` is the folder of one instant's pictures.
        gravity_vector
            Down, in the camera's axes.
        refine_focal
            The focal length is a first guess.
        cube_order
            The picture is six cube faces in this order, such as "rludfb".
        use_gps
            A GPS position in the file narrows the search (default), or not.
        gravity
            "known": upright camera; "unknown": any rotation; "auto": both are tried.
        solver
            Of the last descent.
        near_world, radius
            The camera is within `radius` [m] of this place [m]; a z of None is any height.
        height
            Least and most [m] above the floor.
        heading_deg
            Of the image centre, clockwise from the scan's +y.
        heading_tolerance_deg
            Largest error of `heading_deg`.
        within
            Names of the map's scans that the camera may be in.
        min_confidence
            A pose with less is not called localized.

        Returns
        -------
        Result
            Its `status` is "localized", "ambiguous" or "not_localized"; a photo that can't be found is a
            result too.

        Raises
        ------
        InputError
            The picture can't be read, or an option is invalid.

        Examples
        --------
        >>> scan = open_scan("room/cloud.ply")
        >>> result = scan.localize("room/images/clean_0.jpg", gravity="known")
        >>> result.status, result.pose.center_world.round(2)
        ('localized', array([2.6 , 3.17, 1.21]))
        """
        read_options, settings, is_masked = self._parse(check_arguments(Scan.localize, locals()))
        return self._opened.localize_query(panorama, read_options, settings, is_masked)

    def localize_many(  # noqa: PLR0913  options by name
        self,
        panoramas: Iterable[File | Image],
        *,
        mask: File | Mask | None = None,
        mask_nadir_deg: float | None = None,
        fov_deg: float | None = None,
        projection: Projection | None = None,
        focal_px: float | None = None,
        camera: File | None = None,
        rig: File | None = None,
        gravity_vector: tuple[float, float, float] | None = None,
        refine_focal: bool | None = None,
        cube_order: str | None = None,
        use_gps: bool | None = None,
        gravity: Gravity | None = None,
        solver: Solver | None = None,
        near_world: tuple[float, float, float | None] | None = None,
        radius: float | None = None,
        height: tuple[float, float] | None = None,
        heading_deg: float | None = None,
        heading_tolerance_deg: float | None = None,
        within: Sequence[str] | None = None,
        min_confidence: float | None = None,
    ) -> Iterator[Result]:
        """Return an iterator over the results of panoramas, in order; options as in `localize`.

        The status of a photo that can't be read is "unreadable", or "failed" if another try may succeed.
        """
        read_options, settings, is_masked = self._parse(check_arguments(Scan.localize_many, locals()))
        self._opened.check_options(read_options, settings)

        def localize(panorama: File | Image) -> Result:
            try:
                return self._opened.localize_query(panorama, read_options, settings, is_masked)
            except Exception as error:
                return make_failed_result(self._opened, panorama, error, read_options, settings)

        return map(localize, panoramas)

    def track(  # noqa: PLR0913  options by name
        self,
        *,
        max_speed: float | None = None,
        max_acceleration: float = MAX_ACCELERATION,
        mask: File | None = None,
        mask_nadir_deg: float | None = None,
        fov_deg: float | None = None,
        projection: Projection | None = None,
        focal_px: float | None = None,
        camera: File | None = None,
        rig: File | None = None,
        gravity_vector: tuple[float, float, float] | None = None,
        cube_order: str | None = None,
        use_gps: bool | None = None,
        gravity: Gravity | None = None,
        solver: Solver | None = None,
        near_world: tuple[float, float, float | None] | None = None,
        radius: float | None = None,
        height: tuple[float, float] | None = None,
        heading_deg: float | None = None,
        heading_tolerance_deg: float | None = None,
        within: Sequence[str] | None = None,
        min_confidence: float | None = None,
    ) -> Walk:
        """Follow a camera that is carried through the scan: `add` each frame as it comes.

        Parameters
        ----------
        max_speed
            Largest speed [m/s] (2 by default); for frames without times, the largest distance [m] between
            consecutive frames, by default estimated from their poses.
        max_acceleration
            Standard deviation [m/s^2] along each axis; it smooths the path of `finish`.
        mask
            As in `localize`, like all other parameters; of all frames.
        """
        given = check_arguments(Scan.track, locals())
        return self._track(given)

    def localize_walk(  # noqa: PLR0913  options by name
        self,
        frames: Iterable[File | Image],
        times: Sequence[float] | NDArray[np.floating[Any]] | None = None,
        *,
        max_speed: float | None = None,
        max_acceleration: float = MAX_ACCELERATION,
        mask: File | None = None,
        mask_nadir_deg: float | None = None,
        fov_deg: float | None = None,
        projection: Projection | None = None,
        focal_px: float | None = None,
        camera: File | None = None,
        rig: File | None = None,
        gravity_vector: tuple[float, float, float] | None = None,
        cube_order: str | None = None,
        use_gps: bool | None = None,
        gravity: Gravity | None = None,
        solver: Solver | None = None,
        near_world: tuple[float, float, float | None] | None = None,
        radius: float | None = None,
        height: tuple[float, float] | None = None,
        heading_deg: float | None = None,
        heading_tolerance_deg: float | None = None,
        within: Sequence[str] | None = None,
        min_confidence: float | None = None,
    ) -> list[Result]:
        """Return the results of a walk's frames, in order, each of which narrows the others.

        `times` [s] rise; without them only the order counts. The others are as in `track`.
        """
        given = check_arguments(Scan.localize_walk, locals())
        given.pop("frames")
        given.pop("times", None)
        walk = self._track(given)
        taken = list(frames)
        if times is not None and len(times) != len(taken):
            raise InputError(f"`times`: found {len(times)} of {len(taken)} frames, wanted one of each")
        for k, frame in enumerate(taken):
            walk.add(frame, None if times is None else times[k])
        return walk.finish()

    def occlusion_mask(  # noqa: PLR0913  options by name
        self,
        panorama: File | Image,
        pose: Pose,
        *,
        mask: File | Mask | None = None,
        mask_nadir_deg: float | None = None,
        fov_deg: float | None = None,
        projection: Projection | None = None,
        focal_px: float | None = None,
        camera: File | None = None,
        rig: File | None = None,
        gravity_vector: tuple[float, float, float] | None = None,
        refine_focal: bool | None = None,
        cube_order: str | None = None,
    ) -> NDArray[np.uint8]:
        """Return the pixels of a photo that contradict the scan at a pose: (H, W), of the full sphere.

        255 where it contradicts, 0 where the scan explains it, 128 where one of them shows nothing. Options
        are as in `localize`.
        """
        given = check_arguments(Scan.occlusion_mask, locals())
        given.pop("pose")
        read_options, _, is_masked = self._parse(given)
        return self._opened.occlusion_mask(panorama, pose, read_options, is_masked)

    def _track(self, given: dict[str, Any]) -> Walk:
        speed = given.pop("max_speed", None)
        acceleration = given.pop("max_acceleration")
        read_options, settings, _ = self._parse(given)
        motion = Motion(MAX_SPEED if speed is None else speed, acceleration, is_guess=speed is None)
        return self._opened.walk(read_options, settings, motion)

    def _parse(self, given: Mapping[str, Any]) -> tuple[ReadOptions, Settings, Mask | None]:
        """Return options of a photo as objects; and the mask, if it is an array."""
        reading = {name: given[name] for name in READ_FIELDS & given.keys()}
        mask = reading.pop("mask", None)
        is_masked = mask if isinstance(mask, np.ndarray) else None
        if mask is not None and is_masked is None:
            reading["mask"] = Path(mask)
        if "camera" in given and "rig" in given:
            raise InputError("`camera`, `rig`: found both, wanted one of them")
        if "camera" in given:
            reading["calibration"] = read_calibration(Path(given["camera"]))
        if "rig" in given:
            reading["calibration"] = read_rig(Path(given["rig"]))
        opened = self._opened
        settings = {name: given[name] for name in SETTINGS_FIELDS & given.keys()}
        if prior := {name: given[name] for name in PRIOR_FIELDS & given.keys()}:
            settings["prior"] = _make_prior(prior, opened.settings)
        read_options = ReadOptions(labels=opened.cloud_settings.labels, **reading)
        return read_options, _replace_settings(opened.settings, settings), is_masked


def _replace_settings(settings: Settings, given: dict[str, Any]) -> Settings:
    if unknown := given.keys() - {f.name for f in fields(settings)}:
        raise InputError(f"`{min(unknown)}`: not an option of the preset paper")
    return replace(settings, **given)


def _make_prior(given: dict[str, Any], settings: Settings) -> Prior:
    """Return the prior of some options; InputError if the method has none, or they mean nothing."""
    if not isinstance(settings, CoarseToFineSettings):
        raise InputError(f"`{min(given)}`: not an option of the preset paper")
    return Prior(**given | {"within": tuple(given.get("within", ()))})
