"""Mounts: rotation, lever arm and clock offset of a camera, from photos and given poses."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from mounts import MOUNT, ORIGIN, body_at
from poses import result, write_results
from refusals import assert_input_error, assert_refused

from piccolo.apps.mount import calibrate_mount
from piccolo.apps.mount.mount import Sighting, Trajectory, fit_mount
from piccolo.batch.inputs import read_priors
from piccolo.geometry.pose import (
    Pose,
    angle_between,
    pose_errors,
    rotation_from_quaternion_wxyz,
    yaw_rotation,
)
from piccolo.geometry.pose_gaussian import add, subtract
from piccolo.judge.pose_covariance import PoseCovariance
from piccolo.photo.photo import Prior
from piccolo.poses.pose_table import read_pose_table
from piccolo.poses.relative_poses import read_relative_poses

CLOCK = 0.08
PHOTO = np.repeat([np.radians(0.05), 0.004], 3)  # deviations of a photo's pose
GIVEN = np.repeat([np.radians(0.07), 0.01], 3)


def _made(seed, num_photos=40, num_wrong=2):
    """A trajectory at 20 Hz with errors that last for half a second, and photos with errors of their own."""
    rng = np.random.default_rng(seed)
    times = np.arange(-0.5, 30.5, 0.05)
    slow = np.repeat(rng.normal(size=(len(times) // 10 + 1, 6)) * GIVEN, 10, axis=0)[: len(times)]
    given = [add(body_at(time), error) for time, error in zip(times, slow, strict=True)]
    photo_times = np.sort(rng.uniform(0.0, 30.0, num_photos))
    poses = [add(MOUNT @ body_at(time + CLOCK), PHOTO * rng.normal(size=6)) for time in photo_times]
    for k in range(num_wrong):
        poses[7 * k + 3] = add(poses[7 * k + 3], np.array([0.0, 0.0, 1.0, 2.0, -3.0, 0.0]))
    return Trajectory(times, given), photo_times, poses


def _fit(seed):
    trajectory, times, poses = _made(seed)
    covariance = np.diag(PHOTO**2)
    sightings = [Sighting(p, covariance, t) for p, t in zip(poses, times, strict=True)]
    return fit_mount(sightings, trajectory)


def test_a_mount_and_its_clock_are_found_with_deviations_that_hold():
    squares = []
    for seed in range(2):
        fit = _fit(seed)
        off = np.append(subtract(MOUNT, fit.cam_from_body), CLOCK - fit.clock)
        assert np.degrees(np.linalg.norm(off[:3])) < 0.05
        assert np.linalg.norm(off[3:6]) < 0.01
        assert abs(off[6]) < 0.01
        assert [k for k, is_odd in enumerate(fit.is_odd) if is_odd] == [3, 10]
        squares.append(np.square(off) / np.diag(fit.covariance))
    assert np.max(squares) < 4.0**2
    assert 0.3 < np.mean(squares) < 3.0
    assert fit.errors.move == pytest.approx(0.01, rel=0.5)


def _text_of(kind, names, times, poses):
    """A file of poses in each of the formats, by formulas of its own."""
    lines = {
        "tum": [],
        "potree": [""],
        "opk": ["# CoordinateSystem: LOCAL", OPK_HEAD],
        "metashape": [YPR_HEAD],
    }[kind]
    for name, time, pose in zip(names, times, poses, strict=True):
        R = pose.R_cam_from_world.T  # columns: forward, left, up
        x, y, z = (repr(float(value)) for value in pose.center_world)
        if kind == "potree":
            f, left, up = R.T
            course = np.arctan2(f[0], f[1])
            level = np.array([-np.cos(course), np.sin(course), 0.0])
            angles = [course, np.arcsin(f[2]), np.arctan2(-up @ level, left @ level)]
            lines.append("\t".join([name, repr(float(time)), x, y, z, *map(str, np.degrees(angles))]))
            continue
        right = -R[:, 1]
        top = R[:, 2]
        back = -R[:, 0]
        if kind == "opk":
            phi = np.arcsin(back[0])
            angles = np.degrees([np.arctan2(-back[1], back[2]), phi, np.arctan2(-top[0], right[0])])
            lines.append(" ".join([name.removesuffix(".jpg"), x, y, z, *map(str, angles), *["0"] * 9]))
        if kind == "metashape":
            angles = np.degrees(
                [np.arctan2(top[0], top[1]), np.arcsin(top[2]), np.arctan2(-right[2], back[2])]
            )
            lines.append(",".join([name, x, y, z, *map(str, angles), "1"]))
    return "\n".join(lines) + "\n"


OPK_HEAD = "#Label X/Easting Y/Northing Z/Altitude Omega Phi Kappa r11 r12 r13 r21 r22 r23 r31 r32 r33"
YPR_HEAD = "#Label,X/Easting,Y/Northing,Z/Altitude,Yaw,Pitch,Roll,Enabled"


@pytest.mark.parametrize("kind", ["potree", "opk", "metashape"])
def test_tables_come_out_as_they_came_in_with_the_mount_applied(tmp_path, kind, capsys):
    times = np.linspace(0.0, 20.0, 12)
    names = [f"{k:02d}.jpg" for k in range(12)]
    bodies = [body_at(time) for time in times]
    poses = [MOUNT @ body for body in bodies]
    given = tmp_path / "given.txt"
    given.write_text(_text_of(kind, names, times, bodies))
    for body, read in zip(bodies, read_pose_table(given).poses, strict=True):
        assert pose_errors(read, body) == pytest.approx((0.0, 0.0), abs=1e-7)
    results = write_results(
        tmp_path / "r.jsonl", [result(f"photos/{n}", p) for n, p in zip(names, poses, strict=True)]
    )
    out = tmp_path / "out.txt"
    assert calibrate_mount.main(["--results", str(results), "--given", str(given), "--out", str(out)]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["lever_arm_m"] == pytest.approx([0.06, -0.05, 0.06], abs=1e-6)
    assert report["rotation_deg"] == pytest.approx([1.2, -1.2, 1.1], abs=1e-4)
    for pose, read in zip(poses, read_pose_table(out).poses, strict=True):
        assert pose_errors(read, pose) == pytest.approx((0.0, 0.0), abs=1e-6)
    before, after = (path.read_text().splitlines() for path in (given, out))
    assert len(before) == len(after)
    assert "r11" not in out.read_text()
    assert after[-1].split(",")[-1] == "1" or kind != "metashape"


def test_a_trajectory_and_photos_with_times_in_their_names(tmp_path, capsys):
    trajectory, times, poses = _made(1, 12, 0)
    covariance = PoseCovariance(np.diag(PHOTO**2), "")
    rows = [(f"{t:.6f}.jpg", pose) for t, pose in zip(times, poses, strict=True)]
    results = write_results(tmp_path / "r.jsonl", [result(n, p, covariance=covariance) for n, p in rows])
    given = tmp_path / "tum.txt"
    lines = []
    for time, pose in zip(trajectory.times, trajectory.poses, strict=True):
        x, y, z = pose.center_world.tolist()
        R = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]) @ pose.R_cam_from_world
        w, qx, qy, qz = Pose(R.T, np.zeros(3)).quaternion_wxyz
        lines.append(f"{time} {x} {y} {z} {qx} {qy} {qz} {w}")
    given.write_text("# t x y z qx qy qz qw\n" + "\n".join(lines) + "\n")
    arguments = ["--results", str(results), "--given", str(given), "--times", "names"]
    assert calibrate_mount.main([*arguments, "--out", str(tmp_path / "out.txt")]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["clock_s"] == pytest.approx(CLOCK, abs=max(0.02, 3.0 * report["std_s"]))
    written = read_pose_table(tmp_path / "out.txt")
    at = int(np.argmin(np.abs(trajectory.times - 10.0)))
    assert pose_errors(written.poses[at], MOUNT @ body_at(10.0 + CLOCK)) < (0.06, 0.02)
    assert calibrate_mount.main(arguments[:4]) == 3
    assert "--times: found none" in capsys.readouterr().err


def test_a_mount_on_a_base_with_x_ahead_has_the_axes_of_the_base(tmp_path, capsys):
    """Poses of a base as ROS has them, written by their own matrix: forward, left, up in the world."""
    times = np.linspace(0.0, 20.0, 12)
    mount = Pose(yaw_rotation(2.0) @ MOUNT.R_cam_from_world, np.array([0.1, 0.2, 0.5]))
    bases = [Pose(yaw_rotation(0.6 * time), ORIGIN + np.array([time, 0.1 * time**2, 0.0])) for time in times]
    rows = []
    for time, base in zip(times, bases, strict=True):
        w, x, y, z = Pose(base.R_cam_from_world.T, np.zeros(3)).quaternion_wxyz.tolist()
        rows.append(" ".join(map(repr, [float(time), *base.center_world.tolist(), x, y, z, w])))
    given = tmp_path / "base.txt"
    given.write_text("\n".join(rows) + "\n")
    photos = [result(f"{t}.jpg", mount @ base) for t, base in zip(times, bases, strict=True)]
    results = write_results(tmp_path / "r.jsonl", photos)
    words = ["--results", str(results), "--given", str(given), "--times", "names"]
    outs = [tmp_path / "1.txt", tmp_path / "2.txt"]
    assert calibrate_mount.main([*words, "--out", str(outs[0])]) == 0
    wrong, err = capsys.readouterr()
    assert f"{given}: found poses that turn about their z, as those of a base with z up (ROS)" in err
    assert "has --axes piccolo" in err
    assert calibrate_mount.main([*words, "--axes", "piccolo", "--out", str(outs[1])]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    report = json.loads(out)
    other = json.loads(wrong)
    assert report["lever_arm_m"] == pytest.approx([0.1, 0.2, 0.5], abs=1e-5)
    z, x, y = other["std_m"]  # of forward, left, up, as which they were read
    assert report["std_m"] == pytest.approx([x, y, z])
    R = rotation_from_quaternion_wxyz(report["quaternion_wxyz_cam_from_body"])
    assert angle_between(R, mount.R_cam_from_world) < 1e-5
    assert outs[0].read_text() == outs[1].read_text()  # of the camera, right, down, forward
    for photo, pose in zip(photos, read_pose_table(outs[1]).poses, strict=True):
        assert pose_errors(pose, photo.pose) == pytest.approx((0.0, 0.0), abs=1e-5)
    given.write_text(_text_of("opk", ["a.jpg"], [0.0], bases[:1]))
    assert calibrate_mount.main([*words, "--axes", "piccolo"]) == 2
    assert "--axes: only an option of quaternions" in capsys.readouterr().err


NAVVIS_HEAD = "# pano poses v1.0: ID; filename; timestamp; " + "; ".join(
    [*(f"pano_pos_{axis}" for axis in "xyz"), *(f"pano_ori_{axis}" for axis in "wxyz")]
)
AHEAD = np.eye(3)
OPTICAL = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # right, down, ahead


def _write_quaternions(path, head, mark, axes, names, bodies):
    """A table of names and T_world_from_body, w first, in some axes of the body."""
    lines = [head]
    for k, (name, body) in enumerate(zip(names, bodies, strict=True)):
        wxyz = Pose((axes @ body.R_cam_from_world).T, np.zeros(3)).quaternion_wxyz.tolist()
        lines.append(
            mark.join([str(k), name, repr(10.5 * k), *map(repr, [*body.center_world.tolist(), *wxyz])])
        )
    path.write_text("\n".join(lines) + "\n")
    return path


def _calibrate(tmp_path, given, names, bodies, capsys, *words):
    photos = [result(f"photos/{name}", MOUNT @ body) for name, body in zip(names, bodies, strict=True)]
    results = write_results(tmp_path / "r.jsonl", photos)
    words = ["--results", str(results), "--given", str(given), "--out", str(tmp_path / "out.csv"), *words]
    assert calibrate_mount.main(words) == 0
    out, err = capsys.readouterr()
    return json.loads(out), err


BODIES = [body_at(time) for time in np.linspace(0.0, 20.0, 6)]
PHOTOS = [f"{k:02d}.jpg" for k in range(6)]


def test_poses_of_navvis_have_x_ahead(tmp_path, capsys):
    given = _write_quaternions(tmp_path / "pano-poses.csv", NAVVIS_HEAD, "; ", AHEAD, PHOTOS, BODIES)
    report, err = _calibrate(tmp_path, given, PHOTOS, BODIES, capsys)
    assert err == ""
    assert report["rotation_deg"] == pytest.approx([1.2, -1.2, 1.1], abs=1e-4)
    assert report["lever_arm_m"] == pytest.approx([0.06, -0.05, 0.06], abs=1e-6)
    for body, read in zip(BODIES, read_pose_table(tmp_path / "out.csv").poses, strict=True):
        assert pose_errors(read, MOUNT @ body) == pytest.approx((0.0, 0.0), abs=1e-6)
    relative = read_relative_poses(given, [Path(name) for name in PHOTOS])
    for body, read in zip(BODIES, relative, strict=True):
        assert pose_errors(read, body) == pytest.approx((0.0, 0.0), abs=1e-6)


def test_positions_of_navvis_are_priors(tmp_path):
    given = _write_quaternions(tmp_path / "pano-poses.csv", NAVVIS_HEAD, "; ", AHEAD, PHOTOS, BODIES)
    table = read_priors(given, Prior(height=(1.0, 2.0)))
    assert [*table.by_name] == PHOTOS
    for body, (prior, gravity_vector) in zip(BODIES, table.by_name.values(), strict=True):
        assert prior.near == pytest.approx(body.center_world, abs=1e-12)
        assert (prior.radius, prior.height, prior.heading_deg, gravity_vector) == (
            5.0,
            (1.0, 2.0),
            None,
            None,
        )
    given.write_text(given.read_text().replace("01.jpg", "00.jpg"))
    assert_refused("found the name '00.jpg' twice", read_priors, given, Prior())


def test_longitudes_and_latitudes_are_recognized(tmp_path, capsys):
    """As GPS has them in Potree's coordinates.txt; poses in metres as near to each other are taken."""
    rows = []
    for name, body in zip(PHOTOS, BODIES, strict=True):
        x, y, z = (body.center_world - ORIGIN).tolist()
        rows.append(f"{name}\t0\t{11.5 + 1e-5 * x}\t{48.1 + 1e-5 * y}\t{z}\t10\t0\t0")
    given = tmp_path / "coordinates.txt"
    given.write_text("\n".join(["File\tTime\tLong\tLat\tAlt\tcourse\tpitch\troll", *rows]) + "\n")
    photos = [result(f"photos/{name}", MOUNT @ body) for name, body in zip(PHOTOS, BODIES, strict=True)]
    results = write_results(tmp_path / "r.jsonl", photos)
    assert calibrate_mount.main(["--results", str(results), "--given", str(given)]) == 3
    message = "found longitude and latitude such as 11.5"
    assert f"{given}: {message}" in capsys.readouterr().err
    assert_refused(message, read_priors, given, Prior())
    read_pose_table(given).check_metres([body_at(0.0), body_at(1e-4)])


