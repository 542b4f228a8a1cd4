"""Anybody's panoramas: a list of pictures with positions and quaternions, as CSV, JSON or TUM trajectory."""

import csv
import io
from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from piccolo.geometry.pose import Pose, rotation_from_quaternion_wxyz
from piccolo.system.arguments import PICTURES
from piccolo.system.errors import InputError
from piccolo.system.files.json_file import read_json, read_text

from . import model

NAME = "generic"
LISTS = ("poses.csv", "poses.json", "poses.txt", "poses.tum")
NUMBERS = ("tx", "ty", "tz", "qw", "qx", "qy", "qz")
TUM_COLUMNS = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")
OWN_QUATERNION = {f"quaternion_{letter}" for letter in "wxyz"}  # of R_cam_from_world, in a CSV of ours
WANTED = f"wanted rows with image, {', '.join(NUMBERS)}, direction, axes"

Row = Mapping[str, str]
Entry = tuple[Path | None, model.PosedPanorama]  # a row of the list: its cloud, None for the one of all


def list_scenes(options: model.ConvertOptions) -> model.SceneList:
    """Return the rooms that the list names, or one by the folder's name."""
    found = [path for name in LISTS if (path := options.folder / name).exists()]
    if not options.poses and len(found) != 1:
        wanted = f"wanted one of {', '.join(LISTS)}, or `poses`"
        raise InputError(f"{options.folder}: found {len(found)} lists, {wanted}")
    path = options.poses or options.inside(found[0])
    entries: dict[str, list[Entry]] = defaultdict(list)
    notes: list[str] = []
    for number, row in enumerate(_rows(path, options, notes), 1):
        room, entry = _entry(f"{path}, row {number}", path, row, options)
        entries[room].append(entry)
    if not entries:
        raise InputError(f"{path}: found no row with a picture, {WANTED}")
    specs = tuple(_scene_spec(room, entries[room], options) for room in sorted(entries))
    return model.SceneList(specs, tuple(notes))


def _rows(path: Path, options: model.ConvertOptions, notes: list[str]) -> Iterator[Row]:
    """Return the rows as text by column; a blank field is as good as none."""
    if path.suffix.lower() == ".json":
        document = read_json(path, WANTED)
        if not isinstance(document, list) or not all(isinstance(row, dict) for row in document):
            raise InputError(f"{path}: found no list of objects, {WANTED}")
        rows = [{key: str(value) for key, value in row.items() if value is not None} for row in document]
    elif path.suffix.lower() == ".csv":
        rows = _table(path)
    else:
        rows = _trajectory(path, options, notes)
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
    return [_rename_columns(row) if row.keys() >= OWN_QUATERNION else row for row in texts]


def _rename_columns(row: dict[str, str]) -> dict[str, str]:
    """Return row of tools/export_poses.py as one of a list, its rotation inverted to go with the position."""
    inverse = {f"q{letter}": row[f"quaternion_{letter}"] for letter in "wxyz"}
    w = inverse["qw"]
    inverse["qw"] = w[1:] if w.startswith("-") else f"-{w}"
    position = {f"t{letter}": row.get(letter, "") for letter in "xyz"}
    position["image"] = row.get("image", "").removeprefix("'")  # as of export's `cell`
    return {**row, **inverse, **position, "direction": model.WORLD_FROM_CAM, "axes": "piccolo", "cloud": ""}


def _trajectory(path: Path, options: model.ConvertOptions, notes: list[str]) -> list[dict[str, str]]:
    """Return the lines of a TUM trajectory that have a picture named by their time."""
    folder = options.images or options.folder / "images"
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder, wanted pictures named by the times in {path.name}")
    pictures = {file.stem: file for file in sorted(folder.iterdir()) if file.suffix.lower() in PICTURES}
    lines = [line.split() for line in read_text(path, WANTED).splitlines()]
    lines = [fields for fields in lines if fields and not fields[0].startswith("#")]
    rows = []
    for fields in lines:
        if len(fields) != len(TUM_COLUMNS):
            found = " ".join(fields)[:60]
            raise InputError(f"{path}: found {found!r}, wanted {' '.join(TUM_COLUMNS)} a line")
        row = dict(zip(TUM_COLUMNS, fields, strict=True))
        if row["timestamp"] in pictures:
            image = str(pictures[row["timestamp"]].absolute())
            rows.append({**row, "image": image, "direction": model.WORLD_FROM_CAM})
    if len(rows) < len(lines):
        notes.append(f"{path}: {len(lines) - len(rows)} of {len(lines)} times without a picture")
    return rows


def _entry(where: str, path: Path, row: Row, options: model.ConvertOptions) -> tuple[str, Entry]:
    """Return a row's room, and the row itself."""
    if missing := [name for name in ("image", *NUMBERS) if name not in row]:
        raise InputError(f"{where}: found no {missing[0]}, {WANTED}")
    image = options.inside(path.parent / row["image"], where)
    room = row.get("room", options.folder.resolve().name)
    if room != Path(room).name or room.startswith(".") or not room.isprintable():
        raise InputError(f"{where}: found the room {room!r}, wanted a name for a folder")
    pose = _pose(where, row, options)
    cloud = options.inside(path.parent / row["cloud"], where) if "cloud" in row else None
    return room, (cloud, model.PosedPanorama(image.name, {image.name: image}, row.get("variant", NAME), pose))


def _pose(where: str, row: Row, options: model.ConvertOptions) -> Pose:
    """Return pose in a row, its direction and axes by the row or by the options, and never by guessing."""
    axes = row.get("axes", options.axes)
    direction = row.get("direction", options.direction)
    for name, value, known in (("axes", axes, model.AXES), ("direction", direction, model.DIRECTIONS)):
        if value not in known:
            wanted = f"wanted one of {', '.join(known)} in the list, or as `{name}`"
            raise InputError(f"{where}: found the {name} {value}, {wanted}")
    numbers = model.array_of(where, [row[name] for name in NUMBERS], "wanted numbers", (len(NUMBERS),))
    length = float(np.linalg.norm(numbers[3:]))
    if not abs(length - 1.0) < 1e-2:
        raise InputError(f"{where}: found a quaternion of length {length:.3g}, wanted 1")
    T = np.column_stack([rotation_from_quaternion_wxyz(numbers[3:]), numbers[:3]])
    return model.pose_of_transform(where, T, str(axes), str(direction))


def _scene_spec(room: str, entries: list[Entry], options: model.ConvertOptions) -> model.SceneSpec:
    found = {cloud for cloud, _ in entries}
    clouds = {cloud or options.cloud or model.only_cloud_in(options.folder) for cloud in found}
    if None in clouds:
        raise InputError(f"{options.folder}: found no cloud, wanted one, or `cloud`, or a column 'cloud'")
    if len(clouds) > 1:
        names = ", ".join(sorted(map(str, clouds))[:2])
        raise InputError(f"room {room}: found the clouds {names}, wanted one")
    panoramas = _with_unique_names([panorama for _, panorama in entries])
    parts = tuple(model.CloudPart(cloud) for cloud in clouds if cloud)
    return model.SceneSpec(NAME, room, parts, panoramas)


def _with_unique_names(panoramas: list[model.PosedPanorama]) -> list[model.PosedPanorama]:
    """Panoramas whose pictures have names of their own, else with their number before it."""
    if len({panorama.name for panorama in panoramas}) == len(panoramas):
        return panoramas
    return [
        panorama._replace(name=f"{number:05d}_{name}", files={f"{number:05d}_{name}": image})
        for number, panorama in enumerate(panoramas)
        for name, image in panorama.files.items()
    ]
