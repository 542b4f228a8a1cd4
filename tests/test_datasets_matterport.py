"""Matterport3D: skyboxes rendered by hand around the level camera's last stop, a mesh of small triangles."""

import shutil

import dataset_rooms as made
import numpy as np
import pytest

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
        c, s = np.cos(angle), np.sin(angle)
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
    vertices = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
    rows = np.empty(len(corners), vertices)
    for k, name in enumerate("xyz"):
        rows[name] = corners[:, k]
    for k, name in enumerate(("red", "green", "blue")):
        rows[name] = np.repeat(colors[:, k], 3)
    faces = np.empty(len(points), [("n", "u1"), ("corners", "<i4", 3)])
    faces["n"], faces["corners"] = 3, np.arange(len(corners)).reshape(-1, 3)
    types = "".join(f"property {'float' if kind == '<f4' else 'uchar'} {name}\n" for name, kind in vertices)
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(corners)}\n{types}"
    head += f"element face {len(points)}\nproperty list uchar int vertex_indices\nend_header\n"
    path.parent.mkdir(parents=True)
    path.write_bytes(head.encode() + rows.tobytes() + faces.tobytes())


@pytest.fixture
def dataset(tmp_path):
    root = tmp_path / "mp 3d"
    folder = root / "v1" / "scans" / HOUSE / HOUSE
    for k, camera in enumerate(made.cameras()):
        write_skybox(folder, f"{k:032x}", *camera)
    write_mesh(folder / "house_segmentations" / f"{HOUSE}.ply")
    return root


def test_skyboxes_fit(dataset, tmp_path, capsys):
    code, (line,), err = made.run(capsys, "matterport3d", dataset, tmp_path / "out", "--check", 2)
    assert (code, err) == (0, "")
    assert (line["scene"], line["queries"], line["fits"]) == (HOUSE, 2, True)
    scene = made.assert_fits(tmp_path / "out" / HOUSE, max_loss=0.16)
    for query, (_, center) in zip(scene.queries, made.cameras(), strict=True):
        assert query.image.is_dir()
        np.testing.assert_allclose(query.pose.center_world, center, atol=1e-6)


def test_skyboxes_without_a_pose_are_left_out(dataset, tmp_path, capsys):
    next(dataset.rglob("*_pose_1_5.txt")).unlink()
    code, (line,), _ = made.run(capsys, "matterport3d", dataset, tmp_path / "out")
    assert (code, line["queries"]) == (0, 1)


def test_damaged_files_are_refused(dataset, tmp_path, capsys):
    path = next(dataset.rglob("*_pose_1_2.txt"))
    path.write_text("1 0 0")
    message = f"{path}: found 3 numbers, wanted 4 x 4 numbers"
    made.assert_refused(message, capsys, "matterport3d", dataset, tmp_path / "out")
    next(dataset.rglob("*.ply")).unlink()
    made.assert_refused("with a mesh", capsys, "matterport3d", dataset, tmp_path / "out")


def test_a_house_that_is_there_twice_is_refused(dataset, tmp_path, capsys):
    shutil.copytree(dataset / "v1" / "scans" / HOUSE / HOUSE, dataset / HOUSE)
    made.assert_refused(f"the scene {HOUSE} twice", capsys, "matterport3d", dataset, tmp_path / "out")
