"""Parts of LAS and LAZ files other than the points: header, records, coordinate system and its units."""

import struct
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from ...system.arrays import Array
from ...system.errors import InputError
from ..units import (
    DOUBLES_ID,
    GEOGRAPHIC_KEY,
    PROJECTED_KEY,
    USER_DEFINED,
    Axes,
    choose_units,
    read_geo_keys,
    units_of_geo_keys,
    units_of_wkt,
)

MAGIC = b"LASF"
WORTH = 0.5  # a file that is cut off is read if it has at least this fraction of the promised points
MIN_HEADER_SIZE = 227  # [byte]
MIN_HEADER_SIZE_1_4 = 375  # [byte]
COMPRESSED_BIT = 0x80  # of the point format
# By point format: the least size [byte] of a record, and the first byte of red green blue, if there are any.
RECORD_SIZES = {0: 20, 1: 28, 2: 26, 3: 34, 4: 57, 5: 63, 6: 30, 7: 36, 8: 38, 9: 59, 10: 67}
COLORS_BYTE = {2: 20, 3: 28, 5: 28, 7: 30, 8: 30, 10: 30}
INTENSITY_BYTE = 12
FLAGS_BYTE = 15
WANTED = "wanted LAS or LAZ with red green blue (point format 2, 3, 5, 7, 8 or 10)"
MAX_VLRS = 1 << 16
VLR_HEADER = struct.Struct("<2x16sHH32x")  # user, record id, length of the content that follows
PROJECTION_USER = b"LASF_Projection"
WKT_ID = 2112
GEO_KEYS_ID = 34735
BOX_BYTE = 179  # of the header: greatest and least x, then those of y and of z
BOX = struct.Struct("<6d")


class LasHeader(NamedTuple):
    """The header of a LAS or LAZ file."""

    path: Path
    size: int  # [byte]
    header_size: int  # [byte]
    points_offset: int  # [byte] of the first point
    num_vlrs: int  # variable-length records
    point_format: int
    record_size: int  # [byte]
    num_points: int
    scales: Array  # (3,) of x, y, z
    offsets: Array  # (3,) of x, y, z, in the file's unit
    is_compressed: bool
    warnings: tuple[str, ...] = ()

    @property
    def dtype(self) -> np.dtype[np.void]:
        """The fields of a record that are read."""
        fields = {"xyz": ("3<i4", 0), "intensity": ("<u2", INTENSITY_BYTE), "flags": ("u1", FLAGS_BYTE)}
        if self.has_colors:
            fields["rgb"] = ("3<u2", COLORS_BYTE[self.point_format])
        kinds, at = zip(*fields.values(), strict=True)
        return np.dtype({"names": [*fields], "formats": kinds, "offsets": at, "itemsize": self.record_size})

    @property
    def has_colors(self) -> bool:
        """True if the records have fields for colours, even if all are black."""
        return self.point_format in COLORS_BYTE


