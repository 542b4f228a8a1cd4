"""Poses as tables, trajectories, models and recordings of other programs, points on maps, in JPEGs.

Numbers are written so that the same float64 is read back. Where a format has no place for the offset, it is
written beside it: <name>.offset.txt.
"""

import csv
import io
from collections.abc import Iterable, Sequence
from decimal import Decimal
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from ...api.values import Result
from ...cloud.cloud_settings import check_crs
from ...geometry.pose import CAMERA_AXES, Pose, heading_pitch_roll_deg, quaternion_wxyz, turn_axes
from ...photo.panorama.gpano import with_pose
from ...photo.panorama.picture import WANTED
from ...system.errors import InputError, import_optional, printable
from ...system.files.atomic import (
    check_output,
    check_output_folder,
    replacing_folder,
    write_atomically,
    write_json,
    write_lines,
)
from ...system.files.json_file import read_bytes
from .colmap import check_model, write_colmap
from .faces import write_faces
from .posed_images import (
    NO_UTF8,
    Format,
    LeftOut,
    Options,
    PosedImage,
    names_within,
    numbers,
    offset_comment,
    select_images,
    write_with_offset,
)
from .reconstructions import NERFSTUDIO_LENSES, OPENSFM_LENSES, check_shape, write_nerfstudio, write_opensfm
from .rerun_file import check_float32, write_rerun

COLUMNS = (
    *("image", "cloud", "status", "confidence", "place_probability", "score", "x", "y", "z"),
    *("quaternion_w", "quaternion_x", "quaternion_y", "quaternion_z"),  # of R_cam_from_world
    *("heading_deg", "pitch_deg", "roll_deg"),
)
NORTH_STEP = 10.0  # [m] ahead, to find true north
MARGIN_DEG = 3.0  # around a system's area: a country that spans two zones often uses one for both
LOCAL = 10_000.0  # [m] from (0, 0): without a margin, as scans with coordinates of their own lie there
GPX_NAMESPACE = "http://www.topografix.com/GPX/1/1"


def cell(text: str) -> str:
    """Text that no spreadsheet takes for a formula: after an apostrophe, which marks text there."""
    return f"'{text}" if text.startswith(("=", "+", "-", "@", "\t", "\r", "'")) else text


def write_csv(images: Sequence[PosedImage], out: Path, options: Options) -> None:
    """Write a header and a row a result, in our own axes; what is not known is empty, paths as of `cell`."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(COLUMNS)
    for image in images:
        result = image.result
        pose = image.pose
        score = result.evidence.score if result.evidence else None
        words = cell(image.name), cell(result.cloud_name), result.status
        sure = result.confidence, result.place_probability, score
        wxyz = quaternion_wxyz(pose.R_cam_from_world).tolist()
        table.writerow([*words, *sure, *pose.center_world.tolist(), *wxyz, *heading_pitch_roll_deg(pose)])
    write_with_offset(out, text.getvalue(), options)


def write_tum(images: Sequence[PosedImage], out: Path, options: Options) -> None:
    """Write rows "timestamp tx ty tz qx qy qz qw", world from camera, by time, below a comment."""
    ordered = sorted(images, key=lambda image: Decimal(image.time))
    header, *rows = tum_lines([(image.time, image.pose) for image in ordered], options.axes)
    write_lines(out, [header, *offset_comment(options), *rows])


def tum_lines(poses: Iterable[tuple[str, Pose]], axes: str) -> list[str]:
    """Return a comment and the rows of poses, each with the text of its time; `axes` as in CAMERA_AXES."""
    lines = [f"# timestamp tx ty tz qx qy qz qw, camera axes {axes}"]
    for time, pose in poses:
        T = turn_axes(pose, CAMERA_AXES[axes]).T_world_from_cam
        w, x, y, z = quaternion_wxyz(T[:3, :3])
        lines.append(f"{time} {numbers([*T[:3, 3], x, y, z, w])}")
    return lines


def write_kitti(images: Sequence[PosedImage], out: Path, options: Options) -> None:
    """Write the twelve numbers of a 3 x 4 matrix, world from camera, a row; the format has no comments."""
    matrices = [turn_axes(image.pose, CAMERA_AXES[options.axes]).T_world_from_cam for image in images]
    write_with_offset(out, "".join(f"{numbers(T[:3].ravel())}\n" for T in matrices), options)


def write_potree(images: Sequence[PosedImage], out: Path, options: Options) -> None:
    """Write coordinates.txt of Potree's 360 images (src/modules/Images360/Images360.js).

    Columns, by tabs: file, time, x, y, z in the cloud's coordinates, course, pitch, roll [deg]. Potree turns
    the sphere by R_z(90 - course) R_y(-pitch) R_x(90 + roll); with the picture as three.js lays it on the
    sphere these are heading, pitch and roll of Photo Sphere XMP. The first line is empty: by its version
    Potree skips the first line or reads it.
    """
    lines = [""]
    for image in images:
        values = [*image.pose.center_world, *heading_pitch_roll_deg(image.pose)]
        lines.append("\t".join([image.name, image.time, numbers(values, "\t")]))
    write_with_offset(out, "".join(f"{line}\n" for line in lines), options)


def write_geojson(images: Sequence[PosedImage], out: Path, options: Options) -> None:
    """Write a FeatureCollection (RFC 7946) with a point a result: longitude and latitude in WGS84."""
    geod, transformer, crs = _in_degrees("GeoJSON", images, options)
    features = [_feature(image, transformer, geod, crs) for image in images]
    write_json(out, {"type": "FeatureCollection", "features": features})


def write_gpx(images: Sequence[PosedImage], out: Path, options: Options) -> None:
    """Write a track (GPX 1.1) with a point a result, in order; a new segment behind each gap of a walk."""
    _, transformer, _ = _in_degrees("GPX", images, options)
    root = ElementTree.Element("gpx", version="1.1", creator="piccolo", xmlns=GPX_NAMESPACE)
    track = ElementTree.SubElement(root, "trk")
    segment = ElementTree.SubElement(track, "trkseg")
    for image in images:
        if image.result.walk is not None and image.result.walk.gap is not None:
            segment = ElementTree.SubElement(track, "trkseg")
        longitude, latitude = transformer.transform(*image.pose.center_world[:2].tolist())
        point = ElementTree.SubElement(segment, "trkpt", lat=repr(latitude), lon=repr(longitude))
        if taken := image.result.source.capture_time:
            ElementTree.SubElement(point, "time").text = taken
        ElementTree.SubElement(point, "name").text = printable(image.name)
    write_atomically(out, ElementTree.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n")


def _in_degrees(what: str, images: Sequence[PosedImage], options: Options) -> tuple[Any, Any, str]:
    """Return the ellipsoid, what turns positions into longitude and latitude, and the system's name."""
    pyproj = import_optional(what, "pyproj", "gps")
    crs = str(options.crs)
    system = check_crs(crs, what)
    units = {axis.unit_name for axis in system.axis_info[:2]}
    if not system.is_projected or units != {"metre"}:
        raise InputError(f"`crs`: found {crs} ({system.name}), wanted a projected system in metres")
    transformer = pyproj.Transformer.from_crs(system, "EPSG:4326", always_xy=True)
    for image in images:
        _check_place(image, system, transformer, crs)
    return pyproj.Geod(ellps="WGS84"), transformer, crs


