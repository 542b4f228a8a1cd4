"""Pictures of the cloud at a pose, and the command line of tools/render_pose.py."""

import json
import subprocess
import sys
from pathlib import Path

import cv2
import naive
import numpy as np
import poses
import pytest
import rooms
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import mutated, read_or_refused

from piccolo import animation
from piccolo.animation import shaken, watched_descent, write_animation
from piccolo.cloud.packed import pack_points
from piccolo.errors import InputError
from piccolo.export.axes import R_cam_from_angles, heading_pitch_roll_deg
from piccolo.picture import Picture, closed, encoded, picture_at
from piccolo.pipeline import PlacedPoints
from piccolo.pose import Pose, T_world_from_cam, angle_between, exp_so3, step
from piccolo.pose_file import read_pose_matrix
from piccolo.refine import refine, sampling_loss_of
from piccolo.sampling import pack_texels
from piccolo.scenes import read_scene
from piccolo.settings import DescentSettings
from piccolo.sphere import pixel_rays
from piccolo.splatting import BAND, BAND_OFFSET, MAX_SLOPE, MIN_RADIUS_PX, splat
from piccolo.surfels import surfels_of
from piccolo.synthetic.raycast import cast
from piccolo.threads import Workers
from piccolo.truth import pose_errors
from tools import make_room, prepare_map, render_pose

ROOT = Path(__file__).resolve().parents[1]
WORKERS = Workers(2)
WIDTH = 256
SEED = 3


def _local(pose):
    return Pose(pose.R_cam_from_world, pose.center_world - rooms.room(SEED)[1].origin_world)


@pytest.fixture(scope="module")
def points():
    cloud = rooms.room(SEED)[1]
    return pack_points(cloud.points, cloud.colors)


@pytest.fixture(scope="module")
def true_ranges():
    """Range (H, W) [m] at the tilted query, by casting rays at the room."""
    pose = rooms.query(SEED, "tilt").pose
    rays = pixel_rays(WIDTH).reshape(-1, 3) @ pose.R_cam_from_world
    ranges, _ = cast(rooms.room(SEED)[0].rooms[0], pose.center_world, rays, WORKERS, "cast")
    return ranges.reshape(-1, WIDTH)


@pytest.fixture(scope="module")
def tilted(points):
    return picture_at(points, _local(rooms.query(SEED, "tilt").pose), WIDTH, WORKERS)


