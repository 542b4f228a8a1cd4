"""The coordinate system named in a scan's file, and GPS positions in it."""

import math
import struct
from collections.abc import Sequence
from pathlib import Path

from ..optional import import_optional
from .readers import e57_file, las
from .settings import check_crs

PROJECTION_USER = b"LASF_Projection"  # of LAS's records
WKT_ID = 2112
GEO_KEYS_ID = 34735
PROJECTED_KEY = 3072  # GeoTIFF keys whose value is a code of EPSG
GEOGRAPHIC_KEY = 2048
USER_DEFINED = 32767
MAX_LENGTH = 20_000  # characters of a system's description; a longer one is ignored


def read_crs(paths: Sequence[Path]) -> str:
    """Return the system that the first of a scan's files names, as WKT or EPSG:code; empty if it names none.

    LAS and LAZ: the OGC WKT record, or the GeoTIFF keys. E57: coordinateMetadata.
    """
    with paths[0].open("rb") as file:
        head = file.read(8)
    text = ""
    if head.startswith(las.MAGIC):
        text = _of_las(paths[0])
    elif head.startswith(e57_file.MAGIC):
        text = e57_file.read_xml(paths[0]).findtext("coordinateMetadata", "")
    return " ".join(text.split()) if len(text) <= MAX_LENGTH else ""


def _of_las(path: Path) -> str:
    header = las.read_header(path)
    with path.open("rb") as file:
        wkt = las.record_content(header, file, PROJECTION_USER, WKT_ID)
        keys = las.record_content(header, file, PROJECTION_USER, GEO_KEYS_ID) or b""
    if wkt:
        return wkt.rstrip(b"\0").decode(errors="replace")
    entries = list(struct.iter_unpack("<4H", keys[: len(keys) // 8 * 8]))[1:]
    codes = {key: value for key, place, _, value in entries if place == 0}
    code = codes.get(PROJECTED_KEY, codes.get(GEOGRAPHIC_KEY, 0))
    return f"EPSG:{code}" if 0 < code < USER_DEFINED else ""


def from_wgs84(crs: str, latitude_deg: float, longitude_deg: float) -> tuple[float, float] | None:
    """Return x and y of a place in a projected system, in its unit; None if there are none."""
    system = check_crs(crs)
    pyproj = import_optional("GPS in photos", "pyproj", "tools")
    if not system.is_projected:
        return None
    transformer = pyproj.Transformer.from_crs("EPSG:4326", system, always_xy=True)
    x, y = transformer.transform(longitude_deg, latitude_deg)
    return (float(x), float(y)) if math.isfinite(x) and math.isfinite(y) else None
