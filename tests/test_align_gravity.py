"""The command line of tools/align_gravity.py, and the files it writes."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData, PlyElement
from poses import tilted_poses
from scans import bare_room, points_of, scan, write_scan

from piccolo.cli import align_gravity
from piccolo.geometry.pose import exp_so3
from piccolo.gravity import MIN_CONFIDENCE
from piccolo.gravity.alignment import FORMAT, read_alignment
from piccolo.scenes.scene import Query, read_scene, write_queries

ROOT = Path(__file__).resolve().parents[1]
TURN = np.array([1.4, 0.6, -0.3])
UTM = np.array([691_234.0, 5_335_678.0, 512.0])
ANGLE = 0.01


@pytest.fixture
def run(capsys):
    """Run the tool; returns exit code, stdout as JSON and stderr."""

    def call(*arguments):
        code = align_gravity.main([*map(str, arguments), "--quiet"])
        out, err = capsys.readouterr()
        return code, json.loads(out) if out else None, err

    return call


@pytest.fixture
def tilted(tmp_path):
    """A scan whose z is not up, in a folder with a space in its name."""
    folder = tmp_path / "my scans"
    folder.mkdir()
    write_scan(folder / "scan 1.ply", scan()[0] @ exp_so3(TURN).T)
    return folder / "scan 1.ply"


def test_the_cloud_and_the_transform_are_written(run, tilted):
    out = tilted.with_name("aligned.ply")
    code, report, err = run("--cloud", tilted, "--out", out)
    assert (code, err, report["status"]) == (0, "", "aligned")
    T = np.array(report["T_aligned_from_scan"])
    up = np.array(report["up_scan"])
    np.testing.assert_allclose(up, exp_so3(TURN)[:, 2], atol=np.radians(0.2))
    np.testing.assert_allclose(T[:3, :3] @ up, [0.0, 0.0, 1.0], atol=1e-12)
    assert report["tilt_deg"] == pytest.approx(np.degrees(np.arccos(up[2])))
    np.testing.assert_allclose(points_of(out), points_of(tilted) @ T[:3, :3].T + T[:3, 3], atol=1e-6)
    assert {path.name for path in tilted.parent.iterdir()} == {
        "scan 1.ply", "aligned.ply", "aligned.json", "aligned.txt"
    }  # fmt: skip
    np.testing.assert_array_equal(np.loadtxt(out.with_suffix(".txt")), T)
    document = json.loads(out.with_suffix(".json").read_text())
    np.testing.assert_array_equal(document["T_aligned_from_scan"], T)
    assert (document["format"], document["metres_per_unit"]) == (FORMAT, 1.0)
    assert document["confidence"] == report["confidence"] >= MIN_CONFIDENCE
    assert "\n" not in document["explanation"]


def test_planes_are_reported_with_their_kinds(run, tilted):
    _, report, _ = run("--cloud", tilted)
    assert report["out"] is None
    kinds = [plane["kind"] for plane in report["planes"]]
    assert (kinds.count("floor"), kinds.count("ceiling")) == (1, 1)
    assert kinds.count("wall") >= 4
    points, up = points_of(tilted), exp_so3(TURN)[:, 2]
    low, high = np.quantile(points @ up, [0.01, 0.99])
    for plane, height in (("floor", low), ("ceiling", high)):
        found = report["planes"][kinds.index(plane)]
        assert np.dot(found["normal_scan"], up) > np.cos(np.radians(0.5))
        assert found["offset"] == pytest.approx(height, abs=0.05)
        assert found["rms"] < 0.02
        assert 0.05 < found["fraction"] < 0.5
        assert found["num_inliers"] > 100
    assert sorted(report["planes"], key=lambda plane: -plane["num_inliers"]) == report["planes"]


def test_other_properties_survive_and_normals_turn(run, tilted):
    out = tilted.with_name("aligned.ply")
    _, report, _ = run("--cloud", tilted, "--out", out)
    before, after = PlyData.read(tilted), PlyData.read(out)
    assert after["vertex"].data.dtype == before["vertex"].data.dtype
    for name in ("red", "green", "blue", "scalar_intensity", "label"):
        assert np.array_equal(before["vertex"][name], after["vertex"][name])
    z = np.array(report["T_aligned_from_scan"])[:3, 2]
    for k, name in enumerate(("nx", "ny", "nz")):
        np.testing.assert_allclose(after["vertex"][name], z[k], atol=1e-7)
    assert "made by hand" in after.comments


@pytest.mark.parametrize(("text", "byte_order"), [(True, "="), (False, ">")])
def test_ascii_and_big_endian_are_read_too(run, tmp_path, text, byte_order):
    points = scan()[0] @ exp_so3(TURN).T
    write_scan(tmp_path / "scan.ply", points, text=text, byte_order=byte_order)
    write_scan(tmp_path / "same.ply", points)
    for name in ("scan", "same"):
        assert run("--cloud", tmp_path / f"{name}.ply", "--out", tmp_path / f"{name}_out.ply")[0] == 0
    a, b = (PlyData.read(tmp_path / name)["vertex"].data for name in ("scan_out.ply", "same_out.ply"))
    assert a.dtype == b.dtype
    for name in a.dtype.names:
        np.testing.assert_allclose(a[name], b[name], atol=1e-4)


def test_faces_stay(run, tmp_path):
    size = np.array([5.0, 4.0, 2.6])
    corners = np.array(list(np.ndindex(2, 2, 2))) * size @ exp_so3(TURN).T
    vertex = np.zeros(8, [(n, "<f4") for n in "xyz"] + [(n, "u1") for n in ("red", "green", "blue")])
    for k, name in enumerate("xyz"):
        vertex[name] = corners[:, k]
    vertex["red"] = vertex["green"] = np.arange(8) * 20 + 90
    faces = np.empty(12, [("vertex_indices", "<i4", (3,))])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces["vertex_indices"] = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    elements = [PlyElement.describe(vertex, "vertex"), PlyElement.describe(faces, "face")]
    PlyData(elements, byte_order="<").write(tmp_path / "mesh.ply")
    code, _, err = run("--cloud", tmp_path / "mesh.ply", "--up", "-y", "--out", tmp_path / "out.ply")
    assert (code, err) == (0, "")
    after = PlyData.read(tmp_path / "out.ply")
    np.testing.assert_array_equal(np.stack(after["face"]["vertex_indices"]), faces["vertex_indices"])
    assert np.ptp(after["vertex"]["z"] + corners[:, 1]) < 1e-6


@pytest.mark.parametrize("byte_order", ["<", ">"])
def test_map_coordinates_stay_near_and_come_back(run, tmp_path, byte_order):
    points = scan()[0] @ exp_so3(TURN).T + UTM
    scan_path, out, back = tmp_path / "utm.ply", tmp_path / "out.ply", tmp_path / "back.ply"
    write_scan(scan_path, points, "<f8", byte_order=byte_order)
    code, report, _ = run("--cloud", scan_path, "--out", out, "--yaw-walls")
    assert code == 0
    assert PlyData.read(out)["vertex"].data.dtype["x"] == np.float64
    assert np.abs(points_of(out) - UTM).max() < 20.0
    code, inverse, _ = run("--cloud", out, "--apply", out.with_suffix(".json"), "--inverse", "--out", back)
    assert (code, inverse["status"]) == (0, "applied")
    np.testing.assert_allclose(points_of(back), points, rtol=0.0, atol=1e-8)
    origin = np.round(0.5 * (points.min(axis=0) + points.max(axis=0)))
    T = np.array(report["T_aligned_from_scan"])
    np.testing.assert_allclose(T[:3, :3] @ origin + T[:3, 3], origin, atol=1e-8)


def test_a_transform_applies_to_another_cloud_in_its_unit(run, tmp_path, tilted):
    out, mm, mm_out = tilted.with_name("aligned.ply"), tmp_path / "mm.ply", tmp_path / "mm_out.ply"
    run("--cloud", tilted, "--out", out)
    write_scan(mm, 1000.0 * points_of(tilted))
    apply = ("--apply", out.with_suffix(".json"), "--transform", tmp_path / "T.json")
    code, report, _ = run("--cloud", mm, "--units", "mm", *apply, "--out", mm_out)
    assert code == 0
    np.testing.assert_allclose(points_of(mm_out), 1000.0 * points_of(out), atol=0.01)
    assert read_alignment(tmp_path / "T.json").metres_per_unit == report["metres_per_unit"] == 0.001
    code, report, _ = run("--cloud", mm, "--units", "mm", "--out", mm_out)
    assert code == 0
    np.testing.assert_allclose(np.ptp(points_of(mm_out)[:, 2]), 2500.0, atol=60.0)
    floor = next(plane for plane in report["planes"] if plane["kind"] == "floor")
    assert abs(floor["offset"]) > 100.0


def test_walls_come_to_stand_along_the_axes(run, tilted):
    out = tilted.with_name("aligned.ply")
    code, report, _ = run("--cloud", tilted, "--out", out, "--yaw-walls")
    assert code == 0
    full = np.array(report["T_aligned_from_scan"])[:3, :3] @ exp_so3(TURN)
    yaw = np.degrees(np.arctan2(full[1, 0], full[0, 0]))
    assert abs(yaw - 90.0 * np.round(yaw / 90.0)) < 0.3
    assert -45.0 < report["yaw_deg"] <= 45.0


def test_other_formats_become_ply(run, tmp_path):
    points, colors = scan()
    turned = points @ exp_so3(TURN).T
    np.savez(tmp_path / "a.npz", points=turned[::2], colors=colors[::2])
    np.savez(tmp_path / "b.npz", points=turned[1::2], colors=colors[1::2])
    out = tmp_path / "out.ply"
    code, report, _ = run("--cloud", tmp_path / "a.npz", tmp_path / "b.npz", "--out", out)
    assert (code, len(report["cloud"])) == (0, 2)
    vertex = PlyData.read(out)["vertex"]
    assert [p.name for p in vertex.properties] == ["x", "y", "z", "red", "green", "blue"]
    assert (len(vertex.data), vertex.data.dtype["x"]) == (len(points), np.float32)
    assert np.ptp(vertex["z"]) == pytest.approx(2.5, abs=0.06)
    assert np.array_equal(vertex["red"], np.concatenate([colors[::2, 0], colors[1::2, 0]]))


def test_same_bits_every_run_and_for_every_thread_count(run, tilted, tmp_path):
    outs = [tmp_path / f"{k}.ply" for k in range(2)]
    assert run("--cloud", tilted, "--out", outs[0], "--yaw-walls")[0] == 0
    command = [sys.executable, ROOT / "tools" / "align_gravity.py", "--cloud", tilted, "--out", outs[1]]
    limits = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
    subprocess.run([*command, "--yaw-walls", "--quiet"], env=os.environ | limits, check=True)
    for suffix in (".ply", ".json", ".txt"):
        assert outs[0].with_suffix(suffix).read_bytes() == outs[1].with_suffix(suffix).read_bytes()


def test_nothing_is_written_where_up_is_uncertain(run, tmp_path):
    np.savez(tmp_path / "bare.npz", points=bare_room(), colors=np.full((18_000, 3), 99, np.uint8))
    bare = ("--cloud", tmp_path / "bare.npz", "--out", tmp_path / "out.ply")
    code, report, err = run(*bare, "--assume-nothing")
    assert (code, report["status"], report["out"]) == (1, "uncertain", None)
    assert err.count("\n") == 1
    assert f"confidence {report['confidence']:.2f} is below {MIN_CONFIDENCE:g}" in err
    assert [path.name for path in tmp_path.iterdir()] == ["bare.npz"]
    assert run(*bare, "--assume-nothing", "--min-confidence", ANGLE)[0] == 0
    for convention in ([], ["--assume-z-up"]):
        code, report, _ = run(*bare, *convention)
        assert (code, report["tilt_deg"]) == (0, pytest.approx(0.0, abs=1e-9))
        assert "convention" in report["explanation"]
    probabilities = [hypothesis["probability"] for hypothesis in report["hypotheses"]]
    assert probabilities == sorted(probabilities, reverse=True)
    assert sum(probabilities) < 1.0
    assert report["hypotheses"][0]["evidence"]["convention"] > 6.0
    code, report, _ = run(*bare, "--up", "-z")
    assert (code, report["explanation"]) == (0, "up is the axis -z, as given")
    np.testing.assert_array_equal(np.array(report["T_aligned_from_scan"])[:3, :3], np.diag([1.0, -1.0, -1.0]))


def test_no_wall_no_yaw(run, tmp_path):
    points = np.random.default_rng(3).uniform(-9.0, 9.0, (9000, 3)) * [1.0, 1.0, 0.001]
    np.savez(tmp_path / "ground.npz", points=points, colors=np.full((9000, 3), 99, np.uint8))
    arguments = ("--cloud", tmp_path / "ground.npz", "--out", tmp_path / "out.ply", "--up", "z")
    code, report, err = run(*arguments, "--yaw-walls")
    assert (code, report["yaw_deg"]) == (1, None)
    assert "--yaw-walls: no wall" in err


def test_true_poses_go_along(run, tilted, tmp_path):
    poses = tilted_poses(3, np.zeros(3))
    (tmp_path / "raw").mkdir()
    queries = [Query(tmp_path / "raw" / f"{k}.jpg", "robot", pose) for k, pose in enumerate(poses)]
    write_queries(tmp_path / "raw", queries)
    out = tmp_path / "aligned.ply"
    code, report, _ = run("--cloud", tilted, "--queries", tmp_path / "raw" / "queries.json", "--out", out)
    assert code == 0
    T = np.array(report["T_aligned_from_scan"])
    scene = read_scene(tmp_path)
    assert scene.cloud == out
    assert scene.name_of(scene.queries[0]) == "raw/0.jpg"
    x_scan = np.array([0.3, -0.2, 0.9])
    x_aligned = T[:3, :3] @ x_scan + T[:3, 3]
    for query, pose in zip(scene.queries, poses, strict=True):
        before = pose.R_cam_from_world @ (x_scan - pose.center_world)
        after = query.pose.R_cam_from_world @ (x_aligned - query.pose.center_world)
        np.testing.assert_allclose(after, before, atol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--inverse", "--inverse needs --apply"),
        ("--apply T.json", "--apply needs --out"),
        ("--apply T.json --out o.ply --yaw-walls", "--yaw-walls can't be combined with --apply"),
        ("--apply T.json --out o.ply --up -y", "--up can't be combined with --apply"),
        ("--apply T.json --out o.ply --assume-nothing", "--assume-nothing can't be combined with --apply"),
        ("--up y --assume-z-up", "--assume-z-up can't be combined with --up y"),
        ("--up y --pano photo.jpg", "--pano can't be combined with --up y"),
        ("--min-confidence 1.5", "--min-confidence"),
        ("--scale -1", "--scale"),
        ("--out o.json", "--out o.json: wanted a name that ends with .ply"),
        ("--out o.ply --transform T.txt", "--transform T.txt: wanted a name that ends with .json"),
    ],
)
def test_wrong_usage(run, tilted, arguments, message):
    code, report, err = run("--cloud", tilted, *arguments.split())
    assert (code, report, err.count("\n")) == (2, None, 1)
    assert message in err


def test_bad_input(run, tilted, tmp_path, monkeypatch):
    (tmp_path / "T.json").write_text("{}")
    out, missing = tmp_path / "o.ply", tmp_path / "none.json"

    def refuse(named, *arguments, code=3):
        found, report, err = run(*arguments)
        assert (found, report, err.count("\n")) == (code, None, 1), arguments
        assert str(named) in err

    refuse(tmp_path / "none.ply", "--cloud", tmp_path / "none.ply", "--out", out)
    refuse(tilted, "--cloud", tilted, "--out", tilted, code=2)
    refuse(tmp_path / "no", "--cloud", tilted, "--out", tmp_path / "no" / "o.ply")
    refuse(tmp_path / "T.json", "--cloud", tilted, "--out", out, "--apply", tmp_path / "T.json")
    refuse(missing, "--cloud", tilted, "--out", out, "--apply", missing)
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # root may write everywhere
    refuse(out, "--cloud", tilted, "--out", out)
    assert not out.exists()


def test_a_cloud_on_stdout_and_nothing_beside_it(tilted, tmp_path, capfdbinary):
    out = tmp_path / "out.ply"
    assert align_gravity.main(["--cloud", str(tilted), "--up", "z", "--out", str(out)]) == 0
    capfdbinary.readouterr()
    assert align_gravity.main(["--cloud", str(tilted), "--up", "z", "--out", "-", "--quiet"]) == 0
    assert capfdbinary.readouterr() == (out.read_bytes(), b"")
    assert align_gravity.main(["--cloud", str(tilted), "--out", "-", "--queries", "q.json"]) == 2
    assert b"--queries: nothing can be written beside --out -" in capfdbinary.readouterr().err
    assert not Path("-.json").exists()
