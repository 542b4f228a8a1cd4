"""Poses on maps of the world, in WGS84: points as GeoJSON, a track as GPX."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from ...errors import InputError, printable
from ...files.atomic import write_atomically
from ...geometry.rotations import heading_pitch_roll_deg
from ...optional import import_optional
from .formats import write_json
from .posed_images import Format, Options, PosedImage

STEP = 10.0  # [m] ahead, to find true north
MARGIN_DEG = 3.0  # around a system's area: a country that spans two zones often uses one for both
LOCAL = 10_000.0  # [m] from (0, 0): without a margin, as scans with coordinates of their own lie there
GPX_NAMESPACE = "http://www.topografix.com/GPX/1/1"


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
    """The ellipsoid, what turns positions into longitude and latitude, and the system's name."""
    pyproj = import_optional(what, "pyproj", "tools")
    crs = str(options.crs)
    try:
        system = pyproj.CRS.from_user_input(crs)
    except pyproj.exceptions.CRSError as error:
        raise InputError(f"--crs: found {crs!r}, wanted a coordinate system such as EPSG:25832") from error
    units = {axis.unit_name for axis in system.axis_info[:2]}
    if not system.is_projected or units != {"metre"}:
        raise InputError(f"--crs: found {crs} ({system.name}), wanted a projected system in metres")
    transformer = pyproj.Transformer.from_crs(system, "EPSG:4326", always_xy=True)
    for image in images:
        _check_place(image, system, transformer, crs)
    return pyproj.Geod(ellps="WGS84"), transformer, crs


def _check_place(image: PosedImage, system: Any, transformer: Any, crs: str) -> None:
    """Refuse a camera outside of the area where the system is used, as far as the system says it."""
    x, y = image.pose.center_world[:2].tolist()
    longitude, latitude = transformer.transform(x, y)
    parts = [system, *system.sub_crs_list]  # a system with a height says it of its parts
    area = next((part.area_of_use for part in parts if part.area_of_use), None)
    if not np.isfinite([longitude, latitude]).all() or (area and not _is_in(area, longitude, latitude, x, y)):
        name = str(system.name)
        if area:
            name += f", {area.west:g} to {area.east:g} E, {area.south:g} to {area.north:g} N"
        found = f"found a camera at ({x:g}, {y:g})"
        raise InputError(f"{image.path}: {found}, wanted one where {crs} holds ({name})")


def _is_in(area: Any, longitude: float, latitude: float, x: float, y: float) -> bool:
    """True if a place [deg], (x, y) [m] in the system, is in its area with a margin; some cross 180 E."""
    margin = 0.0 if np.hypot(x, y) < LOCAL else MARGIN_DEG
    width = 360.0 if area.east - area.west >= 360.0 else (area.east - area.west) % 360.0
    is_between = (longitude - area.west + margin) % 360.0 <= width + 2.0 * margin
    return bool(is_between and area.south - margin <= latitude <= area.north + margin)


def _feature(image: PosedImage, transformer: Any, geod: Any, crs: str) -> dict[str, object]:
    """The point without a height, which would have to be above WGS84's ellipsoid: z is a property."""
    result = image.result
    x, y, z = image.pose.center_world.tolist()
    heading, pitch, roll = heading_pitch_roll_deg(image.pose)
    ahead = np.radians(heading)
    eastings = [x, x + STEP * np.sin(ahead)]
    northings = [y, y + STEP * np.cos(ahead)]
    longitudes, latitudes = transformer.transform(eastings, northings)
    true_heading, _, _ = geod.inv(longitudes[0], latitudes[0], longitudes[1], latitudes[1])
    properties = {
        "image": image.name,
        "cloud": result.cloud_name,
        "status": result.status,
        "confidence": result.confidence,
        "score": result.evidence and result.evidence.score,
        **{"crs": crs, "x": x, "y": y, "z": z},
        **{"heading_deg": heading, "heading_true_deg": true_heading % 360.0},
        **{"pitch_deg": pitch, "roll_deg": roll},
    }
    point = {"type": "Point", "coordinates": [longitudes[0], latitudes[0]]}
    return {"type": "Feature", "geometry": point, "properties": properties}


GEOJSON_TEXT = "points for maps, in WGS84; needs --crs and the library pyproj"
GEOJSON = Format("geojson", GEOJSON_TEXT, write_geojson, frozenset({"crs"}), has_unique_names=False)
GPX_TEXT = "track of the positions in WGS84; needs --crs and the library pyproj"
GPX = Format("gpx", GPX_TEXT, write_gpx, frozenset({"crs"}), has_unique_names=False, forbidden="")
