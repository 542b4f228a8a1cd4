"""Data sets: the ways in which poses may be meant, lists of anybody's panoramas, and damaged files."""

import json
from pathlib import Path

import dataset_rooms as made
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from poses import jpeg, tilted_poses
from refusals import mutated, read_or_refused
from scipy.spatial.transform import Rotation

from piccolo.apps.export import export_poses
from research.datasets import true_poses
from research.datasets.convert_dataset import (
    AS_GIVEN,
    Check,
    ConventionCheck,
    convention_variants,
    list_scenes,
)
from research.datasets.model import AXES, DIRECTIONS, ConvertOptions, pose_of_transform
from research.scene import read_scene

pytestmark = pytest.mark.research

ORIGIN = np.array([10.0, -4.0, 2.0])


def fit(score, best=AS_GIVEN, best_score=None):
    return ConventionCheck("images/a.jpg", score, score if best_score is None else best_score, best)


@pytest.mark.parametrize("axes", AXES)
@pytest.mark.parametrize("direction", DIRECTIONS)
@pytest.mark.parametrize("taken_axes", AXES)
def test_the_true_pose_is_among_the_readings_of_a_wrong_one(axes, direction, taken_axes):
    (pose,) = tilted_poses(1, center=np.array([11.0, -3.0, 3.5]))
    T = np.column_stack([pose.R_cam_from_world, pose.center_world])
    true = pose_of_transform("T", T, axes, direction)
    (other,) = set(DIRECTIONS) - {direction}
    for taken_direction in (direction, other):
        taken = pose_of_transform("T", T, taken_axes, taken_direction)
        local = type(taken)(taken.R_cam_from_world, taken.center_world - ORIGIN)
        found = convention_variants(local, ORIGIN)
        assert any(
            np.allclose(p.R_cam_from_world, true.R_cam_from_world)
            and np.allclose(p.center_world + ORIGIN, true.center_world)
            for p in found.values()
        )


def test_more_than_half_must_fit_and_advice_names_the_way_that_fits_most():
    assert Check((fit(0.5), fit(0.4), fit(0.02))).is_passed
    assert not Check((fit(0.5), fit(0.02))).is_passed
    assert not Check((fit(0.3, "axes are x", 0.4),)).is_passed
    wrong = fit(0.02, "the camera's x, y, z are z, x, y", 0.6)
    advice = Check((wrong, wrong, fit(0.1))).advice
    assert "scores 0.02, 0.02, 0.10, wanted 0.1 or more; 0.60 if the camera's x, y, z are z, x, y" in advice
    fits = wrong, fit(0.02), fit(0.05, "others", 0.06)
    assert Check(fits).advice.endswith("no other axes fit better")


ALL_AXES = {"optical": made.OPTICAL, "piccolo": made.FORWARD_LEFT_UP, "opengl": made.OPENGL}
COLUMNS = ("image", "tx", "ty", "tz", "qw", "qx", "qy", "qz", "direction", "axes", "variant", "room")


def entry(image, camera, direction, axes):
    """A row by what the words mean: [R | t] takes camera coordinates to the world's, or back."""
    R_world_from_cam, center = camera
    R, t = R_world_from_cam, center
    if direction == "cam_from_world":
        R, t = R.T, -R.T @ center
    x, y, z, w = Rotation.from_matrix(R).as_quat()
    numbers = dict(zip(COLUMNS[1:8], [*t, w, x, y, z], strict=True))
    return {"image": image, **numbers, "direction": direction, "axes": axes}


def write_csv(path, rows):
    names = [name for name in COLUMNS if any(name in row for row in rows)]
    lines = [",".join(str(row.get(name, "")) for name in names) for row in rows]
    path.write_text("\n".join([",".join(names), *lines, ""]))


@pytest.fixture
def folder(tmp_path):
    """A cloud and pictures with each axes, by any direction; rows in rows.json."""
    root = tmp_path / "my photos"
    made.write_text_cloud(root / "scan.xyz", *made.points_and_colors(), decimals=6)
    rows = []
    directions = ("world_from_cam", "cam_from_world")
    for k, (axes, direction) in enumerate((a, d) for a in ALL_AXES for d in directions):
        camera = made.cameras(6)[k]
        made.write_picture(root / "images" / f"{100 + k}.5.png", made.picture(*camera, ALL_AXES[axes])[0])
        rows.append(entry(f"images/{100 + k}.5.png", camera, direction, axes))
    (root / "rows.json").write_text(json.dumps(rows))
    return root


