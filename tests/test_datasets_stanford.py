"""Stanford2D-3D-S: its folders and formulas, made up here from its documentation."""

import json

import cv2
import dataset_rooms as made
import naive
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from research.datasets import convert_dataset
from research.scene import find_scenes

pytestmark = pytest.mark.research

LABELS = ["<UNK>_0_<UNK>_0_0", "chair_1_office_1_1", "wall_1_office_1_1", "clutter_7_office_1_1"]
CHAIR, WALL, CLUTTER = 9, 3, 13
MISSING = (0x0D, 0x0D, 0x0D)
# area 5b's frame in that of the clouds, as DeepViewAgg has it
M_5B, T_5B = np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1.0]]), np.array([-4.10, 6.25, 0.0])


def is_low(points):
    return points[..., 2] < 1.0


def write_room(root, area="1", room="office_1"):
    """Points as in S3DIS: all, and by object."""
    points, colors = made.points_and_colors()
    folder = root / "Stanford3dDataset_v1.2" / f"Area_{area}" / room
    made.write_text_cloud(folder / f"{room}.txt", points, colors)
    rest = np.flatnonzero(~is_low(points))
    objects = {"wall_1": rest[20:], "clutter_7": rest[:10], "stairs_1": rest[10:20]}
    for name, own in {"chair_1": is_low(points), **objects}.items():
        made.write_text_cloud(folder / "Annotations" / f"{name}.txt", points[own], colors[own])


def write_panorama(root, number, camera, part="1", room="office_1", is_authors=False):
    """Picture, pose and semantic picture; returns the pose's path."""
    R_world_from_cam, center = camera
    rgb, hits = made.picture(R_world_from_cam, center, made.OPENGL)
    if part == "5b":
        R_world_from_cam, center = M_5B.T @ R_world_from_cam, M_5B.T @ (center - T_5B)
    stem = f"camera_{number:032x}_{room}_frame_equirectangular_domain"
    folders = {
        kind: root / kind / f"area_{part}" if is_authors else root / f"area_{part}" / "pano" / kind
        for kind in ("rgb", "pose", "semantic")
    }
    if is_authors:
        folders["rgb"] = root / "pano" / f"area_{part}"
    made.write_picture(folders["rgb"] / f"{stem}_rgb.png", rgb)
    index = np.where(is_low(hits), 1, 2)
    semantic = np.stack([index >> 16, index >> 8, index], axis=-1).astype(np.uint8)
    semantic[0] = MISSING
    made.write_picture(folders["semantic"] / f"{stem}_semantic.png", semantic)
    pose = folders["pose"] / f"{stem}_pose.json"
    pose.parent.mkdir(parents=True, exist_ok=True)
    angles = Rotation.from_matrix(R_world_from_cam).as_euler("xyz")  # R_z R_y R_x
    pose.write_text(json.dumps({"camera_location": list(center), "final_camera_rotation": list(angles)}))
    return pose


@pytest.fixture
def dataset(tmp_path):
    root = tmp_path / "my data"
    write_room(root)
    for k, camera in enumerate(made.cameras()):
        write_panorama(root, k, camera)
    (root / "assets").mkdir()
    (root / "assets" / "semantic_labels.json").write_text(json.dumps(LABELS))
    return root


def test_poses_fit_the_panoramas(dataset, tmp_path, capsys):
    code, (line,), err = made.run(capsys, "stanford2d3ds", dataset, tmp_path / "o ut", "--check", 2)
    assert (code, err) == (0, "")
    assert (line["status"], line["points"], line["queries"], line["fits"]) == ("written", 20_000, 2, True)
    scene = made.assert_fits(tmp_path / "o ut" / "area_1" / "office_1")
    assert {query.variant for query in scene.queries} == {"area_1"}
    assert all(query.image.is_symlink() for query in scene.queries)
    assert [s.name for s in find_scenes([tmp_path / "o ut"])] == ["area_1/office_1"]


def test_labels_of_cloud_and_panoramas_agree(dataset, tmp_path, capsys):
    code, (line,), _ = made.run(capsys, "stanford2d3ds", dataset, tmp_path / "out", "--labels", "--copy")
    assert (code, line["points"]) == (0, 20_000)
    scene = made.assert_fits(tmp_path / "out" / "area_1" / "office_1")
    data = made.vertices(scene.cloud)
    labels = data["label"]
    assert sorted(set(labels)) == [0, WALL, CHAIR, CLUTTER]
    assert (np.sum(labels == 0), np.sum(labels == CLUTTER)) == (10, 10)
    points = np.stack([data["x"], data["y"], data["z"]], axis=1)
    for query in scene.queries:
        assert not query.image.is_symlink()
        shown = cv2.imread(str(query.labels), cv2.IMREAD_UNCHANGED)
        assert (shown.dtype, shown.shape) == (np.uint16, (128, 256))
        assert (shown[0] == 0).all()
        pixels = naive.project(points, query.pose.R_cam_from_world, query.pose.center_world, 256)
        columns, rows = np.minimum(pixels.astype(int), [255, 127]).T
        there = shown[rows, columns]
        is_told = (there > 0) & np.isin(labels, [WALL, CHAIR])
        # not all: some points are behind furniture
        assert np.mean(there[is_told] == labels[is_told]) > 0.8


