"""The paper's experiments: what is changed of a scene, which arms there are, and the tool that runs them."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from piccolo.cli import make_room
from piccolo.cli import reproduce_paper as experiments
from piccolo.cloud import read_cloud
from piccolo.cloud.soa import pack_points
from piccolo.coarse_to_fine.settings import CoarseToFineSettings
from piccolo.errors import InputError
from piccolo.geometry.pose import Pose, angle_between
from piccolo.optimize.sampling_loss import sampling_loss
from piccolo.panorama import read_panorama
from piccolo.panorama.texels import pack_texels
from piccolo.paper.settings import PaperSettings
from piccolo.render.zbuffer import visible_points
from piccolo.scenes.evaluation.run_file import read_rows
from piccolo.scenes.experiments.arms import EXPERIMENTS
from piccolo.scenes.experiments.changes import as_it_is, flipped, turned_at_random, with_count, with_share
from piccolo.scenes.scene import Query, read_scene, write_queries

PRESETS = [PaperSettings(), CoarseToFineSettings()]


@pytest.fixture(scope="module")
def rooms(tmp_path_factory):
    """Two rooms with labels."""
    folder = tmp_path_factory.mktemp("the rooms")
    words = ["--scenes", "2", "--seed", "7", "--points", "40000", "--panoramas", "1", "--width", "256"]
    words += ["--variants", "clean", "tilt", "--labels", "--size", "4.5", "3.5", "2.5", "--quiet"]
    assert make_room.main(["--out", str(folder), *words]) == 0
    return folder


def _loss(scene, number):
    """Of a query at its own pose in its own cloud."""
    query, cloud = scene.queries[number], read_cloud(scene.cloud)
    pose = Pose(query.pose.R_cam_from_world, query.pose.center_world - cloud.origin_world)
    points = visible_points(pack_points(cloud.points, cloud.colors), pose.center_world)
    return sampling_loss(points, pack_texels(read_panorama(query.image).rgb), pose)


@pytest.mark.parametrize("change", [as_it_is, turned_at_random, flipped, with_share(0.5), with_count(9000)])
@pytest.mark.parametrize("number", [0, 1])
def test_a_changed_scene_fits_its_true_poses(rooms, tmp_path, change, number):
    scene = read_scene(rooms / "000")
    changed = change(scene, tmp_path)
    assert _loss(changed, number) < 0.09
    wrong = replace(changed.queries[number].pose, R_cam_from_world=np.diag([-1.0, -1.0, 1.0]))
    queries = [replace(query, pose=wrong) for query in changed.queries]
    assert _loss(replace(changed, queries=tuple(queries)), number) > 0.2


def test_what_a_change_leaves_alone(rooms, tmp_path):
    scene = read_scene(rooms / "000")
    names = ("turned", "again", "flipped", "thinned")
    folders = [tmp_path / name for name in names]
    for folder in folders:
        folder.mkdir()
    turned = turned_at_random(scene, folders[0])
    poses = [(a.pose, b.pose) for a, b in zip(scene.queries, turned.queries, strict=True)]
    angles = {
        round(float(np.degrees(angle_between(a.R_cam_from_world, b.R_cam_from_world))), 6) for a, b in poses
    }
    assert len(angles) == 1
    assert angles.pop() > 1.0
    assert turned.queries[0].image == scene.queries[0].image
    turned_at_random(scene, folders[1])
    assert (folders[0] / "cloud.ply").read_bytes() == (folders[1] / "cloud.ply").read_bytes()
    upside_down = flipped(scene, folders[2])
    assert upside_down.cloud == scene.cloud
    assert [upside_down.name_of(q) for q in upside_down.queries] == [scene.name_of(q) for q in scene.queries]
    up_in_camera = upside_down.queries[0].pose.R_cam_from_world @ [0.0, 0.0, 1.0]
    np.testing.assert_allclose(up_in_camera, [0.0, 0.0, -1.0], atol=1e-12)
    assert len(read_cloud(with_share(0.1)(scene, folders[3]).cloud).points) == 4000


def test_pictures_beside_the_scene_and_masked_ones_are_flipped_too(rooms, tmp_path):
    rgba = np.full((64, 128, 4), 200, np.uint8)
    rgba[:20, :, 3] = 0
    (tmp_path / "raw").mkdir()
    cv2.imwrite(str(tmp_path / "raw" / "a.png"), rgba)
    pose = read_scene(rooms / "000").queries[0].pose
    (tmp_path / "room").mkdir()
    write_queries(tmp_path / "room", [Query(tmp_path / "raw" / "a.png", "clean", pose)])
    (tmp_path / "new").mkdir()
    changed = flipped(read_scene(tmp_path / "room"), tmp_path / "new")
    assert changed.name_of(changed.queries[0]) == "../raw/a.png"
    assert changed.queries[0].image.resolve().is_relative_to(tmp_path / "new")
    is_valid = read_panorama(changed.queries[0].image).is_valid
    assert is_valid[:44].all()
    assert not is_valid[44:].any()


def test_too_few_points_are_told(rooms, tmp_path):
    with pytest.raises(InputError, match=r"cloud\.ply: found 40000 points, wanted at least 1000000"):
        with_count(1_000_000)(read_scene(rooms / "000"), tmp_path)


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_arms_differ_and_have_files_of_their_own(name):
    arms = EXPERIMENTS[name].arms_of(PRESETS, ["change", "clean"])
    assert len(arms) >= 2
    assert len({experiments.file_name(arm) for arm in arms}) == len(arms)
    tried = {(repr(arm.settings), repr(arm.change), arm.variants, arm.use_labels) for arm in arms}
    assert len(tried) == len(arms)


def test_the_tool_writes_table_plot_and_rows_and_takes_them_up_again(rooms, tmp_path, monkeypatch, capsys):
    quick = PaperSettings(num_translations=8, num_iterations=20)
    monkeypatch.setitem(experiments.PRESETS, "paper", quick)
    command = ["labels", "variants", "--scenes", str(rooms), "--out", str(tmp_path / "out"), "--quiet"]
    command += ["--presets", "paper"]
    assert experiments.main([*command, "--variants", "clean"]) == 0
    out = capsys.readouterr().out
    assert "| RGB | paper | 2 |" in out
    assert "| labels | paper | 2 |" in out
    assert "| clean | paper | 2 |" in out
    assert "| tilt |" not in out
    assert (tmp_path / "out" / "labels.png").read_bytes()[1:4] == b"PNG"
    rows = read_rows(tmp_path / "out" / "labels" / "labels_paper.jsonl")[0]
    assert [row.scene for row in rows] == ["000", "001"]
    assert rows[0].result.pano.endswith("labels/clean_0.png")
    before = (tmp_path / "out" / "labels.md").read_text()
    assert experiments.main([*command, "--variants", "clean"]) == 0
    assert (tmp_path / "out" / "labels.md").read_text() == before
    assert experiments.main(command) == 0
    assert "| tilt | paper | 2 |" in capsys.readouterr().out


def test_what_cannot_be_tried_is_told(rooms, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(experiments.PRESETS, "paper", PaperSettings(num_translations=8, num_iterations=20))
    scene = tmp_path / "room"
    scene.mkdir()
    document = json.loads((rooms / "000" / "queries.json").read_text())
    document["cloud"] = str(rooms / "000" / "cloud.ply")
    for entry in document["queries"]:
        entry["image"] = str(rooms / "000" / entry["image"])
    (scene / "queries.json").write_text(json.dumps(document))
    command = ["runtime", "--scenes", str(scene), "--out", str(tmp_path / "out"), "--presets", "paper"]
    assert experiments.main([*command, "--quiet"]) == 3
    told = capsys.readouterr()
    assert "found 40000 points, wanted at least 100000" in told.err
    assert "| 10000 points | paper | 2 |" in told.out
    assert experiments.main(["variants", *command[1:], "--variants", "none"]) == 3
    assert "variants: found no query that could be tried" in capsys.readouterr().err