def _check_place(image: PosedImage, system: Any, transformer: Any, crs: str) -> None:
    """Refuse a camera outside of the area where the system is used, as far as the system says it."""
    x, y = image.pose.center_world[:2].tolist()
    longitude, latitude = transformer.transform(x, y)
    area = system.area_of_use
    if not np.isfinite([longitude, latitude]).all() or (area and not _is_in(area, longitude, latitude, x, y)):
        name = str(system.name)
        if area:
            name += f", {area.west:g} to {area.east:g} E, {area.south:g} to {area.north:g} N"
        found = f"found a camera at ({x:g}, {y:g})"
        raise InputError(f"{image.path}: {found}, wanted one where {crs} holds ({name})")


def _is_in(area: Any, longitude: float, latitude: float, x: float, y: float) -> bool:
    """Return True if a place [deg], (x, y) [m], is in an area, which may cross 180 E, with a margin."""
    margin = 0.0 if np.hypot(x, y) < LOCAL else MARGIN_DEG
    width = 360.0 if area.east - area.west >= 360.0 else (area.east - area.west) % 360.0
    is_between = (longitude - area.west + margin) % 360.0 <= width + 2.0 * margin
    return bool(is_between and area.south - margin <= latitude <= area.north + margin)


def _feature(image: PosedImage, transformer: Any, geod: Any, crs: str) -> dict[str, object]:
    """Return the point without a height, which would have to be above WGS84's ellipsoid: z is a property."""
    result = image.result
    x, y, z = image.pose.center_world.tolist()
    heading, pitch, roll = heading_pitch_roll_deg(image.pose)
    ahead = np.radians(heading)
    eastings = [x, x + NORTH_STEP * np.sin(ahead)]
    northings = [y, y + NORTH_STEP * np.cos(ahead)]
    longitudes, latitudes = transformer.transform(eastings, northings)
    true_heading, _, _ = geod.inv(longitudes[0], latitudes[0], longitudes[1], latitudes[1])
    properties = {
        "image": image.name,
        "cloud": result.cloud_name,
        "status": result.status,
        "confidence": result.confidence,
        "place_probability": result.place_probability,
        "score": result.evidence and result.evidence.score,
        **{"crs": crs, "x": x, "y": y, "z": z},
        **{"heading_deg": heading, "heading_true_deg": true_heading % 360.0},
        **{"pitch_deg": pitch, "roll_deg": roll},
    }
    point = {"type": "Point", "coordinates": [longitudes[0], latitudes[0]]}
    return {"type": "Feature", "geometry": point, "properties": properties}