@pytest.mark.parametrize(
    ("axes", "right", "wrong"), [(AHEAD, "piccolo", "optical"), (OPTICAL, "optical", "piccolo")]
)
def test_named_quaternions_in_other_axes_are_told_by_the_mount(tmp_path, capsys, axes, right, wrong):
    head = "number,name,time,x,y,z,qw,qx,qy,qz"
    given = _write_quaternions(tmp_path / "given.csv", head, ",", axes, PHOTOS, BODIES)
    report, err = _calibrate(tmp_path, given, PHOTOS, BODIES, capsys, "--axes", wrong)
    assert np.linalg.norm(report["rotation_deg"]) == pytest.approx(120.0, abs=2.5)
    found = f"found a camera turned by 1[12][0-9] deg, as {right} axes are from {wrong} ones"
    assert re.search(f": warning: {re.escape(str(given))}: {found}; .* add --axes {right}\n", err)
    assert err.count("\n") == 1
    if wrong == "optical":
        assert _calibrate(tmp_path, given, PHOTOS, BODIES, capsys)[1] == err  # which is the default
    report, err = _calibrate(tmp_path, given, PHOTOS, BODIES, capsys, "--axes", right)
    assert err == ""
    assert report["rotation_deg"] == pytest.approx([1.2, -1.2, 1.1], abs=1e-4)
    poses = [row.split(",") for row in (tmp_path / "out.csv").read_text().splitlines()[1:]]
    for words, body in zip(poses, BODIES, strict=True):  # in the axes that they were given in
        R = axes.T @ rotation_from_quaternion_wxyz(np.array(words[6:], float)).T
        wanted = MOUNT @ body
        assert pose_errors(Pose(R, np.array(words[3:6], float)), wanted) == pytest.approx(
            (0.0, 0.0), abs=1e-6
        )


