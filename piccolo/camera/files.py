"""Calibrations in files: COLMAP's cameras.txt and rig_config.json, OpenSfM's camera_models.json, our JSON.

docs/CAMERAS.md describes each, and ours.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..files.json_file import DAMAGE, describe, read_text
from ..geometry.pose import rotation_from_quaternion_wxyz
from ..geometry.rotations import OPTICAL_FROM_CAM
from .model import Camera
from .rig import IDENTITY, Calibration, Mount, rows

FORMAT = "piccolo-camera/1"
MAX_SIZE = 1 << 22  # [byte] of a file
WANTED = "wanted COLMAP's cameras.txt, OpenSfM's camera_models.json or the JSON of docs/CAMERAS.md"
WANTED_RIG = "wanted COLMAP's rig_config.json, or the JSON of docs/CAMERAS.md with an image for each camera"
ANY_SIZE = 1, 1  # of cameras whose file does not say it
# OpenSfM's projections: COLMAP's model, and OpenSfM's names of its parameters after focal lengths and centre
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


def read_calibration(path: Path) -> Calibration:
    """Return the cameras in a file that take one picture, as `read_cameras`; InputError if they are a rig."""
    calibration = read_cameras(path)
    if calibration.is_rig:
        raise InputError(f"{path}: found a rig, each camera with an image of its own: give it as `rig`")
    return calibration


def open_calibration(path: Path) -> Calibration | Path:
    """Return the cameras in a file, as `read_calibration`; a folder of such files, for `find_calibration`."""
    return path.absolute() if path.is_dir() else read_calibration(path)


def find_calibration(given: Calibration | Path | None, pano: Path) -> Calibration | None:
    """Return what is given, or from a folder the file NAME.camera.json or NAME.json of a photo NAME.jpg."""
    if not isinstance(given, Path):
        return given
    names = [f"{pano.stem}{suffix}" for suffix in (".camera.json", ".json")]
    file = next((given / name for name in names if (given / name).is_file()), None)
    if file is None:
        raise InputError(f"{pano}: found no calibration of it in {given}, wanted {' or '.join(names)}")
    return read_calibration(file)


def read_cameras(path: Path) -> Calibration:
    """Return the cameras in a file, told by its content; InputError if it holds none."""
    text = read_text(path, WANTED, MAX_SIZE)
    with _naming(path, WANTED):
        if text.lstrip()[:1] in ("{", "["):
            return _of_document(path, json.loads(text))
        return _of_colmap(path, text)


def read_rig(path: Path) -> Calibration:
    """Return the cameras of a rig in COLMAP's rig_config.json or our own JSON.

    COLMAP's file does not say how large a picture is: its cameras fit a picture of any size, as they are.
    """
    text = read_text(path, WANTED_RIG, MAX_SIZE)
    with _naming(path, WANTED_RIG):
        document = json.loads(text)
        is_colmap = isinstance(document, list) and "image_prefix" in document[0]["cameras"][0]
        rig = _of_colmap_rig(path, document) if is_colmap else _of_document(path, document)
    if not rig.is_rig:
        raise InputError(f"{path}: found a camera without an image, {WANTED_RIG}")
    return rig


@contextmanager
def _naming(path: Path, wanted: str) -> Iterator[None]:
    """Turn what a damaged file raises into an InputError that names it."""
    try:
        yield
    except DAMAGE as error:
        text = str(error) if isinstance(error, InputError) else f"found {describe(error)}"
        raise InputError(text if text.startswith(str(path)) else f"{path}: {text}; {wanted}") from error


def document_of(mounts: Sequence[Mount]) -> dict[str, object]:
    """Cameras as our own JSON has them; of a single one without a list."""
    entries = [_entry_of(mount) for mount in mounts]
    return {"format": FORMAT, **(entries[0] if len(entries) == 1 else {"cameras": entries})}


def read_mounts(document: Mapping[str, Any]) -> tuple[Mount, ...]:
    """Return the cameras of our own JSON; one of DAMAGE if it is none."""
    if document["format"] != FORMAT:
        raise ValueError(f"format {document['format']!r}, not {FORMAT!r}")
    return tuple(map(_mount_of, document.get("cameras", [document])))


def _entry_of(mount: Mount) -> dict[str, object]:
    """One camera; what is as usual is left out."""
    camera = mount.camera
    entry: dict[str, object] = {"model": camera.model, "width": camera.width, "height": camera.height}
    entry["params"] = list(camera.params)
    if camera.max_angle_deg is not None:
        entry["max_angle_deg"] = camera.max_angle_deg
    if mount.R_lens_from_cam != IDENTITY:
        entry["R_lens_from_cam"] = [list(row) for row in mount.R_lens_from_cam]
    if any(mount.center_cam):
        entry["center_cam"] = list(mount.center_cam)
    if any(mount.offset):
        entry["offset"] = list(mount.offset)
    return entry if mount.image is None else {**entry, "image": mount.image}


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
    cameras = {name: _of_opensfm(entry) for name, entry in document.items()}
    return Calibration(str(path), tuple(map(Mount, cameras.values())), is_choice=True)


def _of_opensfm(entry: Mapping[str, Any]) -> Camera:
    """Return a camera of camera_models.json (opensfm/io.py, https://opensfm.org/docs/geometry.html).

    Lengths there are parts of the larger side, from the picture's middle.
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


def _of_colmap(path: Path, text: str) -> Calibration:
    """Return the cameras of cameras.txt: lines of id, model, width, height, parameters."""
    mounts = []
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split("#")[0].split()
        if not words:
            continue
        try:
            _, model, width, height, *params = words
            camera = Camera(model, int(width), int(height), tuple(map(float, params)))
        except ValueError as error:
            raise InputError(f"{path}, line {number}: {error}; {WANTED}") from error
        mounts.append(Mount(camera))
    if not mounts:
        raise InputError(f"{path}: found no camera, {WANTED}")
    return Calibration(str(path), tuple(mounts), is_choice=True)


def _of_colmap_rig(path: Path, document: Sequence[Any]) -> Calibration:
    """Return one rig of rig_config.json (https://colmap.github.io/rigs.html): axes right, down, forward."""
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
