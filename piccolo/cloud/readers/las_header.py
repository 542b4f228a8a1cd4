"""The header of LAS and LAZ files, read and checked.

laspy would loop and reserve as a damaged header says. Nothing more is needed than a checked header: what
follows are records of a fixed length.
"""

import struct
from dataclasses import dataclass
from pathlib import Path

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


@dataclass(frozen=True)
class LasHeader:
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
        return np.dtype(
            {
                "names": list(fields),
                "formats": [kind for kind, _ in fields.values()],
                "offsets": [begin for _, begin in fields.values()],
                "itemsize": self.record_size,
            }
        )

    @property
    def has_colors(self) -> bool:
        """True if the records have fields for colours, whatever is in them."""
        return self.point_format in COLORS_BYTE


def has_las_magic(head: bytes) -> bool:
    """True if a file that begins with the bytes `head` says it is LAS or LAZ."""
    return head.startswith(MAGIC)


def read_header(path: Path) -> LasHeader:
    """The header of a LAS or LAZ file; InputError if it is broken or promises too much."""
    with path.open("rb") as file:
        head = file.read(MIN_HEADER_SIZE_1_4)
    if not has_las_magic(head) or len(head) < MIN_HEADER_SIZE:
        raise InputError(
            f"{path}: begins with {head[:4]!r} and {len(head)} bytes, wanted 'LASF' and a header of "
            f"{MIN_HEADER_SIZE} bytes or more"
        )
    major, minor = head[24], head[25]
    header_size, points_offset, num_vlrs, format_id, record_size, num_points = struct.unpack_from(
        "<HIIBHI", head, 94
    )
    if minor >= 4 and len(head) == MIN_HEADER_SIZE_1_4:
        num_points = struct.unpack_from("<Q", head, 247)[0] or num_points
    header = LasHeader(
        path=path,
        size=path.stat().st_size,
        header_size=header_size,
        points_offset=points_offset,
        num_vlrs=num_vlrs,
        point_format=format_id & ~COMPRESSED_BIT,
        record_size=record_size,
        num_points=num_points,
        scales=np.frombuffer(head, "<f8", 3, 131),
        offsets=np.frombuffer(head, "<f8", 3, 155),
        is_compressed=bool(format_id & COMPRESSED_BIT),
    )
    if major != 1 or minor > 5:
        raise InputError(f"{path}: found LAS {major}.{minor}, wanted LAS 1.0 to 1.5")
    least = MIN_HEADER_SIZE_1_4 if minor >= 4 else MIN_HEADER_SIZE
    if not least <= header_size <= points_offset <= header.size:
        raise InputError(
            f"{path}: a header of {header_size} bytes and points from byte {points_offset} on, wanted a "
            f"header of {least} or more and points behind it, within the file's {header.size} bytes"
        )
    _check_header(header)
    return header


def _check_header(header: LasHeader) -> None:
    """Refuse what no points could make right."""
    path = header.path
    if header.point_format not in RECORD_SIZES:
        raise InputError(f"{path}: unknown point format {header.point_format}, {WANTED}")
    least = RECORD_SIZES[header.point_format]
    if header.record_size < least:
        raise InputError(
            f"{path}: records of {header.record_size} bytes, wanted {least} or more in point format "
            f"{header.point_format}"
        )
    if not (np.isfinite(header.scales).all() and np.isfinite(header.offsets).all() and header.scales.all()):
        raise InputError(
            f"{path}: scales {_listed(header.scales)} and offsets {_listed(header.offsets)}, wanted finite "
            "ones and no scale of 0"
        )
    if header.num_points == 0:
        raise InputError(f"{path}: the header promises 0 points, wanted a coloured cloud")
    room = (header.size - header.points_offset) // header.record_size
    if not header.is_compressed and header.num_points > room:
        raise InputError(
            f"{path}: the header promises {header.num_points} points of {header.record_size} bytes, found "
            f"room for {room}; the file is cut off or broken"
        )


def _listed(values: NDArray[np.float64]) -> str:
    return " ".join(f"{value:g}" for value in values)
