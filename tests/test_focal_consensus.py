"""What the photos of one camera say of its focal length together; test_three_doors.py has a whole batch."""

import math
from dataclasses import replace

import numpy as np
import pytest
from poses import judged

from piccolo.geometry.pose import Pose
from piccolo.judge.belief import make_belief
from piccolo.judge.conclude import follow_consensus
from piccolo.judge.consensus import WRONG_SHARE, Consensus, Opinion
from piccolo.judge.reasons import Reason
from piccolo.judge.result import Result
from piccolo.judge.result_parts import FocalLength, Source
from piccolo.photo.camera import Mount
from piccolo.photo.camera.model import pinhole
from piccolo.together.second_looks import follow_cameras, list_looks_by_focal

GIVEN = 700.0


def _result(picture, std, given_std=0.003, status="localized", confidence=0.95, **more):
    """A photo's line; the picture's focal length over that given, and the deviations of both."""
    pose = Pose(np.eye(3), np.zeros(3))
    told = {"picture_px": GIVEN * picture, "picture_std_px": GIVEN * picture * std} if picture else {}
    used = GIVEN * picture if picture and std < given_std else GIVEN
    about = {"doubt": WRONG_SHARE, "source": "`camera`", **told, **more}
    focal = FocalLength(used, GIVEN * min(std, given_std), GIVEN, GIVEN * given_std, **about)
    camera = (Mount(pinhole(1024, 768, GIVEN)),)
    source = Source(None, None, (1024, 768), None)
    result = Result(status, confidence, "a.ply", "a.jpg", pose, cameras=camera, source=source)
    place = confidence / (1.0 - focal.doubt)
    found = {"probability_none": 1.0 - confidence, "belief": make_belief([place], doubt=focal.doubt)}
    return replace(result, focal_length=focal, **found)


def test_a_given_focal_length_is_doubted_by_as_much_as_the_picture_can_tell():
    """One in fifty is wrong; a sharp picture confirms or contradicts it, a blurred one says little."""
    assert Opinion(0.0, 0.004**2).doubt(0.003) < 0.005
    assert Opinion(0.0, 0.05**2).doubt(0.003) == pytest.approx(WRONG_SHARE, abs=0.015)
    assert Opinion(0.05, 0.02**2).doubt(0.003) > 0.05
    assert Opinion(-0.05, 0.009**2).doubt(0.003) > 0.99
    rising = [Opinion(off, 0.02**2).doubt(0.003) for off in (0.0, 0.02, 0.04, 0.06, 1.0)]
    assert rising == sorted(rising)
    assert Opinion(9.0, 0.01**2).doubt(0.003) < 1.0


def test_the_given_focal_length_weighs_by_its_variance():
    assert Opinion(0.1, 0.02**2).share_of_given(0.01) == pytest.approx(0.8)
    assert Opinion(0.1, 0.02**2).share_of_given(0.5) == pytest.approx(0.0, abs=0.002)


def test_photos_of_one_camera_agree_on_its_focal_length_whatever_some_say():
    """Each is right to its deviation, but for those at a wrong place; the mean has the deviation it says."""
    rng = np.random.default_rng(5)
    misses = []
    for _ in range(200):
        stds = rng.uniform(0.005, 0.03, 12)
        offs = rng.normal(0.05, stds)
        offs[:3] = rng.uniform(-0.3, 0.3, 3)
        opinions = [Opinion(off, std**2) for off, std in zip(offs, stds, strict=True)]
        consensus = Consensus([None, *opinions]).opinion()
        misses.append((consensus.off - 0.05) / math.sqrt(consensus.variance))
    assert 0.5 < np.std(misses) < 1.4
    one_less = Consensus(opinions).opinion(without=4)
    assert one_less.variance > consensus.variance
    assert Consensus([Opinion(0.0, 1e-4), None, Opinion(0.0, 1e-4)]).opinion() is None
    assert Consensus([None]).opinion() is None


