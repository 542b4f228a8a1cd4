"""Writers of clouds, a chunk at a time: binary PLY, transformed copies, and copies in other colours."""

import math
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from ..geometry.pose import transform_points
from ..system.arrays import Array, Bytes, Floats, Values
from ..system.errors import import_optional
from ..system.files.atomic import replacing, replacing_by_library
from ..system.jobs.memory import check_memory
from .cloud_settings import METRES
from .readers.ply import MAGIC, PlyHeader, place_of_vertices, read_columns, read_ply_header
from .readers.reader import POINTS_A_CHUNK
from .stream import CloudStream

TYPE_NAMES = {
    "i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint", "f4": "float",
    "f8": "double",
}  # fmt: skip
COLOR_NAMES = ("red", "green", "blue")
MAX_DIGITS = 20  # of the number of vertices: the header has room for so many

Rows = np.ndarray[Any, np.dtype[np.void]]  # structured array with a field for each property
AXES = ("x", "y", "z")
NORMALS = ("nx", "ny", "nz")
MAX_LOSS = 1e-4  # [m] by which rounding to float32 may move a point
SUFFIXES = (".ply", ".las", ".laz", ".e57")
UNTURNED = np.array([1.0, 0.0, 0.0, 0.0])  # quaternion (w, x, y, z) of the identity
LAS_STEP = 1e-4  # [m] step of coordinates in LAS
E57_BYTES = 45  # of memory for each point while the file is written, beside the array that is held
Colors = tuple[Bytes, Bytes]  # RGB (N, 3), and the number (N,) of photos that gave each
Add = Callable[[Array, Bytes, Bytes], None]  # points (N, 3) in the files' unit


def vertex_rows(points: Floats, colors: Bytes | None, **more: Values | None) -> Rows:
    """Return vertices with points (N, 3) in their own float type, and colours (N, 3) RGB if there are any.

    `more` names further properties (N,); those that are None are left out.
    """
    columns = dict(zip(AXES, points.T, strict=True))
    columns.update({} if colors is None else dict(zip(COLOR_NAMES, colors.T, strict=True)))
    columns.update((name, column) for name, column in more.items() if column is not None)
    return _rows(columns, np.dtype([(name, column.dtype) for name, column in columns.items()]))


def _rows(columns: dict[str, Values], dtype: np.dtype[Any]) -> Rows:
    rows = np.empty(len(columns["x"]), dtype)
    for name, column in columns.items():
        rows[name] = column
    return rows


@dataclass
class PlyWriter:
    """A writer of vertices, chunk by chunk; all chunks have the fields of the first."""

    file: IO[bytes]  # the caller may write more elements after the vertices, in little-endian order
    comments: Sequence[str]
    more: Sequence[str]  # lines of the header for these elements
    dtype: np.dtype[Any] | None = None  # of a vertex, little-endian; None before the first chunk
    num_vertices: int = 0

    def add(self, rows: Rows) -> None:
        """Write vertices."""
        if self.dtype is None:
            self.dtype = rows.dtype.newbyteorder("<")
            self.write_header()
        self.file.write(np.ascontiguousarray(rows.astype(self.dtype, copy=False)).data)
        self.num_vertices += len(rows)

    def write_header(self) -> None:
        """Write the header for the vertices so far; its size does not depend on their number."""
        # A comment fills the room that the number doesn't need: some programs can't read a padded number.
        lines = ["ply", "format binary_little_endian 1.0"]
        lines.append("comment " + "." * (MAX_DIGITS - len(str(self.num_vertices))))
        lines += [f"comment {text}" for text in self.comments]
        lines.append(f"element vertex {self.num_vertices}")
        dtype = self.dtype or np.dtype([])
        lines += [f"property {TYPE_NAMES[dtype[name].str[1:]]} {name}" for name in dtype.names or ()]
        self.file.write("\n".join([*lines, *self.more, "end_header", ""]).encode("ascii", "replace"))


@contextmanager
def writing_ply(path: Path, comments: Sequence[str] = (), more: Sequence[str] = ()) -> Iterator[PlyWriter]:
    """Yield a writer of `path`; the file is replaced after the block, or left as it was after an error."""
    with replacing(path) as file:
        writer = PlyWriter(file, comments, more)
        yield writer
        file.seek(0)
        writer.write_header()


def coordinate_type(box: Array, T_target_from_source: Array, scale: float) -> type[np.floating[Any]]:
    """Return float64 if rounding to float32 could move a point of a transformed box by more than MAX_LOSS.

    Else return float32. The box (2, 3) is in metres, the transform (4, 4) in units of `scale` metres.
    """
    corners = np.stack(np.meshgrid(*box.T), axis=-1).reshape(8, 3)
    farthest = float(np.abs(transform_points(corners / scale, T_target_from_source)).max())
    is_coarse = float(np.spacing(np.float32(farthest))) * scale > 2.0 * MAX_LOSS
    return np.float64 if is_coarse else np.float32


