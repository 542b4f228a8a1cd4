"""Pictures of the cloud at a pose, and the command line of tools/render_pose.py."""

import json
from pathlib import Path

import cv2
import numpy as np
import poses
import pytest
import rooms

from piccolo.apps import render_pose
from piccolo.cli import prepare_map
from piccolo.geometry.pose import heading_pitch_roll_deg
from research.datasets import true_poses
from research.scene import read_scene

TIER = "scene"


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A made room with a result for each of two panoramas, in a folder with a blank in its name."""
    words = "--seed 7 --size 4 3 2.5 --points 30000 --panoramas 1 --width 256 --variants clean tilt"
    folder = rooms.write_room(tmp_path_factory.mktemp("my room"), words)
    truth = read_scene(folder).by_name
    some = [poses.result(folder / "images" / n, truth[n].pose) for n in ("clean_0.jpg", "tilt_0.jpg")]
    poses.write_results(folder / "poses.jsonl", [*some, poses.result("c.jpg", None, "not_localized")])
    return folder


@pytest.fixture
def run(scene, capsys):
    def call(*arguments, cloud="cloud.ply"):
        code = render_pose.main(["--cloud", str(scene / cloud), *map(str, arguments), "--quiet"])
        out, err = capsys.readouterr()
        return code, [json.loads(line) for line in out.splitlines()], err

    return call


def test_all_results_become_a_folder_of_pictures(run, scene, tmp_path):
    out = tmp_path / "some pictures"
    code, lines, err = run("--result", scene / "poses.jsonl", "--out", out, "--width", 256)
    assert (code, err) == (0, "")
    assert [Path(line["out"]).name for line in lines] == ["clean_0.png", "tilt_0.png"]
    for name in ("clean_0", "tilt_0"):
        photo, drawn = cv2.imread(str(scene / "images" / f"{name}.jpg")), cv2.imread(str(out / f"{name}.png"))
        assert np.corrcoef(photo.ravel(), drawn.ravel())[0, 1] > 0.85
    assert lines[0]["seen_fraction"] > 0.95


def test_the_same_pose_from_each_source_gives_the_same_picture(run, scene, tmp_path):
    pose = read_scene(scene).by_name["tilt_0.jpg"].pose
    assert true_poses.main(["--scenes", str(scene), "--out", str(tmp_path / "true.jsonl")]) == 0
    np.savetxt(tmp_path / "T.txt", pose.T_world_from_cam, fmt="%.17g")
    heading, pitch, roll = heading_pitch_roll_deg(pose)
    sources = {
        "result": ["--result", scene / "poses.jsonl", "--pano", "tilt_0.jpg"],
        "truth": ["--result", tmp_path / "true.jsonl", "--pano", "images/tilt_0.jpg"],
        "pose": ["--pose", tmp_path / "T.txt"],
        "at": ["--at", *pose.center_world, "--heading", heading, "--pitch", pitch, "--roll", roll],
    }
    pictures = []
    for name, source in sources.items():
        depth = ["--depth", tmp_path / f"{name}.npy", "--mask-out", tmp_path / f"{name}_mask.png"]
        code, _, err = run(*source, "--out", tmp_path / f"{name}.png", "--width", 128, *depth)
        assert (code, err) == (0, "")
        pictures.append(cv2.imread(str(tmp_path / f"{name}.png")).astype(int))
        assert (abs(pictures[-1] - pictures[0]) <= 1).mean() > 0.99
        range_m = np.load(tmp_path / f"{name}.npy")
        assert range_m.shape == (64, 128)
        assert range_m.dtype == np.float32
        mask = cv2.imread(str(tmp_path / f"{name}_mask.png"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(mask == 255, ~np.isfinite(range_m))


def test_depth_in_millimetres_and_a_prepared_map_in_place_of_the_cloud(run, scene, tmp_path):
    depth = np.array([[1.2345, np.inf], [65.6, 1e6]], np.float32)
    png = render_pose.depth_file(depth, ".png")
    read = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    assert read.dtype == np.uint16
    assert read.tolist() == [[1234, 0], [65535, 65535]]
    arguments = ["--cloud", str(scene / "cloud.ply"), "--out", str(scene / "cloud.map"), "--quiet"]
    assert prepare_map.main(arguments) == 0
    pano = ["--result", scene / "poses.jsonl", "--pano", "tilt_0.jpg", "--width", 128]
    for cloud in ("cloud.ply", "cloud.map"):
        assert run(*pano, "--out", tmp_path / f"{cloud}.png", cloud=cloud)[0] == 0
    both = [cv2.imread(str(tmp_path / f"cloud.{kind}.png")).ravel() for kind in ("ply", "map")]
    assert np.corrcoef(*both)[0, 1] > 0.98


def test_refusals_leave_nothing(run, scene, tmp_path):
    (tmp_path / "T.txt").write_text("1 2 3\n")
    result, out, at = ["--result", scene / "poses.jsonl"], ["--out", tmp_path / "a.png"], ["--at", 0, 0, 1]
    for code, arguments, message in (
        (2, [*at, *out, "--width", 101], "--width 101: wanted an even number"),
        (2, [*at, "--out", "a.bmp"], "--out a.bmp: wanted a name that ends with .png, .jpg"),
        (2, [*at, *out, "--depth", "a.exr"], "--depth a.exr: wanted"),
        (2, [*at, "--out", "a", "--depth", "a.png"], "only with a single picture"),
        (2, [*at, *out, "--heading", "nan"], "must be finite"),
        (2, ["--pose", "T.txt", *out, "--heading", 3], "only with --at"),
        (2, [*at, *out, "--units", 0], "--units: found 0"),
        (3, [*result, *out], "2 poses, wanted one"),
        (3, [*result, "--pano", "x.jpg", *out], "no pose of x.jpg"),
        (3, [*result, "--out", scene], "found a folder that is not empty"),
        (3, [*at, "--out", tmp_path / "no" / "a.png"], "found no folder"),
        (3, ["--pose", tmp_path / "T.txt", *out], "wanted the 4 x 4 numbers"),
        (3, ["--pose", tmp_path / "no.txt", *out], "no.txt"),
        (3, ["--at", 0, 0, 1e30, *out], "--at: found a position [0.0, 0.0, 1e+30], wanted finite"),
        (3, ["--at", 0, 0, 2e7, *out], "found a camera at [0.0, 0.0, 20000000.0]"),
        (3, [*at, *out, "--cloud", "no.ply"], "no.ply"),
    ):
        found, lines, err = run(*arguments)
        assert (found, lines, err.count("\n")) == (code, [], 1), arguments
        assert message in err
    assert [path.name for path in tmp_path.iterdir()] == ["T.txt"]


def test_pictures_on_stdout_are_those_of_files(scene, tmp_path, capfdbinary):
    arguments = ["--cloud", str(scene / "cloud.ply"), "--at", "3", "2", "1", "--width", "64", "--out"]
    depth = ["--depth", str(tmp_path / "depth.png")]
    assert render_pose.main([*arguments, str(tmp_path / "a.png"), *depth, "--quiet"]) == 0
    capfdbinary.readouterr()
    before = (tmp_path / "depth.png").read_bytes()
    assert render_pose.main([*arguments, "-", *depth, "--quiet"]) == 0
    assert capfdbinary.readouterr() == ((tmp_path / "a.png").read_bytes(), b"")
    assert render_pose.main([*arguments, str(tmp_path / "b.png"), "--depth", "-", "--quiet"]) == 0
    assert capfdbinary.readouterr() == (before, b"")
    assert render_pose.main([*arguments, "-", "--depth", "/dev/stdout", "--quiet"]) == 2
    pano = ["--cloud", str(scene / "cloud.ply"), "--result", str(scene / "poses.jsonl")]
    pano += ["--pano", "clean_0.jpg", "--out", str(scene / "images" / "clean_0.jpg")]
    assert render_pose.main(pano) == 2
    assert b"found an input as the output" in capfdbinary.readouterr().err
