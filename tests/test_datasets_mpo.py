"""MPO: scans with the camera at their origin, moved at random."""

from pathlib import Path

import dataset_rooms as made
import numpy as np
import pytest

from piccolo.scenes.scene import read_scene


@pytest.fixture
def dataset(tmp_path):
    root = tmp_path / "mpo data"
    points, colors = made.points_and_colors()
    for k, (_, center) in enumerate(made.cameras()):
        made.write_text_cloud(root / "coast" / f"set {k}.xyz", points - center, colors)
        rgb, _ = made.picture(np.eye(3), center, made.FORWARD_LEFT_UP)
        made.write_picture(root / "coast" / f"set {k}.png", rgb)
    made.write_text_cloud(root / "coast" / "alone.xyz", points, colors)
    return root


def poses(out):
    return [read_scene(out / "coast" / f"set {k}").queries[0].pose for k in range(2)]


def test_cloud_and_camera_are_moved_together(dataset, tmp_path, capsys):
    code, lines, err = made.run(capsys, "mpo", dataset, tmp_path / "out", "--check", 1)
    assert (code, err) == (0, "")
    assert [line["scene"] for line in lines] == ["coast/set 0", "coast/set 1"]
    for line in lines:
        made.assert_fits(Path(line["folder"]))
    for pose in poses(tmp_path / "out"):
        R_world_from_cam = pose.R_cam_from_world.T
        yaw = np.arctan2(R_world_from_cam[1, 0], R_world_from_cam[0, 0])
        assert 0.0 < yaw < np.pi
        np.testing.assert_allclose(R_world_from_cam[2], [0, 0, 1], atol=1e-12)
        assert np.all((pose.center_world > 0.0) & (pose.center_world < 3.0))


def test_equal_seeds_move_equally_whatever_else_there_is(dataset, tmp_path, capsys):
    first, second = tmp_path / "1", tmp_path / "2"
    made.run(capsys, "mpo", dataset, first, "--seed", 4)
    made.run(capsys, "mpo", dataset, second, "--seed", 4, "--rooms", "set 1")
    other = read_scene(second / "coast" / "set 1").queries[0].pose
    assert np.array_equal(poses(first)[1].center_world, other.center_world)
    assert not np.array_equal(poses(first)[0].center_world, other.center_world)
    made.run(capsys, "mpo", dataset, tmp_path / "3")
    assert not np.array_equal(poses(tmp_path / "3")[1].center_world, other.center_world)


def test_refusals(dataset, tmp_path, capsys):
    assert made.run(capsys, "mpo", dataset, tmp_path / "out", "--seed", -1)[0] == 2
    made.run(capsys, "mpo", dataset, tmp_path / "out", "--seed", 4)
    code, _, err = made.run(capsys, "mpo", dataset, tmp_path / "out", "--seed", 5)
    assert code == 3
    assert '"seed": 4' in err
    (dataset / "coast" / "set 0.pts").write_text("1\n0 0 0 0 1 1 1\n")
    made.assert_refused("leave one cloud of this name", capsys, "mpo", dataset, tmp_path / "out2")
    code, _, err = made.run(capsys, "mpo", tmp_path / "out", tmp_path / "out3")
    assert "with a picture of the same name" in err
