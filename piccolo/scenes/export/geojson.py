"""GeoJSON (RFC 7946): points in WGS84, longitude and latitude, for maps. pyproj converts, if installed."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError
from ...geometry.camera_axes import heading_pitch_roll_deg
from ...runtime.atomic import write_atomically
from ...runtime.optional import import_optional
from .posed_images import Format, Options, PosedImage

STEP = 10.0  # [m] ahead, to find true north


def write(images: Sequence[PosedImage], out: Path, options: Options) -> None:
    """Write a FeatureCollection with a point a result."""
    pyproj = import_optional("GeoJSON", "pyproj", "tools")
    if options.crs is None:
        raise InputError("--crs: not given, wanted the cloud's coordinate system, such as EPSG:25832")
    transformer = _transformer(pyproj, options.crs)
    features = [_feature(image, transformer, pyproj.Geod(ellps="WGS84"), options.crs) for image in images]
    document = {"type": "FeatureCollection", "features": features}
    write_atomically(out, (json.dumps(document, indent=1, allow_nan=False) + "\n").encode())


def _transformer(pyproj: Any, crs: str) -> Any:
    """From the cloud's coordinates to longitude and latitude."""
    try:
        system = pyproj.CRS.from_user_input(crs)
    except pyproj.exceptions.CRSError as error:
        raise InputError(f"--crs: found {crs!r}, wanted a coordinate system such as EPSG:25832") from error
    units = {axis.unit_name for axis in system.axis_info[:2]}
    if not system.is_projected or units != {"metre"}:
        raise InputError(f"--crs: found {crs} ({system.name}), wanted a projected system in metres")
    return pyproj.Transformer.from_crs(system, "EPSG:4326", always_xy=True)


def _feature(image: PosedImage, transformer: Any, geod: Any, crs: str) -> dict[str, object]:
    """The point without a height, which would have to be above WGS84's ellipsoid: z is a property."""
    properties: dict[str, object]
    result, (x, y, z) = image.result, image.pose.center_world.tolist()
    heading, pitch, roll = heading_pitch_roll_deg(image.pose)
    ahead = np.radians(heading)
    longitudes, latitudes = transformer.transform(
        [x, x + STEP * np.sin(ahead)], [y, y + STEP * np.cos(ahead)]
    )
    if not np.isfinite([*longitudes, *latitudes]).all():
        raise InputError(f"{image.path}: found a camera at ({x}, {y}), wanted one where {crs} holds")
    true_heading, _, _ = geod.inv(longitudes[0], latitudes[0], longitudes[1], latitudes[1])
    properties = {"image": image.name, "cloud": result.cloud_name, "status": result.status}
    properties |= {"confidence": result.confidence, "score": result.evidence and result.evidence.score}
    properties |= {"crs": crs, "x": x, "y": y, "z": z, "heading_deg": heading}
    properties |= {"heading_true_deg": true_heading % 360.0, "pitch_deg": pitch, "roll_deg": roll}
    point = {"type": "Point", "coordinates": [longitudes[0], latitudes[0]]}
    return {"type": "Feature", "geometry": point, "properties": properties}


GEOJSON = Format(
    "geojson",
    "points for maps, in WGS84; needs --crs and the library pyproj",
    write,
    frozenset({"crs"}),
    has_unique_names=False,
)
