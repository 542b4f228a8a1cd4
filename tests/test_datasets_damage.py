"""Damaged files of poses: read or refused in one line that names them, and nothing else."""

import json

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from poses import jpeg
from refusals import mutated, read_or_refused

from research.datasets.convert_dataset import list_scenes
from research.datasets.model import ConvertOptions

T = np.eye(4)[[1, 2, 0, 3]]
STEM = "camera_00_office_1_frame_equirectangular_domain"
ROW = {
    "image": "a.jpg", "tx": "1.5", "ty": 2, "tz": 3, "qw": 0.5, "qx": 0.5, "qy": 0.5, "qz": 0.5,
    "direction": "world_from_cam", "axes": "optical", "room": "r",
}  # fmt: skip
CSV = f"{','.join(ROW)}\n{','.join(map(str, ROW.values()))}\n"
SKYBOX = "house/matterport_skybox_images/ab_skybox"
# by dataset: the file of poses, its content, and what else must be there
FILES = {
    "stanford2d3ds": (
        f"area_1/pano/pose/{STEM}_pose.json",
        '{"camera_location": [1.5, 2.0, 1.0], "final_camera_rotation": [1.5, 0.1, -2.0]}',
        (f"area_1/pano/rgb/{STEM}_rgb.png", "Area_1/office_1/office_1.txt"),
    ),
    "omniscenes": (
        "a_pose/b_hall_1_scene_1/c.txt",
        "0 1 0 1.5\n0 0 1 2\n1 0 0 3\n",
        ("a_pano/b_hall_1_scene_1/c.jpg", "pcd/hall_1.txt"),
    ),
    "360loc": (
        "hall/query_360/s/camera_pose.json",
        json.dumps({"a.jpg": T.tolist()}),
        ["hall/cloud.xyz"],
    ),
    "matterport3d": (
        "house/matterport_camera_poses/ab_pose_1_5.txt",
        "\n".join(" ".join(map(str, row)) for row in T),
        ("house/house_segmentations/house.ply", *(f"{SKYBOX}{k}_sami.jpg" for k in range(6))),
    ),
    "generic": ("poses.csv", CSV, ("cloud.xyz",)),
    "generic json": ("poses.json", json.dumps([ROW]), ("cloud.xyz",)),
    "generic tum": ("poses.txt", "1.5 1 2 3 0 0 0 1\n2.5 1 2 3 0 0 1 0\n", ("cloud.xyz", "images/1.5.jpg")),
}  # fmt: skip


def read_poses(name, folder):
    options = ConvertOptions(folder, axes="optical" if name == "generic tum" else None)
    listed = list_scenes(name.split()[0], options)
    return [panorama.pose for spec in listed.specs for panorama in spec.panoramas]


@pytest.fixture(scope="module", params=FILES)
def dataset(request, tmp_path_factory):
    """Name, folder, path of the poses and their whole content."""
    folder = tmp_path_factory.mktemp("data set")
    name, content, others = FILES[request.param]
    for other in (name, *others):
        (folder / other).parent.mkdir(parents=True, exist_ok=True)
        jpeg(folder / other)
    (folder / name).write_text(content)
    return request.param, folder, folder / name, content.encode()


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_files_are_read_or_refused(dataset, data):
    name, folder, path, content = dataset
    path.write_bytes(mutated(data.draw, st.integers, content))
    poses, _ = read_or_refused(lambda _: read_poses(name, folder), path)
    for pose in poses or []:
        assert np.isfinite(pose.center_world).all()
        assert np.linalg.det(pose.R_cam_from_world) == pytest.approx(1.0)


def test_a_link_out_of_the_folder_is_refused_and_one_within_followed(dataset, tmp_path):
    name, folder, path, content = dataset
    path.write_bytes(content)
    root, outside = tmp_path / "root", tmp_path / "outside"
    root.symlink_to(folder)  # may be a link itself
    for file in sorted(file for file in folder.rglob("*") if file.is_file()):
        for target, is_within in ((folder / "kept", True), (outside, False)):
            file.rename(target)
            file.symlink_to(target)
            try:
                poses, message = read_or_refused(lambda _: read_poses(name, root), file.name)
            finally:
                target.rename(file)
            assert len(poses or ()) == is_within, file
            assert is_within or f"leads to {outside}, out of" in message


@pytest.mark.parametrize("number", ["1e999", "1" + "0" * 400, "9" * 5000, "NaN", "[[[[]]]]", "null", '"x"'])
def test_odd_numbers_are_refused(dataset, number):
    name, folder, path, content = dataset
    token = {"generic tum": " 1 ", "matterport3d": "1.0", "360loc": "1.0"}.get(name, "1.5")
    path.write_text(content.decode().replace(token, token.replace(token.strip(), number), 1))
    assert read_or_refused(lambda _: read_poses(name, folder), path)[1]
