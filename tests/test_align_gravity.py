"""The command line of tools/align_gravity.py, and the files it writes."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from pictures import encoded
from plyfile import PlyData, PlyElement
from poses import tilted_poses
from rooms import query as read_photo_facts
from scans import bare_room, points_of, scan, write_scan
from text_files import scan as ptx_lines, write_lines

from piccolo.apps import align_gravity
from piccolo.geometry.pose import exp_so3, transform_points
from research.datasets import true_poses
from research.scene import Query, read_scene, write_queries

TIER = "scene"
pytestmark = pytest.mark.usefixtures("searched_once")

ROOT = Path(__file__).resolve().parents[1]
TURN = np.array([1.4, 0.6, -0.3])
UTM = np.array([691_234.0, 5_335_678.0, 512.0])
FREE = "--assume-nothing"


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
    code, report, err = run("--cloud", tilted, "--out", out, FREE)
    assert (code, err, report["status"]) == (0, "", "aligned")
    T = np.array(report["T_aligned_from_scan"])
    up = np.array(report["up_scan"])
    np.testing.assert_allclose(up, exp_so3(TURN)[:, 2], atol=np.radians(0.2))
    np.testing.assert_allclose(T[:3, :3] @ up, [0.0, 0.0, 1.0], atol=1e-12)
    assert report["tilt_deg"] == pytest.approx(np.degrees(np.arccos(up[2])))
    np.testing.assert_allclose(points_of(out), points_of(tilted) @ T[:3, :3].T + T[:3, 3], atol=1e-6)
    assert {path.name for path in tilted.parent.iterdir()} == {
        "scan 1.ply", "aligned.ply", "aligned.txt"
    }  # fmt: skip
    np.testing.assert_array_equal(np.loadtxt(out.with_suffix(".txt")), T)
    assert report["metres_per_unit"] == 1.0
    assert "furniture +" in report["explanation"]


def test_other_properties_survive_and_normals_turn(run, tilted):
    out = tilted.with_name("aligned.ply")
    _, report, _ = run("--cloud", tilted, "--out", out, FREE)
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
        assert run("--cloud", tmp_path / f"{name}.ply", "--out", tmp_path / f"{name}_out.ply", FREE)[0] == 0
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
    assert np.ptp(after["vertex"]["z"] - 2.6 * np.indices((2, 2, 2))[2].ravel()) < 0.01


@pytest.mark.parametrize("byte_order", ["<", ">"])
def test_map_coordinates_stay_near_and_come_back(run, tmp_path, byte_order):
    points = scan()[0] @ exp_so3(TURN).T + UTM
    scan_path, out = tmp_path / "utm.ply", tmp_path / "out.ply"
    write_scan(scan_path, points, "<f8", byte_order=byte_order)
    code, report, _ = run("--cloud", scan_path, "--out", out, "--yaw-walls", FREE)
    assert code == 0
    assert PlyData.read(out)["vertex"].data.dtype["x"] == np.float64
    assert np.abs(points_of(out) - UTM).max() < 20.0
    back = transform_points(points_of(out), np.linalg.inv(np.loadtxt(out.with_suffix(".txt"))))
    np.testing.assert_allclose(back, points, rtol=0.0, atol=1e-8)
    origin = np.round(0.5 * (points.min(axis=0) + points.max(axis=0)))
    T = np.array(report["T_aligned_from_scan"])
    np.testing.assert_allclose(T[:3, :3] @ origin + T[:3, 3], origin, atol=1e-8)
    x_aligned = T[:3, :3] @ exp_so3(TURN)[:, 0]  # along a wall
    assert np.abs(x_aligned).max() > np.cos(np.radians(0.3))
    assert -45.0 < report["yaw_deg"] <= 45.0


def test_a_transform_is_in_the_unit_of_the_files(run, tmp_path, tilted):
    mm, out = tmp_path / "mm.ply", tmp_path / "out.ply"
    write_scan(mm, 1000.0 * points_of(tilted) + 5000.0)
    code, report, _ = run("--cloud", mm, "--units", "mm", "--out", out, FREE)
    assert (code, report["metres_per_unit"]) == (0, 0.001)
    np.testing.assert_allclose(np.ptp(points_of(out)[:, 2]), 2500.0, atol=60.0)
    moved = transform_points(points_of(mm), np.loadtxt(out.with_suffix(".txt")))
    np.testing.assert_allclose(moved, points_of(out), atol=1e-3)


def test_other_formats_become_ply(run, tmp_path):
    points, colors = scan()
    turned = points @ exp_so3(TURN).T
    np.savez(tmp_path / "a.npz", points=turned[::2], colors=colors[::2])
    np.savez(tmp_path / "b.npz", points=turned[1::2], colors=colors[1::2])
    out = tmp_path / "out.ply"
    code, report, _ = run("--cloud", tmp_path / "a.npz", tmp_path / "b.npz", "--out", out, FREE)
    assert (code, len(report["cloud"])) == (0, 2)
    vertex = PlyData.read(out)["vertex"]
    assert [p.name for p in vertex.properties] == ["x", "y", "z", "red", "green", "blue"]
    assert (len(vertex.data), vertex.data.dtype["x"]) == (len(points), np.float32)
    assert np.ptp(vertex["z"]) == pytest.approx(2.5, abs=0.06)
    assert np.array_equal(vertex["red"], np.concatenate([colors[::2, 0], colors[1::2, 0]]))


def test_a_cloud_without_colours_gets_none(run, tmp_path):
    points, colors = scan()
    turned = points @ exp_so3(TURN).T
    np.save(tmp_path / "bare.npy", turned)
    np.savetxt(tmp_path / "gray.txt", np.column_stack([turned, colors[:, 0]]))
    for name, more in (("bare.npy", []), ("gray.txt", ["intensity"])):
        assert run("--cloud", tmp_path / name, "--out", tmp_path / "out.ply", FREE)[0] == 0
        vertex = PlyData.read(tmp_path / "out.ply")["vertex"]
        assert [p.name for p in vertex.properties] == ["x", "y", "z", *more]
        (tmp_path / "out.ply").unlink()


@pytest.mark.process
def test_same_bits_every_run_and_for_every_thread_count(run, tilted, tmp_path):
    outs = [tmp_path / f"{k}.ply" for k in range(2)]
    assert run("--cloud", tilted, "--out", outs[0], "--yaw-walls", FREE)[0] == 0
    command = [sys.executable, ROOT / "tools" / "align_gravity.py", "--cloud", tilted, "--out", outs[1]]
    limits = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "3")
    subprocess.run([*command, "--yaw-walls", FREE, "--quiet"], env=os.environ | limits, check=True)
    for suffix in (".ply", ".txt"):
        assert outs[0].with_suffix(suffix).read_bytes() == outs[1].with_suffix(suffix).read_bytes()


def test_nothing_is_written_where_up_is_not_known(run, tmp_path):
    np.savez(tmp_path / "bare.npz", points=bare_room(), colors=np.full((18_000, 3), 99, np.uint8))
    bare = ("--cloud", tmp_path / "bare.npz", "--out", tmp_path / "out.ply")
    code, report, err = run(*bare, FREE)
    assert (code, report["status"], report["out"], report["up_scan"]) == (1, "uncertain", None, None)
    assert err.endswith("up is not known: floor and ceiling look alike: furniture +0.0, free space +0.0\n")
    assert [path.name for path in tmp_path.iterdir()] == ["bare.npz"]
    code, report, _ = run(*bare)
    assert (code, report["tilt_deg"], report["explanation"]) == (0, 0.0, "up is the named axis")
    np.testing.assert_array_equal(report["T_aligned_from_scan"], np.eye(4))
    code, report, _ = run(*bare, "--up", "-z")
    assert code == 0
    np.testing.assert_array_equal(np.array(report["T_aligned_from_scan"])[:3, :3], np.diag([1.0, -1.0, -1.0]))


@pytest.mark.parametrize("w", [[0.5 * np.pi, 0.0, 0.0], [np.pi, 0.0, 0.0], [0.7, 0.0, 0.0]])
def test_the_files_axis_is_not_believed_against_plain_evidence(run, tmp_path, w):
    write_scan(tmp_path / "scan.ply", scan()[0] @ exp_so3(np.array(w)).T)
    code, report, err = run("--cloud", tmp_path / "scan.ply", "--out", tmp_path / "out.ply")
    assert (code, report["status"], (tmp_path / "out.ply").exists()) == (1, "uncertain", False)
    assert "up is not known: the floors do not face z (furniture +" in err


def test_a_named_axis_is_levelled_by_planes_that_are_near_it(run, tmp_path):
    R = exp_so3(np.array([0.5 * np.pi, 0.0, 0.0])) @ exp_so3(np.array([0.1, 0.05, 0.0]))
    write_scan(tmp_path / "scan.ply", scan()[0] @ R.T)
    code, report, _ = run("--cloud", tmp_path / "scan.ply", "--up", "-y")
    assert code == 0
    np.testing.assert_allclose(report["up_scan"], R[:, 2], atol=np.radians(0.2))


def test_scanners_tell_up_in_a_bare_room(run, tmp_path):
    R = exp_so3(TURN)
    points = bare_room() @ R.T
    matrix = np.eye(4)
    matrix[:3, :3] = R.T
    matrix[3, :3] = R @ [2.0, 2.0, 1.5]
    path = write_lines(tmp_path / "a.ptx", ptx_lines(points, np.full(points.shape, 128), matrix))
    code, report, _ = run("--cloud", path, FREE)
    assert (code, report["explanation"]) == (0, "the scanners stood upright")
    np.testing.assert_allclose(report["up_scan"], R[:, 2], atol=np.radians(0.3))


@pytest.mark.parametrize("assumed", [[], [FREE]])
def test_a_photo_tells_up(run, tilted, tmp_path, assumed):
    (tmp_path / "photo.png").write_bytes(encoded(read_photo_facts(1).rgb, ".png"))
    code, report, _ = run("--cloud", tilted, "--pano", tmp_path / "photo.png", *assumed)
    assert (code, report["explanation"]) == (0, f"{tmp_path / 'photo.png'} is localized")
    np.testing.assert_allclose(report["up_scan"], exp_so3(TURN)[:, 2], atol=np.radians(0.2))


def test_a_photo_from_elsewhere_tells_nothing(run, tilted, tmp_path):
    (tmp_path / "photo.png").write_bytes(encoded(read_photo_facts(2).rgb, ".png"))
    code, report, err = run("--cloud", tilted, "--pano", tmp_path / "photo.png", FREE)
    assert (code, report["up_scan"]) == (1, None)
    assert "photo.png is not_localized" in err


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
    code, report, _ = run("--cloud", tilted, "--out", out, FREE)
    assert code == 0
    files = ["--transform", tmp_path / "aligned.txt", "--out", tmp_path / "queries.json"]
    assert true_poses.main([*map(str, ["--scenes", tmp_path / "raw", *files])]) == 0
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
        ("--up y --assume-nothing", "--assume-nothing: not with --up"),
        ("--up y --pano photo.jpg", "--pano: not with --up"),
        ("--units -1", "--units"),
        ("--out o.json", "--out o.json: wanted a name that ends with .ply"),
    ],
)
def test_wrong_usage(run, tilted, arguments, message):
    code, report, err = run("--cloud", tilted, *arguments.split())
    assert (code, report, err.count("\n")) == (2, None, 1)
    assert message in err


def test_bad_input(run, tilted, tmp_path, monkeypatch):
    (tmp_path / "text.jpg").write_text("no picture")
    out = tmp_path / "o.ply"

    def refuse(named, *arguments, code=3):
        found, report, err = run(*arguments)
        assert (found, report, err.count("\n")) == (code, None, 1), arguments
        assert str(named) in err

    refuse(tmp_path / "none.ply", "--cloud", tmp_path / "none.ply", "--out", out)
    refuse(tilted, "--cloud", tilted, "--out", tilted, code=2)
    refuse(tmp_path / "no", "--cloud", tilted, "--out", tmp_path / "no" / "o.ply")
    refuse("text.jpg", "--cloud", tilted, "--out", out, "--pano", tmp_path / "text.jpg")
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # root may write everywhere
    refuse(out, "--cloud", tilted, "--out", out)
    assert not out.exists()


def test_a_cloud_on_stdout_and_nothing_beside_it(tilted, tmp_path, capfdbinary):
    out = tmp_path / "out.ply"
    assert align_gravity.main(["--cloud", str(tilted), "--up", "z", "--out", str(out)]) == 0
    capfdbinary.readouterr()
    assert align_gravity.main(["--cloud", str(tilted), "--up", "z", "--out", "-", "--quiet"]) == 0
    assert capfdbinary.readouterr() == (out.read_bytes(), b"")
    assert not Path("-.txt").exists()
