"""Pictures of the cloud from surfels: kernel, closing, hiding; poses in files."""

import math

import cv2
import naive
import numpy as np
import poses
import pytest
import rooms
from hypothesis import given, settings, strategies as st
from refusals import mutated, read_or_refused

from piccolo.apps.render_pose import read_pose_matrix
from piccolo.geometry.points import LocalCloud, pack_points
from piccolo.geometry.pose import (
    Pose,
    R_cam_from_angles,
    angle_between,
    exp_so3,
    heading_pitch_roll_deg,
    step,
)
from piccolo.geometry.sphere import compute_pixels, pixel_rays
from piccolo.photo.panorama.picture import encode_image
from piccolo.system.errors import InputError
from piccolo.system.jobs.threads import Workers
from piccolo.views.pictures import fill_holes
from piccolo.views.surfels import (
    BAND_OFFSET,
    MAX_SLOPE,
    MIN_RADIUS_PX,
    SURFACE_BAND,
    axes_of_pixels,
    make_surfels,
    render_points,
    splat,
)
from piccolo.views.zbuffer import View
from research.synthetic.raycast import cast_rays

WORKERS = Workers(2)
WIDTH = 256
SEED = 3


@pytest.fixture(scope="module")
def points():
    return rooms.packed(SEED)


@pytest.fixture(scope="module")
def true_ranges():
    """Range (H, W) [m] at the tilted query, by casting rays at the room."""
    pose = rooms.query(SEED, "tilt").pose
    rays = pixel_rays(WIDTH).reshape(-1, 3) @ pose.R_cam_from_world
    ranges, *_ = cast_rays(rooms.room(SEED)[0].rooms[0], pose.center_world, rays, WORKERS, "cast")
    return ranges.reshape(-1, WIDTH)


@pytest.fixture(scope="module")
def tilted(points):
    return render_points(points, rooms.local(SEED, rooms.query(SEED, "tilt").pose), WIDTH, WORKERS)


