"""Stanford2D-3D-S (Armeni et al., 2017) with the room clouds of S3DIS (Armeni et al., CVPR 2016)."""

import json
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from piccolo.errors import InputError
from piccolo.files.json_file import read_json
from piccolo.geometry.pose import Pose, move

from .model import (
    WORLD_FROM_CAM,
    CloudPart,
    ConvertOptions,
    PosedPanorama,
    SceneList,
    SceneSpec,
    array_of,
    labels_by_index,
    pose_of_transform,
    scene_list,
)

NAME = "stanford2d3ds"
# As most users of S3DIS number them, less one: theirs begin at 0. Other names, <UNK> among them, are 0.
CLASSES = (
    "ceiling", "floor", "wall", "beam", "column", "window", "door", "table", "chair", "sofa", "bookcase",
    "board", "clutter",
)  # fmt: skip
NUMBERS = {name: number for number, name in enumerate(CLASSES, 1)}
# The dataset's own folders, below the one given or one more; and those of the PICCOLO authors.
PANORAMAS = ("area_*/pano/rgb", "*/area_*/pano/rgb", "pano/area_*")
CLOUDS = (
    "Area_{area}/{room}/{room}.txt",
    "*/Area_{area}/{room}/{room}.txt",
    "pcd_not_aligned/area_{area}/{room}.txt",
    "pcd/area_{area}/{room}.txt",
)
LABEL_FILES = ("semantic_labels.json", "assets/semantic_labels.json", "*/assets/semantic_labels.json")
ALIGNED = "Aligned_Version"
AREA = re.compile(r"area_(\d)([ab]?)$")
PICTURE = re.compile(r"camera_[0-9a-zA-Z]+_([A-Za-z]+_\d+)_frame_equirectangular_domain_rgb\.png$")
# The poses of area 5b are in a frame of their own. Nobody gives the transform to the frame of the clouds but
# DeepViewAgg (Robert et al., CVPR 2022), calibrated by hand: good to a centimetre or so.
T_SCAN_FROM_5B = np.array([[0.0, 1.0, 0.0, -4.10], [-1.0, 0.0, 0.0, 6.25], [0.0, 0.0, 1.0, 0.0]])
WANTED_POSE = "wanted JSON with camera_location and final_camera_rotation"


class Picture(NamedTuple):
    """A panorama and the files that belong to it."""

    path: Path
    part: str  # of the building: 1 to 6, 5a and 5b
    pose: Path
    semantic: Path


def list_scenes(options: ConvertOptions) -> SceneList:
    """Return the rooms for which there are panoramas and a cloud."""
    table = _read_table(options) if options.labels else None
    specs = []
    missing = []
    for (area, room), pictures in sorted(_pictures(options.folder).items()):
        if options.areas and area not in options.areas:
            continue
        name = f"area_{area}/{room}"
        if parts := _cloud_of(options.folder, area, room, options.labels):
            settings: dict[str, object] = {"labels": options.labels}
            if options.labels:
                settings["label_names"] = ["unknown", *CLASSES]
            panoramas = _panoramas(options, pictures, table)
            specs.append(SceneSpec(NAME, name, parts, panoramas, settings=settings))
        else:
            missing.append(name)
    layout = f"room with panoramas ({PANORAMAS[0]}) and a cloud ({CLOUDS[0]}, with `labels` Annotations)"
    return scene_list(options.folder, specs, missing, layout)


