"""The scenes that are found in a dataset, before they are written."""

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from piccolo.cloud.stream import FORMATS
from piccolo.geometry.pose import CAMERA_AXES, OPENGL_FROM_CAM, Pose, check_transform
from piccolo.photo.panorama.picture import read_picture
from piccolo.system.arrays import Array, Uint16s
from piccolo.system.errors import InputError
from piccolo.system.files.json_file import read_text

Labels = Uint16s  # (H, W) the class of each pixel, 0 where unknown
SUFFIXES = frozenset().union(*(f.suffixes for f in FORMATS)) - {".csv"}  # as these hold poses too
AXES = {**CAMERA_AXES, "opengl": OPENGL_FROM_CAM}  # a pose file's camera axes from ours, by name
MAX_SKEW = 1e-2  # of R R^T from the identity: some files have three decimals
WORLD_FROM_CAM = "world_from_cam"
CAM_FROM_WORLD = "cam_from_world"
DIRECTIONS = (WORLD_FROM_CAM, CAM_FROM_WORLD)


@dataclass(frozen=True)
class ConvertOptions:
    """Which scenes of a dataset to convert, and how."""

    folder: Path
    areas: frozenset[str] = frozenset()  # of Stanford2D-3D-S, as in its folders' names; all if empty
    labels: bool = False
    seed: int = 0  # of MPO's random transforms
    # of `generic`
    poses: Path | None = None
    cloud: Path | None = None
    images: Path | None = None
    axes: str | None = None
    direction: str | None = None

    @cached_property
    def _roots(self) -> list[str]:
        """The paths that the user named, which may be links themselves, without links."""
        named = self.folder, self.poses and self.poses.parent, self.cloud, self.images
        return [os.path.realpath(path) for path in named if path]

    def inside(self, path: Path, where: str = "") -> Path:
        """Return a file of the dataset, which is refused if it lies elsewhere, by a link or by "..".

        Where a list names it, `where` is the place in the list.
        """
        at = f"{where}: " if where else ""
        try:
            real = Path(os.path.realpath(path))
        except ValueError as error:  # a zero byte, half a character
            raise InputError(f"{at}found {str(path)!r}, wanted the name of a file") from error
        if not any(real.is_relative_to(root) for root in self._roots):
            leads = f"{at}{path} leads to {real}"
            raise InputError(f"{leads}, out of {self.folder}; move or copy the file into it")
        return path


class CloudPart(NamedTuple):
    """A file with points of a scene, in any format of piccolo.cloud."""

    path: Path
    label: int | None = None  # of all its points


class PosedPanorama(NamedTuple):
    """A panorama with its true pose in the dataset's cloud."""

    name: str  # below images/
    files: Mapping[str, Path]  # by name below images/: the picture, or the faces in the folder `name`
    variant: str
    pose: Pose
    read_labels: Callable[[], Labels] | None = None


class SceneSpec(NamedTuple):
    """A scene to be written; its files are opened only then."""

    dataset: str
    name: str  # its folder below the output: a room, or area/room
    cloud: tuple[CloudPart, ...]
    panoramas: Iterable[PosedPanorama]  # read as they come: InputError naming the file of a damaged pose
    T_written_from_dataset: Array | None = None  # (4, 4) [m], rigid
    settings: Mapping[str, object] = {}  # how it was made

    @property
    def source(self) -> dict[str, object]:
        """The data set and the settings, for queries.json."""
        return {"dataset": self.dataset, **self.settings}


class SceneList(NamedTuple):
    """The scenes of a dataset."""

    specs: tuple[SceneSpec, ...]
    notes: tuple[str, ...] = ()  # one line each, for the user: what is passed over


def scene_list(folder: Path, specs: Sequence[SceneSpec], missing: Sequence[str], layout: str) -> SceneList:
    """Return the scenes found in a folder, InputError if none; and a note on those that miss a cloud."""
    if not specs:
        raise InputError(f"{folder}: found no {layout}, wanted the layout in research/DATASETS.md")
    notes = (f"{len(missing)} scenes without a cloud: {', '.join(missing)}",) if missing else ()
    return SceneList(tuple(specs), notes)


def is_cloud(path: Path) -> bool:
    """Return True for a file whose name ends as that of a cloud format."""
    return path.suffix.lower() in SUFFIXES and path.is_file()


def only_cloud_in(folder: Path) -> Path | None:
    """Return the one cloud in a folder, None if there is none. InputError if there are several."""
    named = sorted(path for path in folder.glob("cloud.*") if is_cloud(path))
    found = named or sorted(path for path in folder.iterdir() if is_cloud(path) and path.suffix != ".txt")
    if len(found) > 1:
        names = ", ".join(path.name for path in found)
        raise InputError(f"{folder}: found the clouds {names}; leave one, or name one of them cloud.*")
    return found[0] if found else None


def read_matrix(path: Path, num_rows: int) -> Array:
    """Return the matrix (num_rows, 4) that is all of a text file."""
    wanted = f"wanted {num_rows} x 4 numbers"
    words = read_text(path, wanted, max_size=1 << 16).split()
    return array_of(str(path), words, wanted, (4 * num_rows,)).reshape(num_rows, 4)


def array_of(where: str, value: object, wanted: str, *shapes: tuple[int, ...]) -> Array:
    """Return numbers, which may be text, as an array of one of the shapes; InputError naming the place."""
    try:
        array = np.array(value, np.float64)
    except (OverflowError, TypeError, ValueError) as error:
        raise InputError(f"{where}: found {error!r}, {wanted}") from error
    if array.shape not in shapes:
        raise InputError(f"{where}: found the shape {array.shape}, {wanted}")
    return array


def pose_of_transform(where: str, T: Array, axes: str, direction: str = WORLD_FROM_CAM) -> Pose:
    """Return the pose in a matrix (3 or 4, 4) [R | t]; `where` names the file for refusals."""
    return check_transform(T, where, AXES[axes], direction == CAM_FROM_WORLD, MAX_SKEW)


def labels_by_index(path: Path, table: Uint16s) -> Labels:
    """Return labels (H, W) of a picture whose colours are indices R 2^16 + G 2^8 + B of a table; 0 beyond."""
    rgb = read_picture(path).rgb.astype(np.uint32)
    index = rgb[..., 0] << 16 | rgb[..., 1] << 8 | rgb[..., 2]
    return np.asarray(np.append(table, np.uint16(0))[np.minimum(index, len(table))], dtype=np.uint16)
