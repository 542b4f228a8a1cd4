"""Data sets of papers: their folders and files of poses. research/DATASETS.md has the sources."""

import json
import math
import re
import zlib
from collections import defaultdict
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from piccolo.geometry.pose import Pose, move, yaw_rotation
from piccolo.system.arguments import PICTURES
from piccolo.system.arrays import Uint16s
from piccolo.system.errors import InputError
from piccolo.system.files.json_file import read_json

from . import model

LOC360 = "360loc"
QUERIES = "query_360"
CAMERA_POSES = "camera_pose.json"
WANTED = 'wanted JSON {"NAME.jpg": a matrix of 4 x 4 numbers}'

MATTERPORT = "matterport3d"
SKYBOXES = "matterport_skybox_images"
MAX_DEPTH = 5  # v1/scans/HOUSE/HOUSE/matterport_skybox_images
FACE = re.compile(r"([0-9a-f]+)_skybox([0-5])_sami\.jpg$")
POSE_FILES = "matterport_camera_poses/{}_pose_1_{}.txt"  # 1: the level camera of three, 0 looks up, 2 down
SKYBOX_YAW = 5  # the stop at which that camera looks through the middle of skybox 1
# House by house the first of these that is there. Coloured vertices come first: they are quick to read.
MESHES = ("house_segmentations/*.ply", "region_segmentations/region*.ply", "matterport_mesh/**/*.obj")

OMNISCENES = "omniscenes"
PANORAMAS = ("*_pano", "*/*_pano")  # change_handheld_pano, turtlebot_pano ...
SEQUENCE = re.compile(r"[A-Za-z]+_([A-Za-z]+_\d+)_scene_\d+$")  # handheld_weddingHall_1_scene_2

MPO = "mpo"

STANFORD = "stanford2d3ds"  # Armeni et al., 2017, with the room clouds of S3DIS (CVPR 2016)
# As most users of S3DIS number them, less one: theirs begin at 0. Other names, <UNK> among them, are 0.
CLASSES = (
    "ceiling", "floor", "wall", "beam", "column", "window", "door", "table", "chair", "sofa", "bookcase",
    "board", "clutter",
)  # fmt: skip
NUMBERS = {name: number for number, name in enumerate(CLASSES, 1)}
# The dataset's own folders, below the one given or one more; and those of the PICCOLO authors.
AREA_PANORAMAS = ("area_*/pano/rgb", "*/area_*/pano/rgb", "pano/area_*")
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


def _glob(folder: Path, patterns: Iterable[str]) -> list[Path]:
    return [path for pattern in patterns for path in sorted(folder.glob(pattern))]


def list_360loc(options: model.ConvertOptions) -> model.SceneList:
    """Return the scenes that have 360-degree queries, and a cloud that the user put there."""
    below = (options.folder, *sorted(options.folder.glob("*")))
    specs = []
    missing = []
    for folder in (path for path in below if (path / QUERIES).is_dir()):
        name = folder.resolve().name
        if cloud := model.only_cloud_in(folder):
            panoramas = _360loc_panoramas(options, folder)
            specs.append(model.SceneSpec(LOC360, name, (model.CloudPart(cloud),), panoramas))
        else:
            missing.append(folder.name)
    layout = f"scene with {QUERIES}/SEQUENCE/{CAMERA_POSES} and a coloured cloud beside {QUERIES}"
    return model.scene_list(options.folder, specs, missing, layout)


def _360loc_panoramas(options: model.ConvertOptions, folder: Path) -> Iterator[model.PosedPanorama]:
    """Yield the panoramas of all sequences: camera-to-world matrices, axes as of COLMAP."""
    for path in map(options.inside, sorted((folder / QUERIES).glob(f"*/{CAMERA_POSES}"))):
        document = read_json(path, WANTED)
        if not isinstance(document, dict):
            raise InputError(f"{path}: found no object, {WANTED}")
        for file, value in document.items():
            where = f"{path}, {file!r}"
            matrix = model.array_of(where, value, WANTED, (4, 4), (3, 4))
            picture = options.inside(path.parent / "image" / Path(file).name, where)
            name = f"{path.parent.name}_{picture.name}"
            pose = model.pose_of_transform(where, matrix, "optical")
            yield model.PosedPanorama(name, {name: picture}, path.parent.name, pose)


def list_matterport(options: model.ConvertOptions) -> model.SceneList:
    """Return the houses with skyboxes, six faces of a cube at each place, poses and a mesh."""
    patterns = ["*/" * depth + SKYBOXES for depth in range(MAX_DEPTH)]
    specs = []
    notes = []
    missing = []
    for folder in [path.parent for path in _glob(options.folder, patterns)]:
        meshes = next((found for pattern in MESHES if (found := sorted(folder.glob(pattern)))), [])
        if not meshes:
            missing.append(str(folder))
            continue
        places: dict[str, dict[str, Path]] = defaultdict(dict)  # by name below the scene's images/
        for path in sorted((folder / SKYBOXES).iterdir()):
            if match := FACE.match(path.name):
                places[match[1]][f"{match[1]}/{path.name}"] = path
        posed = {
            place: files
            for place, files in places.items()
            if len(files) == 6 and (folder / POSE_FILES.format(place, SKYBOX_YAW)).exists()
        }
        if len(posed) < len(places):
            count = len(places) - len(posed)
            notes.append(f"{folder}: {count} skyboxes without a pose or without six faces")
        parts = tuple(map(model.CloudPart, meshes))
        panoramas = _matterport_panoramas(options, folder, posed)
        specs.append(model.SceneSpec(MATTERPORT, folder.resolve().name, parts, panoramas))
    listed = model.scene_list(options.folder, specs, missing, f"HOUSE/{SKYBOXES} with a mesh")
    return listed._replace(notes=(*listed.notes, *notes))


