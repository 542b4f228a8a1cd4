"""360Loc (Huang et al., CVPR 2024): halls with 360-degree queries by day and by night."""

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from ...errors import InputError
from ...files.json_file import read_json
from .files import WORLD_FROM_CAM, only_cloud_in, pose_of_transform
from .model import CloudPart, ConvertOptions, PosedPanorama, SceneList, SceneSpec, scene_list

NAME = "360loc"
QUERIES, POSES, PICTURES = "query_360", "camera_pose.json", "image"
WANTED = 'wanted JSON {"NAME.jpg": a matrix of 4 x 4 numbers}'


def list_scenes(options: ConvertOptions) -> SceneList:
    """The scenes that have 360-degree queries, and a cloud that the user put there."""
    below = (options.folder, *sorted(options.folder.glob("*")))
    folders = [path for path in below if (path / QUERIES).is_dir()]
    clouds = {folder: only_cloud_in(folder) for folder in folders}
    specs = [
        SceneSpec(
            folder.resolve().name,
            (CloudPart(cloud),),
            partial(_panoramas, options, folder),
            source={"dataset": NAME},
        )
        for folder, cloud in clouds.items()
        if cloud
    ]
    missing = [folder.name for folder, cloud in clouds.items() if not cloud]
    layout = f"scene with {QUERIES}/SEQUENCE/{POSES} and a coloured cloud beside {QUERIES}"
    return scene_list(options.folder, specs, missing, layout)


def _panoramas(options: ConvertOptions, folder: Path) -> list[PosedPanorama]:
    paths = map(options.inside, sorted((folder / QUERIES).glob(f"*/{POSES}")))
    return [each for path in paths for each in _sequence(path, options)]


def _sequence(path: Path, options: ConvertOptions) -> Iterator[PosedPanorama]:
    """The panoramas of a sequence: camera-to-world matrices, axes as of COLMAP."""
    document = read_json(path, WANTED)
    if not isinstance(document, dict):
        raise InputError(f"{path}: found no object, {WANTED}")
    for file, value in document.items():
        where = f"{path}, {file!r}"
        try:
            matrix = np.array(value, dtype=np.float64)
        except (OverflowError, TypeError, ValueError) as error:
            raise InputError(f"{where}: found {error}, {WANTED}") from error
        if matrix.shape not in ((4, 4), (3, 4)):
            raise InputError(f"{where}: found the shape {matrix.shape}, {WANTED}")
        picture = options.inside(path.parent / PICTURES / Path(file).name, where)
        name = f"{path.parent.name}_{picture.name}"
        pose = pose_of_transform(where, matrix, WORLD_FROM_CAM, "optical")
        yield PosedPanorama(name, {name: picture}, path.parent.name, pose)
