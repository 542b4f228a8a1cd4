"""Cameras that take one picture together: where each sits, which part of which picture is its own."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np

from ..arrays import Array
from ..errors import InputError, unreadable
from ..geometry.pose import Pose, check_pose
from .model import Camera

IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
MAX_OFFSET = 0.1  # [m] between cameras that pass for one without a warning
MAX_CAMERAS = 64
Rows = tuple[tuple[float, ...], ...]


def rows(R: Array) -> Rows:
    """Return a matrix as tuples, which compare and hash."""
    return tuple(tuple(row) for row in R.tolist())


@dataclass(frozen=True)
class Mount:
    """A camera in the frame of the whole, which is that of the pose found."""

    camera: Camera
    R_lens_from_cam: Rows = IDENTITY  # (3, 3) x_lens = R_lens_from_cam @ (x_cam - center_cam), our axes both
    center_cam: tuple[float, ...] = (0.0, 0.0, 0.0)  # [m]
    offset: tuple[int, int] = (0, 0)  # of its upper left corner in the picture [px], across and down
    image: str | None = None  # of a rig: which file of the folder is its picture, * and ? as in a shell

    def __post_init__(self) -> None:
        """Refuse what is no place."""
        check_pose(Pose(self.rotation, np.array(self.center_cam)), "R_lens_from_cam, center_cam")
        if len(self.offset) != 2 or not all(isinstance(x, int) and x >= 0 for x in self.offset):
            raise InputError(f"found offset {self.offset}, wanted two whole numbers from 0 [px]")

    @property
    def rotation(self) -> Array:
        """R_lens_from_cam as an array (3, 3)."""
        return np.array(self.R_lens_from_cam, dtype=np.float64)

    def pose(self, pose: Pose) -> Pose:
        """Return the camera's own pose, of the whole's."""
        center_world = pose.center_world + pose.R_cam_from_world.T @ np.array(self.center_cam)
        return Pose(self.rotation @ pose.R_cam_from_world, center_world)

    def with_camera(self, camera: Camera) -> "Mount":
        """Another camera at the same place."""
        return replace(self, camera=camera)

    def turn(self, R_cam_from_new: Array) -> "Mount":
        """Return the same camera in a frame that is turned about the origin."""
        R = self.rotation @ R_cam_from_new
        center = R_cam_from_new.T @ np.array(self.center_cam)
        return replace(self, R_lens_from_cam=rows(R), center_cam=tuple(center.tolist()))


def compute_extent(mounts: Sequence[Mount]) -> tuple[int, int]:
    """Width and height [px] of a picture in which cameras have their parts."""
    right = max(mount.offset[0] + mount.camera.width for mount in mounts)
    return right, max(mount.offset[1] + mount.camera.height for mount in mounts)


@dataclass(frozen=True)
class Calibration:
    """Cameras of a calibration file; if it lists alternatives, the picture's size selects one."""

    path: str
    mounts: tuple[Mount, ...]
    is_choice: bool = False  # the cameras have nothing to do with each other
    has_sizes: bool = True  # False: the file does not say how large the pictures are

    def __post_init__(self) -> None:
        """Refuse a file without cameras, or of a kind that makes no sense."""
        if not 1 <= len(self.mounts) <= MAX_CAMERAS and not self.is_choice:
            raise InputError(f"{self.path}: found {len(self.mounts)} cameras, wanted 1 to {MAX_CAMERAS}")

    @property
    def is_rig(self) -> bool:
        """True if each camera has a picture of its own."""
        return not self.is_choice and all(mount.image is not None for mount in self.mounts)

    @property
    def extent(self) -> float:
        """Largest distance [m] of a camera from the origin, which is what is localized."""
        return float(np.linalg.norm([mount.center_cam for mount in self.mounts], axis=1).max())

    def for_picture(self, width: int, height: int) -> tuple[Mount, ...]:
        """Return the cameras of a picture of this size [px]; InputError if none fits, or several do."""
        if not self.is_choice:
            return self._scale(width, height)
        sizes = {(m.camera.width, m.camera.height) for m in self.mounts}
        fits = [m for m in self.mounts if (m.camera.width, m.camera.height) == (width, height)]
        if not fits and len(self.mounts) == 1:
            fits = list(self.mounts)
        if len(fits) != 1:
            found = f"found {len(self.mounts)} cameras, {len(fits)} of them for {width} x {height}"
            wanted = f"wanted one; sizes there are {', '.join(f'{w} x {h}' for w, h in sorted(sizes)[:5])}"
            raise InputError(f"{self.path}: {found}, {wanted}")
        return Calibration(self.path, (fits[0],))._scale(width, height)

    def _scale(self, width: int, height: int) -> tuple[Mount, ...]:
        """All cameras with the whole picture at another size of the same shape."""
        full_width, full_height = compute_extent(self.mounts)
        if len(self.mounts) == 1 and self.mounts[0].offset == (0, 0):
            try:
                return (self.mounts[0].with_camera(self.mounts[0].camera.scale_to_size(width, height)),)
            except InputError as error:
                raise InputError(f"{self.path}: {error}") from error
        if (width, height) != (full_width, full_height):
            found = f"found cameras in a picture of {full_width} x {full_height}"
            raise InputError(f"{self.path}: {found}, wanted {width} x {height} as the picture has")
        return self.mounts

    def images_in(self, folder: Path) -> list[Path]:
        """Return the picture of each camera of a rig in the folder of one instant, in order.

        Raises InputError if a camera has none or several.
        """
        names = _names_in(folder)
        images = []
        for mount in self.mounts:
            patterns = (mount.image or "").split("|")
            found = [name for name in names if any(fnmatchcase(name, pattern) for pattern in patterns)]
            if len(found) != 1:
                text = f"found {len(found)} pictures for the camera {mount.image!r} of {self.path}"
                raise InputError(f"{folder}: {text}, wanted one: a folder has the pictures of one instant")
            images.append(folder / found[0])
        return images

    def is_instant(self, folder: Path) -> bool:
        """Return True for a folder that holds one picture of each camera."""
        try:
            return len(self.images_in(folder)) == len(self.mounts)
        except InputError:
            return False


def _names_in(folder: Path) -> Sequence[str]:
    """Return the files of a folder and of those in it, as their names below it have slashes."""
    try:
        entries = sorted(folder.iterdir())
        inner = [file for entry in entries if entry.is_dir() for file in sorted(entry.iterdir())]
    except (OSError, ValueError) as error:
        raise unreadable(folder, error) from error
    return [f.relative_to(folder).as_posix() for f in [*entries, *inner] if f.is_file() and f.name[0] != "."]
