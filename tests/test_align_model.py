"""Models of structure from motion, moved onto the scan with scale."""

import json
import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pycolmap
import pytest
from poses import result, write_results
from refusals import small_files

from piccolo.apps.models import align_model
from piccolo.geometry.pose import OPENGL_FROM_CAM, OPTICAL_FROM_CAM, Pose, exp_so3, log_so3
from piccolo.geometry.pose_gaussian import add
from piccolo.judge.pose_covariance import PoseCovariance
from piccolo.poses.relative_poses import read_relative_poses

ORIGIN = np.array([500_000.0, 5_400_000.0, 300.0])
SCALE = 0.37  # model from scan
R_MODEL_FROM_SCAN = exp_so3(np.array([0.4, -1.1, 2.0]))
SHIFT = np.array([3.0, -1.0, 0.5])
PHOTO = np.repeat([np.radians(0.05), 0.004], 3)
MODEL = np.repeat([np.radians(0.02), 0.002], 3)  # errors of the model, in the scan's unit


def to_model(points):
    return SCALE * (points - ORIGIN) @ R_MODEL_FROM_SCAN.T + SHIFT


@pytest.fixture
def scene():
    """True poses of 20 photos on a walk through 8 m, one result wrong, and points."""
    rng = np.random.default_rng(4)
    places = ORIGIN + np.column_stack([np.linspace(0.0, 8.0, 20), rng.normal(size=(20, 2))])
    poses = [Pose(exp_so3(2.0 * rng.normal(size=3)), place) for place in places]
    covariance = PoseCovariance(np.diag(PHOTO**2), "")
    found = [add(pose, PHOTO * rng.normal(size=6)) for pose in poses]
    found[5] = add(found[5], np.array([0.0, 0.0, 2.0, 1.0, 3.0, 0.0]))
    results = [result(f"photos/{k:02d}.jpg", pose, covariance=covariance) for k, pose in enumerate(found)]
    noisy = [add(pose, MODEL * rng.normal(size=6)) for pose in poses]
    in_model = [Pose(p.R_cam_from_world @ R_MODEL_FROM_SCAN.T, to_model(p.center_world)) for p in noisy]
    points = ORIGIN + np.array([4.0, 0.0, 0.0]) + rng.uniform(-4.0, 4.0, (300, 3))
    return results, in_model, points


