"""Exports whose readers project pixels: each reader's own projection finds ours."""

import numpy as np
import pycolmap
import pytest
from poses import SIZE, WIDTH, jpeg, json_of, lines_of, pixels_and_points, result, tilted_poses
from refusals import assert_input_error

from piccolo.apps.export.formats import export
from piccolo.apps.export.posed_images import Options
from piccolo.geometry.pose import exp_so3, log_so3
from piccolo.photo.camera import Camera, Mount
from piccolo.photo.camera.model import pinhole
from piccolo.system.errors import InputError

POSES = tilted_poses(4)
TOLERANCE = 1e-6  # px
SIZED = Options(size=SIZE)


def _results(poses=POSES):
    return [result(f"photos/{i}.jpg", pose) for i, pose in enumerate(poses)]


def _rotation(axis, degrees):
    return exp_so3(np.radians(degrees) * np.eye(3)["xyz".index(axis)])


def _check_pixels(found, wanted):
    difference = np.abs(found - wanted)
    difference[:, 0] = np.minimum(difference[:, 0], WIDTH - difference[:, 0])
    assert difference.max() < TOLERANCE


def nerfstudio_pixels(path, number, points):
    """Pixels by the rays of EQUIRECTANGULAR in nerfstudio/cameras/cameras.py, solved for x and y."""
    document = json_of(path)
    assert document["camera_model"] == "EQUIRECTANGULAR"
    frame = document["frames"][number]
    assert frame["file_path"] == f"photos/{number}.jpg"
    T = np.array(frame["transform_matrix"])
    d = (points - T[:3, 3]) @ T[:3, :3]
    theta = np.arctan2(-d[:, 0], -d[:, 2])
    phi = np.arccos(d[:, 1] / np.linalg.norm(d, axis=1))
    x = document["cx"] - theta / np.pi * document["fl_x"]
    y = document["cy"] + (phi / np.pi - 0.5) * document["fl_y"]
    return np.stack([x, y], axis=1)


def opensfm_pixels(path, number, points):
    """Pixels by opensfm.org/docs/geometry.html, "Spherical Camera" and "Pixel Coordinates".

    u = lon / 2 pi, v = -lat / 2 pi in units of the larger side from the middle; its pixel coordinates begin
    at the centre of the first pixel, ours at its corner.
    """
    (reconstruction,) = json_of(path)
    shot = reconstruction["shots"][f"photos/{number}.jpg"]
    camera = reconstruction["cameras"][shot["camera"]]
    assert camera["projection_type"] == "spherical"
    x, y, z = exp_so3(np.array(shot["rotation"])) @ points.T + np.array(shot["translation"])[:, None]
    lon, lat = np.arctan2(x, z), np.arctan2(-y, np.hypot(x, z))
    normalized = np.stack([lon, -lat], axis=1) / (2.0 * np.pi)
    w, h = camera["width"], camera["height"]
    return max(w, h) * normalized + [(w - 1) / 2, (h - 1) / 2] + 0.5


def potree_pixels(path, number, points):
    """Pixels by potree/src/modules/Images360/Images360.js and three.js' SphereGeometry and Euler.

    sphere.rotation.set(roll + 90, -pitch, -course + 90, "ZYX") is R_z R_y R_x; a vertex at (u, v) is
    (-cos(2 pi u) sin(pi v), cos(pi v), sin(2 pi u) sin(pi v)) with texture coordinates (u, 1 - v), v from the
    picture's top; texture.repeat.x = -1 mirrors u.
    """
    first, *rows = lines_of(path)
    assert first == ""  # skipped as a header by Potree 1.8, as an empty line by later versions
    name, time, *values = rows[number].split("\t")
    assert (name, time) == (f"photos/{number}.jpg", str(number))
    x, y, z, course, pitch, roll = map(float, values)
    R_world_from_sphere = _rotation("z", -course + 90) @ _rotation("y", -pitch) @ _rotation("x", roll + 90)
    d = (points - [x, y, z]) @ R_world_from_sphere
    u = np.arctan2(d[:, 2], -d[:, 0]) / (2.0 * np.pi) % 1.0
    v = np.arccos(d[:, 1] / np.linalg.norm(d, axis=1)) / np.pi
    return np.stack([WIDTH * (1.0 - u), WIDTH / 2 * v], axis=1)