def _write_tum(path, times, bodies):
    lines = []
    for time, body in zip(times, bodies, strict=True):
        w, x, y, z = Pose((OPTICAL @ body.R_cam_from_world).T, np.zeros(3)).quaternion_wxyz.tolist()
        lines.append(" ".join(map(repr, [float(time), *body.center_world.tolist(), x, y, z, w])))
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("step", [1.0, 7.0])  # seconds may rise as numbers of rows do
@pytest.mark.parametrize("first", [0.0, 100.0])
def test_a_sparse_trajectory_has_the_poses_of_photos_at_their_times(tmp_path, capsys, step, first):
    times = first + step * np.arange(5)
    names = [f"{time}.jpg" for time in times]
    given = _write_tum(tmp_path / "five.txt", times, BODIES[:5])
    report, err = _calibrate(tmp_path, given, names, BODIES[:5], capsys, "--times", "names")
    assert err == ""
    assert report["rotation_deg"] == pytest.approx([1.2, -1.2, 1.1], abs=1e-4)
    assert report["lever_arm_m"] == pytest.approx([0.06, -0.05, 0.06], abs=1e-5)
    assert report["clock_s"] == pytest.approx(0.0, abs=1e-6)


def test_times_by_another_clock_and_times_that_do_not_rise_are_refused(tmp_path, capsys):
    names = [f"{time}.jpg" for time in range(50, 55)]
    photos = [result(name, MOUNT @ body) for name, body in zip(names, BODIES, strict=False)]
    words = ["--results", str(write_results(tmp_path / "r.jsonl", photos)), "--times", "names", "--given"]
    given = _write_tum(tmp_path / "five.txt", 100.0 + np.arange(5), BODIES[:5])
    assert calibrate_mount.main([*words, str(given)]) == 3
    text = "found photos at 50.000 to 54.000 s, wanted times within those of the given poses, 100.000 to"
    assert text in capsys.readouterr().err
    _write_tum(given, [50.0, 51.0, 51.0, 53.0, 54.0], BODIES[:5])
    assert calibrate_mount.main([*words, str(given)]) == 3
    text = f"{given}: found the time 51.000000 after 51.000000, wanted a trajectory in the order of time"
    assert text in capsys.readouterr().err


def test_what_is_no_table_and_too_few_photos_are_refused(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("name;lon;lat\na;1;2\n")
    assert_input_error(
        "found 0 rows of poses and no known columns, wanted Potree", lambda: read_pose_table(path)
    )
    path.write_text("a 0 1 2 3 40 0 0\nb 1 2 2 3 40 0 0\n".replace(" ", "\t"))  # numbered by Potree's exports
    assert read_pose_table(path).times is None
    path.write_text("name,time,x,y,z,omega,phi,kappa,r\na,noon,1,2,3,4,5,6,0\nb,2,1,2,3,4,5,6,0\n")
    assert_input_error("found could not convert string to float: .noon.", lambda: read_pose_table(path).times)
    still = Trajectory(np.arange(5.0), [body_at(0.0)] * 5)
    sightings = [Sighting(body_at(k), 1e-4 * np.eye(6), k) for k in range(5)]
    assert_input_error("found 3 localized photos with a given pose", lambda: fit_mount(sightings[:3], still))
    assert_input_error(
        "found given poses that are off by .* m and .* deg", lambda: fit_mount(sightings, still)
    )
