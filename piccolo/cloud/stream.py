"""Clouds in files: read chunk by chunk, as often as needed, checked, and put into voxels or into memory.

A file's format is known by its first bytes, or else by its name.
"""

import math
import operator
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..geometry.points import LocalCloud, pack_points
from ..geometry.pose import rotate_points
from ..system.arrays import Array, Array32, Bytes, Floats, Values
from ..system.errors import InputError
from ..system.files.cache import sha256_of_arrays
from ..system.jobs.memory import check_address_space
from ..system.jobs.threads import Progress, Workers, no_progress
from .cloud_settings import BY_FILE, Channel, CloudSettings, UpAxis
from .point_validator import Chunk, PointValidator, find_box
from .readers import e57, e57_file, gltf, las, las_file, mesh, npz, pcd, ply, reader, text
from .voxels import Voxels, VoxelTable, morton_order

METRES_LIMIT = 2000.0  # [m] a scan wider than this along two axes is more likely in millimetres
FAR_FROM_ORIGIN = 16_384.0  # [m] from the origin, where neighbouring float32 numbers differ by 2 mm
MAX_EXTENT_SAMPLES = 100_000  # points by which the extent is estimated

ALONE = Workers()  # the calling thread only
ARRAYS = Path("arrays")  # in messages and results, the name of a scan that is given as arrays


def _name(paths: Sequence[Path]) -> str:
    """Return the name of some files, taken together, for messages."""
    return f"{paths[0]} and {len(paths) - 1} more" if len(paths) > 1 else str(paths[0])


