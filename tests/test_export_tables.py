"""Exports that are lists of poses: trajectories, tables, maps."""

import csv
from dataclasses import replace
from importlib import import_module
from xml.etree import ElementTree

import numpy as np
import pytest
from poses import json_of, lines_of, result, rotation, tilted_poses
from refusals import assert_input_error

from piccolo.apps.export.formats import export
from piccolo.apps.export.posed_images import Options
from piccolo.geometry.pose import Pose, heading_pitch_roll_deg, rotation_from_quaternion_wxyz
from piccolo.judge.result_parts import Gap, Source, WalkFrame
from piccolo.system.errors import InputError

POSES = tilted_poses(4)
EYE = np.eye(3)
RIGHT_DOWN_FORWARD = np.stack([-EYE[1], -EYE[2], EYE[0]])  # these axes of the camera, in ours


@pytest.fixture(scope="module")
def evo(tmp_path_factory):
    """evo's readers; at the first import evo writes its settings into the home folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOME", str(tmp_path_factory.mktemp("home")))
        return import_module("evo.tools.file_interface")


def _results(names=("a", "b", "c", "d"), **changes):
    return [result(f"{name}.jpg", pose, **changes) for name, pose in zip(names, POSES, strict=True)]


def _check_poses(matrices, axes):
    for T, pose in zip(matrices, POSES, strict=True):
        np.testing.assert_allclose(T[:3, :3], (axes @ pose.R_cam_from_world).T, atol=1e-12)
        np.testing.assert_array_equal(T[:3, 3], pose.center_world)


@pytest.mark.parametrize(("name", "axes"), [("optical", RIGHT_DOWN_FORWARD), ("piccolo", EYE)])
def test_trajectories_are_read_by_evo(tmp_path, evo, name, axes):
    export(_results(), "tum", tmp_path / "p.tum", Options(axes=name))
    trajectory = evo.read_tum_trajectory_file(str(tmp_path / "p.tum"))
    _check_poses(trajectory.poses_se3, axes)
    np.testing.assert_array_equal(trajectory.timestamps, [0, 1, 2, 3])
    assert trajectory.check()[0]
    export(_results(), "kitti", tmp_path / "p.kitti", Options(axes=name))
    _check_poses(evo.read_kitti_poses_file(str(tmp_path / "p.kitti")).poses_se3, axes)


def test_timestamps_by_name_are_exact_and_in_order(tmp_path, evo):
    names = ["1305031102.275", "1305031102.1753041", "3", "1305031102.175304"]
    export(_results(names), "tum", tmp_path / "p.tum", Options(timestamps="name", offset=(1e5, 2e5, 0)))
    comment, offset, *rows = lines_of(tmp_path / "p.tum")
    assert comment.endswith("optical")
    assert offset.endswith("100000.0 200000.0 0.0")
    assert [row.split()[0] for row in rows] == [names[i] for i in (2, 3, 1, 0)]
    positions = evo.read_tum_trajectory_file(str(tmp_path / "p.tum")).positions_xyz
    np.testing.assert_array_equal(positions[0], POSES[2].center_world - [1e5, 2e5, 0])
    with pytest.raises(InputError, match="its name 'a' is no number"):
        export(_results(), "tum", tmp_path / "q.tum", Options(timestamps="name"))


def test_table_has_every_number_to_the_last_bit(tmp_path):
    results = [*_results(), result("a.jpg", POSES[0], "ambiguous", 'other, "cloud".ply', evidence=None)]
    export(results, "csv", tmp_path / "p.csv", Options())
    with (tmp_path / "p.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    for row, pose in zip(rows, [*POSES, POSES[0]], strict=True):
        np.testing.assert_array_equal([float(row[k]) for k in "xyz"], pose.center_world)
        q = np.array([float(row[f"quaternion_{k}"]) for k in "wxyz"])
        np.testing.assert_allclose(rotation_from_quaternion_wxyz(q), pose.R_cam_from_world, atol=1e-14)
        angles = [float(row[f"{k}_deg"]) for k in ("heading", "pitch", "roll")]
        np.testing.assert_allclose(rotation(*angles), pose.R_cam_from_world.T, atol=1e-10)
    assert (rows[0]["image"], rows[0]["status"], rows[0]["score"]) == ("a.jpg", "localized", "0.7")
    assert (rows[4]["cloud"], rows[4]["confidence"], rows[4]["score"]) == ('other, "cloud".ply', "0.9", "")


@pytest.mark.parametrize(
    ("direction", "angles"),
    [((0, 1, 0), (0, 0, 0)), ((-1, 0, 1), (270, 45, 0)), ((0, -1, -1), (180, -45, 0))],
)
def test_heading_is_clockwise_from_y_and_pitch_upwards(direction, angles):
    forward = np.array(direction) / np.linalg.norm(direction)
    left = np.cross([0.0, 0.0, 1.0], forward)
    left /= np.linalg.norm(left)
    pose = Pose(np.stack([forward, left, np.cross(forward, left)]), np.zeros(3))
    assert heading_pitch_roll_deg(pose) == pytest.approx(angles, abs=1e-9)


def test_horizon_turns_counterclockwise_as_roll_grows_and_angles_stay_in_their_ranges():
    pose = Pose(rotation(30.0, 0.0, 10.0).T, np.zeros(3))
    assert heading_pitch_roll_deg(pose) == pytest.approx((30.0, 0.0, 10.0), abs=1e-9)
    on_the_right = np.radians(30.0 + 20.0)
    _, y, z = pose.R_cam_from_world @ [np.sin(on_the_right), np.cos(on_the_right), 0.0]
    assert y < 0.0  # right of the image centre
    assert z > 0.0  # and above the middle row
    for heading, roll in ((-1e-12, -180.0), (359.9999999999, 180.0), (0.0, -180.0 + 1e-11)):
        found = heading_pitch_roll_deg(Pose(rotation(heading, 5.0, roll).T, np.zeros(3)))
        assert found == pytest.approx((0.0, 5.0, 180.0), abs=1e-9)
        assert found[0] < 360.0


@pytest.mark.parametrize("pitch", [90.0, -90.0, 89.9999999, 90.0 - 1e-12])
def test_angles_give_the_pose_back_at_the_zenith_too(pitch):
    R = rotation(200.0, pitch, -170.0)
    heading, found, roll = heading_pitch_roll_deg(Pose(R.T, np.zeros(3)))
    assert found == pytest.approx(pitch, abs=1e-7)
    np.testing.assert_allclose(rotation(heading, found, roll), R, atol=1e-10)


def test_geojson_is_in_wgs84(tmp_path):
    # Zone 32 has its meridian at 9 degrees east, where x is 500,000 and grid north is true north.
    R_cam_from_world = rotation(75.0, 10.0, -5.0).T
    places = [np.array([x, 5_538_630.7026, 80.5]) for x in (500_000.0, 700_000.0)]
    results = [result("a.jpg", Pose(R_cam_from_world, place)) for place in places]
    export(results, "geojson", tmp_path / "p.geojson", Options(crs="EPSG:32632"))
    first, second = json_of(tmp_path / "p.geojson")["features"]
    np.testing.assert_allclose(first["geometry"]["coordinates"], [9.0, 50.0], atol=1e-8)
    assert first["properties"]["heading_deg"] == pytest.approx(75.0)
    assert first["properties"]["heading_true_deg"] == pytest.approx(75.0, abs=1e-3)
    assert first["properties"]["z"] == 80.5
    # The meridians converge by about (longitude - 9 degrees) sin(latitude).
    longitude, latitude = second["geometry"]["coordinates"]
    convergence = (longitude - 9.0) * np.sin(np.radians(latitude))
    assert convergence > 2.0
    assert second["properties"]["heading_true_deg"] == pytest.approx(75.0 + convergence, abs=0.01)


def test_gpx_is_a_track_with_a_segment_behind_each_gap(tmp_path):
    sources = [Source(capture_time="2026-11-22T10:00:00+01:00"), Source(), Source(), Source()]
    gaps = [None, None, Gap(30.0, 1.0), None]
    results = []
    for k, (source, gap) in enumerate(zip(sources, gaps, strict=True)):
        pose = Pose(EYE, np.array([500_000.0 + 10.0 * k, 5_538_630.7026, 80.5]))
        frame = WalkFrame(0.5 * k, k, "tracked", None, gap)
        results.append(result(f"{k}.jpg", pose, source=source, walk=frame))
    export(results, "gpx", tmp_path / "p.gpx", Options(crs="EPSG:32632"))
    root = ElementTree.parse(tmp_path / "p.gpx").getroot()
    names = {"g": "http://www.topografix.com/GPX/1/1"}
    segments = root.findall("g:trk/g:trkseg", names)
    assert [len(segment.findall("g:trkpt", names)) for segment in segments] == [2, 2]
    first = segments[0].find("g:trkpt", names)
    np.testing.assert_allclose([float(first.get("lon")), float(first.get("lat"))], [9.0, 50.0], atol=1e-8)
    assert first.find("g:time", names).text == "2026-11-22T10:00:00+01:00"
    assert [point.text for point in root.iterfind(".//g:name", names)] == [f"{k}.jpg" for k in range(4)]
    assert len(root.findall(".//g:time", names)) == 1


def test_tum_has_the_times_of_a_walk(tmp_path):
    frames = [WalkFrame(0.25 * k, k, "tracked", None, None) for k in range(4)]
    walked = [replace(r, walk=frame) for r, frame in zip(_results(), frames, strict=True)]
    export(walked, "tum", tmp_path / "p.tum", Options(timestamps="walk"))
    assert np.loadtxt(tmp_path / "p.tum")[:, 0].tolist() == [0.0, 0.25, 0.5, 0.75]
    with pytest.raises(InputError, match=r"^a\.jpg: found no frame of a walk, as `timestamps` walk needs$"):
        export(_results(), "tum", tmp_path / "q.tum", Options(timestamps="walk"))


@pytest.mark.parametrize(
    ("crs", "center", "message"),
    [
        ("EPSG:99999999", (0, 0, 0), "wanted a coordinate system such as"),
        ("EPSG:4326", (0, 0, 0), "wanted a projected system in metres"),
        ("EPSG:2263", (0, 0, 0), "wanted a projected system in metres"),  # feet
        ("EPSG:32632", (1e12, 0, 0), "wanted one where EPSG:32632 holds"),
        ("EPSG:32632", (3.5, -2.0, 1.0), r"a\.jpg: found a camera at \(3\.5, -2\), .* 6 to 12 E, 0 to 84 N"),
        ("EPSG:25832+5783", (3.5, 2.0, 1.0), "wanted one where EPSG:25832"),
        ("EPSG:25832", (690_000.0, 3_500_000.0, 0), "6 to 12.01 E, 36.53 to 84.01 N"),  # 31.6 N
    ],
)
def test_geojson_refuses_systems_and_places_that_do_not_fit(tmp_path, crs, center, message):
    one = result("a.jpg", Pose(POSES[0].R_cam_from_world, np.array(center, float)))
    assert_input_error(message, lambda: export([one], "geojson", tmp_path / "p.geojson", Options(crs=crs)))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("crs", "x", "y"),
    [
        ("EPSG:25832", 915_000.0, 5_680_000.0),  # in Saxony, which is in the next zone
        ("EPSG:3832", 3_400_000.0, -1_900_000.0),  # about the Pacific, across 180 E
        ("+proj=utm +zone=32 +datum=WGS84", 0.0, 0.0),  # says no area
    ],
)
def test_geojson_takes_what_is_near_the_area_of_a_system(tmp_path, crs, x, y):
    one = result("a.jpg", Pose(POSES[0].R_cam_from_world, np.array([x, y, 0.0])))
    export([one], "geojson", tmp_path / "p.geojson", Options(crs=crs))
    (longitude, _) = json_of(tmp_path / "p.geojson")["features"][0]["geometry"]["coordinates"]
    assert -180.0 <= longitude <= 180.0
