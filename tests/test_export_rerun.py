"""Recordings for Rerun, read back by Rerun's own reader."""

from collections import defaultdict

import cv2
import numpy as np
import pytest
from poses import jpeg, result
from refusals import assert_input_error
from rerun.chunk import RrdReader

from piccolo.apps.export import rerun_file
from piccolo.apps.export.formats import export
from piccolo.apps.export.posed_images import Options
from piccolo.geometry.points import LocalCloud, pack_points
from piccolo.geometry.pose import Pose, exp_so3, uniform_rotations
from piccolo.judge.belief import make_belief
from piccolo.judge.result_parts import Source
from piccolo.photo.camera import Camera, Mount

ORIGIN = np.array([500_000.0, 5_400_000.0, 300.0])
POSE = Pose(exp_so3(np.array([0.3, -0.2, 1.0])), ORIGIN + np.array([0.2, 0.1, 0.0]))
PHOTO = Camera("OPENCV", 640, 480, (420.0, 424.0, 323.0, 238.0, -0.1, 0.02, 1e-3, -2e-3))
DOTS = POSE.center_world + 3.0 * uniform_rotations(400)[:, 0]
TOLERANCE = 0.5  # px


def read(path):
    """The components of each entity by their names, and the timelines it is on."""
    found = defaultdict(dict)
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            found[chunk.entity_path][name] = batch.column(name).to_pylist()[0]
        found[chunk.entity_path]["timelines"] = chunk.timeline_names
    return found


def project(transform, pinhole, points):
    """Pixels of points (N, 3) by what Rerun documents: columns of matrices one after the other, axes RDF."""
    R_world_from_cam = np.reshape(transform["Transform3D:mat3x3"][0], (3, 3)).T
    K = np.reshape(pinhole["Pinhole:image_from_camera"][0], (3, 3)).T
    x_cam = (points - np.array(transform["Transform3D:translation"][0])) @ R_world_from_cam
    homogeneous = x_cam[x_cam[:, 2] > 0.5] @ K.T
    return homogeneous[:, :2] / homogeneous[:, 2:], x_cam[:, 2] > 0.5


def _photo(path):
    """A dark picture with a light dot where the camera sees each of DOTS."""
    pixels, is_in = PHOTO.pixels((DOTS - POSE.center_world) @ POSE.R_cam_from_world.T)
    rows, columns = np.indices((480, 640)) + 0.5
    picture = np.full((480, 640), 40.0)
    for u, v in pixels[is_in]:
        picture += 200.0 * np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / 12.0)
    cv2.imwrite(str(path), np.uint8(np.minimum(picture, 255.0)), [cv2.IMWRITE_JPEG_QUALITY, 98])
    return path