def rows_of(folder):
    return json.loads((folder / "rows.json").read_text())


def test_csv_in_all_axes_and_directions(folder, tmp_path, capsys):
    write_csv(folder / "poses.csv", [{**row, "variant": "tripod"} for row in rows_of(folder)])
    code, (line,), err = made.run(capsys, "generic", folder, tmp_path / "out", "--check", 6)
    assert (code, err) == (0, "")
    assert (line["scene"], line["queries"], line["fits"]) == ("my photos", 6, True)
    scene = made.assert_fits(tmp_path / "out" / "my photos")
    assert {query.variant for query in scene.queries} == {"tripod"}


def test_json_with_rooms_and_clouds(folder, tmp_path, capsys):
    (folder / "clouds").mkdir()
    (folder / "scan.xyz").rename(folder / "clouds" / "a.xyz")
    rows = rows_of(folder)
    (folder / "more").mkdir()  # with a picture of a name that another has
    (folder / rows[3]["image"]).rename(folder / "more" / Path(rows[1]["image"]).name)
    rows[3]["image"] = f"more/{Path(rows[1]['image']).name}"
    for k, row in enumerate(rows):
        row |= {"room": f"room {k % 2}", "cloud": "clouds/a.xyz", "variant": None}
    (folder / "poses.json").write_text(json.dumps(rows))
    code, lines, _ = made.run(capsys, "generic", folder, tmp_path / "out")
    assert (code, [line["queries"] for line in lines]) == (0, [3, 3])
    made.assert_fits(tmp_path / "out" / "room 1")
    rows[0]["cloud"] = "clouds/b.xyz"
    (folder / "poses.json").write_text(json.dumps(rows))
    made.assert_refused("room room 0: found the clouds", capsys, "generic", folder, tmp_path / "out2")


def test_trajectory_with_pictures_named_by_time(folder, tmp_path, capsys):
    row = rows_of(folder)[0]
    numbers = " ".join(str(row[name]) for name in ("tx", "ty", "tz", "qx", "qy", "qz", "qw"))
    (folder / "poses.txt").write_text(f"# time\n99.5 {numbers}\n\n100.5 {numbers}\n")
    code, (line,), _ = made.run(capsys, "generic", folder, tmp_path / "out", "--axes", "optical")
    assert (code, line["queries"]) == (0, 1)
    made.assert_fits(tmp_path / "out" / "my photos")
    made.assert_refused("in the list, or as --axes", capsys, "generic", folder, tmp_path / "out2")
    (folder / "poses.txt").write_text("1 2 3\n")
    assert "found '1 2 3', wanted timestamp tx" in made.run(capsys, "generic", folder, tmp_path / "out2")[2]
    (folder / "images").rename(folder / "pictures")
    assert "no such folder, wanted pictures" in made.run(capsys, "generic", folder, tmp_path / "out2")[2]


def test_optical_axes_called_piccolo_fail_the_check_with_advice(folder, tmp_path, capsys):
    write_csv(folder / "poses.csv", [{**row, "axes": "piccolo"} for row in rows_of(folder)[:2]])
    code, (line,), err = made.run(capsys, "generic", folder, tmp_path / "out", "--check", 2)
    assert (code, line["fits"]) == (1, False)
    assert "if the camera's x, y, z are z, -x, -y" in err
    code, (line,), _ = made.run(capsys, "generic", folder, tmp_path / "out", "--check", 2)  # there already
    assert (code, line["status"]) == (1, "there already")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"qw": 3.0}, "found a quaternion of length"),
        ({"tx": "inf"}, "found a position [inf, "),
        ({"tx": "1e30"}, "found a position [1e+30, "),
        ({"tx": "one"}, "could not convert"),
        ({"tx": ""}, "found no tx"),
        ({"axes": "blender"}, "found the axes blender"),
        ({"direction": "up"}, "found the direction up"),
        ({"room": "../there"}, "wanted a name for a folder"),
        ({"image": "images/none.png"}, "no such panorama"),
        ({"image": "/none.png"}, "poses.csv, row 2: /none.png leads to /none.png, out of"),
        ({"image": "no\0ne.png"}, "no\\x00ne.png', wanted the name of a file"),
    ],
)
def test_refused_rows(folder, tmp_path, capsys, change, message):
    rows = rows_of(folder)
    rows[1] |= change
    write_csv(folder / "poses.csv", rows)
    made.assert_refused(message, capsys, "generic", folder, tmp_path / "out")
    assert not (tmp_path / "there").exists()