def write_transformed(
    cloud: CloudStream, T_target_from_source: Array, out: Path, finish: Callable[[], None]
) -> tuple[str, ...]:
    """Write a cloud as binary PLY under a transform (4, 4) in units of `cloud.scale` metres.

    The cloud must have been read once before, as its box is needed. A single PLY file keeps its other
    properties and elements and its points with NaN, and its normals are rotated. Any other cloud is written
    with x y z and red green blue, or intensity, or neither. `finish` is called when all is written, just
    before `out` appears. Return a line of text for each element that was left out.
    """
    path = cloud.sources[0].path
    with path.open("rb") as file:
        is_ply = file.read(len(MAGIC[0])) in MAGIC
    if is_ply and len(cloud.sources) == 1:
        return _write_copy(cloud, read_ply_header(path), T_target_from_source, out, finish)
    dtype = coordinate_type(cloud.box, T_target_from_source, cloud.scale)
    has_intensity = cloud.sources[0].channel == "intensity"
    with writing_ply(out) as writer:
        for points, colors in cloud.chunks([]):
            target = transform_points(points / cloud.scale, T_target_from_source)
            gray = colors[:, 0] if has_intensity else None
            rows = vertex_rows(target.astype(dtype), colors if cloud.has_colors else None, intensity=gray)
            writer.add(rows)
        finish()
    return ()


def _write_copy(
    cloud: CloudStream, header: PlyHeader, T_target_from_source: Array, out: Path, finish: Callable[[], None]
) -> tuple[str, ...]:
    """Write a transformed copy of a PLY file; return a line of text for each element that was left out.

    Elements after the vertices are copied byte by byte; those of ASCII and big-endian files are left out, and
    so are elements before the vertices.
    """
    full = [k for k, count in enumerate(header.counts) if count and k != header.index]
    copied = [k for k in full if k > header.index and header.byte_order == "<"]
    more: list[str] = []
    for k in copied:  # with its count: plyfile read the header with counts of 0
        element = header.elements[k]
        more += [f"element {element.name} {header.counts[k]}", *map(str, element.properties)]
    found = header.vertices.dtype("<")
    is_double = coordinate_type(cloud.box, T_target_from_source, cloud.scale) is np.float64
    wide = [name for name in AXES if is_double or found[name].kind != "f"]  # integers are not enough either
    names = found.names or ()
    dtype = np.dtype([(name, "<f8" if name in wide else found[name]) for name in names])
    columns = read_columns(header, names)
    with header.path.open("rb") as file:
        lines = file.read(header.size).decode("ascii", "replace").splitlines()
    comments = [line.removeprefix("comment ") for line in lines if line.startswith("comment ")]
    num_chunks = math.ceil(header.counts[header.index] / POINTS_A_CHUNK)
    with writing_ply(out, comments, more) as writer:
        for some in cloud.show(columns, num_chunks, "write"):
            as_found = {name: _of_type(column, found[name]) for name, column in zip(names, some, strict=True)}
            writer.add(_rows(_transform(as_found, T_target_from_source), dtype))
        if copied:
            offset, count, row = place_of_vertices(header)
            with header.path.open("rb") as file:
                file.seek(offset + count * row.itemsize)
                shutil.copyfileobj(file, writer.file)
        finish()
    left_out = [header.elements[k].name for k in full if k not in copied]
    return tuple(f"{header.path}: the element '{name}' is left out" for name in left_out)


def _of_type(column: Values, dtype: np.dtype[Any]) -> Values:
    """Return a column in the type that the file declares; columns of ASCII files are read as float64."""
    if dtype.kind in "iu" and column.dtype.kind == "f":
        limits = np.iinfo(dtype)
        column = np.clip(np.nan_to_num(np.rint(column)), limits.min, limits.max)
    return column.astype(dtype, copy=False)


def _transform(columns: dict[str, Values], T_target_from_source: Array) -> dict[str, Values]:
    """Return the columns of vertices with x y z transformed, nx ny nz rotated, and all others unchanged."""
    turn = T_target_from_source.copy()
    turn[:3, 3] = 0.0
    target = columns.copy()
    for names, T in ((AXES, T_target_from_source), (NORMALS, turn)):
        if set(names) <= columns.keys():
            points = transform_points(np.stack([columns[k] for k in names], axis=1, dtype=np.float64), T)
            target.update(zip(names, points.T, strict=True))
    return target


