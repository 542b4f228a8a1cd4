"""Anybody's panoramas: a list of pictures with positions and quaternions, as CSV, JSON or TUM trajectory."""

import csv
import io
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...errors import InputError
from ...geometry.pose import Pose, rotation_from_quaternion_wxyz
from .clouds import only_cloud_in
from .model import CloudPart, Listing, Plan, Request, Shot
from .poses import AXES, DIRECTIONS, WORLD_FROM_CAM, pose_of_transform, read_json, read_text

NAME = "generic"
LISTS = ("poses.csv", "poses.json", "poses.txt", "poses.tum")
NUMBERS = ("tx", "ty", "tz", "qw", "qx", "qy", "qz")
TUM_COLUMNS = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")
SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp")
OWN_QUATERNION = {f"quaternion_{letter}" for letter in "wxyz"}  # of R_cam_from_world, in a CSV of ours
MAX_LENGTH_ERROR = 1e-2  # of a quaternion
VARIANT = "generic"
WANTED = f"wanted rows with image, {', '.join(NUMBERS)}, direction, axes"

Row = Mapping[str, str]


@dataclass(frozen=True)
class Entry:
    """A row of the list."""

    room: str
    cloud: Path | None  # None: the one for all
    shot: Shot


def listing(request: Request) -> Listing:
    """The rooms that the list names, or one by the folder's name."""
    path = _list_of(request)
    entries: dict[str, list[Entry]] = defaultdict(list)
    notes: list[str] = []
    rows = _rows(path, request, notes)
    for number, row in enumerate(rows, 1):
        entry = _entry(f"{path}, row {number}", path, row, request)
        entries[entry.room].append(entry)
    if not entries:
        raise InputError(f"{path}: found no row with a picture, {WANTED}")
    return Listing(tuple(_plan(room, entries[room], request) for room in sorted(entries)), tuple(notes))


def _list_of(request: Request) -> Path:
    if request.poses:
        return request.poses
    found = [request.folder / name for name in LISTS if (request.folder / name).exists()]
    if len(found) != 1:
        wanted = f"wanted one of {', '.join(LISTS)}, or --poses"
        raise InputError(f"{request.folder}: found {len(found)} lists, {wanted}")
    return found[0]


def _rows(path: Path, request: Request, notes: list[str]) -> Iterator[Row]:
    """The rows as text by column; a blank field is as good as none."""
    if path.suffix.lower() == ".json":
        document = read_json(path, WANTED)
        if not isinstance(document, list) or not all(isinstance(row, dict) for row in document):
            raise InputError(f"{path}: found no list of objects, {WANTED}")
        rows = [{key: str(value) for key, value in row.items() if value is not None} for row in document]
    elif path.suffix.lower() == ".csv":
        rows = _table(path)
    else:
        rows = _trajectory(path, request, notes)
    return ({key: value for key, value in row.items() if value} for row in rows)


def _table(path: Path) -> list[dict[str, str]]:
    try:
        rows = list(csv.DictReader(io.StringIO(read_text(path, WANTED))))
    except csv.Error as error:
        raise InputError(f"{path}: found damaged CSV ({error}), {WANTED}") from error
    texts = [
        {key.strip(): value.strip() for key, value in row.items() if key and isinstance(value, str)}
        for row in rows
    ]
    return [_renamed(row) if row.keys() >= OWN_QUATERNION else row for row in texts]


def _renamed(row: dict[str, str]) -> dict[str, str]:
    """A row of tools/export_poses.py as one of a list, its rotation inverted to go with the position."""
    w, x, y, z = (row[f"quaternion_{letter}"] for letter in "wxyz")
    inverse = {"qw": w, "qx": _negated(x), "qy": _negated(y), "qz": _negated(z)}
    position = {f"t{letter}": row.get(letter, "") for letter in "xyz"}
    return {**row, **inverse, **position, "direction": WORLD_FROM_CAM, "axes": "piccolo", "cloud": ""}


def _negated(number: str) -> str:
    return number[1:] if number.startswith("-") else f"-{number}"


