"""Mounts of cameras whose images and given poses are in an E57 file."""

import json

import numpy as np
import pye57
import pytest
from e57_files import ImageToWrite, ScanToWrite, write
from mounts import MOUNT, body_at
from poses import result, write_results

from piccolo.apps import e57_images
from piccolo.apps.mount import calibrate_mount
from piccolo.cloud.readers.e57 import read_image
from piccolo.geometry.pose import Pose, pose_errors, rotation_from_quaternion_wxyz
from piccolo.geometry.pose_gaussian import add

ORDER = "wxyz"
SCAN_POSE = {"rotation_wxyz": (0.5, 0.5, 0.5, 0.5), "center_world": (1.0, 2.0, 3.0)}
PINHOLE_FROM_CAM = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])  # right, up, back


def _images(bodies):
    """JPEGs in an E57 file: spheres whose centre is +x, and every third a pinhole that looks along -z."""
    images = []
    for k, body in enumerate(bodies):
        R = PINHOLE_FROM_CAM @ body.R_cam_from_world if k % 3 == 2 else body.R_cam_from_world
        kind = "pinholeRepresentation" if k % 3 == 2 else "sphericalRepresentation"
        words = {"rotation_wxyz": Pose(R.T, np.zeros(3)).quaternion_wxyz, "center_world": body.center_world}
        size = {"imageWidth": 4, "imageHeight": 2}
        images.append(ImageToWrite(b"\xff\xd8\xff" + bytes([k]) * 3000, kind, numbers=size, **words))
    return images


def _image_poses(path):
    """The poses of a file's images, as pye57 reads them, in the images' own axes; None of one without."""
    with pye57.E57(str(path)) as file:
        elements = [file.root["images2D"][k] for k in range(len(file.root["images2D"]))]
        poses = [element["pose"] if element.isDefined("pose") else None for element in elements]
        return [
            pose
            and Pose(
                rotation_from_quaternion_wxyz([pose["rotation"][name].value() for name in ORDER]).T,
                np.array([pose["translation"][name].value() for name in "xyz"]),
            )
            for pose in poses
        ]


def test_images_of_an_e57_file_are_given_and_come_out_with_the_mount_applied(tmp_path, capsys):
    bodies = [body_at(time) for time in np.linspace(0.0, 20.0, 12)]
    without = ImageToWrite(b"\xff\xd8\xff", numbers={"imageWidth": 4, "imageHeight": 2})
    rng = np.random.default_rng(0)
    columns = {f"cartesian{axis}": rng.normal(size=3000) for axis in "XYZ"}
    path = write(tmp_path / "a scan.e57", [ScanToWrite(columns, **SCAN_POSE)], [without, *_images(bodies)])
    assert e57_images.main([str(path), "--extract", str(tmp_path / "photos")]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    files = [row["file"] for row in rows[1:]]
    photos = [result(name, MOUNT @ body) for name, body in zip(files, bodies, strict=True)][:9]
    photos[4] = result(files[4], add(MOUNT @ bodies[4], np.array([0.0, 0.0, 1.0, 2.0, -3.0, 0.0])))
    results = write_results(tmp_path / "r.jsonl", photos)
    out = tmp_path / "out.e57"
    words = ["--results", str(results), "--given", str(path)]
    assert calibrate_mount.main([*words, "--out", str(out)]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["contradicting"] == [files[4]]
    assert report["rotation_deg"] == pytest.approx([1.2, -1.2, 1.1], abs=1e-4)
    none, *found = _image_poses(out)
    assert none is None
    for k, (pose, body) in enumerate(zip(found, bodies, strict=True)):
        wanted = MOUNT @ body
        R = PINHOLE_FROM_CAM @ wanted.R_cam_from_world if k % 3 == 2 else wanted.R_cam_from_world
        assert pose_errors(pose, Pose(R, wanted.center_world)) == pytest.approx((0.0, 0.0), abs=1e-6)
    before, after = ([read_image(file, k) for k in range(13)] for file in (path, out))
    assert before == after
    with pye57.E57(str(path)) as old, pye57.E57(str(out)) as new:
        old_points, new_points = (file.read_scan_raw(0) for file in (old, new))
        assert new.get_header(0).translation.tolist() == [1.0, 2.0, 3.0]
        assert new.root["images2D"][1]["name"].value() == "an image"
    for axis in "XYZ":
        np.testing.assert_array_equal(old_points[f"cartesian{axis}"], new_points[f"cartesian{axis}"])
    out.rename(tmp_path / "photos" / path.name)  # photos are found by its name
    assert calibrate_mount.main([*words[:3], str(tmp_path / "photos" / path.name)]) == 0
    assert json.loads(capsys.readouterr().out)["rotation_deg"] == pytest.approx([0.0] * 3, abs=1e-6)
    assert calibrate_mount.main([*words, "--out", str(tmp_path / "out.txt")]) == 2
    assert "--out out.txt: wanted a name that ends with .e57" in capsys.readouterr().err
