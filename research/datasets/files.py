"""Files of all datasets: the one cloud of a folder, matrices and poses, and pictures of labels."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from piccolo.arrays import Array
from piccolo.cloud.stream import FORMATS
from piccolo.errors import InputError
from piccolo.files.json_file import read_text
from piccolo.geometry.pose import Pose, check_transform
from piccolo.geometry.rotations import CAMERA_AXES, OPENGL_FROM_CAM
from piccolo.panorama.picture import read_picture

from .model import Labels

SUFFIXES = frozenset().union(*(f.suffixes for f in FORMATS)) - {".csv"}  # as these hold poses too
AXES = {**CAMERA_AXES, "opengl": OPENGL_FROM_CAM}  # a pose file's camera axes from ours, by name
MAX_SKEW = 1e-2  # of R R^T from the identity: some files have three decimals
WORLD_FROM_CAM = "world_from_cam"
CAM_FROM_WORLD = "cam_from_world"
DIRECTIONS = (WORLD_FROM_CAM, CAM_FROM_WORLD)


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


def pose_of_transform(where: str, T: Array, direction: str, axes: str) -> Pose:
    """Return the pose in a matrix (3 or 4, 4) [R | t]; `where` names the file for refusals."""
    return check_transform(T, where, AXES[axes], direction == CAM_FROM_WORLD, MAX_SKEW)


def labels_by_index(path: Path, table: NDArray[np.uint16]) -> Labels:
    """Return labels (H, W) of a picture whose colours are indices R 2^16 + G 2^8 + B of a table; 0 beyond."""
    rgb = read_picture(path).rgb.astype(np.uint32)
    index = rgb[..., 0] << 16 | rgb[..., 1] << 8 | rgb[..., 2]
    return np.asarray(np.append(table, np.uint16(0))[np.minimum(index, len(table))], dtype=np.uint16)