def unit_warnings(label: str, points: Array32) -> tuple[str, ...]:
    """Return a warning if points (N, 3) [m] look like millimetres, or are too far apart for float32.

    They look like millimetres if 98 % of them span more than METRES_LIMIT along at least two axes.
    """
    samples = points[:: 1 + len(points) // MAX_EXTENT_SAMPLES]
    low, high = np.percentile(samples, [1.0, 99.0], axis=0)
    if np.count_nonzero(high - low > METRES_LIMIT) >= 2:
        size = " x ".join(f"{extent:.0f}" for extent in high - low)
        return (f"{label}: the cloud spans {size} m; if its unit is the millimetre, set `units` to mm",)
    farthest = float(np.abs(points).max())
    if farthest > FAR_FROM_ORIGIN:
        limit = f"limit the precision of the rest to {np.spacing(np.float32(farthest)):.2g} m"
        return (f"{label}: points {2 * farthest:.0f} m apart {limit}; remove the outliers",)
    return ()


@dataclass(frozen=True)
class CloudPoints:
    """Coloured points relative to a local origin, in an order that does not depend on the file's."""

    points: Array32  # (N, 3) world minus origin_world [m], all finite, Morton order
    colors: Bytes  # (N, 3) RGB
    origin_world: Array  # (3,) what was subtracted from the file's coordinates [m]
    warnings: tuple[str, ...] = ()  # one line each, for the user
    up: UpAxis = "z"  # the axis that points up according to the files
    has_colors: bool = True  # if not, `colors` are greys: intensity, or all equal

    def pack(self) -> LocalCloud:
        """Return the points in the form that kernels read."""
        return LocalCloud(np.eye(3), self.origin_world, pack_points(self.points, self.colors), self.warnings)


@dataclass(frozen=True)
class CloudStream:
    """One cloud in one or several files. Each reading begins at the start and ends with all checks."""

    sources: Sequence[reader.PointSource]  # sorted by path, so that the user's order changes nothing
    show: Progress = no_progress
    sha256: str = ""  # of arrays; empty for files
    # (2, 3) [m] least and greatest coordinates of all points read so far
    box: Array = field(default_factory=lambda: find_box(np.empty((0, 3))))

    @property
    def label(self) -> str:
        """The name of all files, taken together, for messages."""
        return _name([source.path for source in self.sources])

    @property
    def scale(self) -> float:
        """Metres per unit of all files and axes; 1 if units differ: the cloud is then written in metres."""
        units = self.units
        return units.pop() if len(units) == 1 else 1.0

    @property
    def units(self) -> set[float]:
        """The distinct units [m] of files and axes."""
        return {unit for source in self.sources for unit in source.units}

    @property
    def station_axes(self) -> Array:
        """The unit z axes (S, 3), in the files' axes, of the scanners whose poses the files contain."""
        return np.array([axis for source in self.sources for axis in source.station_axes]).reshape(-1, 3)

    @property
    def up(self) -> UpAxis:
        """The axis that points up according to the files; z if they disagree."""
        axes = {source.up for source in self.sources}
        return axes.pop() if len(axes) == 1 else "z"

    @property
    def has_colors(self) -> bool:
        """False if the colours are greys: the points' intensity, or all equal."""
        return all(source.channel == "colors" for source in self.sources)

    def chunks(self, validators: list[PointValidator]) -> Iterator[Chunk]:
        """Yield the finite points in metres; append each file's validator after its last chunk."""
        for source in self.sources:
            validator = PointValidator(
                source.path, np.array(source.units), source.channel == "colors", box=self.box
            )
            total = (
                None if source.num_points is None else math.ceil(source.num_points / reader.POINTS_A_CHUNK)
            )
            try:
                for raw in self.show(source.read_chunks(), total, f"read {source.path.name}"):
                    check_address_space()
                    yield validator.filter(raw)
            except OSError as error:
                text = f"{source.path}: cannot be read ({error.strerror or error}), wanted a whole file"
                raise InputError(text) from error
            validator.check()
            validators.append(validator)

    def _warnings(self, validators: list[PointValidator]) -> list[str]:
        """Return the warnings of all files; the same note on the units of several files appears once."""
        of_units: dict[str, list[Path]] = {}
        for source in self.sources:
            if source.unit_note:
                of_units.setdefault(source.unit_note, []).append(source.path)
        lines = [f"{_name(paths)}: {note}" for note, paths in of_units.items()]
        pairs = zip(self.sources, validators, strict=True)
        return lines + [line for source, found in pairs for line in (*source.warnings, *found.warnings())]

    def voxels(self, R_map_from_world: Array, workers: Workers = ALONE) -> Voxels:
        """Return the voxels of the points, in axes turned from the world's by a rotation (3, 3).

        With several threads, the next chunk is read while one is added.
        """
        validators: list[PointValidator] = []
        table = VoxelTable(self.label)

        def add(chunk: Chunk) -> None:
            table.add(rotate_points(chunk[0], R_map_from_world), chunk[1])

        chunks = self.chunks(validators)
        chunk = next(chunks, None)
        while chunk is not None:
            tasks: list[Callable[[], Chunk | None]] = [partial(add, chunk), partial(next, chunks, None)]
            chunk = workers.map(operator.call, tasks, "")[1]
        voxels = table.finish()
        of_all = (*voxels.warnings, *unit_warnings(self.label, voxels.nodes[:, :3]))
        return voxels._replace(warnings=(*self._warnings(validators), *of_all))

    def read(self) -> CloudPoints:
        """Return all points, in Morton order.

        The middle of their bounding box, rounded to whole metres, becomes `origin_world` and is subtracted in
        float64. This is done for every cloud, whether in UTM coordinates or near the origin.
        """
        validators: list[PointValidator] = []
        chunks = list(self.chunks(validators))
        points_world = np.concatenate([points_world for points_world, _ in chunks])
        colors = np.concatenate([colors for _, colors in chunks])
        chunks.clear()
        # Whole metres can be added back exactly; the box's middle does not depend on the order of the points.
        # + 0.0 turns -0.0 into 0.0: equal points have equal bits.
        origin_world = np.round(0.5 * (points_world.min(axis=0) + points_world.max(axis=0))) + 0.0
        points = (points_world - origin_world + 0.0).astype(np.float32)
        order = morton_order(points, colors)
        points = points[order]
        colors = colors[order]
        warnings = (*self._warnings(validators), *unit_warnings(self.label, points))
        return CloudPoints(points, colors, origin_world, warnings, self.up, self.has_colors)


def stream_of_arrays(points: Floats, colors: Values | None, color_range: float | None = None) -> CloudStream:
    """Return the stream of a cloud in memory: points (N, 3) [m], and colours (N, 3) of any range, or None."""
    if points.ndim != 2 or points.shape[1:] != (3,) or (colors is not None and colors.shape != points.shape):
        shapes = f"{points.shape} and {None if colors is None else colors.shape}"
        raise InputError(f"points, colors: found shapes {shapes}, wanted arrays of shape (N, 3)")
    if points.dtype.kind not in "fiu":
        raise InputError(f"points: found {points.dtype}, wanted numbers")
    values = np.full(points.shape, reader.GRAY, np.uint8) if colors is None else colors
    parts = [(reader.points_of([*points.T]), values)]
    usual = reader.USUAL.get(values.dtype.str[1:], reader.BYTE_RANGE)
    settings = replace(BY_FILE, color_range=255.0 if values.dtype == np.uint8 else color_range)
    brightest, notes = reader.find_brightest(ARRAYS, parts, settings, usual)
    chunk = next(reader.color_chunks(parts, brightest, lambda row: f"{ARRAYS}, row {row}"))
    channel: Channel = "shape" if colors is None else "colors"
    source = reader.PointSource(ARRAYS, lambda: iter([chunk]), len(values), notes, channel=channel)
    return CloudStream([source], sha256=sha256_of_arrays(points, values))


class CloudFormat(NamedTuple):
    """A format of cloud files and its reader."""

    name: str
    suffixes: tuple[str, ...]  # lower case, with the dot
    has_magic: Callable[[bytes], object]  # whether a file's first HEAD_SIZE bytes are of the format
    # opens a file; raises MissingChannelError if it has no such channel
    open_source: Callable[[Path, CloudSettings, Channel], reader.PointSource]
    has_columns: bool = False  # the user may name the columns
    read_crs: Callable[[Path], str] | None = None  # returns the coordinate system that a file names, or ""


def _begins(*magic: bytes) -> Callable[[bytes], bool]:
    return lambda head: head.startswith(magic)


FORMATS = (
    CloudFormat("PLY", (".ply",), _begins(*ply.MAGIC), ply.open_ply),
    CloudFormat(
        "LAS, LAZ",
        (".las", ".laz"),
        _begins(las_file.MAGIC),
        las.open_las,
        read_crs=las_file.read_las_crs,
    ),
    CloudFormat("E57", (".e57",), _begins(e57_file.MAGIC), e57.open_e57, read_crs=e57_file.read_e57_crs),
    CloudFormat("PCD", (".pcd",), pcd.FIRST_LINES.match, pcd.open_pcd),
    CloudFormat("PTX", (".ptx",), text.has_ptx_magic, text.open_ptx),
    CloudFormat("PTS", (".pts",), _begins(), partial(text.open_text, has_counts=True), has_columns=True),
    CloudFormat("NumPy .npz", (".npz",), npz.has_npz_magic, npz.open_npz),
    CloudFormat("NumPy .npy", (".npy",), _begins(npz.NPY_MAGIC), npz.open_npy, has_columns=True),
    CloudFormat(
        "OBJ, GLB and glTF meshes", (".obj", ".glb", ".gltf"), _begins(gltf.GLB_MAGIC), mesh.open_mesh
    ),
    CloudFormat(
        "text x y z r g b",
        (".txt", ".xyz", ".asc", ".csv", ".xyzrgb"),
        _begins(),
        text.open_text,
        has_columns=True,
    ),
)
WANTED = f"wanted a point cloud: {', '.join(f.name for f in FORMATS)}"


def open_cloud(
    paths: Sequence[Path], settings: CloudSettings = BY_FILE, show: Progress = no_progress
) -> CloudStream:
    """Return the cloud in one or several files, with the first channel that they have; no point is read yet.

    Raise InputError if a file is missing, has a damaged header, none of the channels or an unknown format, or
    if some files have colours and some have none. Files without colours of which only some have intensity are
    read by their shape. Reading the points raises InputError where the data are damaged or fail the checks of
    `PointValidator`.
    """
    sources = [open_source(path, settings) for path in sorted(paths)]
    if len({source.channel for source in sources}) > 1:
        colored = next((source.path for source in sources if source.channel == "colors"), None)
        if colored:
            bare = next(source.path for source in sources if source.channel != "colors")
            found = f"{bare}: found no colours, though {colored} has them"
            raise InputError(f"{found}, wanted them in all files, or `ignore_colors`")
        only_shape = replace(settings, channels=("shape",))
        sources = [open_source(path, only_shape) for path in sorted(paths)]
    return CloudStream(sources, show)


def open_source(path: Path, settings: CloudSettings = BY_FILE) -> reader.PointSource:
    """Return the points of a file in any supported format, with the first of the channels that it has."""
    try:
        format_ = _format_of(path)
        if settings.columns and not format_.has_columns:
            known = ", ".join(f.name for f in FORMATS if f.has_columns)
            raise InputError(f"{path}: {format_.name} names its columns; `columns` is for {known}")
        try:
            source = _open_channel(format_, path, settings)
            return source if settings.scale is None else source._replace(units=(settings.scale,) * 3)
        except reader.MissingChannelError:
            raise
        except InputError as error:
            raise InputError(f"{error}{_hint(format_, path, settings)}") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}), {WANTED}") from error


