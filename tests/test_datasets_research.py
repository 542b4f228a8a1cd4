"""Data sets of papers, made up from their documentation: folders, poses, and what is refused."""

import json
import shutil
from pathlib import Path

import dataset_rooms as made
import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from piccolo.cloud.writers import vertex_rows
from research.scene import read_scene

pytestmark = pytest.mark.research

# 360loc
SEQUENCES = ("daytime_360_1", "nighttime_360_2")


@pytest.fixture
def loc360(tmp_path):
    root = tmp_path / "360 loc"
    made.write_text_cloud(root / "atrium" / "cloud.txt", *made.points_and_colors())
    for sequence, (R_world_from_cam, center) in zip(SEQUENCES, made.cameras(), strict=True):
        folder = root / "atrium" / "query_360" / sequence
        rgb, _ = made.picture(R_world_from_cam, center, made.OPTICAL)
        made.write_picture(folder / "image" / "000001.jpg", rgb)
        T_world_from_cam = np.vstack([np.column_stack([R_world_from_cam, center]), [0, 0, 0, 1]])
        (folder / "camera_pose.json").write_text(json.dumps({"000001.jpg": T_world_from_cam.tolist()}))
    (root / "hall" / "query_360").mkdir(parents=True)
    return root


def test_poses_fit_and_sequences_are_variants_of_loc360(loc360, tmp_path, capsys):
    code, (line,), err = made.run(capsys, "360loc", loc360, tmp_path / "out", "--check", 2, "--copy")
    assert (code, err, line["scene"], line["fits"]) == (0, "", "atrium", True)
    scene = made.assert_fits(tmp_path / "out" / "atrium")
    assert [query.variant for query in scene.queries] == list(SEQUENCES)
    code, (line,), _ = made.run(capsys, "360loc", loc360 / "atrium", tmp_path / "out2")
    assert (code, line["scene"]) == (0, "atrium")


def test_damaged_poses_and_clouds_that_are_not_one_are_refused_of_loc360(loc360, tmp_path, capsys):
    where = capsys, "360loc", loc360, tmp_path / "out"
    path = loc360 / "atrium" / "query_360" / SEQUENCES[0] / "camera_pose.json"
    for document, message in (
        ([1], "found no object"),
        ({"a.jpg": [[1, 0], [0, 1]]}, "found the shape (2, 2)"),
        ({"a.jpg": [[1, 0], [0]]}, "wanted JSON"),
        ({"a.jpg": np.eye(4).tolist()}, "no such panorama"),
    ):
        path.write_text(json.dumps(document))
        made.assert_refused(message, *where)
    cloud = loc360 / "atrium" / "cloud.txt"
    cloud.with_suffix(".xyz").write_bytes(cloud.read_bytes())
    made.assert_refused("found the clouds cloud.txt, cloud.xyz", *where)
    cloud.unlink()
    cloud.with_suffix(".xyz").unlink()
    made.assert_refused("and a coloured cloud beside query_360", *where)


# matterport
HOUSE = "17DRP5sb8fy"
SIZE = 128  # of a face [px]
RADIUS = 0.02  # of the circle on which the level camera goes around the tripod [m]
# forward, right and up of each face's picture in the axes of the camera at yaw 5: x right, y down, z forward
FACES = {
    0: ([0, -1, 0], [1, 0, 0], [0, 0, -1]),
    1: ([0, 0, 1], [1, 0, 0], [0, -1, 0]),
    2: ([1, 0, 0], [0, 0, -1], [0, -1, 0]),
    3: ([0, 0, -1], [-1, 0, 0], [0, -1, 0]),
    4: ([-1, 0, 0], [0, 0, 1], [0, -1, 0]),
    5: ([0, 1, 0], [1, 0, 0], [0, 0, 1]),
}


def write_skybox(folder, place, R_world_from_cam5, center):
    """Six faces seen from the centre, and the level camera's poses around it."""
    across = (np.arange(SIZE) + 0.5) * 2 / SIZE - 1
    for number, axes in FACES.items():
        forward, right, up = np.array(axes, float)
        rays = forward + across[None, :, None] * right - across[:, None, None] * up
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        rgb, _ = made.look(rays @ R_world_from_cam5.T, center)
        made.write_picture(folder / "matterport_skybox_images" / f"{place}_skybox{number}_sami.jpg", rgb)
    for yaw in range(6):
        angle = np.radians(60.0) * (yaw - 5)  # clockwise from stop to stop: about y, which points down
        c = np.cos(angle)
        s = np.sin(angle)
        R_world_from_cam = R_world_from_cam5 @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        position = center + RADIUS * R_world_from_cam[:, 2]
        T = np.vstack([np.column_stack([R_world_from_cam, position]), [0, 0, 0, 1]])
        path = folder / "matterport_camera_poses" / f"{place}_pose_1_{yaw}.txt"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savetxt(path, T)


