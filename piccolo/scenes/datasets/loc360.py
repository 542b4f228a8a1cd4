"""360Loc (Huang et al., CVPR 2024): halls with 360-degree queries by day and by night."""

from pathlib import Path

import numpy as np

from ...errors import InputError
from .clouds import only_cloud_in
from .model import CloudPart, Listing, Plan, Request, Shot
from .poses import WORLD_FROM_CAM, pose_of_transform, read_json

NAME = "360loc"
QUERIES, POSES, PICTURES = "query_360", "camera_pose.json", "image"
WANTED = 'wanted JSON {"NAME.jpg": a matrix of 4 x 4 numbers}'


def listing(request: Request) -> Listing:
    """The scenes that have 360-degree queries, and a cloud that the user put there."""
    below = (request.folder, *sorted(request.folder.glob("*")))
    folders = [path for path in below if (path / QUERIES).is_dir()]
    clouds = {folder: only_cloud_in(folder) for folder in folders}
    plans = [_plan(folder, cloud) for folder, cloud in clouds.items() if cloud]
    if not plans:
        raise InputError(
            f"{request.folder}: found no scene with {QUERIES}/SEQUENCE/{POSES} and a coloured cloud beside "
            f"{QUERIES}, wanted the layout in docs/DATASETS.md"
        )
    missing = [folder.name for folder, cloud in clouds.items() if not cloud]
    notes = (f"{len(missing)} scenes without a cloud: {', '.join(missing)}",) if missing else ()
    return Listing(tuple(plans), notes)


def _plan(folder: Path, cloud: Path) -> Plan:
    def read_shots() -> list[Shot]:
        return [shot for path in sorted((folder / QUERIES).glob(f"*/{POSES}")) for shot in _shots(path)]

    return Plan(folder.resolve().name, (CloudPart(cloud),), read_shots, source={"dataset": NAME})


def _shots(path: Path) -> list[Shot]:
    """The panoramas of a sequence: camera-to-world matrices, axes as of COLMAP."""
    document = read_json(path, WANTED)
    if not isinstance(document, dict):
        raise InputError(f"{path}: found no object, {WANTED}")
    shots = []
    for file, value in document.items():
        where = f"{path}, {file}"
        try:
            matrix = np.array(value, dtype=np.float64)
        except (OverflowError, TypeError, ValueError) as error:
            raise InputError(f"{where}: found {error}, {WANTED}") from error
        if matrix.shape not in ((4, 4), (3, 4)):
            raise InputError(f"{where}: found the shape {matrix.shape}, {WANTED}")
        picture = path.parent / PICTURES / Path(file).name
        name = f"{path.parent.name}_{picture.name}"
        pose = pose_of_transform(where, matrix, WORLD_FROM_CAM, "optical")
        shots.append(Shot(name, {name: picture}, path.parent.name, pose))
    return shots
