"""What the judge rules out; and photos that help each other never overrule what it has ruled out."""

from dataclasses import replace

import numpy as np
import pytest
import rooms
from camera_room import TRUE, place, scan
from made_up import PROBLEM, make_candidate, make_selection
from walks import walk_through

import piccolo
from piccolo.geometry.pose import Pose, yaw_rotation
from piccolo.judge.belief import make_belief
from piccolo.judge.case import UNKNOWN_ERRORS, Case, Geometry, Measured
from piccolo.judge.conclude import MIRRORED, NOT_AS_CLAIMED
from piccolo.judge.probability import Standing
from piccolo.judge.reasons import Reason
from piccolo.localization import judging
from piccolo.photo.camera import Mount
from piccolo.photo.camera.model import pinhole
from piccolo.system.jobs.threads import Workers
from research.synthetic.world import photograph, render_picture

TIER = "scene"

HERE = Pose(np.eye(3), np.zeros(3))


@pytest.mark.parametrize(
    ("probability", "doubt", "conflict", "is_mirrored", "status", "warns", "num_asked"),
    [
        (0.95, 0.0, 0.0, False, "localized", False, 1),
        (0.95, 0.0, 0.0, True, "not_localized", True, 1),
        (0.21, 0.0, 0.0, True, "not_localized", True, 1),
        (0.2, 0.0, 0.0, True, "not_localized", False, 0),  # nobody would believe it
        (0.95, 0.1, 0.0, False, "not_localized", False, 1),  # no pose is surer than its focal length
        (0.95, 0.0, 99.0, False, "not_localized", False, 1),
    ],
)
def test_what_lies_mirrored_or_contradicts_its_focal_length_is_ruled_out(
    monkeypatch, probability, doubt, conflict, is_mirrored, status, warns, num_asked
):
    asked = []
    mirrored = make_candidate(0.0, 0.9 if is_mirrored else 0.4, 80)
    monkeypatch.setattr(judging, "find_mirrored", lambda _, best, *how: asked.append(best) or mirrored)
    geometry = Geometry((), doubt, conflict, 0.0)
    found = make_selection(make_candidate(0.0, 0.5, 60))
    measured = Measured(HERE, UNKNOWN_ERRORS, 0.05, None, ())
    case = Case(found, (Standing(1.0, 0.5, 60, "drawn scan"),), measured, geometry)
    belief = make_belief([probability])
    problem = replace(PROBLEM, scan_map=rooms.scan_map(1))
    for _ in range(2):  # what is known is not asked again
        case = judging.try_mirrored(problem, case, belief, rooms.means())
    result = judging.decide_case(problem, case, belief, rooms.means(), 0.9)
    assert (result.status, MIRRORED in result.warnings, len(asked)) == (status, warns, num_asked)
    reasons = {Reason.MIRRORED} if warns else {Reason.SPHERE} if conflict else set()
    assert result.belief == replace(belief, doubt=doubt, ruled_out=frozenset(reasons))
    assert (NOT_AS_CLAIMED in result.warnings) == (Reason.SPHERE in reasons)


def test_photos_of_one_wrong_focal_length_are_not_sure_together():
    room, pose = place(1)
    camera = Mount(pinhole(320, 240, TRUE))
    beside = pose.center_world + np.array([0.05, 0.03, 0.0])
    poses = [pose, Pose(yaw_rotation(0.5) @ pose.R_cam_from_world, beside)]
    photos = [render_picture(camera, room, p, Workers(2)) for p in poses]
    given = [piccolo.Photo(photo, focal_px=0.89 * TRUE) for photo in photos]
    results = scan().localize_bundle(given, poses, gravity="known")
    for result in results:
        assert (result.status, result.confidence) == ("not_localized", 0.0)
        assert any(line.endswith(" px, not 142: check `focal_px`") for line in result.warnings)


def test_a_frame_that_contradicts_the_prior_says_so_in_a_walk():
    world = rooms.room(3)[0]
    poses = walk_through(world)[:4]
    frames = [photograph(world.rooms[0], p, rooms.WIDTH, Workers(2)) for p in poses]
    prior = piccolo.Prior(near=tuple(poses[0].center_world), radius=0.4)
    times = [0.5 * k for k in range(len(frames))]
    results = rooms.scan(3).localize_walk(frames, times, prior=prior, gravity="known")
    for result, pose in zip(results, poses, strict=True):
        distance = float(np.linalg.norm(pose.center_world - poses[0].center_world))
        if distance > 0.6:
            assert result.status != "localized"
            assert not result.best_pose or any("from the place given" in w for w in result.warnings)
        elif distance < 0.4:
            assert result.status == "localized"
