"""Calibrations, of cameras that take a picture together, and their files.

Files are COLMAP's cameras.txt and rig_config.json, OpenSfM's camera_models.json, our JSON: docs/CAMERAS.md.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np

from ...geometry.pose import (
    OPTICAL_FROM_CAM,
    Pose,
    check_pose,
    multiply,
    rotate_vector,
    rotation_from_quaternion_wxyz,
)
from ...system.arrays import Array
from ...system.errors import InputError, unreadable
from ...system.files.json_file import naming, read_bytes, read_text
from . import foreign
from .model import Camera

IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
MAX_OFFSET = 0.1  # [m] from a rig's origin to a camera: a warning names larger offsets
MAX_CAMERAS = 64
Rows = tuple[tuple[float, ...], ...]
FORMAT = "piccolo-camera/1"
MAX_CALIBRATION_SIZE = 1 << 22  # [byte] of a file
WANTED = f"wanted COLMAP's cameras.txt or .bin, OpenSfM's camera_models.json, {foreign.READ}: docs/CAMERAS.md"
MARKUP = (".yaml", ".yml", ".xml")
WANTED_RIG = "wanted COLMAP's rig_config.json, or the JSON of docs/CAMERAS.md with an image for each camera"
ANY_SIZE = 1, 1  # [px] of cameras whose file does not name a size
# by OpenSfM's projection: COLMAP's model, and OpenSfM's names of its parameters after focal length and centre
OPENSFM: dict[str, tuple[str, str]] = {
    "perspective": ("RADIAL", "k1 k2"),
    "brown": ("FULL_OPENCV", "k1 k2 p1 p2 k3 - - -"),
    "simple_radial": ("FULL_OPENCV", "k1 - - - - - - -"),
    "radial": ("FULL_OPENCV", "k1 k2 - - - - - -"),
    "fisheye": ("RADIAL_FISHEYE", "k1 k2"),
    "fisheye_opencv": ("OPENCV_FISHEYE", "k1 k2 k3 k4"),
    "spherical": ("EQUIRECTANGULAR", ""),
    "equirectangular": ("EQUIRECTANGULAR", ""),
}


def rows(R: Array) -> Rows:
    """Return a matrix as tuples, which can be compared and hashed."""
    return tuple(tuple(row) for row in R.tolist())


@dataclass(frozen=True)
class Mount:
    """A camera at its place in a rig or a picture; the frame `cam` is that of the pose to be found."""

    camera: Camera
    R_lens_from_cam: Rows = IDENTITY  # (3, 3) x_lens = R_lens_from_cam @ (x_cam - center_cam), in our axes
    center_cam: tuple[float, ...] = (0.0, 0.0, 0.0)  # [m]
    offset: tuple[int, int] = (0, 0)  # [px] of its part's upper left corner in the picture, across and down
    image: str | None = None  # in a rig: pattern of its picture's file name, with * and ? as in a shell

    def __post_init__(self) -> None:
        check_pose(Pose(self.rotation, np.array(self.center_cam)), "R_lens_from_cam, center_cam")
        if len(self.offset) != 2 or not all(isinstance(x, int) and x >= 0 for x in self.offset):
            raise InputError(f"found offset {self.offset}, wanted two whole numbers from 0 [px]")

    @property
    def rotation(self) -> Array:
        """R_lens_from_cam as an array (3, 3)."""
        return np.array(self.R_lens_from_cam, dtype=np.float64)

    def pose(self, pose: Pose) -> Pose:
        """Return the pose of this camera, given the pose of the frame `cam`."""
        center_world = pose.center_world + rotate_vector(pose.R_cam_from_world.T, np.array(self.center_cam))
        return Pose(multiply(self.rotation, pose.R_cam_from_world), center_world)

    def with_camera(self, camera: Camera) -> "Mount":
        """Return another camera at the same place."""
        return replace(self, camera=camera)

    def turn(self, R_cam_from_new: Array) -> "Mount":
        """Return the same camera in a frame that is turned about the origin by a rotation (3, 3)."""
        R = self.rotation @ R_cam_from_new
        center = R_cam_from_new.T @ np.array(self.center_cam)
        return replace(self, R_lens_from_cam=rows(R), center_cam=tuple(center.tolist()))


def compute_extent(mounts: Sequence[Mount]) -> tuple[int, int]:
    """Return width and height [px] of the picture that holds the parts of all cameras."""
    right = max(mount.offset[0] + mount.camera.width for mount in mounts)
    return right, max(mount.offset[1] + mount.camera.height for mount in mounts)


@dataclass(frozen=True)
class Calibration:
    """Cameras of a calibration file; if it lists alternatives, the picture's size selects one."""

    path: str  # of the file, for messages
    mounts: tuple[Mount, ...]
    is_choice: bool = False  # the cameras are alternatives, of which a picture has one
    has_sizes: bool = True  # the file names the sizes of the pictures

    def __post_init__(self) -> None:
        if not 1 <= len(self.mounts) <= MAX_CAMERAS and not self.is_choice:
            raise InputError(f"{self.path}: found {len(self.mounts)} cameras, wanted 1 to {MAX_CAMERAS}")

    @property
    def is_rig(self) -> bool:
        """True if each camera has a picture of its own."""
        return not self.is_choice and all(mount.image is not None for mount in self.mounts)

    @property
    def extent(self) -> float:
        """Largest distance [m] of a camera from the origin of the frame `cam`, which is localized."""
        return float(np.linalg.norm([mount.center_cam for mount in self.mounts], axis=1).max())

    def for_picture(self, width: int, height: int) -> tuple[Mount, ...]:
        """Return the cameras of a picture of this size [px]. Raise InputError if none fits, or several do."""
        if not self.is_choice:
            return self._scale(width, height)
        sizes = {(m.camera.width, m.camera.height) for m in self.mounts}
        fits = [m for m in dict.fromkeys(self.mounts) if (m.camera.width, m.camera.height) == (width, height)]
        if not fits and len(self.mounts) == 1:
            fits = list(self.mounts)
        if len(fits) != 1:
            found = f"found {len(self.mounts)} cameras, {len(fits)} of them for {width} x {height}"
            wanted = f"wanted one; sizes there are {', '.join(f'{w} x {h}' for w, h in sorted(sizes)[:5])}"
            raise InputError(f"{self.path}: {found}, {wanted}")
        return Calibration(self.path, (fits[0],))._scale(width, height)

    def _scale(self, width: int, height: int) -> tuple[Mount, ...]:
        """Return all cameras for the picture at another size, which must have the same shape."""
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
        """Return the picture of each camera in the folder of one instant. InputError for none or several."""
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
    """Return the names of the files in a folder and in its subfolders, relative to it, with slashes."""
    try:
        entries = sorted(folder.iterdir())
        inner = [file for entry in entries if entry.is_dir() for file in sorted(entry.iterdir())]
    except (OSError, ValueError) as error:
        raise unreadable(folder, error) from error
    return [f.relative_to(folder).as_posix() for f in [*entries, *inner] if f.is_file() and f.name[0] != "."]


