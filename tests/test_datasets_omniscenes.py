"""OmniScenes: its folders, and poses by its authors' x_cam = R (x - t)."""

import dataset_rooms as made
import numpy as np
import pytest

PLACES = (
    ("turtlebot", "turtlebot_weddingHall_1_scene_1", "img_0001.jpg"),
    ("change_handheld", "handheld_weddingHall_1_scene_2", "img_0001.jpg"),
)


@pytest.fixture
def dataset(tmp_path):
    root = tmp_path / "omni scenes"
    made.write_text_cloud(root / "pcd" / "weddingHall_1.txt", *made.points_and_colors())
    for (split, sequence, name), (R_world_from_cam, center) in zip(PLACES, made.cameras(), strict=True):
        rgb, _ = made.picture(R_world_from_cam, center, made.FORWARD_LEFT_UP)
        made.write_picture(root / f"{split}_pano" / sequence / name, rgb)
        pose = root / f"{split}_pose" / sequence / name.replace(".jpg", ".txt")
        pose.parent.mkdir(parents=True)
        np.savetxt(pose, np.column_stack([R_world_from_cam.T, center]))
    return root


def test_poses_fit_and_splits_are_variants(dataset, tmp_path, capsys):
    code, (line,), err = made.run(capsys, "omniscenes", dataset, tmp_path / "out", "--check", 5)
    assert (code, err) == (0, "")
    assert (line["scene"], line["queries"], line["fits"]) == ("weddingHall_1", 2, True)
    scene = made.assert_fits(tmp_path / "out" / "weddingHall_1")
    assert sorted(query.variant for query in scene.queries) == ["change_handheld", "turtlebot"]
    assert len({query.image.name for query in scene.queries}) == 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 0 0 0\n0 1 0 0\n", "found 8 numbers, wanted 3 x 4 numbers"),
        ("1 0 0 0\n0 1 0 0\n0 0 1 x\n", "could not convert"),
        ("1 0 0 0\n0 1 0 0\n0 0 -1 0\n", "which is no rotation"),
        ("1 0 0 nan\n0 1 0 0\n0 0 1 0\n", "not finite"),
    ],
)
def test_damaged_poses_are_refused(dataset, tmp_path, capsys, text, message):
    path = dataset / "turtlebot_pose" / PLACES[0][1] / "img_0001.txt"
    path.write_text(text)
    code, lines, err = made.run(capsys, "omniscenes", dataset, tmp_path / "out")
    assert (code, lines) == (3, [])
    assert str(path) in err
    assert message in err
    path.unlink()
    assert "No such file" in made.run(capsys, "omniscenes", dataset, tmp_path / "out")[2]


def test_a_room_without_a_cloud_is_refused(dataset, tmp_path, capsys):
    (dataset / "pcd" / "weddingHall_1.txt").unlink()
    made.assert_refused("with a cloud pcd/ROOM_N.txt", capsys, "omniscenes", dataset, tmp_path / "out")