def write_mesh(path):
    """The room's points as triangles 2 cm wide, in the points' colours."""
    points, colors = made.points_and_colors()
    corners = np.repeat(points, 3, axis=0)
    corners += np.tile([[0.01, 0.0, 0.0], [-0.01, 0.0, 0.0], [0.0, 0.012, 0.012]], (len(points), 1))
    vertices = vertex_rows(corners.astype(np.float32), np.repeat(colors, 3, axis=0))
    faces = np.empty(len(points), [("vertex_indices", "i4", 3)])
    faces["vertex_indices"] = np.arange(len(corners)).reshape(-1, 3)
    path.parent.mkdir(parents=True)
    PlyData([PlyElement.describe(vertices, "vertex"), PlyElement.describe(faces, "face")]).write(path)


@pytest.fixture
def matterport(tmp_path):
    root = tmp_path / "mp 3d"
    folder = root / "v1" / "scans" / HOUSE / HOUSE
    for k, camera in enumerate(made.cameras()):
        write_skybox(folder, f"{k:032x}", *camera)
    write_mesh(folder / "house_segmentations" / f"{HOUSE}.ply")
    return root


def test_skyboxes_fit_of_matterport(matterport, tmp_path, capsys):
    code, (line,), err = made.run(capsys, "matterport3d", matterport, tmp_path / "out", "--check", 2)
    assert (code, err) == (0, "")
    assert (line["scene"], line["queries"], line["fits"]) == (HOUSE, 2, True)
    scene = made.assert_fits(tmp_path / "out" / HOUSE, max_loss=0.16)
    for query, (_, center) in zip(scene.queries, made.cameras(), strict=True):
        assert query.image.is_dir()
        np.testing.assert_allclose(query.pose.center_world, center, atol=1e-6)


def test_skyboxes_without_a_pose_are_left_out_and_damage_is_refused_of_matterport(
    matterport, tmp_path, capsys
):
    def refuse(message):
        made.assert_refused(message, capsys, "matterport3d", matterport, tmp_path / "out2")

    first, second = sorted(matterport.rglob("*_pose_1_5.txt"))
    first.unlink()
    code, (line,), _ = made.run(capsys, "matterport3d", matterport, tmp_path / "out")
    assert (code, line["queries"]) == (0, 1)
    second.write_text("1 0 0")
    refuse(f"{second}: found the shape (3,), wanted 4 x 4 numbers")
    folder = matterport / "v1" / "scans" / HOUSE / HOUSE
    shutil.copytree(folder, matterport / HOUSE)
    refuse(f"the scene {HOUSE} twice")
    shutil.rmtree(matterport / HOUSE)
    next(matterport.rglob("*.ply")).unlink()
    refuse("with a mesh")


# mpo
@pytest.fixture
def mpo(tmp_path):
    root = tmp_path / "mpo data"
    points, colors = made.points_and_colors()
    for k, (_, center) in enumerate(made.cameras()):
        made.write_text_cloud(root / "coast" / f"set {k}.xyz", points - center, colors)
        rgb, _ = made.picture(np.eye(3), center, made.FORWARD_LEFT_UP)
        made.write_picture(root / "coast" / f"set {k}.png", rgb)
    made.write_text_cloud(root / "coast" / "alone.xyz", points, colors)
    return root


def mpo_poses(out):
    return [read_scene(out / "coast" / f"set {k}").queries[0].pose for k in range(2)]


def test_cloud_and_camera_are_moved_together_of_mpo(mpo, tmp_path, capsys):
    code, lines, err = made.run(capsys, "mpo", mpo, tmp_path / "out", "--check", 1)
    assert (code, err) == (0, "")
    assert [line["scene"] for line in lines] == ["coast/set 0", "coast/set 1"]
    for line in lines:
        made.assert_fits(Path(line["folder"]))
    for pose in mpo_poses(tmp_path / "out"):
        R_world_from_cam = pose.R_cam_from_world.T
        yaw = np.arctan2(R_world_from_cam[1, 0], R_world_from_cam[0, 0])
        assert 0.0 < yaw < np.pi
        np.testing.assert_allclose(R_world_from_cam[2], [0, 0, 1], atol=1e-12)
        assert np.all((pose.center_world > 0.0) & (pose.center_world < 3.0))