def _trajectory(path: Path, request: Request, notes: list[str]) -> list[dict[str, str]]:
    """The lines of a TUM trajectory that have a picture named by their time."""
    folder = request.images or request.folder / "images"
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder, wanted pictures named by the times in {path.name}")
    pictures = {file.stem: file for file in sorted(folder.iterdir()) if file.suffix.lower() in SUFFIXES}
    lines = [line.split() for line in read_text(path, WANTED).splitlines() if not _is_comment(line)]
    rows = []
    for fields in lines:
        if len(fields) != len(TUM_COLUMNS):
            found = " ".join(fields)[:60]
            raise InputError(f"{path}: found {found!r}, wanted {' '.join(TUM_COLUMNS)} a line")
        row = dict(zip(TUM_COLUMNS, fields, strict=True))
        if row["timestamp"] in pictures:
            image = str(pictures[row["timestamp"]].resolve())
            rows.append({**row, "image": image, "direction": WORLD_FROM_CAM})
    if len(rows) < len(lines):
        notes.append(f"{path}: {len(lines) - len(rows)} of {len(lines)} times without a picture")
    return rows


def _is_comment(line: str) -> bool:
    return line.strip()[:1] in ("", "#")


def _entry(where: str, path: Path, row: Row, request: Request) -> Entry:
    if missing := [name for name in ("image", *NUMBERS) if name not in row]:
        raise InputError(f"{where}: found no {missing[0]}, {WANTED}")
    image = path.parent / row["image"]
    room = row.get("room", request.folder.resolve().name)
    if room != Path(room).name or room.startswith(".") or not room.isprintable():
        raise InputError(f"{where}: found the room {room!r}, wanted a name for a folder")
    shot = Shot(image.name, {image.name: image}, row.get("variant", VARIANT), _pose(where, row, request))
    return Entry(room, path.parent / row["cloud"] if "cloud" in row else None, shot)


def _pose(where: str, row: Row, request: Request) -> Pose:
    """The pose in a row, its direction and axes by the row or by the options, and never by guessing."""
    axes = row.get("axes", request.axes)
    direction = row.get("direction", request.direction)
    if axes not in AXES:
        wanted = f"wanted one of {', '.join(AXES)} in the list or by --axes"
        raise InputError(f"{where}: found the axes {axes}, {wanted}")
    if direction not in DIRECTIONS:
        wanted = f"wanted one of {', '.join(DIRECTIONS)} in the list or by --direction"
        raise InputError(f"{where}: found the direction {direction}, {wanted}")
    try:
        numbers = np.array([float(row[name]) for name in NUMBERS])
    except ValueError as error:
        raise InputError(f"{where}: found {error}, wanted numbers") from error
    length = float(np.linalg.norm(numbers[3:]))
    if not abs(length - 1.0) < MAX_LENGTH_ERROR:
        raise InputError(f"{where}: found a quaternion of length {length:.3g}, wanted 1")
    T = np.column_stack([rotation_from_quaternion_wxyz(numbers[3:]), numbers[:3]])
    return pose_of_transform(where, T, direction, axes)


def _plan(room: str, entries: list[Entry], request: Request) -> Plan:
    clouds = {entry.cloud or _cloud_of_all(request) for entry in entries}
    if len(clouds) > 1:
        names = ", ".join(sorted(map(str, clouds))[:2])
        raise InputError(f"room {room}: found the clouds {names}, wanted one")
    shots = _with_own_names([entry.shot for entry in entries])
    return Plan(room, (CloudPart(clouds.pop()),), lambda: shots, source={"dataset": NAME})


def _cloud_of_all(request: Request) -> Path:
    cloud = request.cloud or only_cloud_in(request.folder)
    if cloud is None:
        raise InputError(f"{request.folder}: found no cloud, wanted one, or --cloud, or a column `cloud`")
    return cloud


def _with_own_names(shots: list[Shot]) -> list[Shot]:
    """The same, where pictures of several folders have one name with their number before it."""
    names = [shot.name for shot in shots]
    if len(set(names)) == len(names):
        return shots
    numbered = []
    for number, shot in enumerate(shots):
        (image,) = shot.files.values()
        name = f"{number:05d}_{shot.name}"
        numbered.append(Shot(name, {name: image}, shot.variant, shot.pose))
    return numbered
