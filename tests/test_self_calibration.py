"""Pose and corrections of a picture's geometry, fitted together: equations, claims, bent panoramas."""

import math
from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pytest
import rooms
from rooms import as_panorama
from scipy import special
from scipy.spatial.transform import Rotation

from piccolo.evidence.claimed_sphere import CLAIM, SphereFit, count_deviations
from piccolo.evidence.self_calibration import FreeEnd, LensEstimate, displace_blocks
from piccolo.geometry.pose import Pose, exp_so3, yaw_rotation
from piccolo.geometry.pose_gaussian import probability_of_ball
from piccolo.geometry.sphere import compute_pixels
from piccolo.judge.claim import MANY, Claim, PictureCorrections, as_normal, marginal
from piccolo.judge.result import Result
from piccolo.judge.result_parts import SphereGeometry
from piccolo.optimize.channel_loss import ChannelProblem
from piccolo.optimize.corrected_equations import sum_free_equations
from piccolo.photo.camera import Camera, Mount
from piccolo.photo.camera.corrections import Corrections
from piccolo.photo.camera.model import pinhole, whole_sphere
from piccolo.photo.panorama.texels import pack_texels

TIER = "scene"

SEED = 5
LENSES = {
    "sphere": Mount(whole_sphere(512, 256)),
    "part of a sphere": Mount(Camera("PARTIAL_EQUIRECTANGULAR", 512, 256, (85.0, 95.0, 250.0, 120.0))),
    "pinhole": Mount(pinhole(320, 240, 160.0)),
    "distorted": Mount(Camera("OPENCV", 320, 240, (160.0, 158.0, 162.0, 119.0, -0.1, 0.02, 1e-3, -1e-3))),
    "fisheye": Mount(Camera("OPENCV_FISHEYE", 256, 256, (75.0, 75.0, 128.0, 128.0, 0.01, -0.003, 0.0, 0.0))),
}


def _values(mount):
    return np.array([0.02, -0.03, 0.015, -0.02, 0.05])[: len(Corrections(mount).names)]


def _points(mount, count=400):
    """Points that a camera shows, in its axes."""
    rng = np.random.default_rng(3)
    camera = mount.camera
    pixels = rng.uniform(0.2, 0.8, (count, 2)) * (camera.width, camera.height)
    rays, is_there = camera.rays(pixels)
    return np.ascontiguousarray((rays[is_there] * rng.uniform(1.0, 5.0, (is_there.sum(), 1))).T, np.float32)


@pytest.mark.parametrize("name", LENSES)
def test_moves_are_the_derivatives_of_what_is_shown(name):
    mount = LENSES[name]
    corrections = Corrections(mount)
    points = _points(mount)
    values = _values(mount)
    moves = corrections.displace(points, values).moves
    for k in range(len(values)):
        step = np.eye(len(values))[k] * 2e-3
        ends = [corrections.displace(points, values + sign * step).points for sign in (1.0, -1.0)]
        expected = (ends[0].astype(float) - ends[1]) / 4e-3
        np.testing.assert_allclose(moves[k], expected, atol=3e-3 * np.abs(points).max())


@pytest.mark.parametrize("name", ["sphere", "part of a sphere"])
def test_a_sphere_with_corrections_is_a_camera_that_sees_points_where_they_are_shown(name):
    """The pixel by the camera as corrected is that of the displaced point by the camera as claimed."""
    mount = LENSES[name]
    corrections = Corrections(mount)
    points = _points(mount)
    values = _values(mount)
    shown = corrections.displace(points, values)
    assert shown.is_shown.all()
    by_corrected, _ = corrections.apply(values).pixels(points.T.astype(float))
    by_claimed, _ = mount.camera.pixels(shown.points.T.astype(float))
    np.testing.assert_allclose(by_corrected, by_claimed, atol=2e-3)


def test_what_lies_beyond_the_poles_and_the_seam_is_not_shown():
    corrections = Corrections(LENSES["sphere"])
    points = np.float32([[0.05, 0.0, 1.0], [-1.0, 0.02, 0.0], [1.0, 0.3, 0.2]]).T
    assert corrections.displace(points, np.array([0.0, 0.2, 0.0])).is_shown.tolist() == [0.0, 1.0, 1.0]
    assert corrections.displace(points, np.array([0.05, 0.0, 0.0])).is_shown.tolist() == [1.0, 0.0, 1.0]


