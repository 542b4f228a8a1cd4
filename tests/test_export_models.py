"""Models for splats and neural fields, with points, faces of panoramas, photos; read as their readers do."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pycolmap
import pytest
from plyfile import PlyData
from poses import jpeg, json_of, result
from refusals import assert_input_error

from piccolo.apps.export.formats import export
from piccolo.apps.export.posed_images import Options
from piccolo.geometry.points import LocalCloud, pack_points
from piccolo.geometry.pose import Pose, exp_so3, uniform_rotations
from piccolo.geometry.sphere import pixel_rays
from piccolo.photo.camera import Camera, Mount
from piccolo.photo.camera.calibration import read_cameras

SIZE = (512, 256)
FACE = 162  # px
DOT = 0.025  # rad
PIXEL_RAYS = pixel_rays(SIZE[0]).astype(np.float32)
ORIGIN = np.array([500_000.0, 5_400_000.0, 300.0])
POSES = [
    Pose(exp_so3(np.array([0.3, -0.2, 1.0])), ORIGIN + np.array([0.2, 0.1, 0.0])),
    Pose(exp_so3(np.array([-0.1, 0.4, -2.0])), ORIGIN + np.array([-0.6, 0.5, 0.3])),
]
PHOTO = Camera("OPENCV", 320, 240, (260.0, 262.0, 161.5, 119.0, -0.1, 0.02, 1e-3, -2e-3))
TOLERANCE = 0.5  # px, as the reading tool computes it


def _walls():
    """Points on the sides of a cube of 4 m, coloured by their places, and some behind each side."""
    along = np.linspace(-2.0, 2.0, 121)
    a, b = (grid.ravel() for grid in np.meshgrid(along, along))
    sides = [np.stack([a, b, np.full(len(a), side)], axis=1) for side in (-2.0, 2.0)]
    points = np.concatenate([np.roll(side, k, axis=1) for side in sides for k in range(3)])
    colors = np.uint8(127.0 + 60.0 * points)
    behind = points[::10] * 1.5
    return np.concatenate([points, behind]), np.concatenate([colors, np.zeros((len(behind), 3), np.uint8)])


WALLS = _walls()
SCAN = LocalCloud(np.eye(3), ORIGIN, pack_points(WALLS[0].astype(np.float32), WALLS[1]), ())


def _panoramas(folder, dots):
    """Pictures that are dark but for a light dot at each of some world points; and their results."""
    for i, pose in enumerate(POSES):
        picture = np.full((SIZE[1], SIZE[0]), 40.0)
        rays = (dots - pose.center_world) @ pose.R_cam_from_world.T
        for ray in rays / np.linalg.norm(rays, axis=1)[:, None]:
            picture += 215.0 * np.exp((PIXEL_RAYS @ ray - 1.0) * 2.0 / DOT**2)
        picture = np.uint8(np.minimum(picture, 255.0))
        cv2.imwrite(str(folder / f"{i}.png"), picture)
    return [result(folder / f"{i}.png", pose) for i, pose in enumerate(POSES)]


def _centroid(gray, at):
    """The middle of the dot near a pixel; None at the rim."""
    u, v = np.int64(at)
    part = gray[v - 8 : v + 9, u - 8 : u + 9].astype(float)
    if min(u, v) < 8 or part.shape != (17, 17):
        return None
    part = np.maximum(part - 60.0, 0.0)
    rows, columns = np.indices(part.shape) + 0.5
    return np.array([u - 8, v - 8]) + np.array([(columns * part).sum(), (rows * part).sum()]) / part.sum()


@pytest.mark.parametrize("num_faces", [8, 14])  # of 14 the first are the 6 of a cube
def test_dots_of_a_panorama_are_where_colmap_projects_their_points(tmp_path, num_faces):
    dots = ORIGIN + 3.0 * uniform_rotations(24)[:, 0]
    out = tmp_path / "set"
    export(_panoramas(tmp_path, dots), "colmap", out, Options(images=tmp_path, faces=num_faces))
    model = pycolmap.Reconstruction(out / "sparse" / "0")
    assert model.num_images() == 2 * num_faces
    assert not (out / "masks").exists()
    found = set()
    for image in model.images.values():
        gray = cv2.imread(str(out / "images" / image.name), cv2.IMREAD_GRAYSCALE)
        assert gray.shape == (image.camera.height, image.camera.width) == (FACE, FACE)
        for k, dot in enumerate(dots):
            at = image.project_point(dot)
            if at is not None and min(*at, *(FACE - at)) > 8:
                middle = _centroid(gray, at)
                if middle is not None:
                    assert np.abs(middle - at).max() < TOLERANCE
                    found.add((image.name[0], k))
    assert len(found) >= {8: 20, 14: 45}[num_faces]


def test_points_that_are_seen_have_colours_and_tracks_that_project_to_their_pixels(tmp_path):
    photo = result(jpeg_at(tmp_path / "photo.jpg", (320, 240)), POSES[1], cameras=(Mount(PHOTO),))
    results = [*_panoramas(tmp_path, np.empty((0, 3))), photo]
    offset = tuple(ORIGIN - 100.0)
    options = Options(images=tmp_path, points=2000, scan=SCAN, offset=offset)
    export(results, "colmap", tmp_path / "model", options)
    model = pycolmap.Reconstruction()
    model.read_text(tmp_path / "model")
    assert 1000 < model.num_points3D() <= 2000
    assert model.compute_mean_reprojection_error() < 1e-9
    images = {image.name: image for image in model.images.values()}
    assert images.keys() == {"0.png", "1.png", "photo.jpg"}
    assert 30 < images["photo.jpg"].num_points3D < 400 < images["0.png"].num_points3D
    behind = [k for k, point in model.points3D.items() if np.abs(point.xyz - 100.0).max() > 2.001]
    assert len(behind) < 0.02 * model.num_points3D()  # seen between the points of a wall
    for k in set(model.points3D) - {*behind}:
        point = model.points3D[k]
        place = point.xyz - 100.0
        assert np.abs(point.color - (127.0 + 60.0 * place)).max() <= 1.001
        for element in point.track.elements:
            image = model.images[element.image_id]
            found = image.points2D[element.point2D_idx]
            assert np.abs(found.xy - image.project_point(point.xyz)).max() < TOLERANCE
    binary = pycolmap.Reconstruction()
    binary.read_binary(tmp_path / "model")
    np.testing.assert_array_equal(binary.points3D[7].xyz, model.points3D[7].xyz)


def jpeg_at(path, size):
    jpeg(path, size)
    return path


def test_images_are_added_to_a_model_whose_others_stay_as_they_are(tmp_path):
    results = _panoramas(tmp_path, np.empty((0, 3)))
    export(results[:1], "colmap", tmp_path / "old", Options(images=tmp_path, points=500, scan=SCAN))
    export(results[1:], "colmap", tmp_path / "new", Options(images=tmp_path, into=tmp_path / "old"))
    old, new = (pycolmap.Reconstruction(tmp_path / name) for name in ("old", "new"))
    assert {image.name for image in new.images.values()} == {"0.png", "1.png"}
    assert new.num_cameras() == 2
    before, after = ((tmp_path / name / "points3D.bin").read_bytes() for name in ("old", "new"))
    assert before == after
    assert old.images[1].cam_from_world().params.tolist() == new.images[1].cam_from_world().params.tolist()
    np.testing.assert_array_equal(old.images[1].points2D[3].xy, new.images[1].points2D[3].xy)
    again = Options(images=tmp_path, into=tmp_path / "new")
    message = "found the image 0.png in the model"
    assert_input_error(message, lambda: export(results, "colmap", tmp_path / "x", again))
    assert_input_error(
        "found .*wanted the folder of a model",
        lambda: export(results, "colmap", tmp_path / "x", Options(images=tmp_path, into=tmp_path)),
    )


def nerfstudio_pixels(frame, points):
    """Pixels as nerfstudio/cameras/camera_utils.py distorts: r2 (k1 + r2 (k2 + ..)), axes right, up, back."""
    T = np.array(frame["transform_matrix"])
    d = (points - T[:3, 3]) @ T[:3, :3]
    x = d[:, 0] / -d[:, 2]
    y = d[:, 1] / d[:, 2]
    r2 = x * x + y * y
    g = 1 + r2 * (frame["k1"] + r2 * (frame["k2"] + r2 * (frame["k3"] + r2 * frame["k4"])))
    p1 = frame["p1"]
    p2 = frame["p2"]
    u = x * g + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * g + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)
    return np.stack([frame["fl_x"] * u + frame["cx"], frame["fl_y"] * v + frame["cy"]], axis=1)


def test_nerfstudio_has_photos_masks_and_points(tmp_path):
    photo = result(jpeg_at(tmp_path / "photo.jpg", (320, 240)), POSES[1], cameras=(Mount(PHOTO),))
    masked = replace(
        _panoramas(tmp_path, np.empty((0, 3)))[0], settings={"panorama": {"mask_nadir_deg": 20.0}}
    )
    assert_input_error(
        "found the camera models EQUIRECTANGULAR, OPENCV, wanted one for nerfstudio",
        lambda: export([photo, masked], "nerfstudio", tmp_path / "t.json", Options(images=tmp_path)),
    )
    options = Options(images=tmp_path, faces=6, points=300, scan=SCAN, offset=tuple(ORIGIN))
    export([photo, masked], "nerfstudio", tmp_path / "set", options)
    document = json_of(tmp_path / "set" / "transforms.json")
    frames = {frame["file_path"]: frame for frame in document["frames"]}
    assert len(frames) == 7
    is_valid = {}
    for name, frame in frames.items():
        assert (tmp_path / "set" / name).is_file()
        is_valid[name] = cv2.imread(str(tmp_path / "set" / frame["mask_path"]), cv2.IMREAD_GRAYSCALE) > 0
        assert is_valid[name].shape == (frame["h"], frame["w"])
    assert is_valid["images/photo.jpg"].all()
    assert not is_valid["images/0_5.jpg"][FACE // 2, FACE // 2]  # straight down
    vertices = PlyData.read(tmp_path / "set" / document["ply_file_path"])["vertex"]
    points = np.column_stack([vertices[axis] for axis in "xyz"]).astype(float)
    colors = np.column_stack([vertices[name] for name in ("red", "green", "blue")])
    assert 100 < len(points) <= 300
    assert np.abs(colors - (127.0 + 60.0 * points)).max() <= 1.001
    pose = replace(POSES[1], center_world=POSES[1].center_world - ORIGIN)
    pixels, is_in = PHOTO.pixels((points - pose.center_world) @ pose.R_cam_from_world.T)
    assert is_in.sum() > 5
    found = nerfstudio_pixels(frames["images/photo.jpg"], points[is_in])
    assert np.abs(found - pixels[is_in]).max() < 1e-6


@pytest.mark.parametrize(
    "camera",
    [PHOTO, Camera("OPENCV_FISHEYE", 320, 240, (150.0, 151.0, 160.5, 118.0, 0.02, -0.01, 1e-3, 1e-4))],
)
def test_opensfm_has_the_camera_of_a_photo(tmp_path, camera):
    """Read back by our reader of OpenSfM's cameras, which has tests of its own."""
    photo = result("a.jpg", POSES[0], cameras=(Mount(camera),))
    export([photo], "opensfm", tmp_path / "r.json", Options())
    (reconstruction,) = json_of(tmp_path / "r.json")
    (tmp_path / "camera_models.json").write_text(json.dumps(reconstruction["cameras"]))
    (mount,) = read_cameras(tmp_path / "camera_models.json").mounts
    pixels = np.random.default_rng(1).uniform(0.1, 0.9, (40, 2)) * (320, 240)
    assert np.abs(mount.camera.pixels(camera.rays(pixels)[0])[0] - pixels).max() < 1e-6
    odd = Camera("FULL_OPENCV", 320, 240, (260.0, 262.0, 161.5, 119.0, *[0.0] * 4, 0.0, 0.1, 0.0, 0.0))
    refused = result("b.jpg", POSES[0], cameras=(Mount(odd),))
    assert_input_error(
        "found the model FULL_OPENCV d1", lambda: export([refused], "opensfm", tmp_path / "x.json", Options())
    )


@pytest.mark.parametrize("name", ["colmap", "opensfm", "nerfstudio"])
def test_a_part_of_a_panorama_is_left_out_of_models_that_have_no_camera_for_it(tmp_path, name):
    jpeg(tmp_path / "whole.jpg", SIZE)
    whole = result(tmp_path / "whole.jpg", POSES[0])
    cut = Camera("PARTIAL_EQUIRECTANGULAR", 400, 250, (81.5, 81.5, 200.0, 125.0))
    part = result(tmp_path / "part.jpg", POSES[1], cameras=(Mount(cut),))
    left_out = export([whole, part], name, tmp_path / "out", Options(images=tmp_path))
    (why,) = left_out
    assert why.startswith("found the model PARTIAL_EQUIRECTANGULAR, wanted")
    assert left_out[why] == [str(tmp_path / "part.jpg")]
