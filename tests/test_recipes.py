"""The recipes of docs/recipes/, run as they are written on a small room.

What takes long is run by tests of its own: here its options and files are checked, and its results are true
poses.
"""

import json
import re
import shlex
from importlib import import_module
from pathlib import Path

import cv2
import e57_files
import numpy as np
import pycolmap
import pytest
import rooms
from batches import ROOT, main_of
from e57_files import ImageToWrite, ScanToWrite
from poses import result, write_results

from piccolo.api.result_files import read_results
from piccolo.apps.export.formats import export, tum_lines
from piccolo.apps.export.posed_images import Options
from piccolo.cli.command import new_parser, parse
from piccolo.cloud.readers.e57 import list_images
from piccolo.cloud.writers import vertex_rows
from piccolo.doors import COMMANDS
from piccolo.geometry.pose import Pose, pose_errors, yaw_rotation
from piccolo.judge.pose_covariance import PoseCovariance

TIER = "scene"

RECIPES = sorted((ROOT / "docs" / "recipes").glob("*.md"))
SEED = 3
NAMES = [f"photos/clean_{k}.jpg" for k in range(4)] + ["more/clean_4.jpg"]
INSIDE = [f"inside/scan_{k}.jpg" for k in range(4)]  # images of the E57 file
SLOW = ("localize.py", "tools/prepare_map.py", "tools/color_scan.py", "tools/serve.py")
INPUTS = ("cloud", "pano", "relative", "results", "given")
COVARIANCE = PoseCovariance(np.diag(np.repeat([1e-3, 4e-3], 3) ** 2), "")
SIDES = {"imageWidth": 64, "imageHeight": 32}  # [px]
WORLD_FROM_MODEL = 1.0 / 0.37


def poses():
    """The true poses of the photos, by their names; from the fourth on they are like those before."""
    found = [rooms.query(SEED, "clean", k)[1] for k in range(3)]
    found += [
        Pose(yaw_rotation(0.3) @ found[0].R_cam_from_world, found[0].center_world + k) for k in (0.1, 0.2)
    ]
    return dict(zip(NAMES, found, strict=True))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The files that recipes begin with."""
    monkeypatch.chdir(tmp_path)
    world_cloud = rooms.room(SEED)[1]
    points = world_cloud.points[::4] + world_cloud.origin_world
    rooms.write_ply(Path("scan.ply"), vertex_rows(points, world_cloud.colors[::4]))
    rooms.write_ply(Path("bare.ply"), vertex_rows(points, None))
    for name in ("photos", "more", "sparse"):
        Path(name).mkdir()
    for k, name in enumerate(NAMES):
        rgb = np.asarray(rooms.query(SEED, "clean", min(k, 2))[0])
        cv2.imwrite(name, rgb[..., ::-1])
    true = poses()
    small = [Pose(p.R_cam_from_world, p.center_world / WORLD_FROM_MODEL) for p in true.values()]
    photos = [result(name, pose) for name, pose in zip(true, small, strict=True)][:4]
    export(photos, "colmap", Path("sparse/0"), Options(images=Path("photos")))
    times = 10.0 * np.arange(4.0)
    Path("times.csv").write_text(
        "name,time\n" + "".join(f"{n},{t}\n" for n, t in zip(NAMES, times, strict=False))
    )
    rows = [(str(t), pose) for t, pose in zip(times, true.values(), strict=False)]
    Path("trajectory.txt").write_text("\n".join(tum_lines(rows, "optical")) + "\n")
    turned = [yaw_rotation(0.5) @ pose.R_cam_from_world for _, pose in rows]
    wxyz = [Pose(R.T, np.zeros(3)).quaternion_wxyz for R in turned]
    images = [
        ImageToWrite(Path(name).read_bytes(), numbers=SIDES, rotation_wxyz=q, center_world=pose.center_world)
        for name, q, (_, pose) in zip(NAMES, wxyz, rows, strict=False)
    ]
    columns = {f"cartesian{axis}": values for axis, values in zip("XYZ", points.T, strict=True)}
    e57_files.write(Path("scan.e57"), [ScanToWrite(columns)], images)
    return tmp_path


def _check(program, words):
    """Parse a command's options, check that its inputs are there, and write what it would write."""
    name = Path(program).stem
    parser = new_parser(name, "", "")
    import_module(COMMANDS[name]).add_arguments(parser)
    arguments = parse(parser, words)
    for option in INPUTS:
        given = getattr(arguments, option, None) or []
        for path in given if isinstance(given, list) else [given]:
            assert Path(path).exists(), (option, path)
    if name == "serve":
        return ""
    if name != "localize":
        arguments.out.write_text("made elsewhere")
        return ""
    asked = [
        path
        for word in arguments.pano
        for path in ([word] if Path(word).is_file() else Path(word).glob("*.jpg"))
    ]
    cloud = str(arguments.cloud[0])
    true = poses() | dict(zip(INSIDE, poses().values(), strict=False))
    found = [result(p, true[p], cloud=cloud, covariance=COVARIANCE) for p in sorted(map(str, asked))]
    if arguments.out is None:
        return found[0].to_json()
    write_results(arguments.out, found)
    return ""


