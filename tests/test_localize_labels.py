"""Labels, and the comparisons of the paper, through the command line."""

import cv2
import numpy as np
import pytest
from plyfile import PlyData
from rooms import errors, write_room

from piccolo.cli import localize, prepare_map
from piccolo.result import Result
from piccolo.scene import read_scene
from research.evaluation import evaluate
from research.evaluation.query_result import read_run
from research.synthetic.layout import LABEL_NAMES

PAPER = ["--preset", "paper", "num_translations=30", "num_iterations=60", "max_points=30000"]


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A room with labels, and one panorama."""
    words = "--seed 7 --width 512 --points 60000 --panoramas 1 --labels"
    return write_room(tmp_path_factory.mktemp("labels"), words)


def _localized(scene, capsys, *options, pano="labels/clean_0.png"):
    files = ["--cloud", str(scene / "cloud.ply"), "--pano", str(scene / pano), "--cache", "none", "--quiet"]
    code = localize.main([*files, *options])
    out, err = capsys.readouterr()
    return (Result.from_json(out) if out else None), code, err


def test_room_maker_labels_points_and_pixels_alike(scene):
    (query,) = read_scene(scene).queries
    picture = cv2.imread(str(query.labels), cv2.IMREAD_UNCHANGED)
    vertices = PlyData.read(str(scene / "cloud.ply"))["vertex"]
    points = np.stack([vertices[axis] for axis in "xyz"], axis=1)
    x, y, z = query.pose.R_cam_from_world @ (points - query.pose.center_world).T
    column = (512 * (0.5 - np.arctan2(y, x) / (2 * np.pi))).astype(int) % 512
    row = (512 * (0.25 - np.arctan2(z, np.hypot(x, y)) / (2 * np.pi))).astype(int)
    assert (picture[row, column] == vertices["label"]).mean() > 0.7  # the rest is hidden
    assert picture.dtype == np.uint16
    assert set(np.unique(picture)) <= set(range(1, len(LABEL_NAMES)))
    for kind, side in (("floor", points[:, 2] < 0.02), ("ceiling", points[:, 2] > 2.48)):
        assert (vertices["label"][side] == LABEL_NAMES.index(kind)).mean() > 0.3
    assert (picture[[0, -1]] == [[LABEL_NAMES.index("ceiling")], [picture[-1, 0]]]).all()


@pytest.mark.parametrize("preset", [[], PAPER])
def test_camera_is_found_by_labels(scene, capsys, preset):
    result, code, _ = _localized(scene, capsys, "--labels", *preset)
    distance, angle_deg = errors(result.pose, read_scene(scene).queries[0].pose)
    assert distance < 0.05
    assert angle_deg < 1.0
    assert code == (0 if result.status == "localized" else 1)
    assert result.settings["cloud"]["labels"] == result.settings["panorama"]["labels"] == {"ignored": []}


def test_ignored_labels_stand_in_the_result_and_everything_ignored_is_refused(scene, capsys):
    ceiling = str(LABEL_NAMES.index("ceiling"))
    result, _, _ = _localized(scene, capsys, "--labels", "99", ceiling)
    assert errors(result.pose, read_scene(scene).queries[0].pose)[0] < 0.05
    assert result.settings["cloud"]["labels"] == {"ignored": [int(ceiling), 99]}
    everything = map(str, range(len(LABEL_NAMES)))
    _, code, err = _localized(scene, capsys, "--labels", *everything)
    assert code == 3
    assert "cloud.ply: found 0 finite points" in err


def test_wrong_use_of_labels_is_refused(scene, capsys):
    for code, options, message in (
        (2, "--labels --ignore-colors", "--ignore-colors, --labels: found both"),
        (2, "--labels --fov 90", "--labels: found --fov or --projection too"),
        (3, "--labels", "clean_0.jpg: this kind of picture holds no labels, wanted a PNG"),
    ):
        _, found, err = _localized(scene, capsys, *options.split(), pano="images/clean_0.jpg")
        assert (found, message in err) == (code, True)


def test_prepared_map_of_labels_wants_labels(scene, tmp_path, capsys):
    built, cloud = str(tmp_path / "scan.map"), ["--cloud", str(scene / "cloud.ply")]
    assert prepare_map.main([*cloud, "--labels", "--out", built, "--quiet"]) == 0
    capsys.readouterr()
    pano = ["--pano", str(scene / "labels" / "clean_0.png"), "--quiet"]
    localize.main(["--cloud", built, *pano, "--labels"])
    of_map = Result.from_json(capsys.readouterr().out)
    of_cloud, _, _ = _localized(scene, capsys, "--labels")
    np.testing.assert_array_equal(of_map.pose.center_world, of_cloud.pose.center_world)
    assert localize.main(["--cloud", built, *pano]) == 3
    assert "scan.map: found a prepared map of labels, wanted --labels too" in capsys.readouterr().err
    assert prepare_map.main([*cloud, "--out", built, "--quiet"]) == 0
    assert localize.main(["--cloud", built, *pano, "--labels"]) == 3
    assert "scan.map: found a prepared map of colours, wanted no --labels" in capsys.readouterr().err


def test_evaluation_takes_the_pictures_of_labels(scene, tmp_path, capsys):
    words = ["--quiet", "--labels", "--preset", "default", "max_starts=100"]
    assert evaluate.main(["--scenes", str(scene), "--out", str(tmp_path / "run.jsonl"), *words]) == 0
    (row,) = read_run(tmp_path / "run.jsonl")[0]
    assert row.result.pano == str(scene / "labels" / "clean_0.png")
    text = (scene / "queries.json").read_text()
    (scene / "unlabelled.json").write_text(text.replace('"labels"', '"unknown"'))
    unlabelled = ["--scenes", str(scene / "unlabelled.json"), "--out", str(tmp_path / "none.jsonl")]
    assert evaluate.main([*unlabelled, *words]) == 3
    assert "images/clean_0.jpg has no labels in queries.json" in capsys.readouterr().err
