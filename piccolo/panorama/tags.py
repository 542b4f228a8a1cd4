"""Tags of a TIFF directory, which is also what EXIF is."""

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

ORIENTATION = 274
# by the file's number of a type: NumPy's letter; rationals and floats are not needed
TYPES = {1: "u1", 2: "u1", 3: "u2", 4: "u4", 6: "i1", 7: "u1", 8: "i2", 9: "i4", 13: "u4", 16: "u8", 18: "u8"}


class TagError(ValueError):
    """The bytes are no directory of tags."""


@dataclass(frozen=True)
class Directory:
    """The tags of one picture."""

    values: dict[int, NDArray[np.int64] | NDArray[np.uint8]]  # bytes stay uint8
    places: dict[int, int]  # where in the file each value begins [byte]
    next_place: tuple[int, int]  # and size [byte] of what points to the next directory
    has_next: bool

    def number(self, tag: int, default: int) -> int:
        """The first value of a tag."""
        found = self.values.get(tag)
        return int(found[0]) if found is not None and len(found) else default

    def numbers(self, tag: int) -> NDArray[np.int64]:
        """All values of a tag, none if it is missing."""
        return np.asarray(self.values.get(tag, ()), dtype=np.int64)


def read_directory(data: bytes) -> Directory:
    """The first directory of a TIFF or BigTIFF file, or of EXIF's body.

    Raises
    ------
    TagError
        The bytes are cut off, or point outside of themselves.
    """
    try:
        return _read_directory(data)
    except struct.error as error:
        raise TagError("a directory that leads out of the file") from error


def _read_directory(data: bytes) -> Directory:
    order = {b"II": "<", b"MM": ">"}.get(data[:2])
    if order is None:
        raise TagError("no byte order")
    is_big = struct.unpack_from(order + "H", data, 2)[0] == 43
    word, num_bytes = ("Q", 8) if is_big else ("I", 4)
    (begin,) = struct.unpack_from(order + word, data, 2 * num_bytes if is_big else 4)
    if begin > len(data):  # more than struct can count to
        raise TagError("a directory that leads out of the file")
    count_type = "Q" if is_big else "H"
    (num_tags,) = struct.unpack_from(order + count_type, data, begin)
    begin += struct.calcsize(count_type)
    entry_size = 4 + 2 * num_bytes
    end = begin + num_tags * entry_size
    if end + num_bytes > len(data):
        raise TagError("a directory that is cut off")
    (next_begin,) = struct.unpack_from(order + word, data, end)
    values, places = {}, {}
    for k in range(begin, end, entry_size):
        tag, kind, count = struct.unpack_from(order + "HH" + word, data, k)
        place = k + 4 + num_bytes
        dtype = np.dtype(order + TYPES.get(kind, "u1"))
        if count * dtype.itemsize > num_bytes and kind in TYPES:
            (place,) = struct.unpack_from(order + word, data, place)
        if kind not in TYPES or tag in values or count == 0:
            continue
        if place + count * dtype.itemsize > len(data):
            raise TagError(f"tag {tag} leads out of the file")
        array = np.frombuffer(data, dtype, count, place)
        values[tag] = array if dtype.itemsize == 1 else array.astype(np.int64)
        places[tag] = place
    return Directory(values, places, (end, num_bytes), next_begin != 0)


def exif_orientation(body: bytes) -> int:
    """EXIF's orientation, 1 to 8; 1 where EXIF says nothing or makes no sense."""
    try:
        found = read_directory(body).number(ORIENTATION, 1)
    except TagError:
        return 1
    return found if 1 <= found <= 8 else 1


def are_spans_inside(begins: NDArray[np.int64], sizes: NDArray[np.int64], num_bytes: int) -> bool:
    """True if every span of bytes lies in a file of `num_bytes`."""
    return bool(((begins >= 0) & (sizes >= 0) & (begins <= num_bytes) & (sizes <= num_bytes - begins)).all())