def read_las_header(path: Path) -> LasHeader:
    """Return the header of a LAS or LAZ file. Raise InputError if it is broken or promises too much."""
    with path.open("rb") as file:
        head = file.read(MIN_HEADER_SIZE_1_4)
    if not head.startswith(MAGIC) or len(head) < MIN_HEADER_SIZE:
        wanted = f"wanted 'LASF' and a header of {MIN_HEADER_SIZE} bytes or more"
        raise InputError(f"{path}: begins with {head[:4]!r} and {len(head)} bytes, {wanted}")
    major, minor = head[24:26]
    sizes = struct.unpack_from("<HIIBHI", head, 94)
    header_size, points_offset, num_vlrs, format_id, record_size, num_points = sizes
    if minor >= 4:
        num_points = int.from_bytes(head[247:255], "little") or num_points
    scales, offsets = np.frombuffer(head, "<f8", 6, 131).reshape(2, 3)
    size = path.stat().st_size
    point_format = format_id & ~COMPRESSED_BIT
    is_compressed = format_id >= 0x80
    if major != 1 or minor > 5:
        raise InputError(f"{path}: found LAS {major}.{minor}, wanted LAS 1.0 to 1.5")
    least = MIN_HEADER_SIZE_1_4 if minor >= 4 else MIN_HEADER_SIZE
    if not least <= header_size <= points_offset <= size:
        found = f"a header of {header_size} bytes and points from byte {points_offset} on"
        raise InputError(f"{path}: {found}, wanted {least} or more and points within the file's {size} bytes")
    least = RECORD_SIZES.get(point_format, 0)
    if least == 0 or record_size < least:
        wrong = f"records of {record_size} bytes, wanted {least} or more in point format {point_format}"
        raise InputError(f"{path}: {wrong if least else f'unknown point format {point_format}, {WANTED}'}")
    if not (np.isfinite([scales, offsets]).all() and scales.all()):
        raise InputError(f"{path}: scales {scales} and offsets {offsets}, wanted finite ones and no scale 0")
    room = (size - points_offset) // record_size
    found = f"promises {num_points} points of {record_size} bytes, found room for {room}"
    is_cut = num_points > room and not is_compressed
    if num_points == 0 or (is_cut and room < WORTH * num_points):
        raise InputError(f"{path}: the header {found}; the file is cut off or broken")
    return LasHeader(
        path, size, header_size, points_offset, num_vlrs, point_format, record_size,
        room if is_cut else num_points, scales, offsets, is_compressed,
        (f"{path}: the header {found}; read up to there",) if is_cut else (),
    )  # fmt: skip


def record_content(header: LasHeader, file: BinaryIO, wanted_user: bytes, wanted_id: int) -> bytes | None:
    """Return the content of the variable-length record of this user and id; None if there is none."""
    position = header.header_size
    for _ in range(min(header.num_vlrs, MAX_VLRS)):
        if position + VLR_HEADER.size > header.points_offset:
            break
        file.seek(position)
        user, record_id, length = VLR_HEADER.unpack(file.read(VLR_HEADER.size))
        position += VLR_HEADER.size + length
        if user.rstrip(b"\0") == wanted_user and record_id == wanted_id:
            return file.read(length)
    return None


def read_las_crs(path: Path) -> str:
    """Return the coordinate system that a file names, as WKT or EPSG:code; empty if it names none."""
    wkt, keys, _ = _projection(read_las_header(path))
    codes = {key: value for key, (place, value) in read_geo_keys(keys).items() if place == 0}
    code = codes.get(PROJECTED_KEY, codes.get(GEOGRAPHIC_KEY, 0))
    return wkt or (f"EPSG:{code}" if 0 < code < USER_DEFINED else "")


def _projection(header: LasHeader) -> tuple[str, bytes, bytes]:
    """Return the records of the coordinate system: WKT, GeoTIFF keys, and their doubles; empty if missing."""
    with header.path.open("rb") as file:
        ids = WKT_ID, GEO_KEYS_ID, DOUBLES_ID
        wkt, keys, doubles = (record_content(header, file, PROJECTION_USER, id_) or b"" for id_ in ids)
    return wkt.rstrip(b"\0").decode(errors="replace"), keys, doubles


def find_units(header: LasHeader) -> tuple[Axes, str]:
    """Return the units of x, y, z [m] that the coordinate system names, and a note for the user, or ""."""
    wkt, keys, doubles = _projection(header)
    units = units_of_wkt(wkt) if wkt else units_of_geo_keys(keys, doubles)
    with header.path.open("rb") as file:
        file.seek(BOX_BYTE)
        high_x, low_x, high_y, low_y, high_z, low_z = BOX.unpack(file.read(BOX.size))
    try:
        return choose_units(units, (low_x, low_y, low_z), (high_x, high_y, high_z))
    except InputError as error:
        raise InputError(f"{header.path}: {error}") from error
