"""Opening files of point clouds: the format follows from a file's first bytes, or else from its name."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from ..errors import InputError
from ..jobs.threads import Progress, no_progress
from .readers import e57, e57_file, las, mesh, mesh_files, npz, pcd, ply, ptx, text
from .readers.reader import HEAD_SIZE, MissingChannelError, PointSource
from .settings import IN_METRES, Channel, CloudSettings
from .stream import Cloud, CloudStream


class CloudFormat(NamedTuple):
    """A format and its reader."""

    name: str
    suffixes: tuple[str, ...]  # lower case, with the dot
    has_magic: Callable[[bytes], object]  # true of a file's first HEAD_SIZE bytes; content goes before names
    # MissingChannelError if the file has no such channel
    open_source: Callable[[Path, CloudSettings, Channel], PointSource]
    has_labels: bool = False  # the reader knows them


def _begins(*magic: bytes) -> Callable[[bytes], bool]:
    return lambda head: head.startswith(magic)


FORMATS = (
    CloudFormat("PLY", (".ply",), _begins(*ply.MAGIC), ply.open_ply, has_labels=True),
    CloudFormat("LAS, LAZ", (".las", ".laz"), _begins(las.MAGIC), las.open_las, has_labels=True),
    CloudFormat("E57", (".e57",), _begins(e57_file.MAGIC), e57.open_e57),
    CloudFormat("PCD", (".pcd",), pcd.FIRST_LINES.match, pcd.open_pcd, has_labels=True),
    CloudFormat("PTX", (".ptx",), ptx.has_ptx_magic, ptx.open_ptx),
    CloudFormat("PTS", (".pts",), _begins(), text.open_pts),
    CloudFormat("NumPy .npz", (".npz",), npz.has_npz_magic, npz.open_npz),
    CloudFormat("NumPy .npy", (".npy",), _begins(npz.NPY_MAGIC), npz.open_npy),
    CloudFormat(
        "OBJ, GLB and glTF meshes", (".obj", ".glb", ".gltf"), _begins(mesh_files.GLB_MAGIC), mesh.open_mesh
    ),
    CloudFormat("text x y z r g b", (".txt", ".xyz", ".asc", ".csv", ".xyzrgb"), _begins(), text.open_text),
)
WANTED = f"wanted a point cloud: {', '.join(f.name for f in FORMATS)}"


def open_cloud(
    paths: Sequence[Path], settings: CloudSettings = IN_METRES, show: Progress = no_progress
) -> CloudStream:
    """Return the cloud in one or several files, before its points are read, in the first channel of all.

    Raises InputError if a file is missing, has a damaged header, none of the channels, or an unknown format,
    or if some files have colours and some have none. Reading the points raises it where the data are damaged
    or fail the checks of `PointValidator`.
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
    return CloudStream(sources, settings.scale, show)


def read_cloud(path: Path, settings: CloudSettings = IN_METRES) -> Cloud:
    """Return the cloud in a file, checked, in metres, in Morton order.

    The file's coordinates are multiplied by the scale; the middle of their bounding box, rounded to whole
    metres, becomes `origin_world` and is subtracted in float64. This is done for every cloud, so that UTM
    coordinates and a room at the origin take the same path. Raises InputError like `open_cloud`.
    """
    return open_cloud([path], settings).read()


def open_source(path: Path, settings: CloudSettings = IN_METRES) -> PointSource:
    """Return the points of a file in any supported format, in the first of the channels that it has."""
    try:
        format_ = _format_of(path)
        if settings.labels and not format_.has_labels:
            known = ", ".join(f.name for f in FORMATS if f.has_labels)
            raise InputError(f"{path}: labels are not read from {format_.name}, wanted {known}")
        try:
            return _open_channel(format_, path, settings)
        except MissingChannelError:
            raise
        except InputError as error:
            raise InputError(f"{error}{_hint(format_, path, settings)}") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}), {WANTED}") from error


def _open_channel(format_: CloudFormat, path: Path, settings: CloudSettings) -> PointSource:
    """Return the points in the first channel that the file has, with a warning if it has no colours."""
    missing: list[MissingChannelError] = []
    for channel in ("colors",) if settings.labels else settings.channels:
        try:
            source = format_.open_source(path, settings, channel)
        except MissingChannelError as error:
            missing.append(error.with_traceback(None))  # it would keep the file open
            continue
        notes = (str(missing[0]),) if missing and settings.channels[0] == "colors" else ()
        return source._replace(channel=channel, warnings=(*source.warnings, *notes))
    raise missing[0]


def _hint(format_: CloudFormat, path: Path, settings: CloudSettings) -> str:
    """Return what to add to the refusal of a file that would be read without its colours."""
    if settings.labels or settings.channels != IN_METRES.channels:
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
        head = file.read(HEAD_SIZE)
    if not head:
        raise InputError(f"{path}: the file is empty, {WANTED}")
    suffix = path.suffix.lower()
    by_content = [f for f in FORMATS if f.has_magic(head)]
    by_name = [f for f in FORMATS if suffix in f.suffixes]
    if not by_content and not by_name:
        raise InputError(f"{path}: unknown format '{path.suffix}', {WANTED}")
    return (by_content or by_name)[0]