def read_calibration(path: Path) -> Calibration:
    """Return the cameras in a file, as `read_cameras` does. Raise InputError if they are a rig."""
    calibration = read_cameras(path)
    if calibration.is_rig:
        raise InputError(f"{path}: found a rig, each camera with an image of its own: give it as `rig`")
    return calibration


def read_cameras(path: Path) -> Calibration:
    """Return the cameras in a file, whose content tells its format. Raise InputError if it has none."""
    text = "" if path.suffix.lower() == ".bin" else read_text(path, WANTED, MAX_CALIBRATION_SIZE)
    with naming(path, WANTED):
        if text.lstrip()[:1] in ("{", "["):
            return _of_document(path, json.loads(text))
        if path.suffix.lower() in MARKUP:
            return _of_foreign(path, foreign.parse_markup(text))
        return Calibration(str(path), tuple(read_colmap_cameras(path).values()), is_choice=True)


def calibration_of(document: Any, label: str) -> Calibration:
    """Return the cameras in the parsed JSON of a calibration; `label` names it in messages."""
    path = Path(label)
    with naming(path, WANTED):
        return _of_document(path, document)


def read_rig(path: Path) -> Calibration:
    """Return the cameras of a rig in COLMAP's rig_config.json or our own JSON.

    COLMAP's file does not name the size of a picture: its cameras fit a picture of any size, unscaled.
    """
    text = read_text(path, WANTED_RIG, MAX_CALIBRATION_SIZE)
    with naming(path, WANTED_RIG):
        document = json.loads(text)
        is_colmap = isinstance(document, list) and "image_prefix" in document[0]["cameras"][0]
        rig = _of_colmap_rig(path, document) if is_colmap else _of_document(path, document)
    if not rig.is_rig:
        raise InputError(f"{path}: found a camera without an image, {WANTED_RIG}")
    return rig