def _write_colmap(folder, in_model, points):
    """A model with a point in 33 at a wrong place, which the poses don't depend on."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(
            model="SIMPLE_RADIAL", width=640, height=480, params=[500, 320, 240, 0.1], camera_id=1
        )
    )
    for k, pose in enumerate(in_model):
        R = OPTICAL_FROM_CAM @ pose.R_cam_from_world
        rigid = pycolmap.Rigid3d(pycolmap.Rotation3d(R), -R @ pose.center_world)
        model.add_image_with_trivial_frame(
            pycolmap.Image(f"{k:02d}.jpg", keypoints=np.empty((0, 2)), camera_id=1, image_id=k + 1), rigid
        )
    for k, point in enumerate(to_model(points)):
        model.add_point3D(point + (5.0 if k % 33 == 0 else 0.0), pycolmap.Track(), np.uint8([k % 256, 1, 2]))
    folder.mkdir()
    model.write(folder)


def _run(tmp_path, scene, model, out, capsys, is_written=False):
    results = tmp_path / "r.jsonl" if is_written else write_results(tmp_path / "r.jsonl", scene[0])
    words = ["--model", str(model), "--results", str(results), "--out", str(out)]
    code = align_model.main(words)
    printed = capsys.readouterr()
    return code, json.loads(printed.out) if code == 0 else printed.err


def _check(report):
    assert report["scale"] == pytest.approx(1.0 / SCALE, rel=1e-3)
    assert abs(report["scale"] * SCALE - 1.0) < 4.0 * report["std_scale"] * SCALE
    assert report["contradicting"] == ["photos/05.jpg"]
    assert report["photos"] == 20
    assert report["off_m"][0] < 0.02
    assert report["off_deg"][0] < 0.2


def test_a_model_of_colmap_moves_with_its_points_and_photos(tmp_path, scene, capsys):
    _, in_model, points = scene
    _write_colmap(tmp_path / "model", in_model, points)
    code, report = _run(tmp_path, scene, tmp_path / "model", tmp_path / "aligned", capsys)
    assert code == 0
    _check(report)
    with small_files(1000):
        code, err = _run(tmp_path, scene, tmp_path / "model", tmp_path / "full", capsys, is_written=True)
    assert (code, err) == (3, f"align_model.py: {tmp_path / 'full'}: cannot be used (File too large)\n")
    assert not (tmp_path / "full").exists()
    model = pycolmap.Reconstruction(tmp_path / "aligned")
    before = pycolmap.Reconstruction(tmp_path / "model")
    assert model.cameras[1].params.tolist() == [500, 320, 240, 0.1]
    for k, point in enumerate(points):
        if k % 33:
            assert np.linalg.norm(model.points3D[k + 1].xyz - point) < 0.01
        assert model.points3D[k + 1].color.tolist() == [k % 256, 1, 2]
    R = np.array(report["quaternion_wxyz_scan_from_model"])
    turn = pycolmap.Rotation3d(np.roll(R, -1)).matrix() @ R_MODEL_FROM_SCAN
    assert np.degrees(np.linalg.norm(log_so3(turn))) < 0.05
    for number, image in model.images.items():
        seen = before.images[number].project_point(before.points3D[2].xyz)
        if seen is not None:
            assert np.abs(image.project_point(model.points3D[2].xyz) - seen).max() < 0.5


XML = """<?xml version="1.0" encoding="UTF-8"?>
<document version="2.0.0"><chunk label="Chunk 1" enabled="true">
<cameras next_id="20">{}<camera id="99" sensor_id="0" label="lost"/></cameras>
<reference>GEOGCS["WGS 84"]</reference>
<transform><rotation>1 0 0 0 1 0 0 0 1</rotation><translation>0 0 0</translation><scale>2</scale></transform>
</chunk></document>
"""


def test_a_chunk_of_metashape_gets_the_transform(tmp_path, scene, capsys):
    _, in_model, points = scene
    cameras = []
    for k, pose in enumerate(in_model):
        T = np.eye(4)
        T[:3, :3] = (OPTICAL_FROM_CAM @ pose.R_cam_from_world).T
        T[:3, 3] = pose.center_world
        words = " ".join(map(str, T.ravel()))
        cameras.append(
            f'<camera id="{k}" sensor_id="0" label="{k:02d}"><transform>{words}</transform></camera>'
        )
    (tmp_path / "cameras.xml").write_text(XML.format("".join(cameras)))
    code, report = _run(tmp_path, scene, tmp_path / "cameras.xml", tmp_path / "out.xml", capsys)
    assert code == 0
    _check(report)
    chunk = ElementTree.parse(tmp_path / "out.xml").getroot().find("chunk")
    (transform,) = chunk.findall("transform")
    R, t, scale = (
        np.array(transform.findtext(n).split(), float) for n in ("rotation", "translation", "scale")
    )
    moved = scale * to_model(points) @ R.reshape(3, 3).T + t
    assert np.linalg.norm(moved - points, axis=1).max() < 0.01
    assert chunk.findtext("reference").startswith("LOCAL_CS")


def test_a_reconstruction_of_opensfm_moves_with_its_points_and_rigs(tmp_path, scene, capsys):
    results, in_model, points = scene
    shots = {}
    for k, pose in enumerate(in_model):
        R = OPTICAL_FROM_CAM @ pose.R_cam_from_world
        shot = {"rotation": log_so3(R).tolist(), "translation": (-R @ pose.center_world).tolist()}
        shots[f"{k:02d}.jpg"] = {**shot, "camera": "c"}
    rigs = {
        "rig_instances": {"3": {**shots["03.jpg"]}},
        "rig_cameras": {"c": {"translation": [1.0, 0.0, 0.0]}},
    }
    placed = {str(k): {"coordinates": point.tolist()} for k, point in enumerate(to_model(points))}
    part = {"cameras": {}, "shots": shots, **rigs, "points": placed, "reference_lla": {"latitude": 1.0}}
    model = tmp_path / "reconstruction.json"
    model.write_text(json.dumps([part]))
    out = tmp_path / "aligned.json"
    code, report = _run(tmp_path, scene, model, out, capsys)
    assert code == 0
    _check(report)
    (moved,) = json.loads(out.read_text())
    found = np.array([moved["points"][str(k)]["coordinates"] for k in range(len(points))])
    assert np.linalg.norm(found - points, axis=1).max() < 0.01
    photos = [Path(f"photos/{k:02d}.jpg") for k in range(20)]
    for pose, one in zip(read_relative_poses(out, photos), results, strict=True):
        if one.pano != "photos/05.jpg":
            assert np.linalg.norm(pose.center_world - one.pose.center_world) < 0.03
    assert moved["rig_instances"]["3"]["translation"] == moved["shots"]["03.jpg"]["translation"]
    assert moved["rig_cameras"]["c"]["translation"][0] == report["scale"]
    assert "reference_lla" not in moved


def test_the_matrix_moves_what_else_belongs_to_a_model(tmp_path, scene, capsys):
    """Such as a dense cloud; here the model stays as it is."""
    results, in_model, points = scene
    _write_colmap(tmp_path / "model", in_model, points)
    write_results(tmp_path / "r.jsonl", results)
    words = ["--model", tmp_path / "model", "--results", tmp_path / "r.jsonl", "--matrix", tmp_path / "T.txt"]
    assert align_model.main([*map(str, words)]) == 0
    report = json.loads(capsys.readouterr().out)
    T = np.loadtxt(tmp_path / "T.txt")
    assert (report["out"], report["T_scan_from_model"]) == (None, T.tolist())
    moved = to_model(points) @ T[:3, :3].T + T[:3, 3]
    assert np.linalg.norm(moved - points, axis=1).max() < 0.01
    assert np.cbrt(np.linalg.det(T)) == pytest.approx(report["scale"], rel=1e-9)
    assert T[3].tolist() == [0.0, 0.0, 0.0, 1.0]


@pytest.mark.parametrize("noise", [0.0, 1e-4])  # of the model at one place, in its unit
def test_a_model_of_one_place_has_no_scale(tmp_path, scene, capsys, noise):
    results, in_model, points = scene
    rng = np.random.default_rng(5)
    turned = [Pose(pose.R_cam_from_world, in_model[0].center_world) for pose in in_model]
    at_one = [Pose(p.R_cam_from_world, p.center_world + noise * rng.normal(size=3)) for p in turned]
    _write_colmap(tmp_path / "model", at_one, points)
    place = results[0].pose.center_world
    found = [
        replace(r, best_pose=add(Pose(r.pose.R_cam_from_world, place), PHOTO * rng.normal(size=6)))
        for r in results
    ]
    code, err = _run(tmp_path, (found,), tmp_path / "model", tmp_path / "out", capsys)
    assert code == 3
    assert re.search(
        r"model: found 20 localized photos within 0\.0\d+ m, which tell no scale \(.*\), wanted", err
    )
    assert err.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_photos_that_were_localized_by_the_model_say_nothing_of_how_far_it_is_off(tmp_path, scene, capsys):
    """As by --relative: each pose is where the model puts it, with the errors of the whole."""
    results, in_model, points = scene
    _write_colmap(tmp_path / "model", in_model, points)
    apart = _run(tmp_path, scene, tmp_path / "model", tmp_path / "a", capsys)[1]
    R = exp_so3(np.array([0.001, 0.0, 0.002])) @ R_MODEL_FROM_SCAN.T
    placed = [
        Pose(pose.R_cam_from_world @ R.T, R @ (pose.center_world - SHIFT) / SCALE + ORIGIN)
        for pose in in_model
    ]
    made = [replace(r, best_pose=pose) for r, pose in zip(results, placed, strict=True)]
    write_results(tmp_path / "r.jsonl", made)
    words = ["--model", str(tmp_path / "model"), "--results", str(tmp_path / "r.jsonl")]
    assert align_model.main([*words, "--out", str(tmp_path / "b")]) == 0
    out, err = capsys.readouterr()
    report = json.loads(out)
    assert (report["off_m"], report["off_deg"], report["contradicting"]) == (None, None, [])
    assert "the photos' poses are its own, as by --relative" in err
    assert report["scale"] == pytest.approx(1.0 / SCALE, rel=1e-6)
    assert report["std_scale"] > 2.0 * apart["std_scale"]  # 20 of them tell as much as one


def test_what_can_not_be_aligned_is_refused(tmp_path, scene, capsys):
    results, in_model, points = scene
    _write_colmap(tmp_path / "model", in_model, points)
    code, text = _run(tmp_path, (results[:2],), tmp_path / "model", tmp_path / "x", capsys)
    assert (code, "found 2 localized photos of it in the results, wanted 3 or more" in text) == (3, True)
    frames = [{"file_path": f"{k:02d}.jpg", "transform_matrix": np.eye(4).tolist()} for k in range(20)]
    for frame, pose in zip(frames, in_model, strict=True):
        R = OPENGL_FROM_CAM @ pose.R_cam_from_world
        frame["transform_matrix"] = [
            [*row, x] for row, x in zip(R.T.tolist(), pose.center_world, strict=True)
        ]
        frame["transform_matrix"].append([0, 0, 0, 1])
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    code, text = _run(tmp_path, scene, tmp_path / "transforms.json", tmp_path / "x.json", capsys)
    assert (code, "wanted OpenSfM's reconstruction.json; of another model take the matrix" in text) == (
        3,
        True,
    )
    (tmp_path / "a.xml").write_text("<chunk><camera label='00'><transform>1 2</transform></camera></chunk>")
    code, text = _run(tmp_path, scene, tmp_path / "a.xml", tmp_path / "x.xml", capsys)
    assert (code, "a.xml: found" in text) == (3, True)
    code, text = _run(tmp_path, scene, tmp_path / "none", tmp_path / "x", capsys)
    assert code == 3
    assert text.count(str(tmp_path / "none")) == 1