def test_area_5b_is_brought_to_the_clouds_frame(dataset, tmp_path, capsys):
    write_room(dataset, "5", "hallway_2")
    for k, (camera, part) in enumerate(zip(made.cameras(), ("5a", "5b"), strict=True)):
        write_panorama(dataset, 10 + k, camera, part, "hallway_2")
    code, (line,), _ = made.run(capsys, "stanford2d3ds", dataset, tmp_path / "out", "--areas", 5)
    assert (code, line["scene"]) == (0, "area_5/hallway_2")
    scene = made.assert_fits(tmp_path / "out" / "area_5" / "hallway_2")
    assert [query.variant for query in scene.queries] == ["area_5a", "area_5b"]


def test_the_authors_folders(tmp_path, capsys):
    root = tmp_path / "data"
    made.write_text_cloud(root / "pcd_not_aligned" / "area_3" / "WC_1.txt", *made.points_and_colors())
    for k, camera in enumerate(made.cameras()):
        write_panorama(root, k, camera, "3", "WC_1", is_authors=True)
    assert made.run(capsys, "stanford2d3ds", root, tmp_path / "out")[0] == 0
    made.assert_fits(tmp_path / "out" / "area_3" / "WC_1")


def test_a_scene_that_is_there_is_left_but_not_if_made_otherwise(dataset, tmp_path, capsys):
    out = tmp_path / "out"
    made.run(capsys, "stanford2d3ds", dataset, out)
    before = (out / "area_1" / "office_1" / "queries.json").stat().st_mtime_ns
    code, (line,), _ = made.run(capsys, "stanford2d3ds", dataset, out)
    assert (code, line["status"], line["points"], line["queries"]) == (0, "there already", None, 2)
    assert (out / "area_1" / "office_1" / "queries.json").stat().st_mtime_ns == before
    made.assert_refused("remove it, or change --out", capsys, "stanford2d3ds", dataset, out, "--labels")


def test_a_damaged_file_costs_its_room_only(dataset, tmp_path, capsys):
    write_room(dataset, "1", "office_2")
    path = write_panorama(dataset, 20, made.cameras(1)[0], "1", "office_2")
    for text, message in (
        ('{"camera_location": [1, 2], "final_camera_rotation": [0, 0, 0]}', "location: found the shape (2,)"),
        ('{"camera_location": [0, 0, "x"], "final_camera_rotation": [0, 0, 0]}', "found ValueError"),
        ("[]", "wanted JSON with camera_location"),
    ):
        path.write_text(text)
        code, (line,), err = made.run(capsys, "stanford2d3ds", dataset, tmp_path / "out")
        assert (code, line["scene"]) == (3, "area_1/office_1")
        assert str(path) in err
        assert message in err
    assert [p.name for p in (tmp_path / "out" / "area_1").iterdir()] == ["office_1"]


def test_refused_folders(dataset, tmp_path, capsys):
    where = capsys, "stanford2d3ds", dataset, tmp_path / "out"
    made.assert_refused("found no room with panoramas", *where[:2], tmp_path, where[3])
    made.assert_refused("found no office_9, wanted one of office_1", *where, "--rooms", "office_9")
    (dataset / "Stanford3dDataset_v1.2").rename(dataset / "Stanford3dDataset_v1.2_Aligned_Version")
    made.assert_refused("rotated one by one", *where)


def test_rooms_without_a_cloud_are_counted(dataset, tmp_path, capsys):
    write_panorama(dataset, 30, made.cameras(1)[0], "1", "pantry_1")
    arguments = ["stanford2d3ds", "--from", str(dataset), "--out", str(tmp_path / "out")]
    assert convert_dataset.main(arguments) == 0
    assert "1 scenes without a cloud: area_1/pantry_1" in capsys.readouterr().err


def test_rooms_without_objects_have_no_labels(dataset, tmp_path, capsys):
    def refuse(message):
        made.assert_refused(message, capsys, "stanford2d3ds", dataset, tmp_path / "out", "--labels")

    names = dataset / "assets" / "semantic_labels.json"
    for path in dataset.rglob("Annotations/*.txt"):
        path.unlink()
    refuse("with --labels Annotations")
    names.write_text("{}")
    refuse("wanted a list of names")
    names.unlink()
    refuse("found no assets/semantic_labels.json")