def document_of(mounts: Sequence[Mount]) -> dict[str, object]:
    """Return cameras in the form of our own JSON; a single camera is not put into a list."""
    entries = [_entry_of(mount) for mount in mounts]
    return {"format": FORMAT, **(entries[0] if len(entries) == 1 else {"cameras": entries})}


def read_mounts(document: Mapping[str, Any]) -> tuple[Mount, ...]:
    """Return the cameras of our own JSON. Raise an error of damaged JSON (`naming`) if it is none."""
    if document["format"] != FORMAT:
        raise ValueError(f"format {document['format']!r}, not {FORMAT!r}")
    return tuple(map(_mount_of, document.get("cameras", [document])))


def _entry_of(mount: Mount) -> dict[str, object]:
    """Return the JSON of one camera; values that are the default are left out."""
    usual = vars(Mount(mount.camera))
    camera = {name: value for name, value in asdict(mount.camera).items() if value is not None}
    return camera | {name: value for name, value in vars(mount).items() if value != usual[name]}


def _mount_of(entry: Mapping[str, Any]) -> Mount:
    known = {"format", "model", "width", "height", "params", "max_angle_deg"}
    places = {"R_lens_from_cam", "center_cam", "offset", "image"}
    if odd := sorted(entry.keys() - known - places):
        raise ValueError(f"a field {odd[0]!r} that is none of {', '.join(sorted(known | places))}")
    width = _whole(entry["width"])
    height = _whole(entry["height"])
    angle = entry.get("max_angle_deg")
    params = tuple(map(float, entry["params"]))
    max_angle_deg = None if angle is None else float(angle)
    camera = Camera(entry["model"], width, height, params, max_angle_deg)
    image = entry.get("image")
    if image is not None and not (isinstance(image, str) and image.isprintable() and image):
        raise ValueError(f"an image {image!r} that is no name")
    return Mount(
        camera,
        tuple(tuple(map(float, row)) for row in entry.get("R_lens_from_cam", IDENTITY)),
        tuple(map(float, entry.get("center_cam", (0.0, 0.0, 0.0)))),
        (*map(_whole, entry.get("offset", (0, 0))),),  # type: ignore[arg-type]  # Mount checks the length
        image,
    )


