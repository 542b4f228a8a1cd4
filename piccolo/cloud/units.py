"""The units of a scan's coordinates, by the coordinate system that its file names.

A file names it by a text (OGC WKT 1 or 2, also ESRI's) or by GeoTIFF keys. x and y have the same unit, z may
have another.
"""

import math
import re
import struct
from collections import deque
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from ..system.errors import InputError, import_optional
from .cloud_settings import METRES

TOKEN = re.compile(r'"(?:[^"]|"")*"|[\w.+-]+|[\[\](),]')
# keywords of systems that contain others
WITHIN = ("COMPD_CS", "COMPOUNDCRS", "BOUNDCRS", "SOURCECRS", "COORDINATEMETADATA")
PROJECTED = ("PROJCS", "PROJCRS", "PROJECTEDCRS", "DERIVEDPROJCRS")
OTHERS = ("LOCAL_CS", "ENGCRS", "ENGINEERINGCRS", "GEOCCS")  # neither projected nor in degrees
GEOGRAPHIC = ("GEOGCS", "GEOGCRS", "GEOGRAPHICCRS", "GEODCRS", "GEODETICCRS")
VERTICAL = ("VERT_CS", "VERTCS", "VERTCRS", "VERTICALCRS")
LENGTHS = ("UNIT", "LENGTHUNIT")
# relative, of a unit that is written with few digits; feet and US survey feet differ by ten times as much
UNIT_ROUNDING = 2e-7
UNIT_CODES = {9001: 1.0, 9002: METRES["ft"], 9003: METRES["us-ft"], 9036: 1000.0, 1033: 0.01, 1025: 0.001}
USER_DEFINED = 32767  # code of what the file defines itself
MODEL_KEY = 1024  # keys of GeoTIFF, and values of keys
GEOGRAPHIC_KEY = 2048
PROJECTED_KEY = 3072
LINEAR_UNIT_KEY = 3076
LINEAR_SIZE_KEY = 3077
VERTICAL_KEY = 4096
VERTICAL_UNIT_KEY = 4099
IN_DEGREES = 2  # the model of a geographic system
DOUBLES_ID = 34736  # record with the values of keys that are not whole numbers
NAMES = {1.0: "metres", METRES["ft"]: "feet", METRES["us-ft"]: "US survey feet", 0.01: "cm", 0.001: "mm"}
LARGEST = 360.0, 90.0  # [deg] of longitude and latitude
WIDEST = 1.0  # [deg] that a scan may span: a wider one can't be in degrees
OVERRULED = "`units` overrules it"

Axes = tuple[float, float, float]  # of x, y, z
PLAIN: Axes = (1.0, 1.0, 1.0)


class Units(NamedTuple):
    """The units of a coordinate system; None where it names none."""

    across: float | None = None  # [m] of x and y
    up: float | None = None  # [m] of z
    is_degrees: bool = False  # x and y are angles
    unknown: str = ""  # name of the system, if its unit is not known


@dataclass
class Node:
    """A keyword of WKT with the texts and nodes in its brackets."""

    keyword: str
    texts: list[str] = field(default_factory=list)
    nodes: list["Node"] = field(default_factory=list)

    def all(self, *keywords: str) -> list["Node"]:
        """Return the nodes in the brackets that have one of the keywords."""
        return [node for node in self.nodes if node.keyword in keywords]


def parse_wkt(text: str) -> list[Node]:
    """Return the outermost nodes of a text in WKT; anything else in it is ignored."""
    root = Node("")
    open_nodes = [root]
    word = ""
    for token in TOKEN.findall(text):
        if token in "[(":
            node = Node(word.upper())
            open_nodes[-1].nodes.append(node)
            open_nodes.append(node)
            word = ""
        elif token in "]),":
            open_nodes[-1].texts += [word] if word else []
            word = ""
            if token != "," and len(open_nodes) > 1:
                open_nodes.pop()
        else:
            word = token.strip('"')
    return root.nodes


def units_of_wkt(text: str) -> Units:
    """Return the units of a coordinate system in WKT, which may be compound."""
    units = Units()
    nodes = deque(parse_wkt(text))
    while nodes:
        node = nodes.popleft()
        lengths = _lengths(node)
        if node.keyword in WITHIN:
            nodes.extendleft(reversed(node.nodes))
        elif node.keyword in (*PROJECTED, *OTHERS) and lengths:
            up = lengths[2] if len(lengths) > 2 else units.up
            units = Units(lengths[0], up)
        elif node.keyword in GEOGRAPHIC:
            is_cartesian = any("cartesian" in [t.lower() for t in cs.texts] for cs in node.all("CS"))
            units = (
                Units(lengths[0] if lengths else None) if is_cartesian else units._replace(is_degrees=True)
            )
        elif node.keyword in VERTICAL and lengths:
            units = units._replace(up=lengths[0])
    return units


def _lengths(node: Node) -> list[float]:
    """Return the units [m] of a system's axes, or one unit for all; an empty list if it names none."""
    of_all = [length for unit in node.all(*LENGTHS) for length in _length(unit)]
    of_axes = [_lengths(axis) for axis in node.all("AXIS")] if node.keyword != "AXIS" else []
    return [lengths[0] for lengths in of_axes if lengths] or of_all[:1]


def _length(unit: Node) -> list[float]:
    """Return the length [m] that a node of a unit names, in a list; an empty list if it is not a length."""
    with suppress(ValueError, IndexError):
        return [snap_length(float(unit.texts[1]))]
    return []