def _open_channel(format_: CloudFormat, path: Path, settings: CloudSettings) -> reader.PointSource:
    """Return the points with the first channel that the file has, and a warning if it has no colours."""
    missing: list[reader.MissingChannelError] = []
    for channel in settings.channels:
        try:
            source = format_.open_source(path, settings, channel)
        except reader.MissingChannelError as error:
            missing.append(error.with_traceback(None))  # a traceback would keep the file open
            continue
        notes = (str(missing[0]),) if missing and settings.channels[0] == "colors" else ()
        return source._replace(channel=channel, warnings=(*source.warnings, *notes))
    raise missing[0]


def _hint(format_: CloudFormat, path: Path, settings: CloudSettings) -> str:
    """Return advice for the message that refuses a file, if the file could be read without its colours."""
    if settings.channels != BY_FILE.channels:
        return ""
    try:
        format_.open_source(path, settings, "shape")
    except InputError:
        return ""
    return "; `ignore_colors` localizes by the shape alone"


def _format_of(path: Path) -> CloudFormat:
    """Return the format of a file: by its first bytes, or else by its suffix."""
    if not path.exists():
        raise InputError(f"{path}: no such file, {WANTED}")
    if not path.is_file():
        raise InputError(f"{path}: not a file but a folder or a device, {WANTED}")
    with path.open("rb") as file:
        head = file.read(reader.HEAD_SIZE)
    if not head:
        raise InputError(f"{path}: the file is empty, {WANTED}")
    suffix = path.suffix.lower()
    by_content = [f for f in FORMATS if f.has_magic(head)]
    by_name = [f for f in FORMATS if suffix in f.suffixes]
    if not by_content and not by_name:
        raise InputError(f"{path}: unknown format '{path.suffix}', {WANTED}")
    return (by_content or by_name)[0]


def read_crs(paths: Sequence[Path]) -> str:
    """Return the coordinate system that the first of a scan's files names, as WKT or EPSG:code, or "".

    LAS and LAZ files name it in the OGC WKT record or in GeoTIFF keys, E57 files in coordinateMetadata.
    """
    with paths[0].open("rb") as file:
        head = file.read(reader.HEAD_SIZE)
    readers = (form.read_crs for form in FORMATS if form.read_crs and form.has_magic(head))
    text = next((read(paths[0]) for read in readers), "")
    return " ".join(text.split()) if len(text) <= reader.MAX_CRS_LENGTH else ""
