"""OmniScenes (Kim et al., PICCOLO, ICCV 2021): rooms filmed by hand and by a robot, some changed since."""

import re
from collections import defaultdict
from pathlib import Path

from .files import checked_pose, read_matrix
from .model import CloudPart, ConvertOptions, PosedPanorama, SceneList, SceneSpec, scene_list

NAME = "omniscenes"
PANORAMAS = ("*_pano", "*/*_pano")  # change_handheld_pano, turtlebot_pano ...
SEQUENCE = re.compile(r"[A-Za-z]+_([A-Za-z]+_\d+)_scene_\d+$")  # handheld_weddingHall_1_scene_2
SUFFIXES = (".jpg", ".jpeg", ".png")


def list_scenes(options: ConvertOptions) -> SceneList:
    """The rooms, each with the panoramas of all splits."""
    pictures: dict[tuple[Path, str], list[Path]] = defaultdict(list)
    for split in [path for pattern in PANORAMAS for path in sorted(options.folder.glob(pattern))]:
        for sequence in sorted(split.iterdir()):
            if match := SEQUENCE.match(sequence.name):
                files = sorted(path for path in sequence.iterdir() if path.suffix.lower() in SUFFIXES)
                pictures[split.parent / "pcd" / f"{match[1]}.txt", match[1]] += files
    specs = [
        _scene_spec(options, room, cloud, files)
        for (cloud, room), files in pictures.items()
        if cloud.exists()
    ]
    missing = sorted(str(cloud) for cloud, _ in pictures if not cloud.exists())
    layout = "SPLIT_pano/HOW_ROOM_N_scene_K with a cloud pcd/ROOM_N.txt"
    return scene_list(options.folder, sorted(specs, key=lambda spec: spec.name), missing, layout)


def _scene_spec(options: ConvertOptions, room: str, cloud: Path, pictures: list[Path]) -> SceneSpec:
    def read_panoramas() -> list[PosedPanorama]:
        return [_posed_panorama(options, path) for path in pictures]

    return SceneSpec(room, (CloudPart(cloud),), read_panoramas, source={"dataset": NAME})


def _posed_panorama(options: ConvertOptions, path: Path) -> PosedPanorama:
    """A panorama with the pose [R_cam_from_world | center_world] beside it, in our own axes."""
    split = path.parents[1]
    variant = split.name.removesuffix("_pano")
    pose_file = split.parent / f"{variant}_pose" / path.parent.name / f"{path.stem}.txt"
    matrix = read_matrix(options.inside(pose_file), 3)
    pose = checked_pose(str(pose_file), matrix[:, :3], matrix[:, 3], "piccolo")
    name = f"{variant}_{path.parent.name}_{path.name}"
    return PosedPanorama(name, {name: path}, variant, pose)