def test_a_camera_that_shows_a_part_of_the_sphere_is_inverted_also_beside_its_seam():
    camera = LENSES["part of a sphere"].camera
    pixels = np.random.default_rng(4).uniform(0.0, 1.0, (200, 2)) * (camera.width, camera.height)
    rays, is_there = camera.rays(pixels)
    again, is_in = camera.pixels(rays)
    is_one = np.abs((pixels[:, 0] - 250.0) / 85.0) < math.pi  # it shows 345 degrees, so each ray once
    assert is_there.all()
    assert is_in[is_one].all()
    np.testing.assert_allclose(again[is_one], pixels[is_one], atol=1e-9)
    whole = whole_sphere(512, 256)
    expected = np.stack(compute_pixels(rays, 512), axis=1)
    np.testing.assert_allclose(whole.pixels(rays)[0], expected, atol=1e-9)


def _problem(mount):
    """Points in the camera's axes, and a smooth image."""
    rng = np.random.default_rng(7)
    rough = rng.integers(0, 255, (8, 16, 3)).astype(np.uint8)
    texels = pack_texels(cv2.resize(rough, (512, 256), interpolation=cv2.INTER_CUBIC))
    points = _points(mount, 20_000)
    channels = rng.uniform(60.0, 190.0, points.shape).astype(np.float32)
    weights = rng.uniform(0.5, 1.0, points.shape[1]).astype(np.float32)
    return ChannelProblem(np.ascontiguousarray(points), channels, weights, texels.rgbx, texels.width, 40.0)


@pytest.mark.parametrize("name", LENSES)
def test_gradients_are_those_of_the_loss(name):
    """By central differences, with a turned camera, over points near the seam and the poles too."""
    mount = LENSES[name]
    corrections = Corrections(mount)
    problem = _problem(mount)
    begins = np.array([0, problem.points.shape[1]])
    turn = Rotation.from_rotvec([0.01, -0.02, 0.015]).as_matrix()

    def evaluate(step):
        moved = exp_so3(step[:3]) @ turn @ problem.points - step[3:6, None]
        shown = corrections.displace(np.ascontiguousarray(moved, np.float32), step[6:])
        return sum_free_equations(problem._replace(points=shown.points), shown.moves, begins)

    num = 6 + len(corrections.names)
    sums = evaluate(np.zeros(num))
    for k in range(num):
        step = np.eye(num)[k] * 2e-4
        slope = (evaluate(step).loss[0] - evaluate(-step).loss[0]) / 4e-4
        assert sums.gradients[0, k] == pytest.approx(slope, abs=0.015 * abs(sums.gradients[0]).max())


def test_sums_by_part_add_up_and_matrices_are_symmetric():
    problem = _problem(LENSES["pinhole"])
    moves = Corrections(LENSES["pinhole"]).displace(problem.points, np.zeros(5)).moves
    count = problem.points.shape[1]
    whole = sum_free_equations(problem, moves, np.array([0, count]))
    parts = sum_free_equations(problem, moves, np.array([0, 50, 50, count]))
    for one, several in zip(whole, parts, strict=True):
        np.testing.assert_allclose(several.sum(axis=0), one[0], rtol=1e-5, atol=1e-3)
    np.testing.assert_array_equal(whole.matrices, whole.matrices.transpose(0, 2, 1))
    assert np.linalg.eigvalsh(whole.matrices[0])[0] >= -1e-6 * whole.matrices[0].max()


