"""The loss over a plan, and the command line of tools/loss_surface.py."""

import json

import cv2
import numpy as np
import poses
import pytest
import rooms
from scans import read_cloud

from piccolo.geometry.points import pack_points
from piccolo.geometry.pose import Pose, uniform_yaws
from piccolo.optimize.sampling_loss import sampling_loss
from piccolo.photo.panorama.texels import pack_texels
from piccolo.system.jobs.threads import Workers
from piccolo.views.zbuffer import visible_points
from research.experiments import loss_surface as tool
from research.experiments.loss_surface import LossSurface, PoseGrid, loss_surface
from research.scene import read_scene

pytestmark = pytest.mark.research

STEP = 0.3


def _scene(variant):
    cloud = rooms.room(2)[1]
    query = rooms.query(2, variant)
    pose = Pose(query.pose.R_cam_from_world, query.pose.center_world - cloud.origin_world)
    small = cv2.resize(query.rgb, (128, 64), interpolation=cv2.INTER_AREA)
    return pack_points(cloud.points, cloud.colors), pack_texels(small), pose


def _grid(pose, num_yaws=24):
    x, y = (pose.center_world[k] + STEP * np.arange(-3, 4) for k in range(2))
    heights = pose.center_world[2] + np.array([-0.3, 0.0, 0.3])
    return PoseGrid(x, y, heights, pose.R_cam_from_world @ uniform_yaws(num_yaws))


def test_the_least_loss_is_at_the_true_pose():
    points, texels, pose = _scene("tilt")
    grid = _grid(pose)
    surface = loss_surface(points, texels, grid, 5000, Workers(2))
    assert surface.lowest() == (3, 3)
    assert surface.height[3, 3] == pose.center_world[2]
    assert surface.rotation[3, 3] == 0
    assert surface.loss[3, 3] < 0.8 * np.median(surface.loss)
    assert 1 <= surface.num_minima() < 12


