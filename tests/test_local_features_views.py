"""Views from which local features are found: where, and what they show."""

import cv2
import numpy as np
import pytest
import rooms

from piccolo.cloud.octree import build_octree
from piccolo.geometry.pose import Pose, exp_so3
from piccolo.geometry.sphere import compute_indices, pixel_rays
from piccolo.local_features.perspective_view import MULTIPLE, add_margin, cover_sphere, view_around
from piccolo.system.jobs.threads import Workers
from piccolo.views.view_image import fill_gaps, render_gray
from research.synthetic.raycast import cast_rays

TIER = "scene"

SPHERE = 512
FOCAL = 120.0
RAYS = pixel_rays(SPHERE)
STRAIGHT_UP = np.array([0.0, -np.pi / 2.0, 0.0])


def _shown(turn, half_width=0.7, half_height=0.5):
    """The mask of a pinhole picture whose axes are turned by a rotation vector."""
    x, y, z = np.moveaxis(RAYS @ exp_so3(np.asarray(turn)), -1, 0)
    return (x > 0.0) & (np.abs(y) < half_width * x) & (np.abs(z) < half_height * x)


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.0, 0.0, np.pi), (0.0, 0.4, -2.0), STRAIGHT_UP])
def test_a_view_holds_all_that_a_photo_shows(turn):
    is_valid = _shown(turn)
    view = view_around(is_valid, FOCAL, SPHERE)
    assert view.focal == FOCAL
    height, width = view.is_own.shape
    assert height % MULTIPLE == width % MULTIPLE == 0
    np.testing.assert_allclose(view.R_sphere_from_view @ view.R_sphere_from_view.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(view.R_sphere_from_view) == pytest.approx(1.0)
    np.testing.assert_allclose(view.R_sphere_from_view[:, 0], exp_so3(np.asarray(turn))[:, 0], atol=0.02)
    rows, columns = view.project(RAYS[is_valid])
    assert 3 < rows.min() < rows.max() < height - 4
    assert 3 < columns.min() < columns.max() < width - 4
    mask = view.cut_mask(add_margin(is_valid))
    assert (mask[rows, columns] == 255).mean() > 0.97
    assert not mask[[0, 0, -1, -1], [0, -1, 0, -1]].any()


def test_a_level_photo_is_not_turned_about_its_axis():
    """A side of the sphere's picture is a side of the view; its shape is that of the photo."""
    view = view_around(_shown((0.0, 0.0, 1.0), half_width=0.8, half_height=0.3), FOCAL, SPHERE)
    np.testing.assert_allclose(view.R_sphere_from_view[:, 2], [0.0, 0.0, 1.0], atol=1e-3)
    height, width = view.is_own.shape
    assert width > 2 * height
    steps = np.abs(np.diff(view.columns[height // 2]))
    np.testing.assert_allclose(steps, SPHERE / (2.0 * np.pi * FOCAL), rtol=0.5)


def test_what_is_too_wide_for_one_picture_has_no_view_around_it():
    assert view_around(_shown((0, 0, 0), half_width=1.0, half_height=0.5), FOCAL, SPHERE) is not None
    assert view_around(_shown((0, 0, 0), half_width=1.3, half_height=0.5), FOCAL, SPHERE) is None
    assert view_around(np.ones((SPHERE // 2, SPHERE), bool), FOCAL, SPHERE) is None
    assert view_around(np.zeros((SPHERE // 2, SPHERE), bool), FOCAL, SPHERE) is None


def test_pixels_of_a_view_show_what_they_are_cut_from():
    """A picture of the azimuth, across the seam: each pixel has that of its ray."""
    ramp = np.abs(np.arange(SPHERE) - SPHERE // 2).astype(np.float32) / (SPHERE // 2) * 255.0
    picture = np.repeat(ramp[None].astype(np.uint8), SPHERE // 2, axis=0)
    for view in (view_around(_shown((0.0, 0.1, 3.0)), FOCAL, SPHERE), cover_sphere(SPHERE)[4]):
        image = view.cut(add_margin(picture))
        rows, columns = np.mgrid[5 : image.shape[0] : 20, 5 : image.shape[1] : 20].reshape(2, -1)
        height, width = image.shape
        across = (0.5 * width - 0.5 - columns) / view.focal
        up = (0.5 * height - 0.5 - rows) / view.focal
        rays = np.stack([np.ones(len(up)), across, up], axis=1) @ view.R_sphere_from_view.T
        azimuth = np.abs(np.arctan2(rays[:, 1], rays[:, 0]))
        np.testing.assert_allclose(image[rows, columns], azimuth / np.pi * 255.0, atol=2.5)
        np.testing.assert_array_equal(view.project(rays), (rows, columns))


def test_each_direction_is_one_views_own():
    owners = sum(
        np.isin(np.arange(RAYS[..., 0].size), view.find_own(RAYS.reshape(-1, 3))).astype(int)
        for view in cover_sphere(SPHERE)
    )
    np.testing.assert_array_equal(owners, 1)


WIDTH = 256
EVERYWHERE = np.ones((WIDTH // 2, WIDTH), bool)
LEVEL = Pose(np.eye(3), np.zeros(3))


def _octree(*shells):
    """An octree of points (N, 3) [m] of one grey each."""
    points = np.concatenate([points for points, _ in shells]).astype(np.float32)
    colors = np.concatenate([np.full((len(points), 3), gray, np.uint8) for points, gray in shells])
    return build_octree(rooms.voxels(points, colors))


def _sphere(radius, width=WIDTH):
    return radius * pixel_rays(width).reshape(-1, 3)


def test_the_nearest_surface_wins_with_its_grey_and_range():
    near = _sphere(1.5)
    near = near[np.abs(near[:, 1]) < 0.7]
    near = near[(near[:, 0] > 0) & (np.abs(near[:, 2]) < 0.7)]
    view = render_gray(_octree((_sphere(3.0, 512), 60), (near, 200)), LEVEL, EVERYWHERE)
    rays = pixel_rays(WIDTH)
    is_near = (rays[..., 0] > 0) & (np.abs(rays[..., 1:]).max(axis=-1) < 0.42)
    is_far = (rays[..., 0] < 0) | (np.abs(rays[..., 1:]).max(axis=-1) > 0.52)
    assert view.is_filled.all()
    for where, gray, distance in ((is_near, 200, 1.5), (is_far, 60, 3.0)):
        np.testing.assert_allclose(view.gray[where], gray, atol=1)
        shown = view.ranges[where & (view.ranges > 0)]
        assert len(shown) > 0.95 * where.sum()
        np.testing.assert_allclose(shown, distance, rtol=0.02)


def test_ranges_and_greys_are_those_of_the_room():
    _ = rooms.scene(1)[1]
    true_pose = rooms.scene(1)[2]
    room = rooms.room(1)[0].rooms[0]
    view = render_gray(rooms.scan_map(1).octree, Pose(np.eye(3), true_pose.center_world), EVERYWHERE)
    rays = pixel_rays(WIDTH).reshape(-1, 3)
    center_world = rooms.query(1).pose.center_world
    ranges, rgb, _ = cast_rays(room, center_world, rays, Workers(2), "room")
    is_shown = view.ranges.ravel() > 0
    assert is_shown.mean() > 0.8
    assert np.median(np.abs(view.ranges.ravel() - ranges)[is_shown]) < 0.02
    assert (np.abs(view.ranges.ravel() - ranges)[is_shown] < 0.1).mean() > 0.93
    gray = 255.0 * rgb @ [0.299, 0.587, 0.114]
    assert np.corrcoef(view.gray.ravel()[is_shown], gray[is_shown])[0, 1] > 0.85


def test_a_turned_camera_sees_the_same_along_its_rays():
    """Looked up at the nearest pixel of the level picture; what differs lies at edges."""
    center = rooms.scene(1)[2].center_world
    R = exp_so3(np.array([0.5, -0.4, 1.3]))
    level = render_gray(rooms.scan_map(1).octree, Pose(np.eye(3), center), EVERYWHERE)
    turned = render_gray(rooms.scan_map(1).octree, Pose(R, center), EVERYWHERE)
    indices = compute_indices(pixel_rays(WIDTH) @ R, WIDTH)  # x_map = R_cam_from_map.T @ x_cam
    gray = level.gray[indices].astype(float)
    ranges = level.ranges[indices]
    is_shown = turned.is_filled & level.is_filled[indices]
    assert is_shown.mean() > 0.95
    assert np.median(np.abs(turned.gray - gray)[is_shown]) <= 3
    assert np.corrcoef(turned.gray[is_shown], gray[is_shown])[0, 1] > 0.93
    is_seen = (turned.ranges > 0) & (ranges > 0)
    assert is_seen.mean() > 0.8
    assert np.median(np.abs(turned.ranges - ranges)[is_seen]) < 0.02
    assert (np.abs(turned.ranges - ranges)[is_seen] < 0.1).mean() > 0.95
    unturned = level.gray.astype(float)
    assert np.corrcoef(turned.gray[is_shown], unturned[is_shown])[0, 1] < 0.5


def test_only_what_the_mask_asks_for_is_drawn():
    """Inside of it as without a mask, and hardly anything beyond."""
    pose = Pose(exp_so3(np.array([0.5, -0.4, 1.3])), rooms.scene(1)[2].center_world)
    octree = rooms.scan_map(1).octree
    is_drawn = np.zeros((WIDTH // 2, WIDTH), bool)
    is_drawn[30:100, 60:180] = True
    part, whole = render_gray(octree, pose, is_drawn), render_gray(octree, pose, EVERYWHERE)
    inner = np.s_[50:80, 85:155]
    np.testing.assert_array_equal(part.gray[inner], whole.gray[inner])
    np.testing.assert_array_equal(part.ranges[inner], whole.ranges[inner])
    beyond = ~cv2.dilate(is_drawn.view(np.uint8), np.ones((35, 35), np.uint8)).view(bool)
    assert not part.is_filled[beyond].any()
    assert (part.ranges[beyond] == 0).all()


def test_what_is_seen_through_a_thin_scan_is_dropped():
    """Before a wall at 4 m a sheet at 1 m of which one pixel in seven was scanned."""
    sheet = _sphere(1.0, 96)
    sheet = sheet[(sheet[:, 0] > 0.5)]
    view = render_gray(_octree((_sphere(4.0, 512), 40), (sheet, 220)), LEVEL, EVERYWHERE)
    behind_sheet = pixel_rays(WIDTH)[..., 0] > 0.7
    assert (view.ranges[behind_sheet] < 1.5).all()
    assert view.is_filled[behind_sheet].mean() > 0.9  # all but where hardly a quarter is left
    is_inner = pixel_rays(WIDTH)[..., 0] > 0.9  # what is filled takes up some of the wall next to the sheet
    assert (view.gray[is_inner & view.is_filled] > 200).all()
    aside = pixel_rays(WIDTH)[..., 0] < 0.3
    np.testing.assert_allclose(view.ranges[aside & (view.ranges > 0)], 4.0, rtol=0.02)


@pytest.mark.parametrize(("gap", "is_closed"), [(3, True), (6, True), (100, False)])
def test_gaps_are_filled_with_what_is_around_them(gap, is_closed):
    gray = np.full((128, 256), 0.25, np.float32)
    weight = np.ones((128, 256), np.float32)
    gray[:, 128:] = 0.75
    weight[14 : 14 + gap, 30 : 30 + gap] = 0.0
    filled, is_filled = fill_gaps(gray * weight, weight)
    assert is_filled[14 + gap // 2, 30 + gap // 2] == is_closed
    np.testing.assert_array_equal(filled[weight > 0], gray[weight > 0])
    if is_closed:
        assert is_filled.all()
        np.testing.assert_allclose(filled, gray, atol=1e-3)
    assert not fill_gaps(0 * gray, 0 * weight)[1].any()


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.5, -0.4, 1.3)])
def test_a_pinhole_picture_shows_what_the_sphere_shows_along_its_rays(turn):
    pose = Pose(exp_so3(np.array(turn)), rooms.scene(1)[2].center_world)
    octree = rooms.scan_map(1).octree
    focal = WIDTH / (2.0 * np.pi)
    sphere = render_gray(octree, pose, EVERYWHERE)
    pinhole = render_gray(octree, pose, np.ones((48, 64), bool), focal)
    across, up = np.meshgrid(31.5 - np.arange(64), 23.5 - np.arange(48))
    indices = compute_indices(np.stack([np.full(up.shape, focal), across, up], axis=-1), WIDTH)
    is_seen = (pinhole.ranges > 0) & (sphere.ranges[indices] > 0)
    assert is_seen.mean() > 0.8
    difference = np.abs(pinhole.ranges - sphere.ranges[indices])[is_seen]
    assert np.median(difference) < 0.02
    assert (difference < 0.1).mean() > 0.9
    gray = sphere.gray[indices].astype(float)
    assert np.corrcoef(pinhole.gray[is_seen], gray[is_seen])[0, 1] > 0.9
    mirrored = sphere.gray[indices][:, ::-1]
    assert np.corrcoef(pinhole.gray[is_seen], mirrored[is_seen])[0, 1] < 0.7


def test_a_pinhole_picture_shows_nothing_of_what_is_behind_it_or_beside():
    """A wall behind, and one beside that no pixel shows; edges do not continue at the other side."""
    behind = _sphere(2.0)
    behind = behind[behind[:, 0] < 0.5]
    view = render_gray(_octree((behind, 90)), LEVEL, np.ones((48, 64), bool), 40.0)
    assert not view.is_filled.any()
    left = _sphere(2.0, 512)
    left = left[(left[:, 0] > 0.0) & (left[:, 1] > 0.9 * left[:, 0])]
    shown = render_gray(_octree((left, 90)), LEVEL, np.ones((48, 64), bool), 30.0)
    assert shown.is_filled[10:40, :2].all()
    assert not shown.is_filled[:, 16:].any()