def describe_unit(cloud: CloudStream, out: Path, crs: str = "") -> tuple[str, ...]:
    """Return a line of text if a written file has another unit than the metre and does not name it.

    There is none if the user gave the unit, only if it is from the scan's files.
    """
    is_by_files = any(source.unit_note for source in cloud.sources)
    is_named = bool(crs) and out.suffix.lower() in (".las", ".laz")
    if not is_by_files or is_named or cloud.scale == 1.0:
        return ()
    names = [name for name, metres in METRES.items() if metres == cloud.scale]
    unit = names[0] if names else repr(cloud.scale)
    return (f"{out}: written in the unit of the scan, which it does not say; read it with `units` {unit}",)


def write_colored(
    cloud: CloudStream, color: Callable[[Array], Colors], box_world: Array, out: Path, crs: str = ""
) -> tuple[int, int]:
    """Write a cloud in other colours, in the format that the suffix of `out` names.

    `color` takes points (N, 3) [m] of the world and returns their colours, with the number of photos that
    gave each. The points, which lie in a box (2, 3) [m], are written in the unit and order of the files; the
    number of photos is PLY's property `photos` or LAS's user data. If units differ, the file is in metres and
    has no coordinate system. Return the number of points, and of those that a photo coloured.
    """
    crs = crs if len(cloud.units) == 1 else ""
    num_points = num_colored = 0
    writing = {".ply": writing_ply_rows, ".e57": writing_e57}.get(out.suffix.lower(), writing_las)
    with writing(out, box_world / cloud.scale, cloud.scale, crs) as add:
        for points_world, _ in cloud.chunks([]):
            colors, num_photos = color(points_world)
            add(points_world / cloud.scale, colors, num_photos)
            num_points += len(points_world)
            num_colored += int(np.count_nonzero(num_photos))
    return num_points, num_colored


@contextmanager
def writing_ply_rows(out: Path, box: Array, scale: float, _crs: str) -> Iterator[Add]:
    """Yield a function that adds points to a PLY file."""
    dtype = coordinate_type(box * scale, np.eye(4), scale)
    with writing_ply(out) as writer:
        yield lambda points, colors, num_photos: writer.add(
            vertex_rows(points.astype(dtype), colors, photos=num_photos)
        )


@contextmanager
def writing_las(out: Path, box: Array, scale: float, crs: str) -> Iterator[Add]:
    """Yield a function that adds points to a LAS or LAZ file, which names the coordinate system `crs`."""
    laspy = import_optional(out, "laspy")
    header = laspy.LasHeader(point_format=7, version="1.4")
    header.scales = np.full(3, LAS_STEP / scale)
    header.offsets = np.floor(box.mean(axis=0))
    if crs:
        pyproj = import_optional("a coordinate system in LAS", "pyproj", "gps")
        header.add_crs(pyproj.CRS.from_user_input(crs))
    is_packed = out.suffix.lower() == ".laz"
    how = {"mode": "w", "header": header, "do_compress": is_packed, "closefd": False}
    errors = import_optional(out, "lazrs").LazrsError if is_packed else ()
    with (
        replacing_by_library(out, errors) as path,
        path.open("w+b") as file,
        laspy.open(file, **how) as writer,
    ):

        def add(points: Array, colors: Bytes, num_photos: Bytes) -> None:
            record = laspy.ScaleAwarePointRecord.zeros(len(points), header=header)
            record.x, record.y, record.z = points.T
            record.red, record.green, record.blue = colors.T.astype(np.uint16) * 257
            record.user_data = num_photos
            writer.write_points(record)

        yield add


@contextmanager
def writing_e57(out: Path, box: Array, _scale: float, _crs: str) -> Iterator[Add]:
    """Yield a function that adds points to an E57 file; all are written at once, after the block."""
    pye57 = import_optional(out, "pye57")
    failed = pye57.libe57.E57Exception
    middle = np.floor(box.mean(axis=0))  # subtracted, as coordinates are written in float32
    parts: list[tuple[Any, ...]] = []

    def add(points: Array, colors: Bytes, _num_photos: Bytes) -> None:
        parts.append((*(points - middle).T, *colors.T))
        count = sum(len(part[0]) for part in parts)
        check_memory(E57_BYTES * count, f"{out}: {count} points at once", "write LAZ or PLY")

    yield add
    names = "cartesianX", "cartesianY", "cartesianZ", "colorRed", "colorGreen", "colorBlue"
    columns = [np.concatenate(values) for values in zip(*parts, strict=True)]
    with replacing_by_library(out, failed) as path:
        writer = pye57.E57(str(path), mode="w")
        try:
            data = dict(zip(names, columns, strict=True))
            writer.write_scan_raw(data, name="coloured", rotation=UNTURNED, translation=middle)
            writer.close()
        except failed:
            writer.close = lambda: None  # else pye57 closes it once more and prints the error
            raise
