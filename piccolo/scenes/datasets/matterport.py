"""Matterport3D (Chang et al., 3DV 2017): houses with a skybox, six faces of a cube, at each place."""

import re
from collections import defaultdict
from functools import partial
from pathlib import Path

import numpy as np

from .files import WORLD_FROM_CAM, pose_of_transform, read_matrix
from .model import CloudPart, ConvertOptions, PosedPanorama, SceneList, SceneSpec, scene_list

NAME = "matterport3d"
SKYBOXES, POSES = "matterport_skybox_images", "matterport_camera_poses"
MAX_DEPTH = 5  # v1/scans/HOUSE/HOUSE/matterport_skybox_images
FACE = re.compile(r"([0-9a-f]+)_skybox([0-5])_sami\.jpg$")
NUM_FACES, NUM_YAWS = 6, 6
LEVEL_CAMERA = 1  # of the three on the tripod; 0 looks up, 2 down
SKYBOX_YAW = 5  # the stop at which that camera looks through the middle of skybox 1
# House by house the first of these that is there. Coloured vertices come first: they are quick to read.
MESHES = ("house_segmentations/*.ply", "region_segmentations/region*.ply", "matterport_mesh/**/*.obj")
VARIANT = "skybox"


def list_scenes(options: ConvertOptions) -> SceneList:
    """The houses with skyboxes, poses and a mesh."""
    patterns = ["*/" * depth + SKYBOXES for depth in range(MAX_DEPTH)]
    folders = [path.parent for pattern in patterns for path in sorted(options.folder.glob(pattern))]
    specs, notes, missing = [], [], []
    for folder in folders:
        meshes = next((found for pattern in MESHES if (found := sorted(folder.glob(pattern)))), [])
        if not meshes:
            missing.append(str(folder))
            continue
        faces = _faces_in(folder / SKYBOXES)
        whole = [place for place, files in faces.items() if len(files) == NUM_FACES]
        posed = {place: faces[place] for place in whole if _pose_file(folder, place, SKYBOX_YAW).exists()}
        if len(posed) < len(faces):
            notes.append(f"{folder}: {len(faces) - len(posed)} skyboxes without a pose or without six faces")
        read_panoramas = partial(_posed_panoramas, options, folder, posed)
        parts = tuple(map(CloudPart, meshes))
        specs.append(SceneSpec(folder.resolve().name, parts, read_panoramas, source={"dataset": NAME}))
    listed = scene_list(options.folder, specs, missing, f"HOUSE/{SKYBOXES} with a mesh")
    return listed._replace(notes=(*listed.notes, *notes))


def _faces_in(folder: Path) -> dict[str, dict[str, Path]]:
    """The faces by place, each under its name in the scene's images/."""
    faces: dict[str, dict[str, Path]] = defaultdict(dict)
    for path in sorted(folder.iterdir()):
        if match := FACE.match(path.name):
            faces[match[1]][f"{match[1]}/{path.name}"] = path
    return faces


def _pose_file(folder: Path, place: str, yaw: int) -> Path:
    return folder / POSES / f"{place}_pose_{LEVEL_CAMERA}_{yaw}.txt"


def _posed_panoramas(
    options: ConvertOptions, folder: Path, faces: dict[str, dict[str, Path]]
) -> list[PosedPanorama]:
    return [_posed_panorama(options, folder, place, files) for place, files in faces.items()]


def _posed_panorama(
    options: ConvertOptions, folder: Path, place: str, files: dict[str, Path]
) -> PosedPanorama:
    """The skybox of a place: turned as the level camera at one of its stops, in the middle of all of them.

    The camera's axes are right, down, forward; skybox 1 is what our cubes have in front.
    """
    paths = [_pose_file(folder, place, yaw) for yaw in range(NUM_YAWS)]
    matrices = {path: read_matrix(options.inside(path), 4) for path in paths if path.exists()}
    T_world_from_skybox = matrices[paths[SKYBOX_YAW]].copy()
    T_world_from_skybox[:3, 3] = np.mean([matrix[:3, 3] for matrix in matrices.values()], axis=0)
    pose = pose_of_transform(str(paths[SKYBOX_YAW]), T_world_from_skybox, WORLD_FROM_CAM, "optical")
    return PosedPanorama(place, files, VARIANT, pose)
