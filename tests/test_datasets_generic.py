"""Lists of anybody's panoramas: columns, directions, axes, and what is refused."""

import json
from pathlib import Path

import dataset_rooms as made
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from piccolo.cli import export_poses
from piccolo.scene import read_scene

AXES = {"optical": made.OPTICAL, "piccolo": made.FORWARD_LEFT_UP, "opengl": made.OPENGL}
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
    for k, (axes, direction) in enumerate((a, d) for a in AXES for d in directions):
        camera = made.cameras(6)[k]
        made.write_picture(root / "images" / f"{100 + k}.5.png", made.picture(*camera, AXES[axes])[0])
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
        ("a.csv", b"\xff\xfe", "bytes that are no text"),
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
    words = ["--scenes", str(first), "--format", "csv", "--images", str(first), "--out", str(table)]
    assert export_poses.main(words) == 0
    capsys.readouterr()
    code, _, err = made.run(capsys, "generic", folder, tmp_path / "second", "--poses", table)
    assert (code, err) == (0, "")
    second = made.assert_fits(tmp_path / "second" / "my photos").queries
    for one, other in zip(read_scene(first).queries, second, strict=True):
        np.testing.assert_allclose(other.pose.R_cam_from_world, one.pose.R_cam_from_world, atol=1e-14)
        assert np.array_equal(other.pose.center_world, one.pose.center_world)