def test_splat_equals_its_twin_over_seam_and_poles():
    rng = np.random.default_rng(0)
    center = rng.normal(size=(300, 3)) * [2.0, 2.0, 1.0]
    center[:4] = [[-3.0, 0.01, 0.2], [-3.0, -0.01, -0.2], [0.02, 0.0, 2.0], [0.0, 0.01, -2.0]]
    distance = np.linalg.norm(center, axis=1)
    normal = center / distance[:, None] + 0.7 * rng.normal(size=(300, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    radius = np.minimum(rng.uniform(0.001, 0.4, 300), 0.3 * distance)
    along = (center * normal).sum(axis=1)
    discs = np.column_stack([center, normal, along, radius**-2.0, distance]).astype(np.float32)
    rgb = rng.integers(0, 256, (300, 3), dtype=np.uint8)
    angles = np.maximum(np.arcsin(radius / distance), MIN_RADIUS_PX * 2 * np.pi / 64)
    directions = np.stack(
        [np.arctan2(center[:, 1], center[:, 0]), np.arcsin(center[:, 2] / distance)], axis=1
    )
    depth, sums = np.full((32, 64), np.inf, np.float32), np.zeros((32, 64, 5), np.float32)
    packed = pack_points(center.astype(np.float32), rgb).rgbx
    for lo in (0, 11):  # two strips of rows
        part = slice(lo, 11 if lo == 0 else 32)
        splat(discs, packed, directions, angles, lo, depth[part], sums[:0])
        splat(discs, packed, directions, angles, lo, depth[part], sums[part])
    expected_depth, expected_rgb = naive.splat(
        discs.astype(float), rgb, 64, MIN_RADIUS_PX, MAX_SLOPE, BAND, BAND_OFFSET
    )
    is_seen = sums[..., 4] > 0
    assert 0.3 < is_seen.mean() < 1.0
    # a ray along a disc's rim may hit by one rounding and miss by the other
    assert (is_seen == np.isfinite(expected_depth)).mean() > 0.995
    both = is_seen & np.isfinite(expected_depth)
    assert np.isclose(sums[both, 3] / sums[both, 4], expected_depth[both], rtol=1e-4).mean() > 0.98
    assert (abs(sums[both, :3] / sums[both, 4:] - expected_rgb[both]).max(axis=1) < 1.0).mean() > 0.98


@pytest.mark.parametrize("variant", ["clean", "tilt"])
def test_the_picture_at_the_true_pose_is_the_photo(points, variant):
    query = rooms.query(SEED, variant)
    photo = cv2.resize(query.rgb, (WIDTH, WIDTH // 2), interpolation=cv2.INTER_AREA).astype(float)

    def correlation(pose):
        rgb = closed(picture_at(points, pose, WIDTH, WORKERS)).astype(float)
        return np.corrcoef(rgb.ravel(), photo.ravel())[0, 1]

    true_pose = _local(query.pose)
    away = step(true_pose, np.array([0.0, 0.0, 0.0, 0.2, -0.2, 0.1]))
    assert correlation(true_pose) > 0.9
    assert correlation(true_pose) > correlation(away) + 0.05


def test_depth_is_that_of_cast_rays(tilted, true_ranges):
    is_seen = tilted.is_seen
    assert is_seen.mean() > 0.97
    error = abs(tilted.depth - true_ranges)[is_seen]
    assert (error < 0.03).mean() > 0.95
    assert np.median(error) < 0.005


def test_holes_are_marked_where_points_are_missing_and_nowhere_else(points, tilted, true_ranges):
    pose = _local(rooms.query(SEED, "tilt").pose)
    rays = pixel_rays(WIDTH) @ pose.R_cam_from_world
    surface = pose.center_world + rays * true_ranges[..., None]
    low = points.z.max() - 0.1  # the ceiling: nothing is behind it
    picture = picture_at(points.take(np.flatnonzero(points.z < low)), pose, WIDTH, WORKERS)
    is_missing, is_there = surface[..., 2] > low, (surface[..., 2] < low) & tilted.is_seen
    # discs at the upper end of the walls reach some pixels into it
    inner, other = (cv2.erode(m.astype(np.uint8), np.ones((9, 9))) > 0 for m in (is_missing, is_there))
    assert inner.mean() > 0.1
    assert not picture.is_seen[inner].any()
    assert other.mean() > 0.4
    assert picture.is_seen[other].all()
    is_seen = picture.is_seen.copy()
    marked = render_pose.colors_of(picture, "mark")
    np.testing.assert_array_equal((marked == render_pose.MAGENTA).all(axis=-1), ~is_seen)


def test_a_sparse_wall_hides_what_is_behind_it():
    rng = np.random.default_rng(1)
    near = np.column_stack([np.full(4000, 2.0), rng.uniform(-2, 2, (4000, 2))])  # about 6 cm apart
    far = np.column_stack([np.full(40000, 4.0), rng.uniform(-3, 3, (40000, 2))])
    colors = np.repeat(np.array([[255, 0, 0], [0, 0, 255]], np.uint8), [4000, 40000], axis=0)
    cloud = pack_points(np.concatenate([near, far]).astype(np.float32), colors)
    pose = Pose(np.eye(3), np.zeros(3))
    picture = picture_at(cloud, pose, 1024, WORKERS)
    front = np.s_[200:312, 450:574]
    assert picture.is_seen[front].mean() > 0.97
    rgb = closed(picture)[front]
    assert (rgb[..., 2] < 40).mean() > 0.99
    assert abs(picture.depth[256, 512] - 2.0) < 0.01


def test_the_rim_beside_a_thing_in_front_is_seen():
    """A rod before a wall: render.visible_points takes the wall away for two degrees beside it."""
    grid = np.stack(np.meshgrid(np.linspace(-3, 3, 400), np.linspace(-3, 3, 400)), axis=-1).reshape(-1, 2)
    wall = np.column_stack([np.full(len(grid), 4.0), grid])
    rod = np.column_stack([np.full(2000, 1.0), np.zeros(2000), np.linspace(-1, 1, 2000)])
    colors = np.repeat(np.array([[0, 0, 255], [255, 0, 0]], np.uint8), [len(wall), len(rod)], axis=0)
    cloud = pack_points(np.concatenate([wall, rod]).astype(np.float32), colors)
    picture = picture_at(cloud, Pose(np.eye(3), np.zeros(3)), 720, WORKERS)
    row = picture.rgb[180]
    assert (row[360] == [255, 0, 0]).all()
    assert (row[[356, 363], 2] > 200).all()  # two degrees are four pixels


def test_turning_the_camera_rolls_the_picture_with_the_same_bits_on_any_number_of_threads(points):
    pose = _local(rooms.query(SEED).pose)
    straight = picture_at(points, pose, 128, Workers(1))
    again = picture_at(points, pose, 128, Workers(2))
    np.testing.assert_array_equal(straight.rgb, again.rgb)
    np.testing.assert_array_equal(straight.depth, again.depth)
    turned = Pose(exp_so3(np.array([0, 0, -2 * np.pi * 9 / 128])) @ pose.R_cam_from_world, pose.center_world)
    rolled = picture_at(points, turned, 128, WORKERS)
    is_same = np.isclose(rolled.depth, np.roll(straight.depth, 9, axis=1), rtol=1e-3, equal_nan=True)
    assert is_same.mean() > 0.99


@pytest.mark.parametrize("size", [(8, 16), (25, 50), (37, 74), (1, 2)])
def test_holes_take_the_colours_around_them_and_nothing_else_changes(size):
    rng = np.random.default_rng(2)
    rgb = rng.integers(100, 200, (*size, 3), dtype=np.uint8)
    depth = np.where(rng.random(size) < 0.3, np.inf, 1.0).astype(np.float32)
    depth[0, 0] = 1.0
    picture = Picture(np.where(np.isfinite(depth)[..., None], rgb, 0).astype(np.uint8), depth)
    filled = closed(picture)
    np.testing.assert_array_equal(filled[picture.is_seen], rgb[picture.is_seen])
    assert filled.min() >= 98
    assert filled.max() <= 201
    nothing = Picture(np.zeros((*size, 3), np.uint8), np.full(size, np.inf, np.float32))
    assert not closed(nothing).any()


def test_a_hole_at_the_seam_is_closed_from_both_sides():
    rgb = np.zeros((32, 64, 3), np.uint8)
    rgb[:, 32:] = 200
    depth = np.ones((32, 64), np.float32)
    depth[:, :4] = depth[:, -4:] = np.inf
    filled = closed(Picture(np.where(np.isfinite(depth)[..., None], rgb, 0).astype(np.uint8), depth))
    middle = filled[16, [60, 62, 0, 2], 0].astype(int)
    assert (np.diff(middle) < 0).all()
    assert 20 < middle[1:3].mean() < 180


def test_points_in_the_air_and_lines_are_no_surface():
    rng = np.random.default_rng(4)
    wall = np.column_stack([rng.uniform(0, 2, (5000, 2)), np.zeros(5000)])
    stray = np.column_stack([rng.uniform(0, 2, (5, 2)), rng.uniform(0.5, 1.0, 5)])
    line = np.column_stack([np.linspace(5, 6, 100), np.zeros(100), np.zeros(100)])
    points = np.concatenate([wall, stray, line]).astype(np.float32)
    surfels = surfels_of(pack_points(points, np.zeros(points.shape, np.uint8)), WORKERS)
    assert not (surfels.points.z > 0.4).any()
    of_line = surfels.points.x > 4
    assert of_line.sum() > 90
    assert not surfels.normals[of_line].any()
    of_wall = ~of_line
    assert of_wall.sum() > 4950
    assert (abs(surfels.normals[of_wall, 2]) > 0.999).mean() > 0.99


def test_few_points_and_points_at_the_camera_are_drawn():
    for count in (1, 5, 11, 40):
        cloud = np.zeros((count + 1, 3), np.float32)
        cloud[1:] = [1.0, 0.0, 0.0]
        picture = picture_at(
            pack_points(cloud, np.full((count + 1, 3), 9, np.uint8)),
            Pose(np.eye(3), np.zeros(3)),
            32,
            WORKERS,
        )
        assert picture.is_seen.any()
        assert (picture.rgb[picture.is_seen] == 9).all()


def test_pictures_too_large_for_a_format_are_refused_by_name():
    with pytest.raises(OSError, match=r"could not be encoded as \.jpg"):
        encoded(np.zeros((1, 70_000, 3), np.uint8), ".jpg")


@given(st.floats(0, 359.9), st.floats(-89, 89), st.floats(-179, 179))
@settings(max_examples=50, deadline=None)
def test_angles_turn_the_camera_as_exports_read_it(heading, pitch, roll):
    R_cam_from_world = R_cam_from_angles(heading, pitch, roll)
    back = heading_pitch_roll_deg(Pose(R_cam_from_world, np.zeros(3)))
    assert angle_between(R_cam_from_angles(*back), R_cam_from_world) < 1e-6
    np.testing.assert_allclose(back[1:], [pitch, roll], atol=1e-6)


@given(st.data())
@settings(max_examples=100, deadline=None)
def test_a_pose_file_is_read_or_refused(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("pose") / "T.txt"
    pose = poses.tilted_poses(1)[0]
    text = "# T_world_from_cam\n" + "\n".join(
        " ".join(f"{x:.9f}" for x in row) for row in T_world_from_cam(pose)
    )
    path.write_text(text)
    read = read_pose_matrix(path)
    np.testing.assert_allclose(read.center_world, pose.center_world, atol=1e-8)
    assert angle_between(read.R_cam_from_world, pose.R_cam_from_world) < 1e-8
    path.write_bytes(mutated(data.draw, st.integers, text.encode()))
    read_or_refused(read_pose_matrix, path)


@pytest.mark.parametrize("solver", ["adam", "lbfgs", "gauss-newton"])
def test_a_watched_descent_is_the_descent(points, solver):
    query = rooms.query(SEED, "tilt")
    texels, goal = pack_texels(query.rgb), _local(query.pose)
    start = shaken(goal, 0.15, 4.0, seed=1)
    assert pose_errors(start, goal) == pytest.approx((0.15, np.radians(4.0)))
    how = DescentSettings(solver=solver, num_iterations=40, step_size=0.02)
    refined, passed = watched_descent(points, texels, start, how)
    plain = refine(points, sampling_loss_of(texels), start, how)
    np.testing.assert_array_equal(refined.pose.center_world, plain.pose.center_world)
    np.testing.assert_array_equal(passed[0].pose.center_world, start.center_world)
    np.testing.assert_array_equal(passed[-1].pose.center_world, plain.pose.center_world)
    assert passed[-1].loss < 0.7 * passed[0].loss
    assert [p.iteration for p in passed] == sorted(p.iteration for p in passed)
    if solver != "adam":
        assert pose_errors(refined.pose, goal)[0] < 0.02


FRAMES = [np.full((26, 30, 3), (40 * k, 255 - 40 * k, 90), np.uint8) for k in range(4)]


def test_animations_read_back(tmp_path):
    for name in ("a.gif", "a.mp4"):
        write_animation(tmp_path / name, FRAMES)
        video = cv2.VideoCapture(str(tmp_path / name))
        read = [frame for is_read, frame in iter(video.read, (False, None)) if is_read]
        assert len(read) >= len(FRAMES)
        assert abs(read[0][13, 15, ::-1].astype(int) - FRAMES[0][13, 15]).max() < 12
        assert abs(read[-1][13, 15, ::-1].astype(int) - FRAMES[-1][13, 15]).max() < 12
    write_animation(tmp_path / "frames", FRAMES)
    names = [f"{k:04d}.png" for k in range(4)]
    assert sorted(p.name for p in (tmp_path / "frames").iterdir()) == names
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.gif", "a.mp4", "frames"]


def test_without_pillow_a_gif_is_refused_beforehand(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "PIL.Image", None)
    with pytest.raises(InputError, match=r"pip install -r requirements-formats\.txt"):
        animation.check_animation(tmp_path / "a.gif")
    animation.check_animation(tmp_path / "a.mp4")


def test_a_camera_too_far_for_the_kernels_is_refused(points):
    placed = PlacedPoints(points, np.eye(3), np.array([5e5, 5e6, 0.0]), ())
    for far in (1e9, 1e300, np.nan):
        with pytest.raises(InputError, match="wanted one within 1e"):
            placed.from_world(Pose(np.eye(3), np.array([0.0, far, 0.0])))
    pose = Pose(exp_so3(np.array([0.3, 0.4, 0.5])), np.array([5e5 + 1, 5e6 + 2, 3.0]))
    np.testing.assert_allclose(placed.to_world(placed.from_world(pose)).center_world, pose.center_world)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A made room with a result for each of two panoramas, in a folder with a blank in its name."""
    folder = tmp_path_factory.mktemp("my room")
    arguments = ["--seed", "7", "--points", "30000", "--panoramas", "1", "--width", "256", "--quiet"]
    assert (
        make_room.main(
            ["--out", str(folder), *arguments, "--size", "4", "3", "2.5", "--variants", "clean", "tilt"]
        )
        == 0
    )
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
    assert lines[0]["seen_share"] > 0.95


def test_the_same_pose_from_each_source_gives_the_same_picture(run, scene, tmp_path):
    pose = read_scene(scene).by_name["tilt_0.jpg"].pose
    np.savetxt(tmp_path / "T.txt", T_world_from_cam(pose), fmt="%.17g")
    heading, pitch, roll = heading_pitch_roll_deg(pose)
    sources = {
        "result": ["--result", scene / "poses.jsonl", "--pano", "tilt_0.jpg"],
        "queries": ["--queries", scene / "queries.json", "--pano", "images/tilt_0.jpg"],
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


def test_depth_in_millimetres_says_nothing_and_too_far():
    depth = np.array([[1.2345, np.inf], [65.6, 1e6]], np.float32)
    png = render_pose.depth_file(depth, ".png")
    read = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    assert read.dtype == np.uint16
    assert read.tolist() == [[1234, 0], [65535, 65535]]


def test_a_prepared_map_stands_in_place_of_the_cloud(run, scene, tmp_path):
    arguments = ["--cloud", str(scene / "cloud.ply"), "--out", str(scene / "cloud.map"), "--quiet"]
    assert prepare_map.main(arguments) == 0
    pano = ["--queries", scene / "queries.json", "--pano", "tilt_0.jpg", "--width", 128]
    for cloud in ("cloud.ply", "cloud.map"):
        assert run(*pano, "--out", tmp_path / f"{cloud}.png", cloud=cloud)[0] == 0
    both = [cv2.imread(str(tmp_path / f"cloud.{kind}.png")).ravel() for kind in ("ply", "map")]
    assert np.corrcoef(*both)[0, 1] > 0.98


def test_a_descent_is_shown_with_where_it_ended(run, scene, tmp_path, monkeypatch):
    monkeypatch.setattr(animation, "MAX_FRAMES", 5)
    pano = ["--queries", scene / "queries.json", "--pano", "clean_0.jpg", "--animate"]
    seeded = [*pano, tmp_path / "a.gif", "--shake", 0.1, 3, "--seed", 5, "--solver", "gauss-newton"]
    code, (line,), err = run(*seeded)
    assert (code, err) == (0, "")
    assert line["start_distance"] == pytest.approx(0.1)
    assert line["end_distance"] < 0.02
    assert line["frames"] == 5
    content = (tmp_path / "a.gif").read_bytes()
    assert run(*seeded)[1] == [line]
    assert (tmp_path / "a.gif").read_bytes() == content
    center = read_scene(scene).by_name["clean_0.jpg"].pose.center_world + np.array([0.1, 0.0, 0.0])
    code, (line,), _ = run(*pano, tmp_path / "frames", "--start", *center, "--solver", "lbfgs")
    assert (code, line["start_distance"]) == (0, pytest.approx(0.1))
    assert len(list((tmp_path / "frames").iterdir())) == 5


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--at", 0, 0, 1], "--out, --animate: found none"),
        (["--at", 0, 0, 1, "--out", "a.png", "--width", 101], "--width: found 101, wanted an even number"),
        (["--at", 0, 0, 1, "--out", "a.bmp"], "--out: found a.bmp, wanted .png, .jpg"),
        (["--at", 0, 0, 1, "--out", "a.png", "--depth", "a.exr"], "--depth: found a.exr"),
        (["--at", 0, 0, 1, "--out", "a", "--depth", "a.png"], "found no single picture"),
        (["--at", 0, 0, "nan", "--out", "a.png"], "found a number that is not finite"),
        (["--at", 0, 0, 1, "--animate", "a.gif"], "--animate: found no panorama, wanted --photo"),
        (["--pose", "T.txt", "--heading", 3, "--out", "a.png"], "found without --at"),
        (["--at", 0, 0, 1, "--out", "a.png", "--seed", -1], "--seed: found -1"),
        (["--at", 0, 0, 1, "--out", "a.png", "--scale", 0], "--scale: found 0"),
    ],
)
def test_wrong_usage(run, arguments, message):
    code, lines, err = run(*arguments)
    assert (code, lines) == (2, [])
    assert message in err


def test_bad_input_leaves_nothing(run, scene, tmp_path):
    (tmp_path / "T.txt").write_text("1 2 3\n")
    result = ["--result", scene / "poses.jsonl"]
    for arguments, message in (
        ([*result, "--out", tmp_path / "a.png"], "found 2 poses, wanted one"),
        ([*result, "--pano", "x.jpg", "--out", tmp_path / "a.png"], "found no pose, wanted that of x.jpg"),
        ([*result, "--out", scene], "found a folder that is not empty"),
        ([*result, "--out", tmp_path / "no" / "a.png"], "found no folder"),
        (["--pose", tmp_path / "T.txt", "--out", tmp_path / "a.png"], "wanted the 4 x 4 numbers"),
        (["--pose", tmp_path / "no.txt", "--out", tmp_path / "a.png"], "no.txt"),
        (["--at", 0, 0, 1e30, "--out", tmp_path / "a.png"], "found a camera at [0.0, 0.0, 1e+30]"),
        (["--at", 0, 0, 1, "--photo", tmp_path / "no.jpg", "--animate", tmp_path / "a.gif"], "no.jpg"),
    ):
        code, lines, err = run(*arguments)
        assert (code, lines) == (3, []), arguments
        assert message in err
        assert err.count("\n") == 1
    assert run(*result, "--out", tmp_path / "a", cloud="no.ply")[0] == 3
    assert [path.name for path in tmp_path.iterdir()] == ["T.txt"]


def test_interrupts_and_surprises_have_codes_of_their_own(run, tmp_path, monkeypatch):
    for error, code in ((KeyboardInterrupt, 130), (ZeroDivisionError, 4)):

        def fail(*arguments, error=error):
            raise error

        monkeypatch.setattr(render_pose, "picture_at", fail)
        assert run("--at", 1, 1, 1, "--out", tmp_path / "a.png")[0] == code
    assert not list(tmp_path.iterdir())


def test_help_runs():
    command = [sys.executable, ROOT / "tools" / "render_pose.py", "--help"]
    text = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert "--mask-out" in text