@pytest.mark.parametrize("width", [640, 400])
def test_dots_of_a_photo_are_where_the_pinhole_that_is_read_back_projects_them(tmp_path, width, monkeypatch):
    monkeypatch.setattr(rerun_file, "MAX_RERUN_WIDTH", width)
    about = {"cameras": (Mount(PHOTO),), "belief": make_belief([0.95])}
    photo = result(_photo(tmp_path / "a b.jpg"), POSE, **about)
    options = Options(images=tmp_path, offset=tuple(ORIGIN))
    assert export([photo], "rerun", tmp_path / "x.rrd", options) == {}
    found = read(tmp_path / "x.rrd")
    assert found["/scan"]["offset"] == list(ORIGIN)
    frame = found[r"/photos/a\ b.jpg"]
    picture = found[r"/photos/a\ b.jpg/image"]
    assert (frame["confidence"], frame["status"], frame["timelines"]) == ([0.9], ["localized"], [])
    assert frame["place_probability"] == [0.95]
    assert picture["Pinhole:resolution"] == [[width, width * 3 / 4]]
    blob = np.array(picture["EncodedImage:blob"][0], np.uint8)
    gray = cv2.imdecode(blob, cv2.IMREAD_GRAYSCALE).astype(float) - 60.0
    assert gray.shape == (width * 3 // 4, width)
    pixels, _ = project(frame, picture, DOTS - ORIGIN)
    num_found = 0
    for u, v in pixels:
        if min(u, v, width - u, 0.75 * width - v) < 12:
            continue
        top = int(v) - 6
        left = int(u) - 6
        part = np.maximum(gray[top : top + 13, left : left + 13], 0.0)
        rows, columns = np.indices(part.shape) + 0.5
        middle = np.array([(columns * part).sum(), (rows * part).sum()]) / part.sum() + (left, top)
        assert np.abs(middle - (u, v)).max() < TOLERANCE
        num_found += 1
    assert num_found > 20


def test_points_of_the_scan_are_where_the_camera_sees_them_and_spheres_have_axes(tmp_path):
    along = np.linspace(-2.0, 2.0, 121)
    a, b = (grid.ravel() for grid in np.meshgrid(along, along))
    walls = np.concatenate(
        [np.roll(np.stack([a, b, np.full(len(a), s)], axis=1), k, axis=1) for s in (-2, 2) for k in range(3)]
    )
    scan = LocalCloud(
        np.eye(3), ORIGIN, pack_points(walls.astype(np.float32), np.uint8(127.0 + 60.0 * walls)), ()
    )
    sphere = Pose(exp_so3(np.array([-0.1, 0.4, -2.0])), ORIGIN + np.array([-0.6, 0.5, 0.3]))
    jpeg(tmp_path / "7.5.jpg")
    pinhole = Mount(Camera("PINHOLE", 640, 480, (420.0, 424.0, 323.0, 238.0)))
    results = [
        result(_photo(tmp_path / "2.25.jpg"), POSE, cameras=(pinhole,)),
        result(tmp_path / "7.5.jpg", sphere),
    ]
    options = Options(images=tmp_path, points=2000, scan=scan, offset=tuple(ORIGIN), timestamps="name")
    export(results, "rerun", tmp_path / "x.rrd", options)
    found = read(tmp_path / "x.rrd")
    points = np.array(found["/scan"]["Points3D:positions"], float)
    colors = np.array(found["/scan"]["Points3D:colors"], np.uint32)
    assert 1000 < len(points) <= 2000
    red = (colors >> 24).astype(float)
    assert np.abs(red - (127.0 + 60.0 * points[:, 0])).max() <= 1.001
    frame = found["/photos/2.25.jpg"]
    pixels, is_ahead = project(frame, found["/photos/2.25.jpg/image"], points)
    rays = (points[is_ahead] + ORIGIN - POSE.center_world) @ POSE.R_cam_from_world.T
    wanted, is_in = pinhole.camera.pixels(rays)
    assert is_in.sum() > 30
    assert np.abs(pixels - wanted)[is_in].max() < TOLERANCE
    ball = found["/photos/7.5.jpg"]
    assert ball["timelines"] == frame["timelines"] == ["time"]
    assert ball["time"].total_seconds() == 7.5
    assert "TransformAxes3D:axis_length" in ball
    np.testing.assert_allclose(ball["Transform3D:translation"][0], sphere.center_world - ORIGIN, atol=1e-6)
    forward = np.reshape(ball["Transform3D:mat3x3"][0], (3, 3))[2]
    np.testing.assert_allclose(forward, sphere.R_cam_from_world[0], atol=1e-6)
    picture = found["/photos/7.5.jpg/image"]
    assert "EncodedImage:blob" in picture
    assert "Pinhole:resolution" not in picture


def test_times_of_exif_and_places_too_far_for_32_bits(tmp_path):
    near = Pose(POSE.R_cam_from_world, np.array([1.0, 2.0, 3.0]))
    taken = ["2024-05-01T12:00:00+02:00", "2024-05-01T10:00:00", None]
    photos = [
        result(f"{k}.jpg", near, source=Source(capture_time=time), cameras=(Mount(PHOTO),))
        for k, time in enumerate(taken)
    ]
    options = Options(size=(64, 32))
    far = result("far.jpg", POSE)
    left_out = export([*photos, far], "rerun", tmp_path / "x.rrd", options)
    assert [names for names in left_out.values()] == [["far.jpg"]]
    found = read(tmp_path / "x.rrd")
    times = [found[f"/photos/{k}.jpg"].get("taken") for k in range(3)]
    assert times[0] == times[1]
    assert times[0].isoformat().startswith("2024-05-01T10:00:00")
    assert times[2] is None
    assert "EncodedImage:blob" not in found["/photos/0.jpg/image"]  # as a size is given
    wanted = r"found a camera at .*, wanted `offset` X Y Z, as Rerun computes in 32 bits"
    assert_input_error(wanted, lambda: export([far], "rerun", tmp_path / "y.rrd", options))