def write_gpano(images: Sequence[PosedImage], out: Path, options: Options) -> None:
    """Write a copy of each picture into a new folder, under its name in `images` or its file name."""
    names = names_within(images, options.images is not None)
    with replacing_folder(out) as folder:
        for name, image in zip(names, images, strict=True):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            write_atomically(folder / name, _copy(image))


def _copy(image: PosedImage) -> bytes:
    """Return the picture's file with its pose."""
    return with_pose(image.path, read_bytes(image.path, WANTED), heading_pitch_roll_deg(image.pose))


OFFSET = frozenset({"offset"})
MODEL = OFFSET | {"size"}
COLMAP_TEXT = "text and binary model of COLMAP 4; needs the library pycolmap; `out` is a new folder"
NERFSTUDIO_TEXT = "transforms.json of nerfstudio, in the folder of `images`"
POTREE_TEXT = "coordinates.txt of Potree's 360 images, in the folder of `images`"
COLMAP = Format(
    "colmap",
    COLMAP_TEXT,
    write_colmap,
    MODEL | {"points", "faces", "into"},
    is_folder=True,
    forbidden=rf"\s|{NO_UTF8}",  # a blank ends a name, for COLMAP as for the readers in Python
    check=check_model,
    cameras="own",
    data_set=("sparse/0", "images"),
)
NERFSTUDIO = Format(
    "nerfstudio",
    NERFSTUDIO_TEXT,
    write_nerfstudio,
    MODEL | {"points", "faces"},
    cameras="own",
    lenses=NERFSTUDIO_LENSES,
    data_set=("transforms.json", ""),
)
OPENSFM_TEXT = "reconstruction.json of OpenSfM"
OPENSFM = Format(
    "opensfm", OPENSFM_TEXT, write_opensfm, MODEL, cameras="own", check=check_shape, lenses=OPENSFM_LENSES
)
CSV = Format("csv", "table with a header", write_csv, OFFSET, has_unique_names=False)
TRAJECTORY = "trajectory for evo and other tools"
TUM = Format("tum", TRAJECTORY, write_tum, OFFSET | {"axes", "timestamps"}, forbidden="")
KITTI = Format("kitti", TRAJECTORY, write_kitti, OFFSET | {"axes"}, forbidden="")
NOT_IN_POTREE = rf"[\"\t\n\r]|{NO_UTF8}"
POTREE = Format(
    "potree", POTREE_TEXT, write_potree, OFFSET | {"timestamps"}, forbidden=NOT_IN_POTREE, cameras="spheres"
)
GEOJSON_TEXT = "points for maps, in WGS84; needs `crs` and the library pyproj"
GEOJSON = Format("geojson", GEOJSON_TEXT, write_geojson, frozenset({"crs"}), has_unique_names=False)
GPX_TEXT = "track of the positions in WGS84; needs `crs` and the library pyproj"
GPX = Format("gpx", GPX_TEXT, write_gpx, frozenset({"crs"}), has_unique_names=False, forbidden="")
GPANO_TEXT = "copies of the JPEGs with heading, pitch and roll as Photo Sphere XMP; `out` is a new folder"
GPANO = Format("gpano", GPANO_TEXT, write_gpano, is_folder=True, forbidden="", cameras="spheres", check=_copy)
RERUN_TEXT = "recording for Rerun's viewer, with the pictures; needs the library rerun-sdk"
RERUN = Format(
    "rerun", RERUN_TEXT, write_rerun, MODEL | {"points", "timestamps"}, cameras="own", check=check_float32
)
_ALL = COLMAP, NERFSTUDIO, OPENSFM, RERUN, TUM, KITTI, CSV, GEOJSON, GPX, POTREE, GPANO
FORMATS: dict[str, Format] = {form.name: form for form in _ALL}


def export(results: Sequence[Result], name: str, out: Path, options: Options) -> LeftOut:
    """Write the poses of `results`, which all have one, to `out` in the format `name`, whole or not at all.

    Returns the pictures that are left out, by why: the format can't hold them, or they can't be read.
    Raises InputError if no pose is left, or `out` can't be written.
    """
    form = FORMATS[name]
    has_folder = form.is_folder or options.faces is not None
    (check_output_folder if has_folder else check_output)(out)
    if not results:
        raise InputError(f"{out}: there is no pose to write; `all` also writes those that are not localized")
    images, left_out = select_images(results, form, options)
    if options.faces is None:
        form.write(images, out, options)
        return left_out
    with replacing_folder(out) as folder:
        model, root = form.data_set
        (folder / model).parent.mkdir(parents=True, exist_ok=True)
        faces = write_faces(images, options.faces, options.images is not None, folder)
        names = [image.path.relative_to(folder / root).as_posix() for image in faces]
        faces = [image._replace(name=name) for image, name in zip(faces, names, strict=True)]
        form.write(faces, folder / model, options)
    return left_out