def _whole(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError(f"{value!r}, no whole number")
    return value


def _of_document(path: Path, document: Any) -> Calibration:
    if "format" in document:
        return Calibration(str(path), read_mounts(document))
    mounts = tuple(opensfm_cameras(document).values())
    return Calibration(str(path), mounts, is_choice=True) if mounts else _of_foreign(path, document)


def opensfm_cameras(document: Any) -> dict[str, Mount]:
    """Return the cameras of OpenSfM's camera_models.json or reconstruction.json by name; else none."""
    if foreign.is_reconstruction(document):
        document = {name: entry for part in document for name, entry in part["cameras"].items()}
    entries = document if isinstance(document, dict) else {}
    if not all(isinstance(entry, dict) and "projection_type" in entry for entry in entries.values()):
        return {}
    return {name: Mount(_of_opensfm(entry)) for name, entry in entries.items()}


def _of_foreign(path: Path, document: Any) -> Calibration:
    cameras = foreign.cameras_in(document)
    if not cameras:
        raise ValueError("no camera with its size and focal length")
    return Calibration(str(path), tuple(map(Mount, cameras)), is_choice=True)


def _of_opensfm(entry: Mapping[str, Any]) -> Camera:
    """Return a camera of camera_models.json (opensfm/io.py, https://opensfm.org/docs/geometry.html).

    Lengths there are fractions of the picture's larger side, positions are from its middle.
    """
    projection = entry["projection_type"]
    if projection not in OPENSFM:
        raise ValueError(f"the projection {projection!r}, not one of {', '.join(OPENSFM)}")
    model, names = OPENSFM[projection]
    width, height = _whole(entry["width"]), _whole(entry["height"])
    if model == "EQUIRECTANGULAR":
        return Camera(model, width, height, (float(width), float(height)))
    larger = float(max(width, height))
    focal = float(entry["focal"]) if "focal" in entry else float(entry["focal_x"])
    focals = [focal, float(entry.get("focal_y", focal))][: 2 if "OPENCV" in model else 1]
    c_x = float(entry.get("c_x", 0.0))
    c_y = float(entry.get("c_y", 0.0))
    center = width / 2.0 + larger * c_x, height / 2.0 + larger * c_y
    more = [0.0 if name == "-" else float(entry.get(name, 0.0)) for name in names.split()]
    return Camera(model, width, height, (*(larger * f for f in focals), *center, *more))


def read_colmap_cameras(path: Path) -> dict[str, Mount]:
    """Return the cameras of cameras.bin or .txt by id; a line has id, model, width, height, parameters."""
    if path.suffix.lower() == ".bin":
        text = foreign.read_binary_cameras(read_bytes(path, WANTED, MAX_CALIBRATION_SIZE))
    else:
        text = read_text(path, WANTED, MAX_CALIBRATION_SIZE)
    mounts: dict[str, Mount] = {}
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split("#")[0].split()
        if not words:
            continue
        try:
            if len(words) < 5:
                raise ValueError(f"{len(words)} words")
            name, model, width, height, *params = words
            camera = Camera(model, int(width), int(height), tuple(map(float, params)))
        except ValueError as error:
            raise InputError(f"{path}, line {number}: {error}; {WANTED}") from error
        mounts[name] = Mount(camera)
    if not mounts:
        raise InputError(f"{path}: found no camera, {WANTED}")
    return mounts


def _of_colmap_rig(path: Path, document: Sequence[Any]) -> Calibration:
    """Return the rig of rig_config.json (https://colmap.github.io/rigs.html): axes right, down, forward."""
    if len(document) != 1:
        raise InputError(f"{path}: found {len(document)} rigs, wanted one")
    mounts = []
    for entry in document[0]["cameras"]:
        prefix = str(entry["image_prefix"])
        if "camera_model_name" not in entry or "camera_params" not in entry:
            found = f"found no camera_model_name or camera_params for {prefix!r}"
            raise InputError(f"{path}: {found}, {WANTED_RIG}")
        params = tuple(map(float, entry["camera_params"]))
        name = Path(prefix).name
        quaternion = np.array(entry.get("cam_from_rig_rotation", (1, 0, 0, 0)), float)
        rotation = rotation_from_quaternion_wxyz(quaternion)
        translation = np.array(entry.get("cam_from_rig_translation", (0, 0, 0)), float)
        center = OPTICAL_FROM_CAM.T @ -rotation.T @ translation
        R = OPTICAL_FROM_CAM.T @ rotation @ OPTICAL_FROM_CAM
        pattern = f"{name}/*|{name}.*" if prefix.endswith("/") else f"{name}*"
        camera = Camera(str(entry["camera_model_name"]), *ANY_SIZE, params)
        mounts.append(Mount(camera, rows(R), tuple(center.tolist()), image=pattern))
    return Calibration(str(path), tuple(mounts), has_sizes=False)
