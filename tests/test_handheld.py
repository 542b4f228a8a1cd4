"""Photos of somebody who turns around or walks a few steps in made-up rooms, and their measurement."""

import json
from dataclasses import replace

import numpy as np
import pytest

from piccolo.geometry.pose import Pose, angle_between
from piccolo.judge.belief import make_belief
from piccolo.judge.result import nothing_found
from piccolo.photo.camera.model import camera_of_fov
from piccolo.system.errors import InputError
from piccolo.system.jobs.threads import Workers
from piccolo.together.members import Grouped
from research.measuring import benchmark, groups
from research.synthetic import handheld
from research.synthetic.layout import make_room

TIER = "scene"
pytestmark = pytest.mark.research
ROOM = make_room(2, np.array([5.0, 4.0, 2.6]), np.zeros(3))


def test_a_turn_looks_all_around_from_an_arm_away():
    poses = handheld.draw_pan(ROOM, np.random.default_rng(0))
    ahead = np.array([pose.R_cam_from_world[0] for pose in poses])
    yaws = np.sort(np.degrees(np.arctan2(ahead[:, 1], ahead[:, 0])))
    assert len(poses) == handheld.PAN_SIZE
    assert np.diff([*yaws, yaws[0] + 360.0]).max() < 30.0 + 2 * 4.0
    axis = np.mean([pose.center_world for pose in poses], axis=0)
    arms = np.array([pose.center_world - axis for pose in poses])
    assert np.allclose(np.linalg.norm(arms[:, :2], axis=1), handheld.ARM, atol=0.1)
    assert (np.einsum("ij,ij->i", arms, ahead) > 0.2).all(), "the phone is ahead of the person"
    assert min(ROOM.clearance(pose.center_world) for pose in poses) > handheld.LEAST_GAP - 0.1


def test_a_burst_is_a_few_steps_one_way():
    poses = handheld.draw_burst(ROOM, np.random.default_rng(1))
    steps = np.diff([pose.center_world for pose in poses], axis=0)
    assert np.allclose(np.linalg.norm(steps, axis=1), handheld.BURST_STEP, atol=0.15)
    turns = [angle_between(poses[0].R_cam_from_world, pose.R_cam_from_world) for pose in poses]
    assert np.degrees(max(turns)) < 75.0


def test_a_room_without_room_is_refused():
    cupboard = ROOM._replace(size=np.array([0.9, 0.9, 2.6]))
    with pytest.raises(InputError, match=r"^`size`: a room of \[0\.9, 0\.9, 2\.6\] m"):
        handheld.draw_pan(cupboard, np.random.default_rng(0))


def test_photos_of_one_phone_are_processed_alike_with_other_noise():
    camera = camera_of_fov("pinhole", 65.0, 64, 48)
    pose = handheld.draw_pan(ROOM, np.random.default_rng(0))[0]
    one, other = handheld.take_photos(ROOM, [pose, pose], camera, np.random.default_rng(2), Workers(2))
    assert one.shape == (48, 64, 3)
    assert (one != other).any()
    assert np.abs(one.mean(axis=(0, 1)) - other.mean(axis=(0, 1))).max() < 2.0


def test_groups_are_measured_alone_and_together(tmp_path, monkeypatch, capsys):
    """With strangers. Alone nothing is found; together a pose far away, which is false."""
    far = Pose(np.eye(3), np.full(3, 99.0))
    wrong = replace(nothing_found(), best_pose=far, status="localized", belief=make_belief([1.0]))
    monkeypatch.setattr(groups, "GROUP_PHOTO", (75.0, 64, 48))
    monkeypatch.setattr(groups, "POINTS_OF_ROOM", 20_000)
    monkeypatch.setattr(groups, "SPHERE_WIDTH", 64)
    monkeypatch.setattr(groups, "localize", lambda *_: nothing_found())
    monkeypatch.setattr(groups, "localize_trial", lambda *_: nothing_found())
    monkeypatch.setattr(groups, "localize_group", lambda _, shots, *__: [Grouped(wrong, ()) for _ in shots])
    out = tmp_path / "groups.jsonl"
    options = ["--seeds", "0", "1", "--kinds", "furnished", "--strangers", "--out", str(out)]
    assert benchmark.main(["groups", *options]) == 1, "false answers"
    lines = [json.loads(line) for line in out.read_text().splitlines()]
    cases = [line["case"] for line in lines]
    assert cases.count("furnished, turn with strangers, together") == handheld.PAN_SIZE
    assert cases.count("furnished, burst with strangers, alone") == handheld.BURST_SIZE
    assert cases.count("furnished, burst with strangers, sphere") == 1
    strangers = [line for line in lines if "with strangers, strangers" in line["case"]]
    assert len(strangers) == 2 * 2 * 2 * groups.NUM_STRANGERS
    assert all(line["truth"] is None for line in strangers)
    assert "| furnished, turn with strangers, together | 12 | 0 | 12 | 0 | 12 |" in capsys.readouterr().out