def test_colmap_is_read_by_pycolmap_and_projects_to_our_pixels(tmp_path):
    export(_results(), "colmap", tmp_path / "model", SIZED)
    model = pycolmap.Reconstruction(str(tmp_path / "model"))
    images = {image.name: image for image in model.images.values()}
    assert sorted(images) == [f"photos/{i}.jpg" for i in range(4)]
    assert model.num_cameras() == 1
    for i, pose in enumerate(POSES):
        image = images[f"photos/{i}.jpg"]
        assert image.camera.model_name == "EQUIRECTANGULAR"
        pixels, points = pixels_and_points(pose)
        _check_pixels(np.array([image.project_point(point) for point in points]), pixels)
        np.testing.assert_allclose(image.projection_center(), pose.center_world, rtol=0, atol=1e-8)


CAMERA = Camera("OPENCV", 640, 480, (500.0, 505.0, 322.5, 241.0, -0.1, 0.02, 1e-3, -2e-3))
TILTED = tuple(map(tuple, exp_so3(np.array([0.1, 0.7, -1.2])).tolist()))


def test_colmap_has_the_camera_of_a_photo_and_of_each_picture_of_a_rig(tmp_path):
    """A world point, by our camera, and by COLMAP's of the model that we wrote."""
    (tmp_path / "rig").mkdir()
    for name in ("left.jpg", "right.jpg"):
        jpeg(tmp_path / "rig" / name)
    rig = Mount(CAMERA, image="l*"), Mount(pinhole(640, 480, 400.0), TILTED, (0.1, 0.2, 0.3), image="r*")
    results = [
        result(tmp_path / "a.jpg", POSES[0], cameras=(Mount(CAMERA),)),
        result(tmp_path / "rig", POSES[1], cameras=rig),
    ]
    export(results, "colmap", tmp_path / "model", Options(images=tmp_path))
    model = pycolmap.Reconstruction(str(tmp_path / "model"))
    images = {image.name: image for image in model.images.values()}
    assert model.num_cameras() == 2
    wanted = {
        "a.jpg": (POSES[0], Mount(CAMERA)),
        "rig/left.jpg": (POSES[1], rig[0]),
        "rig/right.jpg": (POSES[1], rig[1]),
    }
    assert images.keys() == wanted.keys()
    for name, (pose, mount) in wanted.items():
        pixels = np.random.default_rng(1).uniform(0.0, 1.0, (50, 2)) * (640, 480)
        x_lens = 5.0 * mount.camera.rays(pixels)[0]
        x_cam = x_lens @ np.array(mount.R_lens_from_cam) + np.array(mount.center_cam)
        points = x_cam @ pose.R_cam_from_world + pose.center_world
        found = np.array([images[name].project_point(point) for point in points])
        assert np.abs(found - pixels).max() < TOLERANCE


@pytest.mark.parametrize("name", ["potree", "gpano", "colmap", "nerfstudio"])
def test_photos_are_refused_by_formats_of_spheres_and_two_in_a_picture_by_others(tmp_path, name):
    cameras = [Mount(CAMERA), Mount(CAMERA, TILTED, offset=(640, 0))]
    message = f"found 2 cameras in one picture, wanted one for {name}"
    if name in ("potree", "gpano"):
        cameras.pop()
        message = "a.jpg: found a photo with the camera model OPENCV, wanted a sphere for"
    photo = result(tmp_path / "a.jpg", POSES[0], cameras=tuple(cameras))
    assert_input_error(message, lambda: export([photo], name, tmp_path / "out", Options()))
    export([photo], "csv", tmp_path / "poses.csv", Options())
    assert len(lines_of(tmp_path / "poses.csv")) == 2


