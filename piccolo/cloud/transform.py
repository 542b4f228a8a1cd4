"""Clouds written again under a rigid transform, a chunk at a time."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..geometry.point_transforms import transform_points
from ..geometry.pose import Array
from .ply_copy import is_ply, open_copy
from .ply_writer import Rows, vertex_rows, writing_ply
from .stream import CloudStream
from .validation import Chunk, PointValidator

AXES, NORMALS = ("x", "y", "z"), ("nx", "ny", "nz")
MAX_LOSS = 1e-4  # of float32 coordinates by rounding [m]


@dataclass
class BoundingBox:
    """The smallest box, along the axes, around the points seen so far."""

    low: Array = field(default_factory=lambda: np.full(3, np.inf))
    high: Array = field(default_factory=lambda: np.full(3, -np.inf))

    def add(self, points: Array) -> None:
        """Widen to points (N, 3)."""
        for k in range(3 if len(points) else 0):
            self.low[k] = min(self.low[k], float(points[:, k].min()))
            self.high[k] = max(self.high[k], float(points[:, k].max()))

    def corners(self) -> Array:
        """The eight corners (8, 3)."""
        return np.array([np.where(bits, self.high, self.low) for bits in np.ndindex(2, 2, 2)])


@dataclass(frozen=True)
class BoundedStream(CloudStream):
    """A cloud that knows its bounding box once it has been read."""

    box: BoundingBox = field(default_factory=BoundingBox)  # [m]

    def chunks(self, validators: list[PointValidator]) -> Iterator[Chunk]:
        """Yield the finite points in metres as CloudStream does."""
        for points, colors in super().chunks(validators):
            self.box.add(points)
            yield points, colors


def with_bounds(cloud: CloudStream) -> BoundedStream:
    """The same cloud, which finds its bounding box while it is read."""
    return BoundedStream(cloud.sources, cloud.scale, cloud.show)


def needs_double(box: BoundingBox, T_target_from_source: Array, scale: float) -> bool:
    """True if float32 would lose more than MAX_LOSS of a moved box [m]; T is in units of `scale` metres."""
    farthest = float(np.abs(transform_points(box.corners() / scale, T_target_from_source)).max())
    return float(np.spacing(np.float32(farthest))) * scale > 2.0 * MAX_LOSS


def write_transformed(
    cloud: BoundedStream, T_target_from_source: Array, out: Path, finish: Callable[[], None]
) -> tuple[str, ...]:
    """Write a cloud, read once before, as binary PLY under a transform (4, 4) in the files' unit.

    One PLY file keeps its other properties and elements, its normals are turned and points with NaN stay; any
    other cloud is written with x y z and red green blue. `finish` runs when all is written, just before `out`
    appears. Returns a line for each element that was left out.
    """
    is_double = needs_double(cloud.box, T_target_from_source, cloud.scale)
    path = cloud.sources[0].path
    if len(cloud.sources) > 1 or not is_ply(path):
        dtype = np.dtype(np.float64 if is_double else np.float32)
        with writing_ply(
            out, vertex_rows(np.empty((0, 3), dtype), np.empty((0, 3), np.uint8)).dtype
        ) as writer:
            for points, colors in cloud.chunks([]):
                target = transform_points(points / cloud.scale, T_target_from_source)
                writer.add(vertex_rows(target.astype(dtype), colors))
            finish()
        return ()
    copy = open_copy(path)
    dtype = _dtype_of(copy.dtype, is_double)
    with writing_ply(out, dtype, copy.comments, copy.more) as writer:
        for rows in cloud.show(copy.read_rows(), copy.num_chunks, "write"):
            writer.add(_transformed_rows(rows, dtype, T_target_from_source))
        for block in copy.read_rest():
            writer.file.write(block)
        finish()
    return tuple(f"{path}: the element '{name}' is left out" for name in copy.left_out)


def _dtype_of(dtype: np.dtype[Any], is_double: bool) -> np.dtype[Any]:
    """A PLY file's dtype with x y z of float64 where it `is_double` or they are integers."""
    fields = [(name, dtype[name]) for name in dtype.names or ()]
    wide = [name for name, kind in fields if name in AXES and (is_double or kind.kind != "f")]
    return np.dtype([(name, np.dtype("<f8") if name in wide else kind) for name, kind in fields])


def _transformed_rows(rows: Rows, dtype: np.dtype[Any], T_target_from_source: Array) -> Rows:
    """Vertices with x y z moved and nx ny nz turned, all else as it is."""
    target = rows.astype(dtype)
    turn = T_target_from_source.copy()
    turn[:3, 3] = 0.0
    for names, T in ((AXES, T_target_from_source), (NORMALS, turn)):
        if set(names) <= set(dtype.names or ()):
            points = transform_points(np.stack([rows[name] for name in names], axis=1, dtype=np.float64), T)
            for name, column in zip(names, points.T, strict=True):
                target[name] = column
    return target
