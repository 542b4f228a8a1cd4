"""Copies of clouds in other colours, chunk by chunk: PLY, LAS and LAZ, or E57."""

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ..arrays import Array, Bytes
from ..files.atomic import replacing
from ..files.temporary import temporary_folder
from ..jobs.memory import check_memory
from ..optional import import_optional
from .ply_writer import coordinate_type, vertex_rows, writing_ply
from .stream import CloudStream

SUFFIXES = (".ply", ".las", ".laz", ".e57")
UNTURNED = np.array([1.0, 0.0, 0.0, 0.0])  # quaternion of a scan in the axes of its file
LAS_STEP = 1e-4  # [m] of coordinates in LAS
E57_BYTES = 45  # of a point, beside the array of it that is held, while the file is written
Colors = tuple[Bytes, Bytes]  # RGB (N, 3), and how many photos (N,) gave each
Add = Callable[[Array, Bytes, Bytes], None]  # points (N, 3) in the files' unit


def write_colored(
    cloud: CloudStream, color: Callable[[Array], Colors], box_world: Array, out: Path, crs: str = ""
) -> tuple[int, int]:
    """Write a cloud within a box (2, 3) [m] in the colours of `color(points_world)`, by the suffix of `out`.

    Points (N, 3) [m] are coloured, and written in the files' unit and order with the number of photos that
    gave the colour: PLY's `photos`, LAS's user data. Return the numbers of points, and of coloured ones.
    """
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
    """Yield a function that adds points to a LAS or LAZ file, in its coordinate system if one is known."""
    laspy = import_optional(out, "laspy")
    header = laspy.LasHeader(point_format=7, version="1.4")
    header.scales = np.full(3, LAS_STEP / scale)
    header.offsets = np.floor(box.mean(axis=0))
    if crs:
        pyproj = import_optional("a coordinate system in LAS", "pyproj", "tools")
        header.add_crs(pyproj.CRS.from_user_input(crs))
    is_packed = out.suffix.lower() == ".laz"
    how = {"mode": "w", "header": header, "do_compress": is_packed, "closefd": False}
    with replacing(out) as file, laspy.open(file, **how) as writer:

        def add(points: Array, colors: Bytes, num_photos: Bytes) -> None:
            record = laspy.ScaleAwarePointRecord.zeros(len(points), header=header)
            record.x, record.y, record.z = points.T
            record.red, record.green, record.blue = colors.T.astype(np.uint16) * 257
            record.user_data = num_photos
            writer.write_points(record)

        yield add


@contextmanager
def writing_e57(out: Path, box: Array, _scale: float, _crs: str) -> Iterator[Add]:
    """Yield a function that adds points to an E57 file, whose library wants all of them at once."""
    pye57 = import_optional(out, "pye57")
    middle = np.floor(box.mean(axis=0))  # coordinates are written in float32
    parts: list[tuple[Any, ...]] = []

    def add(points: Array, colors: Bytes, _num_photos: Bytes) -> None:
        parts.append((*(points - middle).T, *colors.T))
        count = sum(len(part[0]) for part in parts)
        check_memory(E57_BYTES * count, f"{out}: {count} points at once", "write LAZ or PLY")

    yield add
    names = "cartesianX", "cartesianY", "cartesianZ", "colorRed", "colorGreen", "colorBlue"
    columns = [np.concatenate(values) for values in zip(*parts, strict=True)]
    with temporary_folder() as folder, replacing(out) as file:
        path = folder / "scan.e57"
        with pye57.E57(str(path), mode="w") as writer:
            data = dict(zip(names, columns, strict=True))
            writer.write_scan_raw(data, name="coloured", rotation=UNTURNED, translation=middle)
        with path.open("rb") as written:
            shutil.copyfileobj(written, file)
