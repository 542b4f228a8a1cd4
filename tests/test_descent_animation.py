"""Descents with their history, and the animations of them."""

import cv2
import numpy as np
import pytest
import rooms

from piccolo.geometry.pose import pose_errors
from piccolo.optimize.descent_animation import gif_of, perturb_pose, refine_with_history
from piccolo.optimize.refine import DescentSettings, refine, sampling_loss_of
from piccolo.panorama.texels import pack_texels

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
    plain = refine(points, sampling_loss_of(texels), start, how)
    np.testing.assert_array_equal(refined.pose.center_world, plain.pose.center_world)
    np.testing.assert_array_equal(history[0].pose.center_world, start.center_world)
    np.testing.assert_array_equal(history[-1].pose.center_world, plain.pose.center_world)
    assert history[-1].loss < 0.7 * history[0].loss
    assert [p.iteration for p in history] == sorted(p.iteration for p in history)
    if solver != "adam":
        assert pose_errors(refined.pose, goal)[0] < 0.02


def test_a_gif_reads_back(tmp_path):
    frames = [np.full((26, 30, 3), (40 * k, 255 - 40 * k, 90), np.uint8) for k in range(4)]
    (tmp_path / "a.gif").write_bytes(gif_of(frames))
    video = cv2.VideoCapture(str(tmp_path / "a.gif"))
    read = [frame for is_read, frame in iter(video.read, (False, None)) if is_read]
    assert len(read) >= len(frames)
    assert abs(read[0][13, 15, ::-1].astype(int) - frames[0][13, 15]).max() < 12
    assert abs(read[-1][13, 15, ::-1].astype(int) - frames[-1][13, 15]).max() < 12