def test_splat_equals_its_twin_over_seam_and_poles():
    rng = np.random.default_rng(0)
    center = rng.normal(size=(300, 3)) * [2.0, 2.0, 1.0]
    center[:4] = [[-3.0, 0.01, 0.2], [-3.0, -0.01, -0.2], [0.02, 0.0, 2.0], [0.0, 0.01, -2.0]]
    distance = np.linalg.norm(center, axis=1)
    normal = center / distance[:, None] + 0.7 * rng.normal(size=(300, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    radius = np.minimum(rng.uniform(0.001, 0.4, 300), 0.3 * distance)
    along = (center * normal).sum(axis=1)
    surfels = np.column_stack([center, normal, along, radius**-2.0, distance]).astype(np.float32)
    rgb = rng.integers(0, 256, (300, 3), dtype=np.uint8)
    angles = np.maximum(np.arcsin(radius / distance), MIN_RADIUS_PX * 2 * np.pi / 64)
    over = np.sin(angles) * distance / np.hypot(*center.T[:2])  # 1 or more: a pole is within
    across = np.where(over < 1.0, np.arcsin(np.minimum(over, 1.0)), np.pi)
    pixels = np.column_stack([across, angles]) * 64 / math.tau
    extents = np.column_stack([*compute_pixels(center, 64), pixels]).astype(np.float32)
    axes = axes_of_pixels(64)
    depth = np.full((32, 64), np.inf, np.float32)
    sums = np.zeros((32, 64, 5), np.float32)
    packed = pack_points(center.astype(np.float32), rgb).rgbx
    for lo in (0, 11):  # two strips of rows
        part = slice(lo, 11 if lo == 0 else 32)
        splat(surfels, packed, extents, *axes, lo, depth[part], sums[:0])
        splat(surfels, packed, extents, *axes, lo, depth[part], sums[part])
    limits = MIN_RADIUS_PX, MAX_SLOPE, SURFACE_BAND, BAND_OFFSET
    expected_depth, expected_rgb = naive.splat(surfels.astype(float), rgb, 64, *limits)
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
        view = render_points(points, pose, WIDTH, WORKERS)
        rgb = fill_holes(view.rgb, view.is_seen).astype(float)
        return np.corrcoef(rgb.ravel(), photo.ravel())[0, 1]

    true_pose = rooms.local(SEED, query.pose)
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
    pose = rooms.local(SEED, rooms.query(SEED, "tilt").pose)
    rays = pixel_rays(WIDTH) @ pose.R_cam_from_world
    surface = pose.center_world + rays * true_ranges[..., None]
    low = points.z.max() - 0.1  # the ceiling: nothing is behind it
    picture = render_points(points.take(np.flatnonzero(points.z < low)), pose, WIDTH, WORKERS)
    is_missing = surface[..., 2] > low
    is_there = (surface[..., 2] < low) & tilted.is_seen
    # surfels at the upper end of the walls reach some pixels into it
    inner, other = (cv2.erode(m.astype(np.uint8), np.ones((9, 9))) > 0 for m in (is_missing, is_there))
    assert inner.mean() > 0.1
    assert not picture.is_seen[inner].any()
    assert other.mean() > 0.4
    assert picture.is_seen[other].all()


def test_a_sparse_wall_hides_what_is_behind_it():
    rng = np.random.default_rng(1)
    near = np.column_stack([np.full(4000, 2.0), rng.uniform(-2, 2, (4000, 2))])  # about 6 cm apart
    far = np.column_stack([np.full(40000, 4.0), rng.uniform(-3, 3, (40000, 2))])
    colors = np.repeat(np.array([[255, 0, 0], [0, 0, 255]], np.uint8), [4000, 40000], axis=0)
    cloud = pack_points(np.concatenate([near, far]).astype(np.float32), colors)
    pose = Pose(np.eye(3), np.zeros(3))
    picture = render_points(cloud, pose, 1024, WORKERS)
    front = np.s_[200:312, 450:574]
    assert picture.is_seen[front].mean() > 0.97
    rgb = fill_holes(picture.rgb, picture.is_seen)[front]
    assert (rgb[..., 2] < 40).mean() > 0.99
    assert abs(picture.depth[256, 512] - 2.0) < 0.01


def test_the_rim_beside_a_thing_in_front_is_seen():
    """A rod before a wall: render.visible_points takes the wall away for two degrees beside it."""
    grid = np.stack(np.meshgrid(np.linspace(-3, 3, 400), np.linspace(-3, 3, 400)), axis=-1).reshape(-1, 2)
    wall = np.column_stack([np.full(len(grid), 4.0), grid])
    rod = np.column_stack([np.full(2000, 1.0), np.zeros(2000), np.linspace(-1, 1, 2000)])
    colors = np.repeat(np.array([[0, 0, 255], [255, 0, 0]], np.uint8), [len(wall), len(rod)], axis=0)
    cloud = pack_points(np.concatenate([wall, rod]).astype(np.float32), colors)
    picture = render_points(cloud, Pose(np.eye(3), np.zeros(3)), 720, WORKERS)
    row = picture.rgb[180]
    assert (row[360] == [255, 0, 0]).all()
    assert (row[[356, 363], 2] > 200).all()  # two degrees are four pixels


def test_turning_the_camera_rolls_the_picture_with_the_same_bits_on_any_number_of_threads(points):
    pose = rooms.local(SEED, rooms.query(SEED).pose)
    straight = render_points(points, pose, 128, Workers(1))
    again = render_points(points, pose, 128, Workers(2))
    np.testing.assert_array_equal(straight.rgb, again.rgb)
    np.testing.assert_array_equal(straight.depth, again.depth)
    turned = Pose(exp_so3(np.array([0, 0, -2 * np.pi * 9 / 128])) @ pose.R_cam_from_world, pose.center_world)
    rolled = render_points(points, turned, 128, WORKERS)
    is_same = np.isclose(rolled.depth, np.roll(straight.depth, 9, axis=1), rtol=1e-3, equal_nan=True)
    assert is_same.mean() > 0.99


@pytest.mark.parametrize("size", [(8, 16), (25, 50), (37, 74), (1, 2)])
def test_holes_take_the_colours_around_them_and_nothing_else_changes(size):
    rng = np.random.default_rng(2)
    rgb = rng.integers(100, 200, (*size, 3), dtype=np.uint8)
    depth = np.where(rng.random(size) < 0.3, np.inf, 1.0).astype(np.float32)
    depth[0, 0] = 1.0
    picture = View(depth, np.where(np.isfinite(depth)[..., None], rgb, 0).astype(np.uint8))
    filled = fill_holes(picture.rgb, picture.is_seen)
    np.testing.assert_array_equal(filled[picture.is_seen], rgb[picture.is_seen])
    assert filled.min() >= 98
    assert filled.max() <= 201
    nothing = View(np.full(size, np.inf, np.float32), np.zeros((*size, 3), np.uint8))
    assert not fill_holes(nothing.rgb, nothing.is_seen).any()


def test_a_hole_at_the_seam_is_closed_from_both_sides():
    rgb = np.zeros((32, 64, 3), np.uint8)
    rgb[:, 32:] = 200
    depth = np.ones((32, 64), np.float32)
    depth[:, :4] = depth[:, -4:] = np.inf
    is_seen = np.isfinite(depth)
    filled = fill_holes(np.where(is_seen[..., None], rgb, 0).astype(np.uint8), is_seen)
    middle = filled[16, [60, 62, 0, 2], 0].astype(int)
    assert (np.diff(middle) < 0).all()
    assert 20 < middle[1:3].mean() < 180


def test_points_in_the_air_and_lines_are_no_surface():
    rng = np.random.default_rng(4)
    wall = np.column_stack([rng.uniform(0, 2, (5000, 2)), np.zeros(5000)])
    stray = np.column_stack([rng.uniform(0, 2, (5, 2)), rng.uniform(0.5, 1.0, 5)])
    line = np.column_stack([np.linspace(5, 6, 100), np.zeros(100), np.zeros(100)])
    points = np.concatenate([wall, stray, line]).astype(np.float32)
    surfels = make_surfels(pack_points(points, np.zeros(points.shape, np.uint8)), WORKERS)
    assert not (surfels.points.z > 0.4).any()
    of_line = surfels.points.x > 4
    assert of_line.sum() > 90
    assert not surfels.normals[of_line].any()
    of_wall = ~of_line
    assert of_wall.sum() > 4950
    assert (abs(surfels.normals[of_wall, 2]) > 0.999).mean() > 0.99


def test_few_points_are_drawn_and_pictures_too_large_refused():
    for count in (1, 5, 11, 40):
        cloud = np.zeros((count + 1, 3), np.float32)
        cloud[1:] = [1.0, 0.0, 0.0]
        packed = pack_points(cloud, np.full((count + 1, 3), 9, np.uint8))
        picture = render_points(packed, Pose(np.eye(3), np.zeros(3)), 32, WORKERS)
        assert picture.is_seen.any()
        assert (picture.rgb[picture.is_seen] == 9).all()
    with pytest.raises(OSError, match=r"could not be encoded as \.jpg"):
        encode_image(np.zeros((1, 70_000, 3), np.uint8), ".jpg")


@given(st.floats(0, 359.9), st.floats(-89, 89), st.floats(-179, 179))
@settings(max_examples=50)
def test_angles_turn_the_camera_as_exports_read_it(heading, pitch, roll):
    R_cam_from_world = R_cam_from_angles(heading, pitch, roll)
    back = heading_pitch_roll_deg(Pose(R_cam_from_world, np.zeros(3)))
    assert angle_between(R_cam_from_angles(*back), R_cam_from_world) < 1e-6
    np.testing.assert_allclose(back[1:], [pitch, roll], atol=1e-6)


@given(st.data())
@settings(max_examples=100)
def test_a_pose_file_is_read_or_refused(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("pose") / "T.txt"
    pose = poses.tilted_poses(1)[0]
    text = "# T_world_from_cam\n" + "\n".join(
        " ".join(f"{x:.9f}" for x in row) for row in pose.T_world_from_cam
    )
    path.write_text(text)
    read = read_pose_matrix(path)
    np.testing.assert_allclose(read.center_world, pose.center_world, atol=1e-8)
    assert angle_between(read.R_cam_from_world, pose.R_cam_from_world) < 1e-8
    path.write_bytes(mutated(data.draw, st.integers, text.encode()))
    read_or_refused(read_pose_matrix, path)


def test_a_camera_too_far_for_the_kernels_is_refused(points):
    placed = LocalCloud(np.eye(3), np.array([5e5, 5e6, 0.0]), points, ())
    for far in (1e9, 1e300, np.nan):
        with pytest.raises(InputError, match="wanted one within 1e"):
            placed.from_world(Pose(np.eye(3), np.array([0.0, far, 0.0])))
    pose = Pose(exp_so3(np.array([0.3, 0.4, 0.5])), np.array([5e5 + 1, 5e6 + 2, 3.0]))
    np.testing.assert_allclose(placed.to_world(placed.from_world(pose)).center_world, pose.center_world)
