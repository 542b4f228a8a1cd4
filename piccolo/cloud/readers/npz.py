"""NumPy files: .npy with one array of points and colours, .npz with an array of points and one of colours.

Nothing is unpickled. A .npy file is read in chunks. An .npz file, and an array in Fortran order (column after
column), is read whole, after the size that its header promises has been compared with the file's.
"""

import errno
import math
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...system.errors import InputError
from ...system.files.array_archive import MAX_HEAD_SIZE, read_array_header
from ..cloud_settings import BY_FILE, Channel, CloudSettings
from . import reader
from .reader import MissingChannelError, PointSource, quote_line
from .text_columns import MAX_COLUMNS, drop_broken, name_columns, names_of_user, note_names

NPY_MAGIC = b"\x93NUMPY"
ZIP_MAGIC = b"PK\x03\x04"
ZIP_NAME_AT = 30  # [byte] in an archive: the name of its first member
NUM_SAMPLED_ROWS = 10_000  # rows whose values tell what the columns are
MAX_ZIP_RATIO = 200  # unpacked to packed size; real scans stay below 10, deflate could reach 1032
MAX_UNPACKED = 1 << 34  # [byte] of an archive's arrays, which are read whole
POINTS_NAMES = ("points", "xyz")
COLORS_NAMES = ("colors", "rgb")
WANTED = "wanted .npy of x y z r g b (N, 6), or .npz with points (N, 3) and colors (N, 3)"


class ArrayInFile(NamedTuple):
    """An array in a .npy file or in a member of an archive, not yet read."""

    path: Path
    member: str | None  # name in an archive; None in a .npy file
    shape: tuple[int, ...]
    is_fortran: bool  # stored column after column
    dtype: np.dtype[Any]
    offset: int  # [byte] of the first number

    def __str__(self) -> str:
        return f"an array {self.shape} of type {quote_line(str(self.dtype).encode())}"

    def read_rows(self) -> Iterator[NDArray[Any]]:
        """Yield the rows (N, C) in chunks."""
        if self.member is None and not self.is_fortran:
            row = np.dtype((self.dtype, self.shape[1:]))
            yield from reader.read_records(self.path, self.offset, self.shape[0], row)
            return
        with naming_damage(self.path), _open(self.path, self.member) as file:
            file.read(self.offset)  # read, not seek, so that the checksum covers all bytes
            content = file.read(math.prod(self.shape) * self.dtype.itemsize)
            order: Literal["F", "C"] = "F" if self.is_fortran else "C"
            array = np.frombuffer(content, self.dtype).reshape(self.shape, order=order)
        for (rows,) in reader.in_chunks([array]):
            yield rows


