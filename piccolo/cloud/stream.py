"""Clouds in files, read as often as they are needed: into voxels, or into memory."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..geometry.point_transforms import rotate_points
from ..geometry.pose import Array
from ..runtime.threads import Progress, no_progress
from .morton import morton_order
from .readers.colors import brightest_of, colored_chunks
from .readers.reader import CHUNK, PointSource, RawCloud
from .validation import Chunk, PointValidator, unit_warnings
from .voxels import Voxels, VoxelTable

ARRAYS = Path("arrays")  # how messages and results name a scan that is no file


@dataclass(frozen=True)
class Cloud:
    """Coloured points near a local origin, in an order that does not depend on the file's."""

    points: NDArray[np.float32]  # (N, 3) world minus origin_world [m], all finite, Morton order
    colors: NDArray[np.uint8]  # (N, 3) RGB
    origin_world: NDArray[np.float64]  # (3,) what was subtracted from the file's coordinates [m]
    num_dropped: int = 0  # points with NaN or infinite coordinates, left out
    warnings: tuple[str, ...] = ()  # one line each, for the user

    def voxels(self, R_map_from_world: NDArray[np.float64]) -> Voxels:
        """The points averaged voxel by voxel, in axes turned by a rotation (3, 3)."""
        table = VoxelTable("cloud")
        table.add(rotate_points(self.points + self.origin_world, R_map_from_world), self.colors)
        voxels = table.finish()
        return Voxels(voxels.codes, voxels.nodes, voxels.origin, self.warnings + voxels.warnings)


def stream_of(path: Path, raw: RawCloud) -> "CloudStream":
    """Points in memory as if they stood in a file named `path`."""
    return CloudStream([PointSource(path, lambda: iter([raw]), len(raw.colors))])


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
class CloudStream:
    """One cloud in one or several files. Each reading starts again, and ends with the same checks."""

    sources: Sequence[PointSource]  # in an order of their own: the user's changes nothing
    scale: float = 1.0  # metres per unit of the files
    show: Progress = no_progress  # progress
    box: BoundingBox = field(default_factory=BoundingBox)  # of the points read so far [m]

    @property
    def label(self) -> str:
        """What messages about all files together call them."""
        first, num_more = self.sources[0].path, len(self.sources) - 1
        return f"{first} and {num_more} more" if num_more else str(first)

    def chunks(self, validators: list[PointValidator]) -> Iterator[Chunk]:
        """Yield the finite points in metres; `validators` gets what is then known of each file."""
        for source in self.sources:
            validator = PointValidator(source.path, self.scale)
            total = None if source.num_points is None else math.ceil(source.num_points / CHUNK)
            try:
                for raw in self.show(source.read_chunks(), total, f"read {source.path.name}"):
                    points_world, colors = validator.filter(raw)
                    self.box.add(points_world)
                    yield points_world, colors
            except OSError as error:
                text = f"{source.path}: cannot be read ({error.strerror or error}), wanted a whole file"
                raise InputError(text) from error
            validator.check()
            validators.append(validator)

    def _warnings(self, validators: list[PointValidator]) -> list[str]:
        pairs = zip(self.sources, validators, strict=True)
        return [line for source, validator in pairs for line in (*source.warnings, *validator.warnings())]

    def voxels(self, R_map_from_world: NDArray[np.float64]) -> Voxels:
        """The points averaged voxel by voxel, in axes turned by a rotation (3, 3)."""
        validators: list[PointValidator] = []
        table = VoxelTable(self.label)
        for points_world, colors in self.chunks(validators):
            table.add(rotate_points(points_world, R_map_from_world), colors)
        voxels = table.finish()
        of_all = (*voxels.warnings, *unit_warnings(self.label, voxels.nodes[:, :3]))
        return replace(voxels, warnings=(*self._warnings(validators), *of_all))

    def read(self) -> Cloud:
        """All points, in Morton order."""
        validators: list[PointValidator] = []
        chunks = list(self.chunks(validators))
        points_world = np.concatenate([points_world for points_world, _ in chunks])
        colors = np.concatenate([colors for _, colors in chunks])
        chunks.clear()
        # Rounded to metres, so that adding it back costs no digit; of the box, so that no order matters.
        # + 0.0 turns -0.0 into 0.0: equal points have equal bits.
        origin_world = np.round(0.5 * (points_world.min(axis=0) + points_world.max(axis=0))) + 0.0
        points = (points_world - origin_world + 0.0).astype(np.float32)
        order = morton_order(points, colors)
        points, colors = points[order], colors[order]
        warnings = (*self._warnings(validators), *unit_warnings(self.label, points))
        num_dropped = sum(validator.num_dropped for validator in validators)
        return Cloud(points, colors, origin_world, num_dropped, warnings)


def stream_of_arrays(points: NDArray[np.floating[Any]], colors: NDArray[Any] | None) -> CloudStream:
    """A cloud in memory: points (N, 3), colours (N, 3) in uint8, uint16, or floats in [0, 1]."""
    if points.ndim != 2 or points.shape[1:] != (3,) or colors is None or colors.shape != points.shape:
        shapes = f"{points.shape} and {None if colors is None else colors.shape}"
        raise InputError(f"points, colors: found shapes {shapes}, wanted two arrays of shape (N, 3)")
    brightest = brightest_of(ARRAYS, [f"{colors.dtype.kind}{colors.dtype.itemsize}"])
    chunks = colored_chunks([(points, colors)], brightest, lambda row: f"{ARRAYS}, row {row}")
    return stream_of(ARRAYS, next(iter(chunks)))