def snap_length(metres: float) -> float:
    """Return the known unit [m] that equals a length up to rounding, or the length itself.

    Raise ValueError if it is not a finite number above 0.
    """
    if not (math.isfinite(metres) and metres > 0.0):
        raise ValueError(f"found a unit of {metres} m")
    return next((known for known in NAMES if abs(metres / known - 1.0) < UNIT_ROUNDING), metres)


def read_geo_keys(keys: bytes) -> dict[int, tuple[int, int]]:
    """Return, by GeoTIFF key, the record that holds its value (0: the key), and the value or its index."""
    entries = list(struct.iter_unpack("<4H", keys[: len(keys) // 8 * 8]))[1:]
    return {key: (place, value) for key, place, _, value in entries}


def units_of_geo_keys(keys: bytes, doubles: bytes) -> Units:
    """Return the units of a coordinate system in GeoTIFF keys; pyproj, if installed, knows most codes."""
    entries = read_geo_keys(keys)
    codes = {key: value for key, (place, value) in entries.items() if place == 0}
    system = codes.get(PROJECTED_KEY, 0)
    is_known = 0 < system < USER_DEFINED
    is_projected = is_known or LINEAR_UNIT_KEY in codes
    if codes.get(MODEL_KEY, IN_DEGREES) == IN_DEGREES and GEOGRAPHIC_KEY in codes and not is_projected:
        return Units(is_degrees=True)
    across = _length_of_unit(codes.get(LINEAR_UNIT_KEY, 0))
    place, index = entries.get(LINEAR_SIZE_KEY, (0, 0))
    if codes.get(LINEAR_UNIT_KEY) == USER_DEFINED and place == DOUBLES_ID and len(doubles) >= 8 * index + 8:
        with suppress(ValueError):
            across = snap_length(*struct.unpack_from("<d", doubles, 8 * index))
    if across is None and is_known:
        across = _length_of_system(system)
    up = _length_of_unit(codes.get(VERTICAL_UNIT_KEY, 0)) or _length_of_system(codes.get(VERTICAL_KEY, 0))
    return Units(across, up, unknown=f"EPSG:{system}" if is_known and across is None else "")


def _length_of_unit(code: int) -> float | None:
    """Return the length [m] of a unit by its EPSG code; None if it is not known."""
    if code in UNIT_CODES or not 0 < code < USER_DEFINED:
        return UNIT_CODES.get(code)
    with suppress(InputError):
        database = import_optional("the unit of a coordinate system", "pyproj.database", "gps")
        units = database.get_units_map(auth_name="EPSG", category="linear").values()
        return next((snap_length(unit.conv_factor) for unit in units if unit.code == str(code)), None)
    return None


def _length_of_system(code: int) -> float | None:
    """Return the unit [m] of a system by its EPSG code; None if it is unknown or pyproj is missing."""
    if not 0 < code < USER_DEFINED:
        return None
    with suppress(InputError):
        pyproj = import_optional("the unit of a coordinate system", "pyproj", "gps")
        with suppress(pyproj.exceptions.CRSError, ValueError):
            axis: Any = pyproj.CRS.from_epsg(code).axis_info[0]
            return snap_length(axis.unit_conversion_factor) if "degree" not in axis.unit_name else None
    return None


def choose_units(units: Units, low: Axes, high: Axes) -> tuple[Axes, str]:
    """Return the units of x, y, z [m] of a file, and a note for the user, or "".

    `low` and `high` are the corners of the points' box. Raise InputError if x and y are degrees, unless the
    box is too large for that.
    """
    if units.is_degrees:
        size = [b - a for a, b in zip(low[:2], high[:2], strict=True)]
        farthest = [max(abs(a), abs(b)) for a, b in zip(low[:2], high[:2], strict=True)]
        if max(size) < WIDEST and farthest[0] <= LARGEST[0] and farthest[1] <= LARGEST[1]:
            raise InputError(
                "found degrees of longitude and latitude, wanted metres or feet (a projected system)"
            )
        found = f"its coordinate system is in degrees, but it spans {size[0]:.0f} x {size[1]:.0f}"
        return PLAIN, f"{found}: read in metres; {OVERRULED}"
    across = units.across or 1.0
    up = units.up or across
    if units.unknown:
        why = f"it names {units.unknown}, whose unit is not known (pyproj knows most: extra gps)"
        return (across, across, up), f"{why}: read in {_name_units(across, up)}; {OVERRULED}"
    if across == up == 1.0:
        return PLAIN, ""
    source = "its coordinate system says" if units.up else "its coordinate system says of x and y"
    return (across, across, up), f"read in {_name_units(across, up)}, as {source}; {OVERRULED}"


def describe_foreign(units: Units) -> str:
    """Return a note if the coordinate system of an E57 file names another unit than the metre, else ""."""
    across = units.across or 1.0
    up = units.up or across
    if across == up == 1.0:
        return ""
    found = f"its coordinate system is in {_name_units(across, up)}"
    return f"{found}, but E57 is in metres: read in metres; {OVERRULED}"


def _name_units(across: float, up: float) -> str:
    """Name the units in which x and y, and z, are read."""
    names = [NAMES.get(metres, f"units of {metres:.6g} m") for metres in (across, up)]
    return names[0] if across == up else f"{names[0]} across and {names[1]} up"
