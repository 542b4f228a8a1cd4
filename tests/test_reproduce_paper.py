"""The paper's experiments: transforms of scenes, conditions, and the tool that runs them."""

import json
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
from rooms import write_room
from scans import read_cloud

from piccolo.geometry.points import pack_points
from piccolo.geometry.pose import Pose, angle_between
from piccolo.localization.paper import PaperSettings
from piccolo.optimize.sampling_loss import sampling_loss
from piccolo.photo.panorama import read_panorama
from piccolo.photo.panorama.texels import pack_texels
from piccolo.problem.settings import CoarseToFineSettings
from piccolo.views.zbuffer import visible_points
from research.evaluation.query_result import read_run
from research.experiments import reproduce_paper
from research.experiments.reproduce_paper import EXPERIMENTS, conditions_of, flip, thin, with_random_rotation
from research.scene import Query, read_scene, write_queries

pytestmark = pytest.mark.research

TIER = "scene"

PRESETS = [PaperSettings(), CoarseToFineSettings()]
QUICK = PaperSettings(num_translations=8, num_iterations=20)


@pytest.fixture(autouse=True)
def _quick(monkeypatch):
    monkeypatch.setitem(reproduce_paper.PRESETS, "paper", QUICK)


@pytest.fixture(scope="module")
def rooms(tmp_path_factory):
    """Two rooms with labels."""
    words = "--scenes 2 --seed 7 --points 40000 --panoramas 1 --width 256 --variants clean tilt --labels"
    return write_room(tmp_path_factory.mktemp("the rooms"), words)


def _loss(scene, number):
    """Of a query at its own pose in its own cloud."""
    query = scene.queries[number]
    cloud = read_cloud(scene.cloud)
    pose = Pose(query.pose.R_cam_from_world, query.pose.center_world - cloud.origin_world)
    points = visible_points(pack_points(cloud.points, cloud.colors), pose.center_world)
    return sampling_loss(points, pack_texels(read_panorama(query.image).rgb), pose)


@pytest.mark.parametrize(
    "transform", [with_random_rotation, flip, partial(thin, fraction=0.5), partial(thin, num_points=9000)]
)
@pytest.mark.parametrize("number", [0, 1])
def test_a_transformed_scene_fits_its_true_poses(rooms, tmp_path, transform, number):
    transformed = transform(read_scene(rooms / "000"), tmp_path)
    assert _loss(transformed, number) < 0.09
    wrong = replace(transformed.queries[number].pose, R_cam_from_world=np.diag([-1.0, -1.0, 1.0]))
    queries = [replace(query, pose=wrong) for query in transformed.queries]
    assert _loss(replace(transformed, queries=tuple(queries)), number) > 0.2


def test_what_a_transform_leaves_alone(rooms, tmp_path):
    scene = read_scene(rooms / "000")
    folders = [tmp_path / name for name in ("turned", "again", "flipped", "thinned")]
    for folder in folders:
        folder.mkdir()
    turned, again = (with_random_rotation(scene, folder) for folder in folders[:2])
    rotations = [[q.pose.R_cam_from_world for q in s.queries] for s in (scene, turned)]
    angles = list(map(angle_between, *rotations))
    assert angles == pytest.approx([angles[0]] * 2, abs=1e-7)
    assert np.degrees(angles[0]) > 1.0
    assert turned.queries[0].image == scene.queries[0].image
    assert turned.cloud.read_bytes() == again.cloud.read_bytes()
    changed = flip(scene, folders[2])
    assert changed.cloud == scene.cloud
    assert [changed.name_of(q) for q in changed.queries] == [scene.name_of(q) for q in scene.queries]
    up_in_camera = changed.queries[0].pose.R_cam_from_world @ [0.0, 0.0, 1.0]
    np.testing.assert_allclose(up_in_camera, [0.0, 0.0, -1.0], atol=1e-12)
    assert len(read_cloud(thin(scene, folders[3], 0.1).cloud).points) == 4000


def test_pictures_beside_the_scene_and_masked_ones_are_flipped_too(rooms, tmp_path):
    for name in ("raw", "room", "new"):
        (tmp_path / name).mkdir()
    rgba = np.full((64, 128, 4), 200, np.uint8)
    rgba[:20, :, 3] = 0
    cv2.imwrite(str(tmp_path / "raw" / "a.png"), rgba)
    pose = read_scene(rooms / "000").queries[0].pose
    write_queries(tmp_path / "room", [Query(tmp_path / "raw" / "a.png", "clean", pose)])
    transformed = flip(read_scene(tmp_path / "room"), tmp_path / "new")
    (query,) = transformed.queries
    assert transformed.name_of(query) == "../raw/a.png"
    assert query.image.resolve().is_relative_to(tmp_path / "new")
    is_valid = read_panorama(query.image).is_valid
    assert is_valid[:44].all()
    assert not is_valid[44:].any()


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_conditions_differ_and_have_files_of_their_own(name):
    conditions = conditions_of(EXPERIMENTS[name], PRESETS, ["change", "clean"])
    assert len(conditions) >= 2
    assert len({reproduce_paper.file_name(condition) for condition in conditions}) == len(conditions)
    tried = {(repr(c.settings), repr(c.transform), c.variants) for c in conditions}
    assert len(tried) == len(conditions)


def _command(names, scenes, out, *more):
    words = ["--presets", "paper", "--quiet", *more]
    return reproduce_paper.main([*names.split(), "--scenes", str(scenes), "--out", str(out), *words])


def test_the_tool_writes_table_and_runs_and_resumes_them(rooms, tmp_path, capsys):
    out = tmp_path / "out"
    assert _command("labels variants", rooms, out, "--variants", "clean") == 0
    text = capsys.readouterr().out
    assert all(f"| {name} | paper | 2 |" in text for name in ("RGB", "labels", "clean"))
    assert "| tilt |" not in text
    rows = read_run(out / "labels" / "labels_paper.jsonl")[0]
    assert [row.scene for row in rows] == ["000", "001"]
    assert rows[0].result.pano.endswith("images/clean_0.jpg")
    assert rows[0].result.settings["num_translations"] == 8
    before = (out / "labels.md").read_text()
    assert _command("labels variants", rooms, out, "--variants", "clean") == 0
    assert (out / "labels.md").read_text() == before
    assert _command("variants", rooms, out) == 0
    assert "| tilt | paper | 2 |" in capsys.readouterr().out


def test_what_cannot_be_localized_is_named(rooms, tmp_path, capsys):
    scene = tmp_path / "room"
    scene.mkdir()
    document = json.loads((rooms / "000" / "queries.json").read_text())
    document["cloud"] = str(rooms / "000" / "cloud.ply")
    for entry in document["queries"]:
        entry["image"] = str(rooms / "000" / entry["image"])
    (scene / "queries.json").write_text(json.dumps(document))
    assert _command("runtime", scene, tmp_path / "out") == 3
    out, err = capsys.readouterr()
    assert "found 40000 points, wanted at least 100000" in err
    assert "| 10000 points | paper | 2 |" in out
    assert _command("variants", scene, tmp_path / "out", "--variants", "none") == 3
    assert "variants: no query could be localized" in capsys.readouterr().err
    assert _command("variants", scene, tmp_path / "out", "--jobs", "0") == 2
