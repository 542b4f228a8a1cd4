"""The header of LAS and LAZ files, read and checked.

laspy would loop and reserve as a damaged header says. Nothing more is needed than a checked header: what
follows are records of a fixed length.
"""

import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError

MAGIC = b"LASF"
MIN_HEADER_SIZE, MIN_HEADER_SIZE_1_4 = 227, 375  # [byte]
COMPRESSED_BIT = 0x80  # of the point format
# The least length of a record by point format, and where red green blue begin in those that have them [byte].
RECORD_SIZES = {0: 20, 1: 28, 2: 26, 3: 34, 4: 57, 5: 63, 6: 30, 7: 36, 8: 38, 9: 59, 10: 67}
COLORS_BYTE = {2: 20, 3: 28, 5: 28, 7: 30, 8: 30, 10: 30}
INTENSITY_BYTE, FLAGS_BYTE = 12, 15
CLASS_BYTE_OLD, CLASS_BYTE = 15, 16  # in the formats 0-5, whose upper three bits are flags, and 6-10
WANTED = "wanted LAS or LAZ with red green blue (point format 2, 3, 5, 7, 8 or 10)"


class LasHeader(NamedTuple):
    """The header of a LAS file."""

    path: Path
    size: int  # [byte]
    header_size: int  # [byte]
    points_offset: int  # [byte]
    num_vlrs: int
    point_format: int
    record_size: int  # [byte]
    num_points: int
    scales: NDArray[np.float64]  # (3,) x y z
    offsets: NDArray[np.float64]  # (3,)
    is_compressed: bool

    @property
    def dtype(self) -> np.dtype[np.void]:
        """The fields that are wanted of a record."""
        fields = {"xyz": ("3<i4", 0), "intensity": ("<u2", INTENSITY_BYTE), "flags": ("u1", FLAGS_BYTE)}
        fields["class"] = ("u1", CLASS_BYTE_OLD if self.point_format < 6 else CLASS_BYTE)
        if self.has_colors:
            fields["rgb"] = ("3<u2", COLORS_BYTE[self.point_format])
        kinds, begins = zip(*fields.values(), strict=True)
        return np.dtype(
            {"names": [*fields], "formats": kinds, "offsets": begins, "itemsize": self.record_size}
        )

    @property
    def has_colors(self) -> bool:
        """True if the records have fields for colours, whatever is in them."""
        return self.point_format in COLORS_BYTE


def read_header(path: Path) -> LasHeader:
    """The header of a LAS or LAZ file; InputError if it is broken or promises too much."""
    with path.open("rb") as file:
        head = file.read(MIN_HEADER_SIZE_1_4)
    if not head.startswith(MAGIC) or len(head) < MIN_HEADER_SIZE:
        wanted = f"wanted 'LASF' and a header of {MIN_HEADER_SIZE} bytes or more"
        raise InputError(f"{path}: begins with {head[:4]!r} and {len(head)} bytes, {wanted}")
    major, minor = head[24], head[25]
    sizes = struct.unpack_from("<HIIBHI", head, 94)
    header_size, points_offset, num_vlrs, format_id, record_size, num_points = sizes
    if minor >= 4:
        num_points = int.from_bytes(head[247:255], "little") or num_points
    scales, offsets = np.frombuffer(head, "<f8", 6, 131).reshape(2, 3)
    size, point_format, is_compressed = path.stat().st_size, format_id & ~COMPRESSED_BIT, format_id >= 0x80
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
        found = f"scales {_listed(scales)} and offsets {_listed(offsets)}"
        raise InputError(f"{path}: {found}, wanted finite ones and no scale of 0")
    room = (size - points_offset) // record_size
    if num_points == 0 or (num_points > room and not is_compressed):
        promised = f"promises {num_points} points of {record_size} bytes, found room for {room}"
        raise InputError(f"{path}: the header {promised}; the file is cut off or broken")
    sizes = size, header_size, points_offset, num_vlrs, point_format, record_size, num_points
    return LasHeader(path, *sizes, scales, offsets, is_compressed)


def _listed(values: NDArray[np.float64]) -> str:
    return " ".join(f"{value:g}" for value in values)
