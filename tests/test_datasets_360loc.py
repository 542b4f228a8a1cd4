"""360Loc: camera-to-world matrices with COLMAP's axes, a JSON a sequence."""

import json

import dataset_rooms as made
import numpy as np
import pytest

SEQUENCES = ("daytime_360_1", "nighttime_360_2")


@pytest.fixture
def dataset(tmp_path):
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


def test_poses_fit_and_sequences_are_variants(dataset, tmp_path, capsys):
    code, (line,), err = made.run(capsys, "360loc", dataset, tmp_path / "out", "--check", 2, "--copy")
    assert (code, err, line["scene"], line["fits"]) == (0, "", "atrium", True)
    scene = made.assert_fits(tmp_path / "out" / "atrium")
    assert [query.variant for query in scene.queries] == list(SEQUENCES)
    code, (line,), _ = made.run(capsys, "360loc", dataset / "atrium", tmp_path / "out2")
    assert (code, line["scene"]) == (0, "atrium")


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ([1], "found no object"),
        ({"a.jpg": [[1, 0], [0, 1]]}, "found the shape (2, 2)"),
        ({"a.jpg": [[1, 0], [0]]}, "wanted JSON"),
        ({"a.jpg": np.eye(4).tolist()}, "no such panorama"),
    ],
)
def test_damaged_poses_are_refused(dataset, tmp_path, capsys, document, message):
    path = dataset / "atrium" / "query_360" / SEQUENCES[0] / "camera_pose.json"
    path.write_text(json.dumps(document))
    made.assert_refused(message, capsys, "360loc", dataset, tmp_path / "out")


def test_clouds_are_needed_and_one_only(dataset, tmp_path, capsys):
    cloud = dataset / "atrium" / "cloud.txt"
    cloud.with_suffix(".xyz").write_bytes(cloud.read_bytes())
    assert "found the clouds cloud.txt, cloud.xyz" in made.run(capsys, "360loc", dataset, tmp_path / "out")[2]
    cloud.unlink()
    cloud.with_suffix(".xyz").unlink()
    made.assert_refused("and a coloured cloud beside query_360", capsys, "360loc", dataset, tmp_path / "out")
