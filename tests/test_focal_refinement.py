"""A calibration that is a first guess: what matches and the picture make of it."""

from types import SimpleNamespace

import numpy as np
import pytest
from rooms import scan_map
from test_localize_cameras import place, scan

import piccolo
from piccolo.camera import Calibration, Camera, Mount
from piccolo.camera.model import pinhole
from piccolo.camera.resampling import View, recalibrated, sphere_of
from piccolo.coarse_to_fine import focal_refinement as focal
from piccolo.coarse_to_fine.query import prepare_query
from piccolo.coarse_to_fine.settings import CoarseToFineSettings
from piccolo.geometry.pose import Pose, exp_so3
from piccolo.local_features.matching import Matches
from piccolo.panorama import ReadOptions, panorama_of_array
from piccolo.runtime.threads import Workers
from piccolo.scenes.synthetic.photographs import picture_by

TRUE = Mount(Camera("SIMPLE_RADIAL", 640, 480, (400.0, 320.0, 240.0, -0.1)))
GIVEN = Mount(Camera("SIMPLE_RADIAL", 640, 480, (440.0, 320.0, 240.0, 0.0)))


def _seen(mount, pose, num, seed=3, depths=(2.0, 8.0)):
    """Matches of points that a camera sees exactly, as a photo read with GIVEN has them."""
    rng = np.random.default_rng(seed)
    pixels = rng.uniform([20, 20], [620, 460], (num, 2))
    rays = mount.camera.rays(pixels)[0] * rng.uniform(*depths, (num, 1))
    points = rays @ pose.R_cam_from_world + pose.center_world
    directions = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    up = np.cross(directions, np.cross([0.0, 0.0, 1.0], directions))
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    ranges = np.linalg.norm(rays, axis=1)
    return Matches(
        np.arange(num, dtype=np.int32),
        GIVEN.camera.rays(pixels)[0].astype(np.float32),
        up.astype(np.float32),
        np.full(num, 0.02, np.float32),
        points.astype(np.float32),
        (directions @ pose.R_cam_from_world).astype(np.float32),
        (up @ pose.R_cam_from_world).astype(np.float32),
        (0.02 * ranges).astype(np.float32),
        np.ones(num, np.float32),
    )


def _by_matches(matches, pose, mount=GIVEN):
    """The camera that matches say, from a pose a little off."""
    off = Pose(exp_so3(np.array([0.01, -0.01, 0.02])) @ pose.R_cam_from_world, pose.center_world + 0.1)
    panorama = SimpleNamespace(cameras=(mount,))
    return focal.refine_by_matches(SimpleNamespace(matches=matches), off, panorama)


POSE = Pose(exp_so3(np.array([0.1, 0.05, 1.2])), np.array([1.0, -2.0, 1.5]))


def test_exact_matches_give_focal_length_and_distortion():
    matches = _seen(TRUE, POSE, 120)
    wrong = matches.points.copy()
    wrong[::6] += 1.0  # a sixth are of other places
    mount = _by_matches(matches._replace(points=wrong), POSE)
    assert mount.camera.params == pytest.approx((400.0, 320.0, 240.0, -0.1), abs=0.05)
    assert mount == GIVEN.with_camera(mount.camera)


def test_few_matches_give_the_focal_length_alone():
    ideal = Mount(Camera("SIMPLE_RADIAL", 640, 480, (400.0, 320.0, 240.0, 0.0)))
    mount = _by_matches(_seen(ideal, POSE, 40), POSE)
    assert mount.camera.params == pytest.approx((400.0, 320.0, 240.0, 0.0), abs=0.05)
    assert mount.camera.params[3] == 0.0


@pytest.mark.parametrize(
    ("num", "focal_px", "depths"),
    [
        (15, 400.0, (2.0, 8.0)),  # too few
        (60, 280.0, (2.0, 8.0)),  # further off than a guess may be
        (60, 400.0, (5000.0, 5000.1)),  # far away, where hardly a pose is told
    ],
)
def test_matches_that_do_not_tell_the_focal_length_leave_it(num, focal_px, depths):
    matches = _seen(Mount(pinhole(640, 480, focal_px)), POSE, num, depths=depths)
    found = _by_matches(matches, POSE)
    assert found is None or (depths[0] > 100.0 and abs(found.camera.focal[0] / 400.0 - 1.0) < 0.04)


