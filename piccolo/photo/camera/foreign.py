"""Calibrations and poses in files of other programs: COLMAP's binary files; JSON, YAML and XML with a matrix.

These are the transforms.json of nerfstudio and of phone apps, the JSON that Polycam puts beside a photo,
Record3D's metadata, and files of OpenCV, ROS, Kalibr and Metashape. They name the same numbers differently.
"""

import math
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from ...system.errors import import_optional
from ...system.files.json_file import MAX_JSON_SIZE, is_number, read_bytes, read_text
from .model import MODELS, Camera

READ = "JSON of nerfstudio, Polycam or Record3D, YAML of OpenCV, ROS or Kalibr, XML of OpenCV or Metashape"
MODEL_NUMBERS = {  # numbers of models in COLMAP's binary files
    0: "SIMPLE_PINHOLE",
    1: "PINHOLE",
    2: "SIMPLE_RADIAL",
    3: "RADIAL",
    4: "OPENCV",
    5: "OPENCV_FISHEYE",
    6: "FULL_OPENCV",
    7: "FOV",
    8: "SIMPLE_RADIAL_FISHEYE",
    9: "RADIAL_FISHEYE",
    10: "THIN_PRISM_FISHEYE",
    14: "SIMPLE_FISHEYE",
    15: "FISHEYE",
    17: "EQUIRECTANGULAR",
}
NUM_COLMAP = 10  # columns: id, qw, qx, qy, qz, tx, ty, tz, camera, name
POINT_SIZE = 24  # [byte] of a point in images.bin
MAX_NAME_SIZE = 4096  # [byte]
MATRIX = ("camera_matrix", "cameramatrix", "intrinsic_matrix", "intrinsics", "k")
COEFFICIENTS = ("distortion_coefficients", "distortion_coeffs", "dist_coeffs", "distcoeffs", "d")
WIDTHS = ("image_width", "width", "w")
HEIGHTS = ("image_height", "height", "h")
SIZES = ("resolution", "image_size", "imagesize")
LENS = ("distortion_model", "camera_model", "fisheye_model")
FISHEYES = ("equidistant", "fisheye", "opencv_fisheye", "kannalabrandt4", "kannala_brandt")
CORNER = 0.5  # [px] from a picture's corner to the middle of its first pixel, the origin of OpenCV and ROS
SAME_FOCAL = 0.02  # relative range of the focal lengths of frames by one camera with autofocus
MAX_NESTING = 8


def read_binary_cameras(content: bytes) -> str:
    """Return COLMAP's cameras.bin as the text of cameras.txt. Raise ValueError if it is damaged."""
    lines = []
    (count,) = _unpack("<Q", content, 0)
    at = 8
    for _ in range(min(count, len(content))):
        camera, model, width, height = _unpack("<IiQQ", content, at)
        if model not in MODEL_NUMBERS:
            raise ValueError(f"the camera model number {model}, which is not read")
        num_params = len(MODELS[MODEL_NUMBERS[model]][1])
        params = _unpack(f"<{num_params}d", content, at + 24)
        at += 24 + 8 * num_params
        lines.append(" ".join(map(str, (camera, MODEL_NUMBERS[model], width, height, *params))))
    return "\n".join(lines)


def read_images(path: Path, wanted: str) -> list[list[str]]:
    """Return the rows of COLMAP's images.bin or .txt: number, pose, camera, name. ValueError if damaged."""
    if path.suffix == ".bin":
        return list(_read_binary_images(read_bytes(path, wanted, MAX_JSON_SIZE)))
    lines = [line.strip() for line in read_text(path, wanted).splitlines()]
    rows = [line.split(None, NUM_COLMAP - 1) for line in lines if not line.startswith("#")]
    return [row for row in rows if not all(map(is_number, " ".join(row).split()))]  # else: points


def _read_binary_images(content: bytes) -> Iterator[list[str]]:
    (count,) = _unpack("<Q", content, 0)
    at = 8
    for _ in range(min(count, len(content))):
        image, *pose, camera = _unpack("<I7dI", content, at)
        end = content.find(b"\0", at + 64, at + 64 + MAX_NAME_SIZE)
        if end < 0:
            raise ValueError("a photo without a name")
        (num_points,) = _unpack("<Q", content, end + 1)
        yield [*map(str, (image, *pose, camera)), content[at + 64 : end].decode("utf-8", "replace")]
        at = end + 9 + POINT_SIZE * num_points


def is_reconstruction(document: Any) -> bool:
    """Return True for OpenSfM's reconstruction.json: a list of parts with cameras and shots."""
    parts = document if isinstance(document, list) else []
    return bool(parts) and all(isinstance(part, dict) and {"cameras", "shots"} <= {*part} for part in parts)


def _unpack(form: str, content: bytes, at: int) -> tuple[Any, ...]:
    if at + struct.calcsize(form) > len(content):
        raise ValueError("a file that is cut off")
    return struct.unpack_from(form, content, at)


def parse_markup(text: str) -> Any:
    """Return the content of YAML or XML as parsed JSON would be. Raise ValueError if it is damaged."""
    if text.lstrip().startswith("<"):
        return {"xml": _of_element(parse_xml(text))}
    yaml = import_optional("a calibration in YAML", "yaml", "formats")
    lines = [line for line in text.replace("!!opencv-matrix", "").splitlines() if not line.startswith("%")]
    try:
        return yaml.safe_load("\n".join(lines))
    except yaml.YAMLError as error:
        raise ValueError(f"damaged YAML ({' '.join(str(error).split())[:100]})") from error