def _pictures(folder: Path) -> dict[tuple[str, str], list[Picture]]:
    """Return the panoramas by area and room; 5a and 5b are both of area 5."""
    pictures: dict[tuple[str, str], list[Picture]] = defaultdict(list)
    for rgb in _glob(folder, PANORAMAS):
        is_original = rgb.name == "rgb"
        area_folder = rgb.parents[1] if is_original else rgb
        match = AREA.match(area_folder.name)
        if not match:
            continue
        folders = (rgb.parent, "") if is_original else (folder, area_folder.name)
        pose = folders[0] / "pose" / folders[1]
        semantic = folders[0] / "semantic" / folders[1]
        for path in sorted(rgb.glob("camera_*_rgb.png")):
            if room := PICTURE.match(path.name):
                stem = path.name.removesuffix("_rgb.png")
                pose_file = pose / f"{stem}_pose.json"
                labels_file = semantic / f"{stem}_semantic.png"
                picture = Picture(path, match[1] + match[2], pose_file, labels_file)
                pictures[match[1], room[1]].append(picture)
    return pictures


def _glob(folder: Path, patterns: Iterable[str]) -> list[Path]:
    return [path for pattern in patterns for path in sorted(folder.glob(pattern))]


def _cloud_of(folder: Path, area: str, room: str, has_labels: bool) -> tuple[CloudPart, ...]:
    """Return the room's points, one `x y z r g b` a line; with labels, an object a file named by class."""
    found = _glob(folder, [pattern.format(area=area, room=room) for pattern in CLOUDS])
    usable = [path for path in found if not any(ALIGNED in part for part in path.parts)]
    if found and not usable:
        text = f"found a cloud of the {ALIGNED}, whose rooms are rotated one by one"
        raise InputError(f"{found[0]}: {text}, wanted those of Stanford3dDataset_v1.2")
    if not has_labels:
        return tuple(CloudPart(path) for path in usable[:1])
    objects = [path for cloud in usable[:1] for path in sorted(cloud.parent.glob("Annotations/*.txt"))]
    return tuple(CloudPart(path, NUMBERS.get(path.name.split("_")[0], 0)) for path in objects)


def _panoramas(
    options: ConvertOptions, pictures: list[Picture], table: NDArray[np.uint16] | None
) -> Iterator[PosedPanorama]:
    for picture in pictures:
        semantic = options.inside(picture.semantic)
        options.inside(picture.pose)
        read_labels = None if table is None else partial(labels_by_index, semantic, table)
        name = picture.path.name
        variant = f"area_{picture.part}"
        yield PosedPanorama(name, {name: picture.path}, variant, _read_pose(picture), read_labels)


def _read_pose(picture: Picture) -> Pose:
    """Return the pose in a JSON file: Blender's Euler angles of a camera that looks along -z, y up.

    R_world_from_opengl = R_z(c) R_y(b) R_x(a) with final_camera_rotation = (a, b, c) [rad].
    """
    document = read_json(picture.pose, WANTED_POSE)
    names = ("final_camera_rotation", "camera_location")
    if not isinstance(document, dict) or not all(name in document for name in names):
        raise InputError(f"{picture.pose}: found no {' and '.join(names)}, {WANTED_POSE}")
    angles, center_world = (
        array_of(f"{picture.pose}, {name}", document[name], "wanted three numbers", (3,)) for name in names
    )
    R_world_from_opengl = Rotation.from_euler("xyz", angles).as_matrix()  # about fixed axes, x first
    T = np.column_stack([R_world_from_opengl, center_world])
    pose = pose_of_transform(str(picture.pose), T, WORLD_FROM_CAM, "opengl")
    return move(pose, T_SCAN_FROM_5B, 1.0) if picture.part == "5b" else pose


def _read_table(options: ConvertOptions) -> NDArray[np.uint16]:
    """Return the class of each index in the semantic pictures."""
    found = _glob(options.folder, LABEL_FILES)
    if not found:
        wanted = "wanted the names of the semantic indices"
        raise InputError(f"{options.folder}: found no {LABEL_FILES[1]}, {wanted}")
    names = read_json(options.inside(found[0]), "wanted a list of names")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise InputError(f"{found[0]}: found {json.dumps(names)[:60]}, wanted a list of names")
    return np.array([NUMBERS.get(name.split("_")[0], 0) for name in names], dtype=np.uint16)