@pytest.mark.parametrize("page", RECIPES, ids=lambda page: page.stem)
def test_recipe_runs_as_written(folder, page, capsys):
    commands = re.findall(r"^    (?:python )(.*)", page.read_text(), flags=re.MULTILINE)
    assert commands
    for command in commands:
        words, _, out = command.partition(" > ")
        program, *words = shlex.split(words)
        printed = _check(program, words) if program in SLOW else None
        if printed is None:
            assert main_of(program)(words) == 0, capsys.readouterr().err
            printed = capsys.readouterr().out
        if out:
            Path(out.strip()).write_text(printed)
    CHECKS.get(page.stem, lambda printed: None)(printed)


def _check_potree(_):
    lines = Path("photos/coordinates.txt").read_text().splitlines()
    assert [line.split("\t")[0] for line in lines[1:]] == [f"clean_{k}.jpg" for k in range(4)]


def _check_splat(_):
    model = pycolmap.Reconstruction("splat/sparse/0")
    assert model.num_images() == 24
    assert model.num_points3D() > 5_000
    assert all(Path("splat/images", image.name).is_file() for image in model.images.values())
    document = json.loads(Path("nerf/transforms.json").read_text())
    assert Path("nerf", document["ply_file_path"]).stat().st_size > 100_000


def _check_aligned(_):
    model = pycolmap.Reconstruction("both")
    assert model.num_images() == 5
    true = poses()
    for image in model.images.values():
        name = next(name for name in true if name.endswith(image.name))
        assert np.linalg.norm(image.projection_center() - true[name].center_world) < 0.01


def _check_sure(printed):
    assert read_results([Path("pose.json")])[0].confidence == 0.9


def _check_mount(printed):
    report = json.loads(Path("mount.json").read_text())
    assert report["lever_arm_m"] == pytest.approx([0.0, 0.0, 0.0], abs=0.01)
    inside = json.loads(Path("inside.json").read_text())
    assert inside["rotation_deg"] == pytest.approx([0.0, 0.0, np.degrees(0.5)], abs=0.1)
    for image, pose in zip(list_images(Path("corrected.e57")), poses().values(), strict=False):
        assert pose_errors(image.pose, pose) == pytest.approx((0.0, 0.0), abs=1e-6)


CHECKS = {
    "potree": _check_potree,
    "splat": _check_splat,
    "align_model": _check_aligned,
    "how_sure": _check_sure,
    "mount": _check_mount,
}


def test_readme_links_every_recipe():
    text = (ROOT / "README.md").read_text()
    for page in RECIPES:
        assert f"(docs/recipes/{page.name})" in text, page.name
        assert len(page.read_text().split()) <= 170