def parse_xml(text: str) -> ElementTree.Element:
    """Return the root of XML. Raise ValueError if it is damaged, or has a document type."""
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError("a document type, which is not read")
    try:
        return ElementTree.fromstring(text.strip())
    except ElementTree.ParseError as error:
        raise ValueError(f"damaged XML ({error})") from error


def _of_element(element: ElementTree.Element) -> Any:
    if not len(element):
        words = (element.text or "").split()
        return [float(word) for word in words] if len(words) > 1 else (words or [""])[0]
    return dict(element.attrib) | {child.tag: _of_element(child) for child in element}


def cameras_in(document: Any) -> list[Camera]:
    """Return the cameras that a document describes anywhere in it; frames of one camera count once."""
    cameras = list(dict.fromkeys(_search(document, MAX_NESTING)))
    if len(cameras) > 1 and len({(c.width, c.height, c.model) for c in cameras}) == 1:
        focals = np.array([camera.focal[0] for camera in cameras])
        if np.ptp(focals) <= SAME_FOCAL * focals.mean():
            return [cameras[int(np.argsort(focals)[len(focals) // 2])]]
    return cameras


def _search(document: Any, depth: int) -> Iterator[Camera]:
    if depth == 0:
        return
    if isinstance(document, Mapping):
        entry = {str(key).lower(): value for key, value in document.items()}
        camera = _camera_of(entry)
        if camera is not None:
            yield camera
            return
        document = list(document.values())
    for value in document if isinstance(document, list) else ():
        if isinstance(value, Mapping | list):
            yield from _search(value, depth - 1)


def _first(entry: Mapping[str, Any], names: tuple[str, ...]) -> Any:
    return next((entry[name] for name in names if name in entry), None)


def _numbers(value: Any) -> list[float]:
    """Return the numbers in a list, a list of lists, or a matrix with `data`; empty for anything else."""
    data = value.get("data") if isinstance(value, Mapping) else value
    flat: Any = np.ravel(data) if isinstance(data, list) else []
    return [float(number) for number in flat]


def _camera_of(entry: Mapping[str, Any]) -> Camera | None:
    """Return the camera that a mapping with lower-case names describes, or None."""
    sizes = _numbers(_first(entry, SIZES))
    if isinstance(entry.get("resolution"), Mapping):
        sizes = [float(_first(entry["resolution"], names)) for names in (WIDTHS, HEIGHTS)]
    width = _first(entry, WIDTHS) or sizes[0:1]
    height = _first(entry, HEIGHTS) or sizes[1:2]
    if not (width and height) or isinstance(width, Mapping):
        return None
    width = round(float(np.ravel(width)[0]))
    height = round(float(np.ravel(height)[0]))
    matrix = _matrix_of(entry, width, height)
    if matrix is None:
        return None
    coefficients = _numbers(_first(entry, COEFFICIENTS)) or _named_coefficients(entry)
    lens = " ".join(str(entry[name]) for name in LENS if name in entry).lower().split()
    is_fisheye = any(word in FISHEYES for word in lens) or str(entry.get("type")) == "fisheye"
    if is_fisheye:
        return Camera("OPENCV_FISHEYE", width, height, (*matrix, *(coefficients + [0.0] * 4)[:4]))
    if not any(coefficients):
        return Camera("PINHOLE", width, height, matrix)
    return Camera("FULL_OPENCV", width, height, (*matrix, *(coefficients + [0.0] * 8)[:8]))


def _matrix_of(entry: Mapping[str, Any], width: int, height: int) -> tuple[float, float, float, float] | None:
    """Return focal lengths and centre (fx, fy, cx, cy) [px], from a picture's corner; None without."""
    values = _numbers(_first(entry, MATRIX))
    if len(values) == 9:
        if not (values[2] or values[5]):  # Record3D's matrix is stored column after column
            return values[0], values[4], values[6], values[7]
        return values[0], values[4], values[2] + CORNER, values[5] + CORNER
    if len(values) == 4:
        return values[0], values[1], values[2] + CORNER, values[3] + CORNER
    if "f" in entry:  # Metashape's centre is relative to the picture's middle
        focal = float(entry["f"])
        x, y = (float(entry.get(name, 0.0)) for name in ("cx", "cy"))
        return focal + float(entry.get("b1", 0.0)), focal, width / 2.0 + x, height / 2.0 + y
    if "camera_angle_x" in entry and "fl_x" not in entry:
        entry = {**entry, "fl_x": width / 2.0 / math.tan(float(entry["camera_angle_x"]) / 2.0)}
    f_x = _first(entry, ("fl_x", "fx", "focal_x"))
    if f_x is None:
        return None
    f_y = _first(entry, ("fl_y", "fy", "focal_y"))
    center = (float(entry.get("cx", width / 2.0)), float(entry.get("cy", height / 2.0)))
    return float(f_x), float(f_x if f_y is None else f_y), *center


def _named_coefficients(entry: Mapping[str, Any]) -> list[float]:
    """Return coefficients in OpenCV's order: k1 k2 p1 p2 k3, or for a fisheye k1 k2 k3 k4."""
    k1, k2, k3, k4, p1, p2 = (float(entry.get(name, 0.0)) for name in ("k1", "k2", "k3", "k4", "p1", "p2"))
    if "fisheye" in str(entry.get("camera_model", "")).lower():
        return [k1, k2, k3, k4]
    if "f" in entry:  # Metashape exchanges p1 and p2
        p1, p2 = p2, p1
    return [k1, k2, p1, p2, k3]
