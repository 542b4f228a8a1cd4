"""Scenes on disk: a folder with a cloud, panoramas, and a queries.json with their true poses."""

import json
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from piccolo.geometry.pose import Pose, check_pose
from piccolo.geometry.sphere import CONVENTION
from piccolo.photo.camera import Calibration, Mount
from piccolo.photo.camera.calibration import document_of, read_mounts
from piccolo.system.errors import InputError
from piccolo.system.files.atomic import write_atomically
from piccolo.system.files.json_file import naming, read_json

QUERIES_NAME = "queries.json"
CLOUD_NAME = "cloud.ply"
WANTED = "wanted a queries.json with true poses"
POSE_FIELDS = ("R_cam_from_world", "center_world")
MAX_SKEW = 1e-4  # of R R^T from the identity


@dataclass(frozen=True)
class Query:
    """A panorama with its true pose."""

    image: Path  # a file, or a folder of cube faces or of a rig's pictures
    variant: str  # what sets it apart: how it was taken, or the split of its dataset
    pose: Pose  # in the cloud's coordinates
    labels: Path | None = None  # a picture of what each pixel shows, as numbers
    cameras: tuple[Mount, ...] = ()  # that took it; none for a sphere
    walk: str | None = None  # the walk of which it is a frame
    time: float | None = None  # of a frame, from its walk's beginning [s]
    is_answerable: bool = True  # else it shows nothing of the cloud: a black, mirrored or foreign frame

    @property
    def calibration(self) -> Calibration | None:
        """The cameras as a file would tell them; None for a sphere."""
        return Calibration(QUERIES_NAME, self.cameras) if self.cameras else None


@dataclass(frozen=True)
class Scene:
    """A cloud and the panoramas taken in it."""

    name: str  # its folder, below the folder that was asked for: a room, or area/room
    folder: Path
    cloud: Path
    queries: tuple[Query, ...]

    @property
    def by_name(self) -> dict[str, Query]:
        """The queries by their images' file names."""
        return {query.image.name: query for query in self.queries}

    def name_of(self, query: Query) -> str:
        """Return a query's image as queries.json has it."""
        return Path(os.path.relpath(query.image, self.folder)).as_posix()


def read_scene(folder: Path, name: str | None = None) -> Scene:
    """Return the scene of a folder, or of the queries.json in it.

    Raises InputError if there is no queries.json, or it is not as `write_queries` writes it.
    """
    path = folder if folder.suffix == ".json" else folder / QUERIES_NAME
    document = read_json(path, WANTED)
    with naming(path, WANTED):
        queries = tuple(_query(path.parent, k, entry) for k, entry in enumerate(document["queries"]))
        cloud = path.parent / str(document.get("cloud", CLOUD_NAME))
        if len({query.image for query in queries}) < len(queries):
            raise ValueError("an image twice")
    return Scene(name or path.parent.resolve().name, path.parent, cloud, queries)


def find_scenes(roots: Sequence[Path]) -> list[Scene]:
    """Return the scenes in and below folders, by name; a queries.json may stand for its folder.

    Raises InputError if there is none below one of the roots, or two have the same name.
    """
    scenes: dict[str, Scene] = {}
    for root in roots:
        if root.is_file() and root.suffix != ".json":
            raise InputError(f"{root}: found a file, wanted a folder with scenes or a {QUERIES_NAME}")
        folders = [root] if root.is_file() else [p.parent for p in sorted(root.rglob(QUERIES_NAME))]
        if not folders:
            raise InputError(f"{root}: found no {QUERIES_NAME} in or below it, wanted a folder with scenes")
        for folder in folders:
            name = "" if folder == root else folder.relative_to(root).as_posix()
            scene = read_scene(folder, name or None)
            if scenes.setdefault(scene.name, scene) is not scene:
                raise InputError(f"{folder}: found a second scene named {scene.name}, wanted other names")
    return [scenes[name] for name in sorted(scenes)]


def input_files(scenes: Sequence[Scene]) -> list[Path]:
    """Return the files of scenes, which no output may replace."""
    of_all = [path for scene in scenes for path in (scene.folder / QUERIES_NAME, scene.cloud)]
    queries = [query for scene in scenes for query in scene.queries]
    return of_all + [path for query in queries for path in (query.image, query.labels) if path]


def document_of_pose(pose: Pose) -> dict[str, list[Any]]:
    """Return a pose as JSON has it."""
    return {name: getattr(pose, name).tolist() for name in POSE_FIELDS}


def pose_of(document: Mapping[str, Any]) -> Pose:
    """Return the pose in a JSON object; what it lacks, or what is no array, raises as it comes."""
    return Pose(*(np.array(document[name], float) for name in POSE_FIELDS))


def _query(folder: Path, number: int, entry: dict[str, Any]) -> Query:
    """One entry; ValueError if it lacks something, or its numbers are no pose."""
    fields = ("image", "variant", *POSE_FIELDS)
    if not isinstance(entry, dict) or not all(name in entry for name in fields):
        raise ValueError(f"queries[{number}] without one of {', '.join(fields)}")
    names = [entry["image"], entry.get("labels") or ""]
    is_plain = isinstance(entry["variant"], str) and entry["variant"].isprintable()
    if not is_plain or not all(isinstance(name, str) and "\0" not in name for name in names):
        raise ValueError(f"queries[{number}] with an image, a variant or labels that are no plain text")
    labels = folder / entry["labels"] if entry.get("labels") else None
    cameras = read_mounts(entry["camera"]) if entry.get("camera") else ()
    pose = check_pose(pose_of(entry), entry["image"], MAX_SKEW)
    return Query(folder / entry["image"], entry["variant"], pose, labels, cameras, *_walk_of(entry))


def _walk_of(entry: dict[str, Any]) -> tuple[str | None, float | None, bool]:
    """Return a frame's walk and time, and whether it has an answer; ValueError if they are none."""
    walk, time, is_answerable = entry.get("walk"), entry.get("time"), entry.get("answerable", True)
    if (walk is None) != (time is None) or not isinstance(is_answerable, bool):
        text = "a walk without a time, or an answerable that is not true or false"
        raise ValueError(f"{entry['image']}: {text}")
    if walk is None:
        return None, None, is_answerable
    if not isinstance(walk, str) or not walk.isprintable():
        raise ValueError(f"{entry['image']}: a walk that is no plain text")
    if isinstance(time, bool) or not isinstance(time, int | float) or not math.isfinite(time):
        raise ValueError(f"{entry['image']}: a time that is no finite number")
    return walk, float(time), is_answerable


def _relative(path: Path, folder: Path) -> str:
    """Return a path as a folder's files may give it, whatever links lead to either; a link stays one."""
    return Path(os.path.relpath(path.parent.resolve() / path.name, folder.resolve())).as_posix()


def write_queries(folder: Path, queries: Iterable[Query], **more: object) -> None:
    """Write the queries.json of a folder that holds the cloud and the images; `more` goes in beside them."""
    entries = []
    for query in queries:
        labels = {"labels": _relative(query.labels, folder)} if query.labels else {}
        image = _relative(query.image, folder)
        camera = {"camera": document_of(query.cameras)} if query.cameras else {}
        walk = {"walk": query.walk, "time": query.time} if query.walk is not None else {}
        refused = {} if query.is_answerable else {"answerable": False}
        own = {**labels, **camera, **walk, **refused}
        entries.append({"image": image, "variant": query.variant, **document_of_pose(query.pose), **own})
    document = {"cloud": CLOUD_NAME, "convention": CONVENTION, **more, "queries": entries}
    write_atomically(folder / QUERIES_NAME, json.dumps(document, indent=1).encode())
