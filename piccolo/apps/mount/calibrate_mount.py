"""Find how a camera sits on a scanner, vehicle or robot: rotation, lever arm and clock offset."""

import math
from argparse import ArgumentParser
from collections.abc import Sequence
from dataclasses import replace
from itertools import compress
from pathlib import Path

import numpy as np

from ...api.result_files import read_results
from ...api.values import Result
from ...cli.command import Arguments, UsageError, check_outputs, check_suffix, command, option
from ...geometry.pose import CAMERA_AXES, OPTICAL_FROM_CAM, Pose, angle_between, log_so3, quaternion_wxyz
from ...poses.pose_table import AHEAD, QUATERNION, PoseTable, read_pose_table
from ...poses.relative_poses import warn_of_axes
from ...poses.times import times_of
from ...system.arrays import Array
from ...system.errors import InputError
from ...system.files.photo_names import match_names
from .mount import Sighting, Trajectory, fit_mount

ALIKE_DEG = 20.0  # chosen: no camera that is mounted otherwise is turned about this axis by 100 to 140 deg
EPILOG = """\
example:
  python tools/calibrate_mount.py --results poses.jsonl --given coordinates.txt --out corrected.txt

Given poses are in the scan's coordinates: Potree's coordinates.txt, NavVis' pano-poses.csv, a table with a
header that names x, y, z and omega, phi, kappa or yaw, pitch, roll [deg] (Metashape, Pix4D) or a quaternion,
a trajectory in TUM's form (time x y z qx qy qz qw), which needs the photos' times, or an E57 file, whose
images tools/e57_images.py writes. Photos are found by their names. --out is the same file with the camera's
poses in place of the given ones.

Prints one JSON object: cam_from_body as a quaternion and a rotation vector [deg], axes of both +x forward, +y
left, +z up, as those of the camera that the given poses mean; the lever arm [m] in the body's axes; the clock
offset [s] to be added to photos' times; standard deviations; errors of a given pose; and the photos that
contradict the others.
"""


def add_arguments(parser: ArgumentParser) -> None:
    """All options."""
    option(parser, "--results FILE ...", "results of localize.py, JSON lines", required=True)
    option(parser, "--given FILE", "given poses, see below", required=True)
    option(parser, "--out FILE", "write the file again with the mount applied")
    text = "axes of quaternions: optical (default): right, down, forward; piccolo: forward, left, up (ROS)"
    option(parser, "--axes", text, choices=CAMERA_AXES)
    text = "photos' times, for a trajectory: exif, names (the last number in each) or a CSV file of name and "
    option(parser, "--times SOURCE", text + "time [s] (default: of a walk its own, else exif)")


def find_times(
    results: Sequence[Result], table: PoseTable, clock: Array, source: str | None
) -> list[float | None]:
    """Return the time of each photo; None of one that the table has not."""
    photos = [Path(result.pano) for result in results]
    if (names := table.column("name")) is not None:
        return match_names(table.path, list(zip(names, clock.tolist(), strict=True)), photos)
    own = [result.walk.time for result in results if result.walk]
    found = own if own else times_of(photos, source)
    if found is None or len(found) != len(photos):
        raise InputError("`times`: found none of the photos, wanted those for the trajectory")
    return [*found]


def read_table(arguments: Arguments) -> PoseTable:
    """Return the given poses; those of a trajectory are read as optical ones whatever its axes."""
    table = read_pose_table(arguments.given)
    if table.path.suffix.lower() == ".e57":
        check_suffix("--out", arguments.out, (".e57",))
    if arguments.axes and not has_axes(table):
        raise UsageError("--axes: only an option of quaternions; the axes of other files are known")
    is_named = table.column("name") is not None
    return replace(table, form=AHEAD) if arguments.axes == "piccolo" and is_named else table


def has_axes(table: PoseTable) -> bool:
    """Return True if a file does not say which axes its poses have."""
    return table.form.names == QUATERNION.names and table.path.suffix.lower() != ".e57"


def warn_of_other_axes(arguments: Arguments, table: PoseTable, R_cam_from_body: Array) -> None:
    """Warn if the mount is about the turn between both conventions, or the poses are as those of a base."""
    if not has_axes(table):
        return
    given = arguments.axes or "optical"
    other, turn = ("optical", OPTICAL_FROM_CAM.T) if given == "piccolo" else ("piccolo", OPTICAL_FROM_CAM)
    if angle_between(R_cam_from_body, turn) < math.radians(ALIKE_DEG):
        angle = math.degrees(float(np.linalg.norm(log_so3(R_cam_from_body))))
        found = f"found a camera turned by {angle:.0f} deg, as {other} axes are from {given} ones"
        arguments.warn([f"{arguments.given}: {found}; if the given poses have those, add --axes {other}"])
    elif not arguments.axes:
        warn_of_axes(arguments.given, table.poses)


@command(__file__, __doc__, EPILOG, add_arguments)
def main(arguments: Arguments) -> int:
    """Read, fit, write; returns the exit code."""
    outputs = {"--out": arguments.out}
    check_outputs(outputs, [*arguments.results, arguments.given])
    table = read_table(arguments)
    times = table.times
    clock = np.arange(float(len(table.rows))) if times is None else times
    trajectory = Trajectory(clock, table.poses, has_clock=times is not None)
    results = [result for result in read_results(arguments.results) if result.pose]
    table.check_metres([result.pose for result in results if result.pose])
    found = find_times(results, table, clock, arguments.times)
    sightings = {
        result.pano: Sighting(result.pose, result.pose_errors, time)
        for result, time in zip(results, found, strict=True)
        if result.pose is not None and time is not None
    }
    fit = fit_mount(list(sightings.values()), trajectory)
    if arguments.out:
        poses = [fit.cam_from_body @ trajectory.at(float(time) + fit.clock) for time in clock]
        table.write(arguments.out, poses)
    std = np.sqrt(np.diag(fit.covariance))
    mount = fit.cam_from_body
    if arguments.axes == "piccolo" and table.form is QUATERNION:  # they were read as optical ones
        mount = mount @ Pose(OPTICAL_FROM_CAM.T, np.zeros(3))
        std[3:6] = np.abs(OPTICAL_FROM_CAM) @ std[3:6]
    R = mount.R_cam_from_world
    warn_of_other_axes(arguments, table, R)
    report = {
        "photos": len(sightings),
        "contradicting": list(compress(sightings, fit.is_odd)),
        "quaternion_wxyz_cam_from_body": quaternion_wxyz(R).tolist(),
        "rotation_deg": np.degrees(log_so3(R)).tolist(),
        "std_deg": np.degrees(std[:3]).tolist(),
        "lever_arm_m": mount.center_world.tolist(),
        "std_m": std[3:6].tolist(),
        "clock_s": fit.clock if trajectory.has_clock else None,
        "std_s": float(std[6]) if trajectory.has_clock else None,
        "given_errors": {"deg": float(np.degrees(fit.errors.turn)), "m": fit.errors.move},
    }
    arguments.report(outputs, report)
    return 0