def test_colmap_has_a_camera_a_size_and_refuses_blanks_in_names(tmp_path):
    jpeg(tmp_path / "a.jpg")
    jpeg(tmp_path / "b.jpg", (256, 128))
    results = [result(tmp_path / name, POSES[0]) for name in ("a.jpg", "b.jpg")]
    export(results, "colmap", tmp_path / "model", Options(images=tmp_path))
    model = pycolmap.Reconstruction(str(tmp_path / "model"))
    assert {image.name: image.camera.width for image in model.images.values()} == {"a.jpg": 512, "b.jpg": 256}
    # macOS has \u202f in names: COLMAP reads over it, but readers in Python end the name there
    names = ["my photo.jpg", "ph\u00f6to.jpg", "my\u202fphoto.jpg"]
    left_out = export([result(name, POSES[0]) for name in names], "colmap", tmp_path / "some", SIZED)
    assert [left for reason in left_out.values() for left in reason] == [names[0], names[2]]
    (image,) = pycolmap.Reconstruction(str(tmp_path / "some")).images.values()
    assert image.name == names[1]
    with pytest.raises(InputError, match=r"my photo\.jpg: colmap can't read ' ' in a name"):
        export([result(names[0], POSES[0])], "colmap", tmp_path / "other", SIZED)
    assert not (tmp_path / "other").exists()


@pytest.mark.parametrize(
    ("name", "compute_pixels", "options"),
    [
        ("nerfstudio", nerfstudio_pixels, SIZED),
        ("opensfm", opensfm_pixels, SIZED),
        ("potree", potree_pixels, Options()),
    ],
)
def test_readers_project_to_our_pixels(tmp_path, name, compute_pixels, options):
    export(_results(), name, tmp_path / "out", options)
    for number, pose in enumerate(POSES):
        pixels, points = pixels_and_points(pose)
        _check_pixels(compute_pixels(tmp_path / "out", number, points), pixels)


def test_nerfstudio_with_two_sizes_and_an_offset(tmp_path):
    jpeg(tmp_path / "a.jpg")
    jpeg(tmp_path / "b.jpg", (256, 128))
    results = [result(tmp_path / name, POSES[1]) for name in ("a.jpg", "b.jpg")]
    offset = (500_000.0, 5_400_000.0, 300.0)
    export(results, "nerfstudio", tmp_path / "t.json", Options(images=tmp_path, offset=offset))
    document = json_of(tmp_path / "t.json")
    assert "w" not in document
    assert [(frame["w"], frame["fl_x"]) for frame in document["frames"]] == [(512, 256.0), (256, 128.0)]
    applied = np.array(document["applied_transform"])
    for frame in document["frames"]:
        moved = np.array(frame["transform_matrix"])[:3, 3]
        np.testing.assert_array_equal(moved, POSES[1].center_world - offset)
        np.testing.assert_allclose(applied @ [*POSES[1].center_world, 1.0], moved, atol=1e-9)


def test_rotation_vectors_at_all_angles():
    axis = np.array([2.0, -1.0, 2.0]) / 3.0
    for angle in (0.0, 1e-9, 1e-4, 1.0, np.pi - 1e-9, np.pi):
        R = exp_so3(angle * axis)
        np.testing.assert_allclose(exp_so3(log_so3(R)), R, atol=1e-14)
        assert np.linalg.norm(log_so3(R)) == pytest.approx(angle, abs=1e-15)


def test_the_offset_is_written_beside_what_has_no_place_for_it(tmp_path):
    offset = (500_000.0, 5_400_000.0, 0.1)
    export(_results(), "opensfm", tmp_path / "r.json", Options(size=SIZE, offset=offset))
    written = np.array(lines_of(tmp_path / "r.json.offset.txt")[1].split(), float)
    np.testing.assert_array_equal(written, offset)
    pixels, points = pixels_and_points(POSES[2])
    _check_pixels(opensfm_pixels(tmp_path / "r.json", 2, points - written), pixels)
    with pytest.raises(InputError, match="wanted W = 2 H exactly"):
        export(_results(), "opensfm", tmp_path / "wide.json", Options(size=(512, 257)))
    export(_results(), "colmap", tmp_path / "model", Options(size=SIZE, offset=offset))
    assert "position here + 500000.0 5400000.0 0.1" in (tmp_path / "model.offset.txt").read_text()
    image = pycolmap.Reconstruction(str(tmp_path / "model")).images[1]
    np.testing.assert_allclose(image.projection_center(), POSES[0].center_world - offset, atol=1e-9)