def test_refused_lists_and_clouds(folder, tmp_path, capsys):
    out = tmp_path / "out"
    assert "found 0 lists" in made.run(capsys, "generic", folder, out)[2]
    write_csv(folder / "poses.csv", rows_of(folder))
    (folder / "second.xyz").write_text("0 0 0 1 1 1\n")
    assert "found the clouds scan.xyz, second.xyz" in made.run(capsys, "generic", folder, out)[2]
    code, (line,), _ = made.run(capsys, "generic", folder, out, "--cloud", folder / "scan.xyz")
    assert (code, line["queries"]) == (0, 6)
    for name, content, message in (
        ("a.csv", b"\xff\xff", "bytes that are no text"),
        ("b.csv", b"image,tx\n", "found no row with a picture"),
        ("c.json", b"{}", "found no list of objects"),
    ):
        (folder / name).write_bytes(content)
        made.assert_refused(message, capsys, "generic", folder, out, "--poses", folder / name)


def test_files_elsewhere_are_read_only_where_an_option_names_them(folder, tmp_path, capsys):
    row = {**rows_of(folder)[0], "image": str(folder / "images" / "100.5.png")}
    (tmp_path / "lists").mkdir()
    write_csv(tmp_path / "lists" / "poses.csv", [row])
    lists, out = tmp_path / "lists", tmp_path / "out"
    scan = folder / "scan.xyz"
    message = f"leads to {row['image']}, out of {lists}; move or copy"
    made.assert_refused(message, capsys, "generic", lists, out, "--cloud", scan)
    options = ("--cloud", scan, "--images", folder / "images")
    assert made.run(capsys, "generic", lists, out, *options)[0] == 0
    assert made.run(capsys, "generic", folder, out, "--poses", lists / "poses.csv")[0] == 0


def test_a_table_of_exported_poses_comes_back(folder, tmp_path, capsys):
    write_csv(folder / "poses.csv", rows_of(folder))
    assert made.run(capsys, "generic", folder, tmp_path / "first")[0] == 0
    first = tmp_path / "first" / "my photos"
    (folder / "poses.csv").unlink()
    table = folder / "exported.csv"
    assert true_poses.main(["--scenes", str(first), "--out", str(tmp_path / "true.jsonl")]) == 0
    words = ["--results", tmp_path / "true.jsonl", "--format", "csv", "--images", first, "--out", table]
    assert export_poses.main([*map(str, words)]) == 0
    capsys.readouterr()
    code, _, err = made.run(capsys, "generic", folder, tmp_path / "second", "--poses", table)
    assert (code, err) == (0, "")
    second = made.assert_fits(tmp_path / "second" / "my photos").queries
    for one, other in zip(read_scene(first).queries, second, strict=True):
        np.testing.assert_allclose(other.pose.R_cam_from_world, one.pose.R_cam_from_world, atol=1e-14)
        assert np.array_equal(other.pose.center_world, one.pose.center_world)


TRANSFORM = np.eye(4)[[1, 2, 0, 3]]
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
        "hall/query_360/s/camera_pose.json", json.dumps({"a.jpg": TRANSFORM.tolist()}), ["hall/cloud.xyz"]
    ),
    "matterport3d": (
        "house/matterport_camera_poses/ab_pose_1_5.txt",
        "\n".join(" ".join(map(str, row)) for row in TRANSFORM),
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


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
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
    root = tmp_path / "root"
    outside = tmp_path / "outside"
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