def open_npy(path: Path, options: CloudSettings = BY_FILE, channel: Channel = "colors") -> PointSource:
    """Return the points of a .npy file: an array (N, 6) of x y z r g b, or columns as in text files."""
    array = _open_array(path, None, path.stat().st_size)
    num_columns = array.shape[-1] if len(array.shape) == 2 else 0
    if not 3 <= num_columns <= MAX_COLUMNS or array.dtype.kind not in "fiu":
        raise InputError(f"{path}: {array}, {WANTED}")
    names = names_of_user(path, options, num_columns)
    note = ""
    if not names:
        rows = next(array.read_rows(), np.empty((0, num_columns)))
        names = name_columns(drop_broken(rows[:: 1 + len(rows) // NUM_SAMPLED_ROWS].astype(np.float64)))
        note = note_names(path, names, "")
    chosen = reader.find_fields([name for name in names if names.count(name) == 1], channel)
    if not chosen:
        raise MissingChannelError(f"{path}: {array}, {WANTED}")
    columns = [names.index(name) for name in chosen]

    def read_columns() -> Iterator[reader.Columns]:
        return (list(rows[:, columns].T) for rows in array.read_rows())

    # the types that text files get, which declare none
    types = ["i8" if len(chosen) == reader.NUM_COLORED else "u4"] * len(chosen)
    source = reader.Table(path, read_columns, chosen, types, array.shape[0]).source(channel, options)
    return source._replace(warnings=(*filter(None, [note]), *source.warnings))


def open_npz(path: Path, options: CloudSettings = BY_FILE, channel: Channel = "colors") -> PointSource:
    """Return the points of a .npz file: the arrays `points` (or `xyz`) and `colors` (or `rgb`), both (N, 3).

    An archive whose arrays promise more than 200 times the size of the file, or more than 16 GB, is refused.
    """
    if channel == "intensity":
        raise MissingChannelError(f"{path}: has no intensity")
    arrays = [_open_array(path, m.filename, m.file_size) for m in _members(path, channel == "shape")]
    points = arrays[0]
    colors = arrays[-1]
    kinds = points.dtype.kind, colors.dtype.kind
    is_right = points.shape[1:] == (3,) and colors.shape[1:] in ((3,), (4,)) and len({*kinds, *"fiu"}) == 3
    if not is_right or points.shape[0] != colors.shape[0]:
        raise InputError(f"{path}: {points} and {colors}, {WANTED}")

    def read() -> Iterator[reader.Part]:
        pairs = zip(points.read_rows(), colors.read_rows(), strict=True)
        return ((reader.points_of([*xyz.T]), rgb[:, :3]) for xyz, rgb in pairs)

    return reader.make_source(path, read, channel, options, points.shape[0], [colors.dtype.str[1:]])


def has_npz_magic(head: bytes) -> bool:
    """Return True if `head` begins as an archive does whose first member is an array."""
    name_size = int.from_bytes(head[ZIP_NAME_AT - 4 : ZIP_NAME_AT - 2], "little")
    return head.startswith(ZIP_MAGIC) and head[ZIP_NAME_AT : ZIP_NAME_AT + name_size].endswith(b".npy")


@contextmanager
def naming_damage(path: Path, wanted: str = WANTED) -> Iterator[None]:
    """Turn the errors of zipfile, zlib and NumPy's header parser on damaged files into an InputError."""
    try:
        yield
    except (InputError, MemoryError):
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.errno != errno.EINVAL:
            raise  # not damage of the file; EINVAL is: zipfile then seeks before the beginning
        raise InputError(f"{path}: damaged ({quote_line(str(error).encode())}), {wanted}") from error


def _open(path: Path, member: str | None) -> IO[bytes]:
    """Open a .npy file, or a member of an archive."""
    if member is None:
        return path.open("rb")
    with zipfile.ZipFile(path) as archive:
        return archive.open(member)  # can be read after the archive is closed


def _members(path: Path, is_bare: bool) -> list[zipfile.ZipInfo]:
    """Return an archive's members with points and with colours; with points alone if `is_bare`."""
    with naming_damage(path), zipfile.ZipFile(path) as archive:
        members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
    kinds = (POINTS_NAMES,) if is_bare else (POINTS_NAMES, COLORS_NAMES)
    names = [name for kind in kinds for name in kind if name in members]
    if [name in COLORS_NAMES for name in names] != [False, True][: len(kinds)]:
        listed = quote_line(" ".join(list(members)[:12]).encode())
        error = MissingChannelError if [name in POINTS_NAMES for name in names] == [True] else InputError
        raise error(f"{path}: the arrays are {listed}, {WANTED}")
    infos = [members[name] for name in names]
    for info in infos:
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) or info.flag_bits & 1:
            name = quote_line(info.filename.encode())
            raise InputError(f"{path}: {name} is encrypted or compressed in another way than by NumPy")
    size = sum(info.file_size for info in infos)
    most = min(MAX_ZIP_RATIO * path.stat().st_size, MAX_UNPACKED)
    if size > most:
        raise InputError(f"{path}: the arrays promise {size} bytes, {most} at most are read; use .npy files")
    return infos


def _open_array(path: Path, member: str | None, size: int) -> ArrayInFile:
    """Return the array in a file or member of `size` bytes; only its header is read."""
    with naming_damage(path), _open(path, member) as file:
        shape, is_fortran, dtype, offset = read_array_header(file.read(MAX_HEAD_SIZE))
    array = ArrayInFile(path, member, shape, is_fortran, dtype, offset)
    if dtype.hasobject or dtype.itemsize == 0 or any(count < 0 for count in shape):
        raise InputError(f"{path}: {array}, {WANTED}")
    promised = math.prod(shape) * dtype.itemsize
    found = size - offset
    if promised != found:
        raise InputError(f"{path}: an array promises {promised} bytes, found {found}; it is cut off")
    return array
