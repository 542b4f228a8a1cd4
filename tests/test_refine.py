"""Descents on a loss, with their history and the animations of them."""

import dataclasses
import json

import av
import cv2
import numpy as np
import pytest
import rooms

from piccolo.geometry.pose import Pose, pose_errors, step, yaw_rotation
from piccolo.optimize.refine import Adam, DescentSettings, descend_lbfgs, make_sampling_loss, refine
from piccolo.panorama.texels import pack_texels
from piccolo.paper.localize import PaperSettings
from research.experiments import animate_descent
from research.experiments.animate_descent import encode_gif, perturb_pose, refine_with_history

PERTURBATION = np.array([0.05, -0.04, 0.12, 0.15, -0.12, 0.08])  # rad, m


@pytest.fixture(scope="module")
def scene():
    return rooms.scene(1)


@pytest.mark.parametrize("solver", ["adam", "lbfgs", "gauss-newton"])
@pytest.mark.parametrize("use_visibility", [True, False])
def test_descent_recovers_the_true_pose(scene, solver, use_visibility):
    points, panorama, true_pose = scene
    texels = pack_texels(panorama.rgb)
    settings = dataclasses.replace(PaperSettings(), solver=solver, use_visibility=use_visibility)
    refined = refine(points, make_sampling_loss(texels), step(true_pose, PERTURBATION), settings)
    rooms.assert_near(refined.pose, true_pose, 0.010, 0.3)


def test_adam_decays_after_patience_stalled_losses():
    adam = Adam(step_size=0.1, step_decay=0.8, patience=5)
    for loss in [1.0] + [1.0] * 4:
        adam.update(loss, np.ones(6))
    assert adam.step_size == 0.1
    adam.update(1.0, np.ones(6))
    assert adam.step_size == pytest.approx(0.08)


def test_adams_first_step_is_the_step_size_against_the_gradient():
    delta = Adam(0.1, 0.8, 5).update(1.0, np.array([3.0, -0.001, 0, 0, 0, 7.0]))
    np.testing.assert_allclose(delta, [-0.1, 0.1, 0, 0, 0, -0.1], rtol=1e-4)


def test_lbfgs_follows_a_gradient_in_steps_of_the_camera():
    """A bowl about a known pose, its gradient by steps: a wrong chain rule would not arrive."""
    start = Pose(yaw_rotation(0.5), np.array([1.0, 2.0, 3.0]))
    goal = step(start, np.array([0.3, -0.2, 0.4, 0.5, 0.4, -0.3]))
    x_world = np.random.default_rng(0).normal(size=(20, 3))

    def objective(pose):
        p = (x_world - pose.center_world) @ pose.R_cam_from_world.T
        e = p - (x_world - goal.center_world) @ goal.R_cam_from_world.T
        gradient = np.concatenate([np.cross(p, e).sum(axis=0), -e.sum(axis=0)])
        return 0.5 * (e**2).sum(), gradient, np.eye(6)

    start = Pose(yaw_rotation(0.5), np.array([1.0, 2.0, 3.0]))
    best = descend_lbfgs(objective, start, 100)
    np.testing.assert_allclose(best.pose.center_world, goal.center_world, atol=1e-4)
    np.testing.assert_allclose(best.pose.R_cam_from_world, goal.R_cam_from_world, atol=1e-4)


SEED = 3


@pytest.fixture(scope="module")
def points():
    return rooms.packed(SEED)


@pytest.mark.parametrize("solver", ["adam", "lbfgs", "gauss-newton"])
def test_a_descent_with_history_is_the_descent(points, solver):
    query = rooms.query(SEED, "tilt")
    texels, goal = pack_texels(query.rgb), rooms.local(SEED, query.pose)
    start = perturb_pose(goal, 0.15, 4.0)
    assert pose_errors(start, goal) == pytest.approx((0.15, np.radians(4.0)))
    how = DescentSettings(solver=solver, num_iterations=40, step_size=0.02)
    refined, history = refine_with_history(points, texels, start, how)
    plain = refine(points, make_sampling_loss(texels), start, how)
    np.testing.assert_array_equal(refined.pose.center_world, plain.pose.center_world)
    np.testing.assert_array_equal(history[0].pose.center_world, start.center_world)
    np.testing.assert_array_equal(history[-1].pose.center_world, plain.pose.center_world)
    assert history[-1].loss < 0.7 * history[0].loss
    assert [p.iteration for p in history] == sorted(p.iteration for p in history)
    if solver != "adam":
        assert pose_errors(refined.pose, goal)[0] < 0.02


def test_a_gif_reads_back(tmp_path):
    frames = [np.full((26, 30, 3), (40 * k, 255 - 40 * k, 90), np.uint8) for k in range(4)]
    (tmp_path / "a.gif").write_bytes(encode_gif(frames))
    video = cv2.VideoCapture(str(tmp_path / "a.gif"))
    read = [frame for is_read, frame in iter(video.read, (False, None)) if is_read]
    assert len(read) >= len(frames)
    assert abs(read[0][13, 15, ::-1].astype(int) - frames[0][13, 15]).max() < 12
    assert abs(read[-1][13, 15, ::-1].astype(int) - frames[-1][13, 15]).max() < 12


def test_a_descent_is_shown_with_where_it_ended(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(animate_descent, "MAX_FRAMES", 5)
    monkeypatch.setattr(animate_descent, "DESCENT", DescentSettings(solver="gauss-newton"))
    words = "--seed 7 --size 4 3 2.5 --points 30000 --panoramas 1 --width 256 --variants clean"
    room = rooms.write_room(tmp_path, words)
    pano = ["--cloud", room / "cloud.ply", "--pano", room / "images" / "clean_0.jpg", "--quiet"]
    video = [*pano, "--out", tmp_path / "a.mp4"]
    assert animate_descent.main(list(map(str, video))) == 2
    assert "--result, --truth: found none of them" in capsys.readouterr().err
    assert animate_descent.main(list(map(str, [*video, "--truth", room / "queries.json"]))) == 0
    line = json.loads(capsys.readouterr().out)
    assert line["start_distance"] == pytest.approx(0.3)
    assert line["end_distance"] < 0.02
    assert line["frames"] == 5 + animate_descent.NUM_LAST
    with av.open(tmp_path / "a.mp4") as shown:
        frames = [frame.to_ndarray(format="rgb24") for frame in shown.decode(video=0)]
    assert (len(frames), frames[0].shape[1]) == (line["frames"], animate_descent.FRAME_WIDTH)
