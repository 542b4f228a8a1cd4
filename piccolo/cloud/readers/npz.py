"""NumPy files: .npy with one array of points, .npz with points and colours in one array or two.

Nothing is unpickled. Arrays are read in chunks, from compressed archives too, whatever size they promise.
"""

import errno
import math
import struct
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from ...errors import InputError
from . import reader as raw
from .colors import BRIGHTEST, TYPES_WANTED, in_words, to_bytes
from .lines import quoted
from .reader import PLAIN, Format, PointSource, RawCloud, ReadOptions

NPY_MAGIC, ZIP_MAGIC = b"\x93NUMPY", b"PK\x03\x04"
ZIP_NAME_AT = 30  # [byte] in an archive: the name of its first member
MAX_HEADER_SIZE = 4096  # [byte] of an array's header
MAX_RATIO = 200  # unpacked to packed; real scans stay below 10, deflate could reach 1032
MAX_CHUNK_SIZE = 1 << 26  # [byte] read at once
SKIP_SIZE = 1 << 20  # [byte] passed over at once
POINTS_NAMES, COLORS_NAMES = ("points", "xyz"), ("colors", "rgb")
FIELD_NAMES = (("r", "g", "b"), ("red", "green", "blue"))
# What zipfile, zlib and NumPy's header parser (which evaluates a Python literal) raise on damaged files.
DAMAGES = (
    ValueError, TypeError, AttributeError, LookupError, ArithmeticError, EOFError, MemoryError, RuntimeError,
    SyntaxError, tokenize.TokenError, Warning, struct.error, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
WANTED = (
    "wanted an array (N, 6) of x y z r g b with colours 0-255, one with fields x y z r g b, or an archive "
    "with points (N, 3) and colors (N, 3)"
)


Parts = Iterator[tuple[NDArray[Any], NDArray[Any]]]  # positions and colours (N, 3), chunk by chunk


@dataclass(frozen=True)
class Array:
    """An array in a file, not yet read."""

    open_at: Callable[[int], IO[bytes]]  # the file, from a byte on
    shape: tuple[int, ...]
    is_fortran: bool  # column after column
    dtype: np.dtype[Any]
    offset: int  # [byte] of the first number

    def read_rows(self) -> Iterator[NDArray[Any]]:
        """Yield the rows (N, C), or (N,) of an array with fields, in chunks."""
        num_rows = self.shape[0]
        num_columns = self.shape[1] if len(self.shape) > 1 else 1
        num_files = num_columns if self.is_fortran else 1
        row_size = self.dtype.itemsize * num_columns // num_files
        starts = [self.offset + k * row_size * num_rows for k in range(num_files)]
        with ExitStack() as stack:
            files = [stack.enter_context(self.open_at(start)) for start in starts]
            chunk = max(1, min(raw.CHUNK, MAX_CHUNK_SIZE // row_size))
            for begin in range(0, num_rows, chunk):
                count = min(chunk, num_rows - begin)
                parts = [np.frombuffer(_read(file, count * row_size), self.dtype) for file in files]
                if self.dtype.names:
                    yield parts[0]
                else:
                    yield np.concatenate([part.reshape(count, -1) for part in parts], axis=1)


def open_npy(path: Path, options: ReadOptions = PLAIN) -> PointSource:
    """The points of a .npy file: an array (N, 6) with colours 0-255, or one with named fields."""

    def open_at(offset: int) -> IO[bytes]:
        file = path.open("rb")
        file.seek(offset)
        return file

    with _damage_named(path):
        array = _open_array(path, open_at, path.stat().st_size)
    return _single_source(path, array)


def open_npz(path: Path, options: ReadOptions = PLAIN) -> PointSource:
    """The points of a .npz file: `points` or `xyz` with `colors` or `rgb`, or its only array as in .npy.

    Two arrays have the range of colours from their type: uint8 0-255, uint16 0-65535, float 0-1, and so have
    named fields. One array (N, 6) can't declare it and has 0-255. An archive whose arrays promise more than
    200 times the size of the file is refused.
    """
    with _damage_named(path):
        arrays = _open_archive(path)
    return _single_source(path, arrays[0]) if len(arrays) == 1 else _pair_source(path, *arrays)


def has_npy_magic(head: bytes) -> bool:
    """True if a file that begins with the bytes `head` is an array."""
    return head.startswith(NPY_MAGIC)


def has_npz_magic(head: bytes) -> bool:
    """True if a file that begins with the bytes `head` is an archive that begins with an array."""
    name_size = int.from_bytes(head[ZIP_NAME_AT - 4 : ZIP_NAME_AT - 2], "little")
    return head.startswith(ZIP_MAGIC) and head[ZIP_NAME_AT : ZIP_NAME_AT + name_size].endswith(b".npy")


@contextmanager
def _damage_named(path: Path) -> Iterator[None]:
    """Turn what the libraries raise on damaged files into one line."""
    try:
        yield
    except InputError:
        raise
    except (*DAMAGES, OSError) as error:
        if isinstance(error, OSError) and error.errno != errno.EINVAL:
            raise  # the disk's or the user's trouble; EINVAL is zipfile going to a place before the beginning
        raise InputError(f"{path}: damaged ({quoted(str(error).encode())}), {WANTED}") from error


def _open_archive(path: Path) -> list[Array]:
    """The only array, or points and colours."""
    with zipfile.ZipFile(path) as archive:
        members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
    names = [name for names in (POINTS_NAMES, COLORS_NAMES) for name in names if name in members]
    if len(members) == 1:
        names = list(members)
    elif [name in COLORS_NAMES for name in names] != [False, True]:
        listed = quoted(" ".join(list(members)[:12]).encode())
        raise InputError(f"{path}: the arrays are {listed}, {WANTED}")
    size, packed_size = sum(members[name].file_size for name in names), path.stat().st_size
    if size > MAX_RATIO * packed_size:
        raise InputError(
            f"{path}: promises {size} bytes in a file of {packed_size}, "
            f"wanted {MAX_RATIO} times as many at most"
        )
    return [_open_member(path, members[name]) for name in names]


def _open_member(path: Path, info: zipfile.ZipInfo) -> Array:
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) or info.flag_bits & 1:
        name = quoted(info.filename.encode())
        raise InputError(
            f"{path}: {name} is encrypted or compressed in another way than np.savez_compressed does"
        )

    def open_at(offset: int) -> IO[bytes]:
        with zipfile.ZipFile(path) as archive, ExitStack() as stack:
            file = stack.enter_context(archive.open(info.filename))
            # reading, not seeking, so that the checksum covers all
            for begin in range(0, offset, SKIP_SIZE):
                _read(file, min(SKIP_SIZE, offset - begin))
            stack.pop_all()  # it outlives the archive
            return file

    return _open_array(path, open_at, info.file_size)


def _open_array(path: Path, open_at: Callable[[int], IO[bytes]], size: int) -> Array:
    """The array in a file of `size` bytes, by its header."""
    with open_at(0) as file, warnings.catch_warnings():
        warnings.simplefilter("error")  # NumPy warns of headers that it had to mend
        version = npy.read_magic(file)
        readers = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
        if version not in readers:
            raise InputError(f"{path}: an array of version {version[0]}.{version[1]}, wanted 1.0 or 2.0")
        shape, is_fortran, dtype = readers[version](file, max_header_size=MAX_HEADER_SIZE)
        offset = file.tell()
    if dtype.hasobject or dtype.itemsize == 0 or any(count < 0 for count in shape):
        raise InputError(f"{path}: an array {shape} of type {quoted(str(dtype).encode())}, {WANTED}")
    promised = math.prod(shape) * dtype.itemsize
    if promised != size - offset:
        raise InputError(
            f"{path}: an array's header promises {promised} bytes, found {size - offset}; "
            "the file is cut off or broken"
        )
    return Array(open_at, shape, is_fortran, dtype, offset)


def _read(file: IO[bytes], size: int) -> bytes:
    data = file.read(size)
    if len(data) < size:
        raise EOFError("the file is cut off")
    return data


def _single_source(path: Path, array: Array) -> PointSource:
    """The points of one array with named fields, or (N, 6)."""
    if array.dtype.names and len(array.shape) == 1:
        return _fields_source(path, array)
    if len(array.shape) != 2 or array.shape[1] != 6 or array.dtype.kind not in "fiu":
        raise InputError(
            f"{path}: an array {array.shape} of type {quoted(str(array.dtype).encode())}, {WANTED}"
        )

    def read_parts() -> Parts:
        return ((rows[:, :3], rows[:, 3:]) for rows in array.read_rows())

    return PointSource(path, lambda: _read_chunks(path, read_parts(), BRIGHTEST["u1"]), array.shape[0])


def _fields_source(path: Path, array: Array) -> PointSource:
    """The points of an array with named fields."""
    types = {name: array.dtype[name] for name in array.dtype.names or ()}
    names = next((names for names in FIELD_NAMES if all(name in types for name in names)), None)
    if names is None or not all(axis in types and types[axis].kind in "fiu" for axis in "xyz"):
        raise InputError(f"{path}: the fields are {quoted(' '.join(list(types)[:12]).encode())}, {WANTED}")
    brightest = _brightest(path, [types[name] for name in names])

    def read_parts() -> Parts:
        for rows in array.read_rows():
            yield (
                np.stack([rows[axis] for axis in "xyz"], axis=1),
                np.stack([rows[name] for name in names], 1),
            )

    return PointSource(path, lambda: _read_chunks(path, read_parts(), brightest), array.shape[0])


def _pair_source(path: Path, points: Array, colors: Array) -> PointSource:
    """The points of an array (N, 3) with the colours of another."""
    shapes = f"{points.shape} of {points.dtype} and {colors.shape} of {colors.dtype}"
    if points.shape != colors.shape or points.shape[1:] != (3,) or points.dtype.kind not in "fiu":
        raise InputError(f"{path}: the arrays are {quoted(shapes.encode())}, {WANTED}")
    brightest = _brightest(path, [colors.dtype])

    def read_parts() -> Parts:
        return zip(points.read_rows(), colors.read_rows(), strict=True)

    return PointSource(path, lambda: _read_chunks(path, read_parts(), brightest), points.shape[0])


def _brightest(path: Path, types: list[np.dtype[Any]]) -> float:
    """The value of full brightness in colours of these types, which must be one."""
    found = {type_.str[1:] for type_ in types}
    if len(found) > 1 or not found <= BRIGHTEST.keys():
        listed = quoted(" ".join(str(type_) for type_ in types).encode())
        raise InputError(f"{path}: the colours are of type {listed}, wanted {TYPES_WANTED}")
    return BRIGHTEST[found.pop()]


def _read_chunks(path: Path, parts: Parts, brightest: float) -> Iterator[RawCloud]:
    num_before = 0
    with _damage_named(path):
        for points, values in parts:
            points_world = points.astype(np.float64)
            colors, wrong = to_bytes(values, points_world, brightest)
            if wrong >= 0:
                raise InputError(
                    f"{path}: row {num_before + wrong} has the colour {in_words(values[wrong])}, wanted "
                    f"0 to {brightest:g} of the type {values.dtype}"
                )
            num_before += len(colors)
            yield RawCloud(points_world, colors)


NPY = Format("NumPy .npy", frozenset({".npy"}), has_npy_magic, open_npy)
NPZ = Format("NumPy .npz", frozenset({".npz"}), has_npz_magic, open_npz)
