"""A focal length that is not exact: fitted with the pose, and part of the pose's covariance."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import rooms
from camera_room import DENSE, SEED, TRUE, place, scan
from pictures import encoded, write
from poses import judged

import piccolo
from piccolo.evidence import focal_length as focal, verification
from piccolo.evidence.examine import count_agreeing, examine, examine_again
from piccolo.evidence.lens_matches import fit_matches
from piccolo.evidence.self_calibration import LensEstimate
from piccolo.geometry.pose import Pose, yaw_rotation
from piccolo.judge.belief import make_belief
from piccolo.judge.candidate import Selection
from piccolo.judge.claim import PictureCorrections
from piccolo.judge.result_parts import Alternative, Evidence, FocalLength
from piccolo.local_features.matching import NO_MATCHES
from piccolo.localization import claimed_geometry, run as module
from piccolo.localization.claimed_geometry import follow_matches, recalibrate
from piccolo.localization.run import select_likeliest
from piccolo.photo.camera import Calibration, Camera, Mount
from piccolo.photo.camera.model import pinhole
from piccolo.photo.camera.resampling import CameraView, make_sphere
from piccolo.photo.panorama import read_panorama
from piccolo.photo.photo import Photo
from piccolo.problem.method import METHOD
from piccolo.system.jobs.threads import Workers
from piccolo.views.view import Cells
from research.synthetic.world import render_picture

TIER = "scene"
ELSEWHERE = Pose(yaw_rotation(0.4), np.array([1.0, 2.0, 0.5]))


def _photo(camera, yaw=0.0):
    this, pose = place(1)
    pose = Pose(yaw_rotation(yaw) @ pose.R_cam_from_world, pose.center_world)
    return render_picture(Mount(camera), this, pose, Workers(2)), pose


def _panorama(rgb, **options):
    return read_panorama(Photo(rgb, **options))


def _fit(rgb, pose, **options):
    panorama = _panorama(rgb, **options)
    problem = rooms.ask(panorama, rooms.scan_map(SEED))
    candidate = examine(problem, scan().from_world(pose))
    return panorama, focal.fit_focal(problem, candidate, rooms.WORKERS)


def test_the_picture_tells_the_focal_length_within_its_deviation():
    given = 1.015
    rgb, pose = _photo(pinhole(320, 240, TRUE))
    panorama, fit = _fit(rgb, pose, focal_px=given * TRUE)
    off = fit.change[0] + math.log(given)
    assert abs(off) < 3.0 * fit.deviation
    assert abs(off) < 0.015
    assert 0.0005 < fit.deviation < 0.01
    assert fit.conflict < 3.0
    assert fit.focal_length(panorama).given_std_px == pytest.approx(0.01 * given * TRUE)


def test_matches_with_photos_beside_follow_the_focal_length():
    """A ray goes to the same pixel of the picture, by the new focal length."""
    panorama = _panorama(_photo(pinhole(320, 240, TRUE))[0], focal_px=TRUE)
    problem = rooms.ask(panorama, rooms.scan_map(SEED))
    rays = np.float32([[1.0, 0.0, 0.0], [0.8, 0.6, 0.0]])
    beside = NO_MATCHES._replace(rays=rays)
    asked = replace(problem, beside=(beside,))
    (turned,) = recalibrate(asked, np.array([0.02]), rooms.WORKERS).beside
    np.testing.assert_allclose(turned.rays[0], rays[0], atol=1e-6)
    slope = turned.rays[1, 1] / turned.rays[1, 0]
    assert slope == pytest.approx(0.75 * math.exp(-0.02), abs=1e-4)


def test_k1_is_fitted_with_the_focal_length_of_a_guess():
    rgb, pose = _photo(Camera("SIMPLE_RADIAL", 320, 240, (TRUE, 160.0, 120.0, -0.04)))
    mount = Mount(Camera("SIMPLE_RADIAL", 320, 240, (1.03 * TRUE, 160.0, 120.0, 0.0)))
    _, fit = _fit(rgb, pose, camera=Calibration("guess", (mount,)), refine_focal=True)
    f, k1 = mount.camera.change(*fit.change).params[::3]
    assert f == pytest.approx(TRUE, rel=0.02)
    assert k1 == pytest.approx(-0.04, abs=0.015)


def test_the_focal_length_of_a_bare_part_of_a_wall_stays_open():
    rgb, pose = _photo(pinhole(320, 240, TRUE))
    blank = np.full_like(rgb, 128)
    blank[100:130, 140:180] = rgb[100:130, 140:180]
    panorama, fit = _fit(blank, pose, focal_px=TRUE, refine_focal=True)
    assert fit.deviation > 0.05
    assert fit.conflict < 3.0
    assert fit.focal_length(panorama).std_px > 7.5


def test_a_photo_with_a_guessed_focal_length_is_localized_and_says_what_it_found():
    rgb, pose = _photo(pinhole(320, 240, TRUE))
    dense = rooms.scan(SEED, num_points=DENSE)
    result = dense.localize(Photo(rgb, focal_px=145.0, refine_focal=True), gravity="known")
    assert result.status == "localized"
    found = result.focal_length
    assert abs(found.px - TRUE) < 3.0 * found.std_px
    assert found.px == pytest.approx(TRUE, rel=0.02)
    assert (found.given_px, found.given_std_px) == (145.0, pytest.approx(29.0))
    assert result.cameras[0].camera.focal[0] == found.px
    assert np.linalg.norm(result.pose.center_world - pose.center_world) < 0.03
    assert piccolo.Result.from_json(result.to_json()).focal_length == found


def test_a_focal_length_that_contradicts_what_was_given_makes_no_sure_pose():
    """Nor does a bundle of one photo, which keeps what that rules out."""
    rgb, pose = _photo(pinhole(320, 240, TRUE))
    photo = Photo(rgb, focal_px=145.0)
    dense = rooms.scan(SEED, num_points=DENSE)
    alone = dense.localize(photo, gravity="known")
    (together,) = dense.localize_bundle([photo], [pose], gravity="known")
    for result in (alone, together):
        assert result.status == "not_localized"
        assert any(line.endswith(" px, not 145: check `focal_px`") for line in result.warnings)
    assert alone.focal_length.px == pytest.approx(TRUE, rel=0.03)


def test_each_source_of_a_focal_length_has_its_deviation():
    rgb, _ = _photo(pinhole(320, 240, TRUE))
    of_file = _panorama(rgb, camera=Calibration("a", (Mount(pinhole(320, 240, TRUE)),))).focal_prior
    assert (of_file.deviation, of_file.source) == (0.003, "`camera`")
    of_field = _panorama(rgb, projection="fisheye", fov_deg=90.0).focal_prior
    assert (of_field.deviation, of_field.source) == (0.03, "`fov_deg`")
    assert _panorama(np.zeros((64, 128, 3), np.uint8)).focal_prior is None


def _estimate(values, information):
    """What independent blocks without number tell of a lens."""
    return LensEstimate(PictureCorrections(values, information, np.zeros((0, 5, 5))), np.ones((6, 5)))


@pytest.mark.parametrize(
    ("minimum", "share", "std"),
    [(0.01, 0.5, 0.0071), (0.021, 0.5, 0.0071), (0.03, 0.88, 0.0096), (0.065, 0.97, 0.0101)],
)
def test_the_more_picture_and_user_disagree_the_wider_is_the_prior(minimum, share, std):
    """Beyond two deviations the picture says where to look next."""
    panorama = _panorama(_photo(pinhole(320, 240, TRUE))[0], focal_px=TRUE)
    camera = panorama.cameras[0].camera
    information = np.diag([1.0 / 0.01**2, 0.0, 0.0, 0.0, 0.0])
    found = _estimate(np.array([minimum, 0.0, 0.0, 0.0, 0.0]), information)
    fit = focal.weigh_claim(panorama.focal_prior, camera, found, found)
    assert fit.conflict == pytest.approx(minimum / 0.01 / math.sqrt(2.0), rel=0.02)
    assert fit.change[0] / minimum == pytest.approx(share, abs=0.02)
    assert fit.deviation == pytest.approx(std, rel=0.03)
    assert (fit.of_difference[0, 0] > 1e-6) == (minimum == 0.021)  # beyond two they are in the deviation
    nothing = _estimate(found.by_picture.values, np.zeros((5, 5)))
    open_fit = focal.weigh_claim(panorama.focal_prior, camera, nothing, nothing)
    assert (open_fit.change[0], open_fit.deviation, open_fit.conflict) == (0.0, pytest.approx(0.01), 0.0)


def test_what_other_photos_tell_is_not_doubted_by_one_of_them():
    """Its confidence would follow a millimetre of theirs: from 3.3 to 4 deviations a doubt is 0.4 to 0.9."""
    given = _panorama(_photo(pinhole(320, 240, TRUE))[0], focal_px=TRUE)
    first = np.eye(5)[0]
    found = _estimate(0.04 * first, np.diag(1e4 * first))
    by_others = given.expect_focal(TRUE, 0.004)
    alone, beside = (
        focal.weigh_claim(panorama.focal_prior, panorama.cameras[0].camera, found, found)
        for panorama in (given, by_others)
    )
    assert alone.doubt > 0.1
    assert beside.doubt == 0.0
    assert beside.conflict == pytest.approx(0.04 / math.hypot(0.01, 0.004), rel=0.02)


def test_matches_lead_to_a_focal_length_that_is_far_off():
    rgb, pose = _photo(pinhole(320, 240, TRUE))
    problem = rooms.ask(_panorama(rgb, focal_px=0.8 * TRUE), rooms.scan_map(SEED))
    found = Selection(examine(problem, scan().from_world(pose)), ())
    problem, found = follow_matches(problem, found, rooms.WORKERS)
    assert problem.given.cameras[0].camera.focal[0] == pytest.approx(TRUE, rel=0.05)
    assert found.best.pose.distance(scan().from_world(pose)) < 0.15
    matches = focal.list_matches(problem, found.best, rooms.WORKERS)
    by_matches = fit_matches(METHOD, problem.given.cameras[0], found.best.pose, matches, focal.FOCAL_WIDTHS)
    assert abs(by_matches.values[0]) < 2.5 / math.sqrt(by_matches.information)
    assert follow_matches(problem, found, rooms.WORKERS) == (problem, found)


def test_the_lowest_end_of_descents_is_first_and_the_others_scatter_about_it(monkeypatch):
    def descend(cells, image, freedom, pose, values, limits):
        return SimpleNamespace(loss=abs(values[0] - 0.28), values=values)

    monkeypatch.setattr(focal, "descend_freely", descend)
    shown = SimpleNamespace(photo=SimpleNamespace(image=lambda name: name))
    points = Cells(np.ones((3, 402)), np.ones((3, 402)), np.ones(402), np.zeros(3))
    descents = focal.LensDescents(shown, np.ones((4, 8), bool), Workers(1))
    starts = [(ELSEWHERE, np.full(5, value)) for value in (0.0, 0.1, 0.3, 0.5)]
    ends = descents.find_ends(points, None, starts)
    assert [end.values[0] for end in ends] == [0.3, 0.1, 0.5, 0.0]
    assert focal.compute_scatter(ends) == pytest.approx((0.2**2 + 0.2**2 + 0.3**2) / 4)
    assert focal.compute_scatter(ends[:1]) == 0.0


@pytest.mark.parametrize(
    ("changes", "num_refined"),
    [
        ([0.0], 0),
        ([0.02, 0.0], 1),
        ([0.02, 0.01, 0.001, 0.0], 3),
        ([0.02, -0.03], 1),  # it does not settle
        ([0.05, 0.04, 0.03, 0.02, 0.01], 4),  # at most
    ],
)
def test_a_lens_is_fitted_again_for_as_long_as_it_settles(monkeypatch, changes, num_refined):
    refined = []
    fits = iter(changes)
    covariance = np.array([[1e-8]])

    def fit(*_, is_first=True):
        return focal.FocalFit(np.array([next(fits)]), covariance, np.zeros((6, 1)), None, 0.0)

    def refine(problem, found, *_):
        refined.append(found)
        return problem, found

    monkeypatch.setattr(claimed_geometry, "fit_focal", fit)
    monkeypatch.setattr(claimed_geometry, "refine_with", refine)
    monkeypatch.setattr(claimed_geometry, "follow_matches", lambda problem, found, _: (problem, found))
    monkeypatch.setattr(claimed_geometry, "find_change_left", lambda given, fit: 0.0 * fit.change)
    found = SimpleNamespace(best=SimpleNamespace(pose=ELSEWHERE))
    claimed_geometry.calibrate(SimpleNamespace(given=None), found, rooms.WORKERS)
    assert len(refined) == num_refined


def test_the_scan_is_not_drawn_again_for_another_calibration(monkeypatch):
    """The photo with its new rays is matched with what was drawn for the old ones."""
    rgb, pose = _photo(pinhole(320, 240, TRUE))
    problem = rooms.ask(_panorama(rgb, focal_px=1.01 * TRUE), rooms.scan_map(SEED))
    before = count_agreeing(problem, examine(problem, scan().from_world(pose)), rooms.WORKERS)
    after = recalibrate(problem, np.array([-math.log(1.01)]), rooms.WORKERS)
    drawn_again = count_agreeing(after, examine(after, before.pose), rooms.WORKERS)
    monkeypatch.setattr(verification, "find_all_drawn", lambda *_: pytest.fail("drawn again"))
    found = count_agreeing(after, examine_again(after, before, rooms.WORKERS), rooms.WORKERS)
    assert found.score == drawn_again.score > before.score
    assert found.num_matches == pytest.approx(drawn_again.num_matches, abs=3)
    assert found.num_matches > before.num_matches
    none = before.drawn.picture.keypoints.take(np.empty(0, np.int64))
    nothing = before.drawn._replace(picture=before.drawn.picture._replace(keypoints=none))
    assert verification.match_again(after, nothing, rooms.WORKERS) is None


def test_other_poses_with_other_guesses_share_the_probability():
    settings = rooms.AUTO
    evidence = Evidence(0.5, 1.0, 0.5, 0.9, 0.3)
    here, elsewhere = (Pose(np.eye(3), np.array([x, 0.0, 0.0])) for x in (0.0, 3.0))
    sure = judged("localized", make_belief([0.95]), here, evidence=evidence)
    less = judged("localized", make_belief([0.9]), here, evidence=evidence)
    assert select_likeliest([less, sure], settings) is sure
    other = replace(less, best_pose=elsewhere)
    doubtful = select_likeliest([sure, other, other], settings)
    assert doubtful.status == "ambiguous"
    assert doubtful.confidence == pytest.approx(0.95**2 / 1.85)
    (rival,) = doubtful.alternatives
    assert rival.pose is elsewhere
    assert rival.probability == pytest.approx(0.95 * 0.9 / 1.85)
    assert doubtful.probability_none == pytest.approx(0.05)


def test_the_same_place_by_another_focal_length_is_no_alternative_and_none_is_listed_twice():
    settings = rooms.AUTO
    evidence = Evidence(0.5, 1.0, 0.5, 0.9, 0.3)
    ahead, aside = Pose(np.eye(3), np.array([1.0, 0.1, 0.0])), Pose(np.eye(3), np.array([0.0, 1.0, 0.0]))
    first = replace(
        judged("localized", make_belief([0.95, 0.02]), Pose(np.eye(3), np.zeros(3)), evidence=evidence),
        alternatives=(Alternative(aside, 0.4, None, 0.02),),
        focal_length=FocalLength(300.0, 3.0, 300.0, 60.0),
    )
    longer = replace(
        judged("localized", make_belief([0.9, 0.02]), ahead, evidence=evidence),
        alternatives=first.alternatives,
        focal_length=FocalLength(345.0, 3.0, 345.0, 69.0),
    )
    assert select_likeliest([first, longer], settings) is first
    as_long = replace(longer, focal_length=first.focal_length)
    assert select_likeliest([first, as_long], settings).status == "ambiguous"
    beside = replace(longer, best_pose=aside)
    (rival,) = select_likeliest([first, beside, beside], settings).alternatives
    assert rival.pose is aside
    assert rival.probability == pytest.approx(0.95 * 0.9 / 1.85, rel=0.1)


@pytest.mark.parametrize("is_blank", [False, True])
def test_the_first_sure_guess_ends_the_search(is_blank):
    rgb, _ = _photo(pinhole(320, 240, TRUE))
    panorama = _panorama(np.full_like(rgb, 128) if is_blank else rgb, focal_px=TRUE, refine_focal=True)
    scan_map = rooms.scan_map(SEED, DENSE)
    means = rooms.means(rooms.KNOWN)
    found = module.localize_guessed(scan_map, panorama, rooms.KNOWN, means)
    num_searched = [made["step"] for made in means.trace.steps].count("refined")
    assert (found.status, num_searched) == (("not_localized", 3) if is_blank else ("localized", 1))


def test_a_retaken_sphere_is_the_one_of_that_calibration_and_keeps_its_mask(tmp_path):
    rgb, _ = _photo(pinhole(320, 240, TRUE))
    path = write(tmp_path / "a.png", encoded(rgb, ".png"))
    panorama = read_panorama(Photo(path, focal_px=TRUE, mask_nadir_deg=80.0))
    found = panorama.resample(pinhole(320, 240, 1.1 * TRUE), 1024)
    pixels = np.dstack([rgb, np.full(rgb.shape[:2], 255, np.uint8)])
    wanted, is_wanted = make_sphere([CameraView(Mount(pinhole(320, 240, 1.1 * TRUE)), pixels)], 1024)
    assert not found.is_valid[300:].any()
    assert is_wanted[300:].any()
    assert (found.is_valid == is_wanted)[:270].mean() > 0.998
    np.testing.assert_array_equal(found.rgb, wanted)


def test_pictures_of_a_result_are_made_with_the_camera_found():
    found = (Mount(pinhole(320, 240, 321.5)),)
    options = Photo("a.jpg", focal_px=300.0, refine_focal=True).with_refined_camera(found)
    assert (options.focal_px, options.calibration.mounts) == (None, found)
    turned = Mount(pinhole(320, 240, 300.0), ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)))
    given = Photo("a.jpg", camera=Calibration("a.json", (turned,)), refine_focal=True)
    assert given.with_refined_camera(found).calibration.mounts == (turned.with_camera(found[0].camera),)
    plain = Photo("a.jpg")
    assert plain.with_refined_camera(()) is plain
