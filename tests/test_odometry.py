"""Odometry: the poses of frames in a file, by their order, their clock or their names."""

from pathlib import Path

import numpy as np
import pytest
from poses import SIZE, assert_same_poses, result, tilted_poses

from piccolo.apps.export.formats import export
from piccolo.apps.export.posed_images import Options
from piccolo.geometry.pose import exp_so3, quaternion_wxyz, yaw_rotation
from piccolo.poses.relative_poses import read_odometry, read_relative_poses
from piccolo.poses.times import times_of
from piccolo.system.errors import InputError

POSES = tilted_poses(4, np.array([20.0, -30.0, 2.0]))
PHOTOS = [Path(f"photos/{k}.jpg") for k in (7, 8, 12, 100)]


def _write(path, text):
    path.write_text(text)
    return path


@pytest.mark.parametrize("name", ["tum", "kitti"])
def test_an_odometry_has_a_pose_of_each_frame_in_order(tmp_path, name):
    path = tmp_path / "poses.txt"
    results = [result(photo, pose) for photo, pose in zip(PHOTOS, POSES, strict=True)]
    options = Options(timestamps="name") if name == "tum" else Options()
    export(results, name, path, options)
    assert_same_poses(read_odometry(path, PHOTOS, [0.0, 1.0, 2.0, 3.0]), POSES)


def test_an_odometry_of_more_poses_is_matched_by_time_or_name(tmp_path):
    results = [result(Path(f"{k}.jpg"), pose) for k, pose in enumerate(POSES)]
    export(results, "tum", tmp_path / "poses.txt", Options(timestamps="name"))
    found = read_odometry(tmp_path / "poses.txt", PHOTOS[:3], [0.9, 2.1, 9.0])
    assert_same_poses(found[:2], [POSES[1], POSES[2]])
    assert found[2] is None
    export(results, "nerfstudio", tmp_path / "transforms.json", Options(size=SIZE))
    found = read_odometry(tmp_path / "transforms.json", [Path("a/2.jpg"), Path("a/9.jpg")], [0.0, 1.0])
    assert_same_poses(found[:1], [POSES[2]])
    assert found[1] is None


CLOCK = 1311868164.0  # [s] as frames and trajectories of TUM have it


def _trajectory(path, clock):
    """At each time of a clock, so many seconds after its beginning, a pose so many metres along x."""
    return _write(path, "".join(f"{t:.6f} {t - clock[0]:.6f} 0 0 0 0 0 1\n" for t in clock))


def test_frames_take_the_poses_of_their_clock(tmp_path):
    frames = [Path(f"{CLOCK + 0.5 * k:.6f}.jpg") for k in range(6)]
    times = times_of(frames, "names")
    steps = CLOCK - 3.0 + 0.1 * np.arange(90)
    found = read_odometry(_trajectory(tmp_path / "tum.txt", steps), frames, times)
    np.testing.assert_allclose([pose.center_world[0] for pose in found], 3.0 + 0.5 * np.arange(6), atol=1e-5)
    # as many poses as frames, but begun a second before: the last frames have none
    path = _trajectory(tmp_path / "tum.txt", CLOCK - 1.0 + 0.5 * np.arange(6))
    found = read_odometry(path, frames, times)
    assert [pose and pose.center_world[0] for pose in found] == [1.0, 1.5, 2.0, 2.5, None, None]


def test_a_trajectory_that_begins_with_the_first_frame_is_matched_by_the_time_since(tmp_path):
    path = _trajectory(tmp_path / "tum.txt", 0.1 * np.arange(30))
    for times, has_clock in ((CLOCK + 0.5 * np.arange(6), True), (0.5 * np.arange(6), False)):
        found = read_odometry(path, [Path("a.jpg")] * 6, times, has_clock)
        assert [pose.center_world[0] for pose in found] == [0.0, 0.5, 1.0, 1.5, 2.0, 2.5]


def test_one_clock_goes_before_the_time_since_the_first_frame_and_without_one_the_order_counts(tmp_path):
    """An odometry that was begun 10 s before the first frame is not shifted; other numbers are no seconds."""
    for step, count, times, has_clock in ((0.5, 40, [10.0, 10.5, 11.0], True), (1.1, 10, range(10), False)):
        path = _trajectory(tmp_path / "tum.txt", step * np.arange(count))
        found = read_odometry(path, [Path("a.jpg")] * len(times), np.array(times, float), has_clock)
        expected = times if has_clock else step * np.arange(10)
        np.testing.assert_allclose([pose.center_world[0] for pose in found], expected, atol=1e-6)


def _turning(path, axes):
    """What turns once about the vertical, and sways by 5 degrees; axes (3, 3) by forward, left, up."""
    world = exp_so3(np.array([1.0, -2.0, 0.5]))
    lines = []
    for k in range(24):
        sway = exp_so3(np.radians([5.0 * np.sin(k), 5.0 * np.cos(k), 0.0]))
        w, x, y, z = quaternion_wxyz(world @ yaw_rotation(k * np.pi / 12.0).T @ sway @ axes)
        lines.append(f"{k} {0.1 * k} 0 0 {x} {y} {z} {w}\n")
    return _write(path, "".join(lines))


def test_poses_of_a_base_are_told_from_those_of_a_camera(tmp_path, caplog):
    photos = [Path(f"{k}.jpg") for k in range(3)]
    base = _turning(tmp_path / "base.txt", np.eye(3))
    camera = _turning(
        tmp_path / "camera.txt", np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    )
    for path in (base, camera, _trajectory(tmp_path / "still.txt", np.arange(3.0))):
        read_odometry(path, photos, [0.0, 1.0, 2.0])
    read_relative_poses(base, photos)
    read_relative_poses(camera, photos)
    text = "found poses that turn about their z, as those of a base with z up (ROS), wanted a camera's"
    starts = [record.getMessage()[: len(f"{base}: {text}")] for record in caplog.records]
    assert starts == [f"{base}: {text}"] * 2


def test_what_is_no_odometry_of_the_frames_is_refused(tmp_path):
    times = [0.0, 1.0]
    wanted = "wanted a TUM or KITTI trajectory or a transforms.json"
    cases = {
        "words": ("these eight words are no numbers at all\n", "which is no number"),
        "columns": ("1 2 3\n", "found 3 columns"),
        "skew": ("1 0 0 0 0 2 0 0 0 0 1 0\n" * 2, "a row: found a matrix that"),
        "late": ("50 0 0 0 0 0 0 1\n" * 3, "found 2 frames and no pose of them"),
        "kitti of others": ("1 0 0 0 0 1 0 0 0 0 1 0\n" * 3, "found 2 frames and no pose of them"),
    }
    for name, (text, found) in cases.items():
        path = _write(tmp_path / f"{name}.txt", text)
        with pytest.raises(InputError, match=found) as error:
            read_odometry(path, PHOTOS[:2], times)
        assert wanted in str(error.value)