def test_equal_seeds_move_equally_whatever_else_there_is_of_mpo(mpo, tmp_path, capsys):
    first, second = tmp_path / "1", tmp_path / "2"
    made.run(capsys, "mpo", mpo, first, "--seed", 4)
    made.run(capsys, "mpo", mpo, second, "--seed", 4, "--rooms", "set 1")
    other = read_scene(second / "coast" / "set 1").queries[0].pose
    assert np.array_equal(mpo_poses(first)[1].center_world, other.center_world)
    assert not np.array_equal(mpo_poses(first)[0].center_world, other.center_world)
    made.run(capsys, "mpo", mpo, tmp_path / "3")
    assert not np.array_equal(mpo_poses(tmp_path / "3")[1].center_world, other.center_world)


def test_refusals_of_mpo(mpo, tmp_path, capsys):
    assert made.run(capsys, "mpo", mpo, tmp_path / "out", "--seed", -1)[0] == 2
    made.run(capsys, "mpo", mpo, tmp_path / "out", "--seed", 4)
    made.assert_refused('"seed": 4', capsys, "mpo", mpo, tmp_path / "out", "--seed", 5)
    (mpo / "coast" / "set 0.pts").write_text("1\n0 0 0 0 1 1 1\n")
    made.assert_refused("leave one cloud of this name", capsys, "mpo", mpo, tmp_path / "out2")
    made.assert_refused("with a picture of the same name", capsys, "mpo", tmp_path / "out", tmp_path / "3")


# omniscenes
PLACES = (
    ("turtlebot", "turtlebot_weddingHall_1_scene_1", "img_0001.jpg"),
    ("change_handheld", "handheld_weddingHall_1_scene_2", "img_0001.jpg"),
)


@pytest.fixture
def omniscenes(tmp_path):
    root = tmp_path / "omni scenes"
    made.write_text_cloud(root / "pcd" / "weddingHall_1.txt", *made.points_and_colors())
    for (split, sequence, name), (R_world_from_cam, center) in zip(PLACES, made.cameras(), strict=True):
        rgb, _ = made.picture(R_world_from_cam, center, made.FORWARD_LEFT_UP)
        made.write_picture(root / f"{split}_pano" / sequence / name, rgb)
        pose = root / f"{split}_pose" / sequence / name.replace(".jpg", ".txt")
        pose.parent.mkdir(parents=True)
        np.savetxt(pose, np.column_stack([R_world_from_cam.T, center]))
    return root


def test_poses_fit_and_splits_are_variants_of_omniscenes(omniscenes, tmp_path, capsys):
    code, (line,), err = made.run(capsys, "omniscenes", omniscenes, tmp_path / "out", "--check", 5)
    assert (code, err) == (0, "")
    assert (line["scene"], line["queries"], line["fits"]) == ("weddingHall_1", 2, True)
    scene = made.assert_fits(tmp_path / "out" / "weddingHall_1")
    assert sorted(query.variant for query in scene.queries) == ["change_handheld", "turtlebot"]
    assert len({query.image.name for query in scene.queries}) == 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 0 0 0\n0 1 0 0\n", "found the shape (8,), wanted 3 x 4 numbers"),
        ("1 0 0 0\n0 1 0 0\n0 0 1 x\n", "could not convert"),
        ("1 0 0 0\n0 1 0 0\n0 0 -1 0\n", "found a matrix that is no rotation"),
    ],
)
def test_damaged_poses_are_refused_of_omniscenes(omniscenes, tmp_path, capsys, text, message):
    path = omniscenes / "turtlebot_pose" / PLACES[0][1] / "img_0001.txt"
    path.write_text(text)
    where = capsys, "omniscenes", omniscenes, tmp_path / "out"
    made.assert_refused(f"{path}: ", *where)
    made.assert_refused(message, *where)
    path.unlink()
    made.assert_refused("No such file", *where)
    (omniscenes / "pcd" / "weddingHall_1.txt").unlink()
    made.assert_refused("with a cloud pcd/ROOM_N.txt", *where)