def test_photos_that_contradict_a_calibration_together_rule_out_all_of_its_poses():
    """None of them contradicts it alone, and one says nothing; it is said once, however often it is asked."""
    results = [_result(1.05, 0.02) for _ in range(6)] + [_result(None, 1.0)]
    changed = list(follow_cameras(results, 0.9))
    assert [(change.number, change.before.status) for change in changed] == [
        (k, "localized") for k in range(7)
    ]
    assert all(change.is_news for change in changed)
    assert [change.after for change in changed] == results
    for result in results:
        assert (result.status, result.confidence) == ("not_localized", 0.0)
        assert result.belief.ruled_out == {Reason.CAMERA}
        (warning,) = result.warnings
        assert warning == "the pictures of this camera have a focal length of 735 px, not 700: check `camera`"
    assert list(follow_cameras(results, 0.9)) == []


def test_photos_that_confirm_a_calibration_make_all_of_its_poses_surer():
    results = [_result(1.0, 0.005, status="ambiguous", confidence=0.89) for _ in range(6)]
    assert len(list(follow_cameras(results, 0.9))) == 6
    assert [result.status for result in results] == ["localized"] * 6
    assert all(0.9 < result.confidence < 0.91 for result in results)
    assert all(result.belief.doubt == result.focal_length.doubt < 0.01 for result in results)
    assert list(follow_cameras(results, 0.9)) == []


def _judged(belief, **focal):
    """A result alone by a focal length that was given."""
    focal = FocalLength(700.0, 2.0, 700.0, 2.1, 700.0, 7.0, doubt=belief.doubt, source="`camera`", **focal)
    return judged("localized", belief, Pose(np.eye(3), np.zeros(3)), focal_length=focal)


def test_a_consensus_changes_the_doubt_alone_and_rules_out():
    belief = make_belief([0.97], within=0.98, doubt=0.02)
    confirming = Opinion(0.0, 0.002**2)
    contradicting = Opinion(0.05, 0.002**2)
    found = follow_consensus(_judged(belief), confirming, 0.9)
    assert found.belief == replace(belief, doubt=found.focal_length.doubt)
    assert found.belief.doubt < 0.01
    used = follow_consensus(_judged(belief, others_px=701.0, others_std_px=1.0), confirming, 0.9)
    assert used.belief == belief, "it was localized with that of the others"
    refused = follow_consensus(_judged(belief), contradicting, 0.9)
    assert (refused.status, refused.belief.ruled_out) == ("not_localized", {Reason.CAMERA})
    assert refused.belief.place == belief.place
    mirrored = _judged(belief.rule_out(Reason.MIRRORED))
    assert follow_consensus(mirrored, confirming, 0.9).belief.ruled_out == {Reason.MIRRORED}


def test_other_cameras_have_their_own_say():
    """Those of another size or focal length, and guesses, are no photos of this camera."""
    results = [_result(1.05, 0.02) for _ in range(2)]
    other = results[0]
    results += [replace(other, source=replace(other.source, image_size=(768, 1024)))]
    longer = {name: 1.1 * getattr(other.focal_length, name) for name in ("px", "given_px", "picture_px")}
    results += [replace(other, focal_length=replace(other.focal_length, **longer))]
    results += [_result(1.05, 0.02, given_std=0.2)] * 3
    assert list(follow_cameras(results, 0.9)) == []
    assert list_looks_by_focal(results) == []


def test_a_photo_is_looked_at_again_with_the_focal_length_of_the_others():
    """One that is sure and agrees is not; nor one for the second time."""
    by_exif = {"given_std": 0.015, "source": "EXIF"}
    sure = [_result(1.03, 0.004, **by_exif) for _ in range(4)]
    weak = _result(1.2, 0.2, status="not_localized", confidence=0.2, **by_exif)
    (look,) = list_looks_by_focal([*sure, weak])
    assert (look.number, look.first, look.beside) == (4, None, ())
    assert look.focal.others_px == pytest.approx(1.03 * GIVEN, rel=1e-3)
    assert 0.002 < look.focal.others_std_px / look.focal.others_px < 0.006
    assert look.focal.picture_px == pytest.approx(1.2 * GIVEN)
    done = replace(weak, focal_length=look.focal)
    assert list_looks_by_focal([*sure, done]) == []