def _matterport_panoramas(
    options: model.ConvertOptions, folder: Path, places: dict[str, dict[str, Path]]
) -> Iterator[model.PosedPanorama]:
    """Yield the skyboxes: turned as the level camera at one of its stops, in the middle of all of them.

    The camera's axes are right, down, forward; skybox 1 is what our cubes have in front.
    """
    for place, files in places.items():
        paths = [folder / POSE_FILES.format(place, yaw) for yaw in range(6)]
        matrices = {path: model.read_matrix(options.inside(path), 4) for path in paths if path.exists()}
        T_world_from_skybox = matrices[paths[SKYBOX_YAW]].copy()
        T_world_from_skybox[:3, 3] = np.mean([matrix[:3, 3] for matrix in matrices.values()], axis=0)
        pose = model.pose_of_transform(str(paths[SKYBOX_YAW]), T_world_from_skybox, "optical")
        yield model.PosedPanorama(place, files, "skybox", pose)


def list_omniscenes(options: model.ConvertOptions) -> model.SceneList:
    """Return the rooms, each with the panoramas of all splits."""
    pictures: dict[tuple[str, Path], list[Path]] = defaultdict(list)
    for split in _glob(options.folder, PANORAMAS):
        for sequence in sorted(split.iterdir()):
            if match := SEQUENCE.match(sequence.name):
                files = sorted(path for path in sequence.iterdir() if path.suffix.lower() in PICTURES)
                pictures[match[1], split.parent / "pcd" / f"{match[1]}.txt"] += files
    specs = [
        model.SceneSpec(OMNISCENES, room, (model.CloudPart(cloud),), _omniscenes_panoramas(options, files))
        for (room, cloud), files in sorted(pictures.items())
        if cloud.exists()
    ]
    missing = sorted(str(cloud) for _, cloud in pictures if not cloud.exists())
    layout = "SPLIT_pano/HOW_ROOM_N_scene_K with a cloud pcd/ROOM_N.txt"
    return model.scene_list(options.folder, specs, missing, layout)


def _omniscenes_panoramas(
    options: model.ConvertOptions, pictures: list[Path]
) -> Iterator[model.PosedPanorama]:
    """Panoramas with the pose [R_cam_from_world | center_world] of a file of their own, in our own axes."""
    for path in pictures:
        split = path.parents[1]
        variant = split.name.removesuffix("_pano")
        pose_file = split.parent / f"{variant}_pose" / path.parent.name / f"{path.stem}.txt"
        matrix = model.read_matrix(options.inside(pose_file), 3)
        matrix[:, :3] = matrix[:, :3].T.copy()
        pose = model.pose_of_transform(str(pose_file), matrix, "piccolo")
        name = f"{variant}_{path.parent.name}_{path.name}"
        yield model.PosedPanorama(name, {name: path}, variant, pose)


def list_mpo(options: model.ConvertOptions) -> model.SceneList:
    """Each scan with a picture of the same name beside it.

    All true poses are the identity, so each scan and its camera get a random rigid transform: a turn about z
    by U(0, pi) and a shift by U(0, 3) m along each axis, by seed and name.
    """
    files: dict[Path, list[Path]] = defaultdict(list)
    for path in sorted(options.folder.rglob("*")):
        files[path.with_suffix("")].append(path)
    specs = []
    num_alone = 0
    for stem, found in files.items():
        clouds = [path for path in found if model.is_cloud(path)]
        pictures = [path for path in found if path.suffix.lower() in PICTURES]
        picture = min(pictures, key=lambda path: path.suffix.lower() not in (".jpg", ".jpeg"), default=None)
        if not clouds or picture is None:
            num_alone += len(clouds[:1])
            continue
        if len(clouds) > 1:
            raise InputError(f"{clouds[0]}: found {clouds[1].name} beside it; leave one cloud of this name")
        name = stem.relative_to(options.folder).as_posix()
        rng = np.random.default_rng([options.seed, zlib.crc32(name.encode())])
        T = np.eye(4)
        T[:3, :3] = yaw_rotation(rng.uniform(0.0, math.pi)).T
        T[:3, 3] = rng.uniform(0.0, 3.0, 3)
        pose = Pose(np.eye(3), np.zeros(3))  # at the scanner's origin, with the scanner's axes
        panorama = model.PosedPanorama(picture.name, {picture.name: picture}, "moved", pose)
        source: dict[str, object] = {"seed": options.seed}
        specs.append(model.SceneSpec(MPO, name, (model.CloudPart(clouds[0]),), iter([panorama]), T, source))
    if not specs:
        raise InputError(f"{options.folder}: found no cloud with a picture of the same name")
    return model.SceneList(tuple(specs), (f"{num_alone} clouds without a picture",) if num_alone else ())