def test_displaced_blocks_move_the_corrections_as_descents_with_displaced_points_do():
    """By a step of Gauss and Newton, from a pose at which each point has the colour that it shows."""
    mount = LENSES["pinhole"]
    corrections = Corrections(mount)
    problem = _problem(mount)
    problem = problem._replace(points=problem.points[:, np.argsort(problem.points[1] / problem.points[0])])
    pose = Pose(Rotation.from_rotvec([0.4, -0.3, 1.2]).as_matrix(), np.array([2.0, -1.0, 0.5]))
    texels = problem.texels.reshape(-1, problem.width + 2)
    image = np.float32([(texels >> shift) & 255 for shift in (0, 8, 16)])
    rays = problem.points.T.astype(float) / np.linalg.norm(problem.points, axis=0)[:, None]
    u, v = compute_pixels(rays, problem.width)
    places = np.float32(u + 0.5), np.float32(v + 0.5)  # a column and a row of padding come before the pixels
    shown = np.stack([cv2.remap(one, *places, cv2.INTER_LINEAR).ravel() for one in image])
    problem = problem._replace(channels=shown)
    begins = np.array([0, 4000, 9000, problem.points.shape[1]])

    def evaluate(points_cam):
        displaced = corrections.displace(points_cam, np.zeros(5))
        return sum_free_equations(problem._replace(points=displaced.points), displaced.moves, begins)

    sums = evaluate(problem.points)
    move = np.array([0.006, -0.004, 0.008])  # [m] in the map
    expected = np.zeros((5, 5))
    for begin, end in pairwise(begins):
        ends = []
        for sign in (1.0, -1.0):
            points = problem.points.copy()
            points[:, begin:end] += np.float32(sign * pose.R_cam_from_world @ move)[:, None]
            ends.append(evaluate(points).gradients.sum(axis=0))
        step = -np.linalg.solve(sums.matrices.sum(axis=0), 0.5 * (ends[0] - ends[1]))
        expected += np.outer(step[6:], step[6:])
    found = displace_blocks(FreeEnd(pose, np.zeros(5), 0.0, sums), np.outer(move, move))
    np.testing.assert_allclose(found, expected, atol=0.05 * np.abs(expected).max())
    assert found[0, 0] == pytest.approx(expected[0, 0], rel=0.1)


def _claim(count=2):
    return Claim(np.zeros(count), np.full(count, 0.01), np.full(count, 0.1), np.full(count, 0.02))


def _tell(values, information):
    """What independent blocks without number tell."""
    return PictureCorrections(values, information, np.zeros((0, len(values), len(values))))


def test_deviations_of_students_distribution_become_normal_ones_as_rare():
    freedom, deviations = np.meshgrid(np.geomspace(1.0, MANY, 50), [0.0, *np.geomspace(1e-6, 60.0, 50)])
    found = as_normal(deviations.ravel(), freedom.ravel()).reshape(freedom.shape)
    chances = special.stdtr(freedom, -deviations)
    is_common = chances > 1e-9
    np.testing.assert_allclose(found[is_common], -special.ndtri(chances[is_common]), atol=0.021)
    assert np.all(np.diff(found, axis=0) > 0.0)


def test_what_few_blocks_tell_contradicts_a_claim_less():
    """By Student's distribution of as many degrees of freedom; not where the claim itself is the vaguer."""
    claim = _claim(1)
    information = np.array([[1.0 / 0.1**2]])
    off = np.array([4.0 * math.hypot(0.1, 0.01)])
    for num_blocks in (3, 8, 1000):
        by_picture = PictureCorrections(off, information, np.ones((num_blocks, 1, 1)))
        chance = 2.0 * special.stdtr(num_blocks, -4.0)
        assert claim.conflict(by_picture) == pytest.approx(-special.ndtri(0.5 * chance), rel=0.03)
    uneven = PictureCorrections(off, information, np.array([1.0, *[1e-6] * 20])[:, None, None])
    assert claim.conflict(uneven) < 2.0
    exact = PictureCorrections(np.array([0.04]), np.array([[1.0 / 0.001**2]]), np.ones((3, 1, 1)))
    assert claim.conflict(exact) == pytest.approx(4.0, rel=0.02)


