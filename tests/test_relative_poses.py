"""Files of relative poses: the poses that were exported, by photo, and what is refused."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest
from poses import SIZE, assert_same_poses, result, tilted_poses
from refusals import assert_refused

from piccolo.apps.export.formats import export
from piccolo.apps.export.posed_images import Options
from piccolo.geometry.pose import (
    OPTICAL_FROM_CAM,
    rotation_from_quaternion_wxyz,
)
from piccolo.poses.relative_poses import find_file_scale, read_odometry, read_relative_poses, read_tum_row

POSES = tilted_poses(4, np.array([20.0, -30.0, 2.0]))
PHOTOS = [Path(f"photos/{k}.jpg") for k in (7, 8, 12, 100)]
IDENTITY = np.eye(4).tolist()
EXPORTED = [
    ("colmap", "model", "model/images.txt", Options(size=SIZE)),
    ("nerfstudio", "transforms.json", "transforms.json", Options(size=SIZE)),
    ("opensfm", "reconstruction.json", "reconstruction.json", Options(size=SIZE)),
    ("tum", "poses.txt", "poses.txt", Options(timestamps="name")),
]


def _write(path, text):
    path.write_text(text)
    return path


def _transforms(path, *frames):
    return _write(path, json.dumps({"frames": [{"file_path": n, "transform_matrix": T} for n, T in frames]}))


def _colmap_row(name, values="1 0 0 0 1 2 3"):
    return f"1 {values} 1 {name}\n\n"


@pytest.mark.parametrize(("name", "out", "file", "options"), EXPORTED)
def test_exported_poses_are_read_again(tmp_path, name, out, file, options):
    """In the order of the photos, and of some of them."""
    results = [result(photo, pose) for photo, pose in zip(PHOTOS, POSES, strict=True)]
    export(results, name, tmp_path / out, options)
    assert_same_poses(read_relative_poses(tmp_path / file, PHOTOS), POSES)
    assert_same_poses(read_relative_poses(tmp_path / file, [PHOTOS[2], PHOTOS[0]]), [POSES[2], POSES[0]])
    elsewhere = [Path("/elsewhere") / photo.name for photo in PHOTOS]
    assert_same_poses(read_relative_poses(tmp_path / file, elsewhere), POSES)


def _in_model(pose):
    """The rotation and the centre of an optical camera."""
    return OPTICAL_FROM_CAM @ pose.R_cam_from_world, pose.center_world.tolist()


def _openmvg():
    views = []
    extrinsics = []
    for k, (photo, pose) in enumerate(zip(PHOTOS, POSES, strict=True)):
        data = {"filename": photo.name, "id_view": k, "id_intrinsic": 0, "id_pose": 10 + k}
        views.append({"key": k, "value": {"ptr_wrapper": {"id": 1, "data": data}}})
        R, center = _in_model(pose)
        extrinsics.append({"key": 10 + k, "value": {"rotation": R.tolist(), "center": center}})
    views.append({"key": 9, "value": {"ptr_wrapper": {"data": {"filename": "lost.jpg", "id_pose": 99}}}})
    return {"sfm_data_version": "0.3", "views": views, "extrinsics": extrinsics}


def _meshroom(**more):
    """Numbers are text, and matrices go column after column."""
    views = [
        {"viewId": f"{k}", "poseId": f"{k}", "path": f"/x/{photo}", **more} for k, photo in enumerate(PHOTOS)
    ]
    poses = []
    for k, pose in enumerate(POSES):
        R, center = _in_model(pose)
        transform = {"rotation": [str(x) for x in R.T.ravel()], "center": [str(x) for x in center]}
        poses.append({"poseId": f"{k}", "pose": {"transform": transform, "locked": "0"}})
    return {"version": ["1", "2", "6"], "views": views, "poses": poses}


@pytest.mark.parametrize(("name", "document"), [("sfm_data.json", _openmvg()), ("cameras.sfm", _meshroom())])
def test_models_of_other_programs(tmp_path, name, document):
    path = _write(tmp_path / name, json.dumps(document))
    assert_same_poses(read_relative_poses(path, PHOTOS), POSES)
    assert find_file_scale(path) == "unknown"


def test_models_that_are_not_read_are_named(tmp_path):
    texts = {
        "is Bundler's file, which is not read: export COLMAP's": "# Bundle file v0.3\n4 10\n500 0 0\n",
        "is RealityCapture's file, which is not read": "#name,x,y,alt,heading\n1.jpg,1,2,3,4\n",
    }
    for message, text in texts.items():
        path = _write(tmp_path / "model.out", text)
        assert_refused(message, read_relative_poses, path, PHOTOS)
    path = _write(tmp_path / "cameras.sfm", json.dumps(_meshroom(rigId="7")))
    assert_refused(
        "found a rig of Meshroom, which is not read: export COLMAP's", read_relative_poses, path, PHOTOS
    )
    part = {"cameras": {}, "shots": {}}
    path = _write(tmp_path / "reconstruction.json", json.dumps([part, part]))
    assert_refused(
        "found 2 reconstructions of OpenSfM, which have nothing in common", read_relative_poses, path, PHOTOS
    )
    path = _write(tmp_path / "reconstruction.json", json.dumps([part]))
    assert_refused("found a model without a scale", read_odometry, path, PHOTOS, [0.0, 1.0, 2.0, 3.0])


def test_points_of_photos_are_skipped(tmp_path):
    """As COLMAP writes them below each photo, here ten numbers too."""
    points = "1 2 3 4 5 6 7 8 9 10\n"
    rows = [_colmap_row(f"{k}.jpg", f"1 0 0 0 {k} 0 0").strip() + "\n" + points for k in range(3)]
    path = _write(tmp_path / "images.txt", "# comment\n" + "".join(rows))
    found = read_relative_poses(path, [Path("2.jpg"), Path("1.jpg")])
    assert [pose.center_world.tolist() for pose in found] == [[-2.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]


def test_a_path_goes_before_a_name(tmp_path):
    """Photos of two cameras have the same names."""
    moved = np.eye(4)
    moved[0, 3] = 5.0
    path = _transforms(tmp_path / "a.json", ("left/1.jpg", IDENTITY), ("right/1.jpg", moved.tolist()))
    left, right = read_relative_poses(path, [Path("left/1.jpg"), Path("right/1.jpg")])
    assert (left.center_world[0], right.center_world[0]) == (0.0, 5.0)
    for read in (read_relative_poses, lambda path, photos: read_odometry(path, photos, [0.0])):
        assert_refused("found 2 poses of x/1.jpg, wanted one of each photo", read, path, [Path("x/1.jpg")])


def test_rounded_rotations_become_rotations(tmp_path):
    T = np.round(POSES[0].T_world_from_cam, 4)
    path = _transforms(tmp_path / "a.json", ("1.jpg", T.tolist()))
    (pose,) = read_relative_poses(path, [Path("1.jpg")])
    R = pose.R_cam_from_world
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)


@pytest.mark.parametrize("name", ["a.jpg", "2.jpg", "11.jpg"])
@pytest.mark.parametrize(("form", "out", "file", "options"), EXPORTED)
def test_a_photo_without_a_pose_is_refused(tmp_path, form, out, file, options, name):
    export([result(PHOTOS[2], POSES[2]), result(PHOTOS[0], POSES[0])], form, tmp_path / out, options)
    message = f"found 0 poses of {name}, wanted one of each photo"
    assert_refused(message, read_relative_poses, tmp_path / file, [PHOTOS[0], Path(name)])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "found 0 poses of 1.jpg"),
        ("# only a comment\n", "found 0 poses of 1.jpg"),
        ("hello\n", "found 1 columns, wanted COLMAP's images.txt or .bin"),
        ("1 0 0 0 0 0 0\n", "found 7 columns, wanted"),
        ("1 0 0 0 0 0 0 one\n", "found 'one', which is no number, wanted"),
        ("1 0 0 0 0 0 0 0\n", "found a quaternion whose length is not 1, wanted"),
        ("1 0 0 0 0 0 0 1e200\n", "found a quaternion whose length is not 1, wanted"),
        ("1 0 0 0 0 0 0 nan\n", "found a quaternion whose length is not 1, wanted"),
        ("1 inf 0 0 0 0 0 1\n", r"poses.txt, 1: found a position \[inf, 0.0, 0.0\], wanted finite numbers"),
        ("1 1e30 0 0 0 0 0 1\n", r"1: found a position \[1e\+30, 0.0, 0.0\], wanted"),
        ("1 0 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n", "found 2 poses of 1.jpg, wanted one of each photo"),
        (_colmap_row("1.jpg", "0 0 0 0 1 2 3"), "found a quaternion whose length is not 1, wanted"),
        (_colmap_row("1.jpg", "1 0 0 0 1 inf 3"), "1.jpg: found a position .*inf.*, wanted finite numbers"),
        (_colmap_row("1.jpg", "1 0 nan 0 1 2 3"), "found a quaternion whose length is not 1, wanted"),
        (_colmap_row("1.jpg") + "2 1 0 0 x\n", "found 5 columns of a photo, wanted"),
        ("\0\1\2", "found 1 columns, wanted"),
    ],
)
def test_damaged_rows_are_refused_in_one_line(tmp_path, text, message):
    path = _write(tmp_path / "poses.txt", text)
    assert_refused(message, read_relative_poses, path, [Path("1.jpg")])


def _changed(place, value):
    """A transforms.json with a number of the identity changed."""
    T = np.eye(4)
    T[place] = value
    return json.dumps({"frames": [{"file_path": "1.jpg", "transform_matrix": T.tolist()}]})


NO_ROTATION = "transforms.json, 1.jpg: found a matrix that is no rotation"


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ("{", "found damaged JSON"),
        ("[]", "found fields of another kind"),
        ("{}", "found no field 'frames', wanted"),
        ('{"frames": [{"file_path": "1.jpg"}]}', "found no field 'transform_matrix', wanted"),
        ('{"frames": [{"transform_matrix": [[1]]}]}', r"found a transform_matrix of shape \(1, 1\), wanted"),
        ('{"frames": 3}', "found fields of another kind"),
        ('{"frames": []}', "found 0 poses of 1.jpg"),
        (_changed((0, 0), 2.0), NO_ROTATION),
        (_changed((0, 0), -1.0), NO_ROTATION),  # it mirrors
        (_changed((0, 1), 0.01), NO_ROTATION),
        (_changed((0, 0), 1e300), NO_ROTATION),
        (_changed((2, 2), np.nan), NO_ROTATION),
        (_changed((1, 3), np.inf), "1.jpg: found a position .*inf.*, wanted finite numbers"),
        (_changed((1, 3), 1e30), "1.jpg: found a position .*1e.30.*, wanted finite numbers"),
    ],
)
def test_another_json_is_refused_in_one_line(tmp_path, document, message):
    path = _write(tmp_path / "transforms.json", document)
    assert_refused(message, read_relative_poses, path, [Path("1.jpg")])


def test_a_file_that_is_none_is_refused(tmp_path):
    (tmp_path / "a.txt").write_bytes(b"\xff\xfa\x00\x80")
    assert_refused("found bytes that are no text", read_relative_poses, tmp_path / "a.txt", [Path("1.jpg")])
    assert_refused("not a file but a folder", read_relative_poses, tmp_path, [Path("1.jpg")])
    assert_refused("cannot be|No such file", read_relative_poses, tmp_path / "none.txt", [Path("1.jpg")])


def _rotated(k):
    """Return a rotation that is not the identity, as a quaternion w x y z, and a position."""
    q = np.array([0.8, 0.1 * k, -0.3, 0.4])
    return q / np.linalg.norm(q), np.array([1.0 + k, 2.0, -k])


PHOTO_NAMES = [Path("1.jpg"), Path("2.jpg")]


def _expected():
    """Poses of PHOTO_NAMES whose T_world_from_cam (right, down, forward) are `_rotated`."""
    rows = [["", *t, *np.roll(q, -1)] for q, t in map(_rotated, (1, 2))]
    return [read_tum_row([str(word) for word in row])[1] for row in rows]


def _assert_expected(found):
    for pose, expected in zip(found, _expected(), strict=True):
        np.testing.assert_allclose(pose.R_cam_from_world, expected.R_cam_from_world, atol=1e-9)
        np.testing.assert_allclose(pose.center_world, expected.center_world, atol=1e-9)


HEADERS = {
    "#timestamp x y z qx qy qz qw id": "{n} {x} {y} {z} {qx} {qy} {qz} {qw} 7",  # RTAB-Map, format 11
    "": "{n} {x} {y} {z} {qx} {qy} {qz} {qw} 7",
    "name,tx,ty,tz,qw,qx,qy,qz": "{n},{x},{y},{z},{qw},{qx},{qy},{qz}",
    "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []": (
        "{n},{x},{y},{z},{qw},{qx},{qy},{qz}"  # EuRoC
    ),
    "Frame, File, qx, qy, qz, qw, pos_x, pos_y, pos_z": "9, {n}.jpg,{qx},{qy},{qz},{qw},{x},{y},{z}",
}


@pytest.mark.parametrize("header", HEADERS)
def test_tables_of_trackers(tmp_path, header):
    rows = [header] * bool(header)
    for name, (q, t) in zip(PHOTO_NAMES, map(_rotated, (1, 2)), strict=True):
        values = dict(zip(("qw", "qx", "qy", "qz", "x", "y", "z"), (*q, *t), strict=True))
        rows.append(HEADERS[header].format(n=name.stem, **values))
    path = _write(tmp_path / "a.txt", "\n".join(rows) + "\n")
    _assert_expected(read_relative_poses(path, PHOTO_NAMES))
    assert find_file_scale(path) == "metres"


def _colmap_values(k):
    """Return quaternion w x y z and translation of T_cam_from_world."""
    q, center = _rotated(k)
    R = rotation_from_quaternion_wxyz(q)
    return q * [1.0, -1.0, -1.0, -1.0], -R.T @ center


def test_poses_of_hloc_are_no_trajectory(tmp_path):
    rows = [[name, *q, *t] for name, (q, t) in zip(PHOTO_NAMES, map(_colmap_values, (1, 2)), strict=True)]
    path = _write(tmp_path / "a.txt", "\n".join(" ".join(map(str, row)) for row in rows))
    _assert_expected(read_relative_poses(path, PHOTO_NAMES))
    assert find_file_scale(path) == "unknown"


@pytest.mark.parametrize("between", ["\n", "\n\n", "\n10.5 20.5 -1 30 40 7\n"])
@pytest.mark.parametrize("before", ["", "\n", "# a comment\n\n"])
def test_lines_of_points_in_colmaps_text_may_be_missing(tmp_path, between, before):
    pairs = zip(PHOTO_NAMES, map(_colmap_values, (1, 2)), strict=True)
    rows = [[7, *q, *t, 1, f"rig/{name}"] for name, (q, t) in pairs]
    path = _write(tmp_path / "images.txt", before + between.join(" ".join(map(str, row)) for row in rows))
    _assert_expected(read_relative_poses(path, PHOTO_NAMES))


def test_colmaps_binary_images(tmp_path):
    content = struct.pack("<Q", 2)
    for k, (name, (q, t)) in enumerate(zip(PHOTO_NAMES, map(_colmap_values, (1, 2)), strict=True)):
        content += struct.pack("<I7dI", k, *q, *t, 1) + str(name).encode() + b"\0"
        content += struct.pack("<Q", k) + bytes(24 * k)
    path = tmp_path / "images.bin"
    path.write_bytes(content)
    _assert_expected(read_relative_poses(path, PHOTO_NAMES))
    assert find_file_scale(path) == "unknown"
    path.write_bytes(content[:-30])
    assert_refused("found a file that is cut off, wanted COLMAP's", read_relative_poses, path, PHOTO_NAMES)


def test_names_match_by_the_end_of_their_paths(tmp_path):
    moved = np.eye(4)
    moved[0, 3] = 5.0
    frames = ("rig1\\\\cam1\\\\1.jpg", IDENTITY), ("rig1\\\\cam2\\\\1.jpg", moved.tolist())
    path = _transforms(tmp_path / "a.json", *frames)
    photos = [Path("/x/images/rig1/cam2/1.jpg"), Path("/x/images/rig1/cam1/1.jpg")]
    found = read_relative_poses(path, photos)
    assert [pose.center_world[0] for pose in found] == [5.0, 0.0]


def test_a_photo_that_was_not_registered_has_no_pose(tmp_path):
    path = _transforms(tmp_path / "a.json", ("1.jpg", IDENTITY), ("2.jpg", IDENTITY))
    found = read_relative_poses(path, [Path("1.jpg"), Path("3.jpg"), Path("2.jpg")])
    assert [pose is None for pose in found] == [False, True, False]