class Picture(NamedTuple):
    """A panorama and the files that belong to it."""

    path: Path
    part: str  # of the building: 1 to 6, 5a and 5b
    pose: Path
    semantic: Path


def list_stanford(options: model.ConvertOptions) -> model.SceneList:
    """Return the rooms for which there are panoramas and a cloud."""
    table = _read_table(options) if options.labels else None
    specs = []
    missing = []
    for (area, room), pictures in sorted(_stanford_pictures(options.folder).items()):
        if options.areas and area not in options.areas:
            continue
        name = f"area_{area}/{room}"
        if parts := _stanford_cloud(options.folder, area, room, options.labels):
            settings: dict[str, object] = {"labels": options.labels}
            if options.labels:
                settings["label_names"] = ["unknown", *CLASSES]
            panoramas = _stanford_panoramas(options, pictures, table)
            specs.append(model.SceneSpec(STANFORD, name, parts, panoramas, settings=settings))
        else:
            missing.append(name)
    layout = f"room with panoramas ({AREA_PANORAMAS[0]}) and a cloud ({CLOUDS[0]}, with `labels` Annotations)"
    return model.scene_list(options.folder, specs, missing, layout)


def _stanford_pictures(folder: Path) -> dict[tuple[str, str], list[Picture]]:
    """Return the panoramas by area and room; 5a and 5b are both of area 5."""
    pictures: dict[tuple[str, str], list[Picture]] = defaultdict(list)
    for rgb in _glob(folder, AREA_PANORAMAS):
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


def _stanford_cloud(folder: Path, area: str, room: str, has_labels: bool) -> tuple[model.CloudPart, ...]:
    """Return the room's points, one `x y z r g b` a line; with labels, an object a file named by class."""
    found = _glob(folder, [pattern.format(area=area, room=room) for pattern in CLOUDS])
    usable = [path for path in found if not any(ALIGNED in part for part in path.parts)]
    if found and not usable:
        text = f"found a cloud of the {ALIGNED}, whose rooms are rotated one by one"
        raise InputError(f"{found[0]}: {text}, wanted those of Stanford3dDataset_v1.2")
    if not has_labels:
        return tuple(model.CloudPart(path) for path in usable[:1])
    objects = [path for cloud in usable[:1] for path in sorted(cloud.parent.glob("Annotations/*.txt"))]
    return tuple(model.CloudPart(path, NUMBERS.get(path.name.split("_")[0], 0)) for path in objects)


def _stanford_panoramas(
    options: model.ConvertOptions, pictures: list[Picture], table: Uint16s | None
) -> Iterator[model.PosedPanorama]:
    for picture in pictures:
        semantic = options.inside(picture.semantic)
        options.inside(picture.pose)
        read_labels = None if table is None else partial(model.labels_by_index, semantic, table)
        name = picture.path.name
        variant = f"area_{picture.part}"
        yield model.PosedPanorama(name, {name: picture.path}, variant, _read_pose(picture), read_labels)


def _read_pose(picture: Picture) -> Pose:
    """Return the pose in a JSON file: Blender's Euler angles of a camera that looks along -z, y up.

    R_world_from_opengl = R_z(c) R_y(b) R_x(a) with final_camera_rotation = (a, b, c) [rad].
    """
    document = read_json(picture.pose, WANTED_POSE)
    names = ("final_camera_rotation", "camera_location")
    if not isinstance(document, dict) or not all(name in document for name in names):
        raise InputError(f"{picture.pose}: found no {' and '.join(names)}, {WANTED_POSE}")
    angles, center_world = (
        model.array_of(f"{picture.pose}, {name}", document[name], "wanted three numbers", (3,))
        for name in names
    )
    R_world_from_opengl = Rotation.from_euler("xyz", angles).as_matrix()  # about fixed axes, x first
    T = np.column_stack([R_world_from_opengl, center_world])
    pose = model.pose_of_transform(str(picture.pose), T, "opengl")
    return move(pose, T_SCAN_FROM_5B, 1.0) if picture.part == "5b" else pose


def _read_table(options: model.ConvertOptions) -> Uint16s:
    """Return the class of each index in the semantic pictures."""
    found = _glob(options.folder, LABEL_FILES)
    if not found:
        wanted = "wanted the names of the semantic indices"
        raise InputError(f"{options.folder}: found no {LABEL_FILES[1]}, {wanted}")
    names = read_json(options.inside(found[0]), "wanted a list of names")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise InputError(f"{found[0]}: found {json.dumps(names)[:60]}, wanted a list of names")
    return np.array([NUMBERS.get(name.split("_")[0], 0) for name in names], dtype=np.uint16)