def test_a_place_has_the_least_of_its_losses_with_the_same_bits_on_any_number_of_threads():
    points, texels, pose = _scene("tilt")
    grid = _grid(pose, 5)
    one = loss_surface(points, texels, grid, 10**6, Workers(1))
    two = loss_surface(points, texels, grid, 10**6, Workers(2))
    for name in ("loss", "height", "rotation", "is_free"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    losses = {}
    for z in grid.heights:
        center = np.array([grid.x[5], grid.y[1], z])
        seen = visible_points(points, center)
        for k, R in enumerate(grid.R_cam_from_local):
            losses[sampling_loss(seen, texels, Pose(R, center))] = (z, k)
    least = min(losses)
    assert one.loss[1, 5] == least
    assert (one.height[1, 5], one.rotation[1, 5]) == losses[least]


def test_walls_and_outside_are_not_free():
    points, texels, pose = _scene("clean")
    low = points.x.min()
    high = points.x.max()
    x = np.array([low - 2.0, low, pose.center_world[0], high, high + 2.0])
    grid = PoseGrid(x, pose.center_world[1:2], pose.center_world[2:], pose.R_cam_from_world[None])
    surface = loss_surface(points, texels, grid, 5000, Workers(2))
    assert surface.is_free.tolist() == [[False, False, True, False, False]]


def test_minima_are_counted_in_free_space():
    loss = np.full((7, 9), 0.5)
    loss[1, 1] = 0.1
    loss[1, 2] = 0.2
    loss[5, 8] = 0.3
    loss[3, 5] = 0.4
    loss[0, 5] = np.inf
    is_free = np.ones(loss.shape, np.bool_)
    surface = LossSurface(loss, loss, np.zeros(loss.shape, np.int64), is_free)
    assert surface.lowest() == (1, 1)
    assert surface.num_minima() == 3
    is_free[5, 8] = False
    assert surface.num_minima() == 2
    is_free[1, 1] = False
    assert surface.lowest() == (1, 2)
    is_free[:] = False
    assert surface.lowest() == (1, 1)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A made room and a result for one panorama, in a folder with a blank in its name."""
    words = "--seed 5 --size 4 3 2.5 --points 30000 --panoramas 1 --width 256 --variants clean tilt"
    folder = rooms.write_room(tmp_path_factory.mktemp("my room"), words)
    pose = read_scene(folder).by_name["tilt_0.jpg"].pose
    found = Pose(pose.R_cam_from_world, pose.center_world + 0.05)
    poses.write_results(folder / "pose.json", [poses.result("x/tilt_0.jpg", found)])
    return folder


@pytest.fixture
def run(scene, capsys, monkeypatch):
    for name, value in {"NUM_YAWS": 24, "NUM_ROTATIONS": 30, "MAX_POINTS": 3000, "WIDTH": 128}.items():
        monkeypatch.setattr(tool, name, value)

    def call(*arguments, pano="clean_0.jpg"):
        files = ["--cloud", scene / "cloud.ply", "--pano", scene / "images" / pano]
        code = tool.main([*map(str, [*files, *arguments]), "--quiet"])
        out, err = capsys.readouterr()
        return code, json.loads(out) if out else None, err

    return call


def test_picture_of_a_tilted_panorama(run, scene, tmp_path):
    files = ["--truth", scene / "queries.json", "--result", scene / "pose.json"]
    out = tmp_path / "a surface.png"
    code, told, err = run(*files, "--step", STEP, "--out", out, pano="tilt_0.jpg")
    assert (code, err) == (0, "")
    assert told["distance_to_true"] < STEP
    assert told["distance_to_found"] < STEP + 0.1
    assert told["num_minima"] >= 1
    picture = cv2.imread(str(out))
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 100


def test_without_a_pose_known(run, tmp_path):
    code, told, _ = run("--step", 1.0, "--gravity", "unknown", "--out", tmp_path / "b.png")
    assert (code, told["poses"]) == (0, np.prod(told["places"]) * 5 * 30)


def test_a_cloud_with_another_axis_up(run, scene, tmp_path):
    """y up: world positions stay the world's."""
    cloud = tmp_path / "y up.txt"
    read = read_cloud(scene / "cloud.ply")
    x, y, z = (read.points + read.origin_world).T
    np.savetxt(cloud, np.column_stack([x, z, -y, read.colors]), fmt="%.4f %.4f %.4f %d %d %d")
    truth = read_scene(scene).by_name["clean_0.jpg"].pose
    R_z_up = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    turned = Pose(truth.R_cam_from_world @ R_z_up, R_z_up.T @ truth.center_world)
    poses.write_results(tmp_path / "pose.json", [poses.result("clean_0.jpg", turned)])
    files = ["--cloud", cloud, "--result", tmp_path / "pose.json", "--out", tmp_path / "a.png"]
    code, told, err = run(*files, "--up", "y", "--step", STEP)
    assert (code, err) == (0, "")
    assert told["distance_to_found"] < STEP
    assert np.linalg.norm(told["lowest_world"] - turned.center_world) < STEP


def test_refusals_leave_nothing(run, scene, tmp_path):
    out = ["--out", tmp_path / "a.png"]
    for code, words, message in (
        (2, ["--out", "a.jpg"], "--out a.jpg: wanted a name that ends with .png"),
        (2, [*out, "--step", 0], "--step 0.0: wanted metres above 0"),
        (2, [*out, "--step", "nan"], "--step nan"),
        (3, [*out, "--step", 1e-5], "places, wanted at most"),
        (3, [*out, "--result", scene / "pose.json"], "0 poses of clean_0.jpg, wanted one"),
        (3, [*out, "--truth", scene / "pose.json"], "wanted a queries.json with true poses"),
        (3, ["--out", tmp_path / "no" / "a.png"], "found no folder"),
        (3, [*out, "--pano", "no.jpg"], "no.jpg"),
    ):
        found, told, err = run(*words)
        assert (found, told, err.count("\n")) == (code, None, 1)
        assert message in err
    assert not list(tmp_path.iterdir())