def test_a_recalibrated_sphere_is_the_one_of_that_calibration():
    this, pose = place(1)
    before, after = Mount(pinhole(480, 360, 300.0)), Mount(pinhole(480, 360, 330.0))
    rgb = picture_by(before, this, pose, Workers(2))
    pixels = np.dstack([rgb, np.full(rgb.shape[:2], 255, np.uint8)])
    wrong, shown = sphere_of([View(before, pixels)], 1024)
    wanted, is_wanted = sphere_of([View(after, pixels)], 1024)
    found, is_valid = recalibrated(wrong, shown, before, after)
    assert (is_valid == is_wanted).mean() > 0.998
    both = is_valid & is_wanted
    assert np.abs(found[both].astype(int) - wanted[both]).mean() < 2.0
    assert not found[~shown].any()
    nothing = recalibrated(wrong, np.zeros_like(shown), before, after)
    assert not nothing[1].any()


def test_the_picture_tells_the_focal_length_to_one_and_a_half_per_cent():
    this, pose = place(1)
    rgb = picture_by(Mount(pinhole(640, 480, 320.0)), this, pose, Workers(2))
    options = ReadOptions(focal_px=320.0 * 1.015)
    panorama = panorama_of_array(rgb, np.ones(rgb.shape[:2], np.bool_), options)
    query = prepare_query(panorama, scan_map(5), CoarseToFineSettings(), Workers(2))
    mount = focal.refine_by_picture(query, scan().from_world(pose), panorama)
    assert mount.camera.focal[0] == pytest.approx(320.0, rel=0.015)


def test_a_photo_with_a_wrong_focal_length_is_localized():
    this, pose = place(1)
    rgb = picture_by(Mount(pinhole(640, 480, 320.0)), this, pose, Workers(2))
    wrong = scan().localize(rgb, focal_px=290.0, gravity="known")
    result = scan().localize(rgb, focal_px=290.0, gravity="known", refine_focal=True)
    (mount,) = result.cameras
    assert mount.camera.focal[0] == pytest.approx(320.0, rel=0.025)
    assert result.warnings[-1] == f"focal length 290.0 px refined to {mount.camera.focal[0]:.1f} px"
    assert result.evidence.score > wrong.evidence.score
    off, off_before = (np.linalg.norm(r.best_pose.center_world - pose.center_world) for r in (result, wrong))
    assert off < min(0.1, off_before)


def test_what_has_no_focal_length_is_refused_and_what_cannot_be_told_stays():
    with pytest.raises(
        piccolo.InputError, match="--refine-focal: found a part of a sphere, wanted the photo"
    ):
        scan().localize(np.zeros((64, 128, 3), np.uint8), refine_focal=True)
    rgb = np.random.default_rng(1).integers(0, 255, (120, 160, 3), np.uint8)
    result = scan().localize(rgb, focal_px=100.0, refine_focal=True)
    assert result.warnings[-1] == focal.NOT_REFINED
    assert result.cameras == (Mount(pinhole(160, 120, 100.0)),)


def test_pictures_of_a_result_are_made_with_its_refined_camera():
    found = (Mount(pinhole(640, 480, 321.5)),)
    options = ReadOptions(focal_px=300.0, refine_focal=True).refined(found)
    assert (options.focal_px, options.calibration.mounts) == (None, found)
    turned = Mount(pinhole(640, 480, 300.0), ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)))
    given = ReadOptions(calibration=Calibration("a.json", (turned,)), refine_focal=True)
    assert given.refined(found).calibration.mounts == (turned.with_camera(found[0].camera),)
    plain = ReadOptions(focal_px=300.0)
    assert plain.refined(found) is plain