def test_a_claim_is_doubted_as_far_as_the_picture_contradicts_it():
    """As by the formula for one correction; of two that the picture tells together, each by itself."""
    one = _claim(1)
    information = np.array([[1.0 / 0.02**2]])
    spread = 0.01**2 + 0.02**2
    for off in (0.0, 0.03, -0.06):
        odds = 0.02 / 0.98 * math.sqrt(spread / (spread + 0.01))
        odds *= math.exp(0.5 * off**2 * (1.0 / spread - 1.0 / (spread + 0.01)))
        by_picture = _tell(np.array([off]), information)
        assert one.doubt(by_picture) == pytest.approx(odds / (1.0 + odds))
        assert one.conflict(by_picture) == pytest.approx(abs(off) / math.sqrt(spread))
    two = _claim()
    together = np.linalg.inv(0.02**2 * np.array([[1.0, 0.9], [0.9, 1.0]]))
    alike = two.conflict(_tell(np.array([0.05, 0.05]), together))
    apart = two.conflict(_tell(np.array([0.05, -0.05]), together))
    assert apart > 2.0 * alike
    assert two.conflict(_tell(np.array([1.0, 1.0]), np.zeros((2, 2)))) == pytest.approx(0.0)


def test_a_correction_by_the_picture_has_the_others_as_claimed():
    claim = _claim()
    values = np.array([0.03, 0.02])
    covariance = np.array([[4e-4, 3e-4], [3e-4, 9e-4]])
    off, variance = marginal(_tell(values, np.linalg.inv(covariance)), claim, 0)
    gain = covariance[0, 1] / (covariance[1, 1] + 0.01**2)
    assert off == pytest.approx(values[0] - gain * values[1], rel=1e-6)
    assert variance == pytest.approx(covariance[0, 0] - gain * covariance[0, 1], rel=1e-6)
    assert marginal(_tell(values, np.zeros((2, 2))), claim, 0)[1] == math.inf


def test_the_probability_of_a_ball_is_that_of_draws():
    """With 50 mm in all directions three of four positions are within 0.1 m, not 95 of a hundred."""
    assert probability_of_ball(0.05**2 * np.eye(3), 0.1) == pytest.approx(0.7385, abs=1e-4)
    assert probability_of_ball(np.diag([0.05**2, 0.0, 0.0]), 0.1) == pytest.approx(0.9545, abs=1e-4)
    assert probability_of_ball(np.zeros((3, 3)), 0.1) == pytest.approx(1.0)
    assert probability_of_ball(100.0 * np.eye(3), 0.1) < 1e-6
    rng = np.random.default_rng(8)
    for stds in ((0.02, 0.05, 0.08), (0.001, 0.09, 0.1), (0.15, 0.2, 0.02)):
        turn = exp_so3(rng.normal(size=3))
        draws = rng.normal(size=(200_000, 3)) * stds @ turn.T
        share = (np.linalg.norm(draws, axis=1) < 0.1).mean()
        covariance = turn @ np.diag(np.square(stds)) @ turn.T
        assert probability_of_ball(covariance, 0.1) == pytest.approx(share, abs=0.005)


def _bend(rgb, top=0, bottom=0, across=1.0):
    """Rows cut off at both ends, columns at the sides, and the rest resized to the size of before."""
    height, width = rgb.shape[:2]
    side = round(width * (1.0 - across) / 2.0)
    part = rgb[round(height * top) : height - round(height * bottom), side : width - side]
    return cv2.resize(part, (width, height), interpolation=cv2.INTER_CUBIC)


@pytest.mark.parametrize(
    ("bent", "shown", "horizon"),
    [
        ({"top": 0.1, "bottom": 0.1}, (360.0, 144.0), 0.0),
        ({"top": 0.02, "bottom": 0.12}, (360.0, 154.8), 9.0),
        ({"across": 0.95}, (342.0, 180.0), 0.0),
        ({"across": 0.8}, (288.3, 180.0), 0.0),
    ],
)
def test_a_panorama_that_was_cut_and_resized_is_taken_as_the_scan_shows_it(bent, shown, horizon):
    query = rooms.query(SEED)
    result = rooms.scan(SEED).localize(_bend(query.rgb, **bent), gravity="known")
    assert result.status == "localized"
    rooms.assert_near(result.pose, query.pose, 0.03, 0.5)
    assert (result.sphere.width_deg, result.sphere.height_deg) == pytest.approx(shown, abs=1.5)
    assert result.sphere.horizon_deg == pytest.approx(horizon, abs=1.0)
    assert "of 360 x 180 degrees" in result.warnings[-1]
    assert result.cameras[0].camera.model == "PARTIAL_EQUIRECTANGULAR"
    assert Result.from_json(result.to_json()).sphere == result.sphere


@pytest.mark.parametrize(("horizon", "side"), [(9.04, "9.0 deg below"), (-3.0, "3.0 deg above")])
def test_the_warning_says_on_which_side_of_the_middle_the_horizon_is(horizon, side):
    told = SphereGeometry(360.0, 154.8, horizon, (0.1, 0.1, 0.1)).explain()
    assert f"360.0 x 154.8 of 360 x 180 degrees, its horizon {side} the middle" in told


def test_a_panorama_as_it_is_has_no_geometry_to_tell_of():
    query = rooms.query(SEED)
    result = rooms.scan(SEED).localize(query.rgb, gravity="known")
    assert result.status == "localized"
    assert result.sphere is None
    assert result.cameras == ()


def test_a_claim_that_holds_widens_a_pose_by_what_picture_and_claim_leave_open():
    motion = np.zeros((6, 3))
    motion[5, 2] = 4.0  # metres up by a radian of the horizon
    sharp = LensEstimate(_tell(np.zeros(3), np.diag([1e8, 1e8, 1e8])), motion)
    camera = whole_sphere(512, 256)
    held = SphereFit(camera, sharp, is_claimed=True)
    assert math.sqrt(held.pose_covariance[5, 5]) == pytest.approx(4e-4, rel=0.01)
    blind = held._replace(estimate=sharp._replace(by_picture=_tell(np.zeros(3), np.zeros((3, 3)))))
    assert math.sqrt(blind.pose_covariance[5, 5]) == pytest.approx(4.0 * CLAIM.deviations[2], rel=0.01)
    by_picture = sharp.by_picture._replace(values=np.array([0.0, 0.0, 0.002]))
    off = held._replace(estimate=sharp._replace(by_picture=by_picture))
    assert math.sqrt(off.pose_covariance[5, 5]) == pytest.approx(0.008, rel=0.03)
    assert count_deviations(off.estimate) == pytest.approx(0.002 / CLAIM.deviations[2], rel=0.01)


def test_a_sphere_taken_again_shows_what_it_has_where_it_belongs():
    rgb = np.zeros((128, 256, 3), np.uint8)
    rgb[:64] = 200
    camera = Corrections(Mount(whole_sphere(256, 128))).apply(np.array([0.0, math.log(2.0), 0.0]))
    taken = as_panorama(rgb).retake(camera)
    rows = taken.is_valid.all(axis=1)
    quarter = len(rows) // 4
    assert rows[quarter + 1 : 3 * quarter - 1].all()
    assert not rows[: quarter - 1].any()
    assert not rows[3 * quarter + 1 :].any()
    assert (taken.rgb[quarter + 2 : 2 * quarter - 2] == 200).all()
    assert (taken.rgb[2 * quarter + 2 : 3 * quarter - 2] == 0).all()
    assert taken.cameras == (Mount(camera),)


def test_a_pinhole_displaces_points_as_lenses_do_in_general():
    """The kernel in float32 equals its twin for all lenses, also of a turned camera and points behind it."""
    turned = replace(LENSES["pinhole"], R_lens_from_cam=tuple(map(tuple, yaw_rotation(0.3).tolist())))
    values = np.array([0.02, -0.03, 0.015, -0.02, 0.05])
    for mount in (LENSES["pinhole"], turned):
        corrections = Corrections(mount)
        around = np.random.default_rng(5).normal(size=(3, 500)).astype(np.float32)
        points = np.hstack([_points(mount), 3.0 * around])
        fast = corrections.displace(points, values)
        general = corrections._displace_in_lens(points, values)
        np.testing.assert_array_equal(fast.is_shown, general.is_shown)
        assert 0.0 < fast.is_shown.mean() < 1.0
        np.testing.assert_allclose(fast.points, general.points, atol=1e-5)
        atol = 1e-4 * np.abs(points).max()  # the twin has differences over a hundredth of a pixel
        np.testing.assert_allclose(fast.moves, general.moves, atol=atol)
