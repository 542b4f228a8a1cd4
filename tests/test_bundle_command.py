"""localize.py --relative and Scan.localize_bundle: results in order, and refusals."""

import json

import numpy as np
import pytest
import rooms
from poses import SIZE, result
from refusals import assert_input_error
from rooms import scan as scan_of_room

import piccolo
from piccolo.api.result_files import read_results
from piccolo.apps.export.formats import export
from piccolo.apps.export.posed_images import Options
from piccolo.cli.localize import main
from piccolo.geometry.pose import Pose, exp_so3
from piccolo.photo.photo import Photo
from research.scene import read_scene

TIER = "scene"
pytestmark = pytest.mark.usefixtures("searched_once")

COMMON_FROM_WORLD = Pose(exp_so3(np.array([0.3, -0.2, 2.0])), np.array([3.0, -1.0, 2.0]))
NAMES = ("clean_2.jpg", "clean_0.jpg", "clean_1.jpg")  # in another order than in the files


@pytest.fixture(scope="module")
def relative(scene, tmp_path_factory):
    """Relative poses of the scene's photos as transforms.json, in a frame of their own."""
    folder = tmp_path_factory.mktemp("poses")
    poses = [(q.image, q.pose @ COMMON_FROM_WORLD.inverse()) for q in read_scene(scene).queries]
    results = [result(image, pose) for image, pose in poses]
    export(results, "nerfstudio", folder / "transforms.json", Options(size=SIZE))
    return folder / "transforms.json"


def _command(scene, relative, *options):
    photos = [str(scene / "images" / name) for name in NAMES]
    cloud = ["--cloud", str(scene / "cloud.ply"), "--cache", str(scene.parent / "maps"), "--gravity", "known"]
    return [*cloud, "--relative", str(relative), *map(str, options), "--pano", *photos]


def _assert_right(scene, results):
    truth = read_scene(scene).by_name
    assert [r.status for r in results] == ["localized"] * 3
    for found, name in zip(results, NAMES, strict=True):
        rooms.assert_near(found.pose, truth[name].pose, 0.02, 0.5)


def test_results_are_written_in_order(scene, relative, tmp_path, capsys):
    out = tmp_path / "poses.jsonl"
    assert main(_command(scene, relative, "--out", out)) == 0
    results = read_results([out])
    assert [r.pano for r in results] == [str(scene / "images" / name) for name in NAMES]
    _assert_right(scene, results)
    assert len(out.read_text().splitlines()) == 3
    printed, err = capsys.readouterr()
    assert printed == ""
    assert [err.count(f"{name}: localized at") for name in NAMES] == [1, 1, 1]
    assert "3 photos together in" in err
    assert err.splitlines()[-1].endswith("s: 3 localized")
    before = out.read_bytes()
    assert main(_command(scene, relative, "--out", out)) == 0
    assert f"{out}: nothing is left to do" in capsys.readouterr().err
    assert out.read_bytes() == before
    assert main(_command(scene, relative, "--out", out, "--overwrite", "--quiet")) == 0
    assert capsys.readouterr() == ("", "")
    assert [r.pose.key for r in read_results([out])] == [r.pose.key for r in results]


def test_pictures_priors_and_steps_of_photos_together(scene, relative, tmp_path):
    """As of photos that come one by one."""
    truth = read_scene(scene).by_name[NAMES[0]].pose.center_world
    priors = tmp_path / "priors.csv"
    priors.write_text(f"name,x,y,radius\n{NAMES[0]},{truth[0]},{truth[1]},1.5\n")
    out = tmp_path / "poses.jsonl"
    trace = tmp_path / "trace.jsonl"
    folders = [tmp_path / "overlays", tmp_path / "masks"]
    for folder in folders:
        folder.mkdir()
    words = ["--overlay", folders[0], "--occlusion-mask", folders[1], "--priors", priors, "--trace", trace]
    assert main(_command(scene, relative, "--out", out, *words)) == 0
    results = read_results([out])
    _assert_right(scene, results)
    assert [r.settings["prior"]["radius"] for r in results] == [1.5, None, None]
    for folder in folders:
        assert sorted(path.stem for path in folder.iterdir()) == ["clean_0", "clean_1", "clean_2"]
    steps = [json.loads(line) for line in trace.read_text().splitlines()]
    assert {step["pano"].rpartition("/")[2] for step in steps} == set(NAMES)
    assert {step["step"] for step in steps} >= {"attempt", "refined", "judged"}


def test_results_go_to_stdout_and_the_code_says_that_some_are_not_localized(scene, relative, capsys):
    """Nothing is sure enough."""
    assert main(_command(scene, relative, "--min-confidence", 1.0 - 1e-15)) == 1
    printed, err = capsys.readouterr()
    lines = [json.loads(line) for line in printed.splitlines()]
    assert [line["pano"].rpartition("/")[2] for line in lines] == list(NAMES)
    assert "localized" not in {line["status"] for line in lines}
    assert "3 not localized" in err


@pytest.mark.parametrize(
    ("options", "code", "text"),
    [
        (["--walk"], 2, "--walk: not with --relative"),
        (["--jobs", "2"], 2, "--jobs: not with --relative: its photos are weighed as one camera"),
        (["--refine-focal"], 2, "--refine-focal: not with --relative"),
        (["--preset", "paper"], 2, "--relative: not an option of the preset paper"),
        (["--relative", "none.json"], 3, "none.json: cannot be"),
    ],
)
def test_options_that_do_not_go_together_are_refused(scene, relative, capsys, options, code, text):
    given = _command(scene, relative, *options)
    if "--preset" in options:
        given.remove("--gravity")
        given.remove("known")
    assert main(given) == code
    err = capsys.readouterr().err
    assert text in err
    assert err.count("\n") == 1


def test_a_file_without_the_photos_poses_is_refused_before_any_work(scene, relative, tmp_path, capsys):
    document = json.loads(relative.read_text())
    del document["frames"][1:]
    (tmp_path / "less.json").write_text(json.dumps(document))
    out = tmp_path / "out.jsonl"
    assert main(_command(scene, tmp_path / "less.json", "--out", out)) == 3
    assert "less.json: found 0 poses of" in capsys.readouterr().err
    assert not out.exists()
    assert main(_command(scene, relative, "--out", relative)) == 2
    assert "an input as the output" in capsys.readouterr().err


def _photos_and_poses(scene):
    truth = read_scene(scene).by_name
    poses = [truth[name].pose @ COMMON_FROM_WORLD.inverse() for name in NAMES]
    return [scene / "images" / name for name in NAMES], poses


def test_scan_localizes_many_together(scene):
    photos, poses = _photos_and_poses(scene)
    scan = piccolo.open_scan(scene / "cloud.ply", cache=scene.parent / "maps")  # as the command's
    results = scan.localize_bundle(iter(photos), poses, gravity="known")
    _assert_right(scene, results)
    assert all(piccolo.Result.from_json(r.to_json()).to_json() == r.to_json() for r in results)
    assert results[0].settings["gravity"] == "known"
    assert scan.localize_bundle([], []) == []


def test_positions_of_unknown_scale_are_scaled(scene):
    photos, poses = _photos_and_poses(scene)
    doubled = [Pose(pose.R_cam_from_world, 2.0 * pose.center_world) for pose in poses]
    of_any_scale = piccolo.RelativePoses(doubled, "unknown")
    scan = piccolo.open_scan(scene / "cloud.ply", cache=scene.parent / "maps")
    _assert_right(scene, scan.localize_bundle(photos, of_any_scale, gravity="known"))
    assert_input_error("`scale`: found 'feet'", piccolo.RelativePoses, doubled, "feet")


def test_relative_poses_that_are_none_are_refused(scene, tmp_path):
    photos, poses = _photos_and_poses(scene)
    scan = scan_of_room(7)
    for given, text in (
        (poses[:2], "`relative_poses`: found 2 of 3 photos, wanted one of each photo"),
        ([], "`relative_poses`: found 0 of 3 photos"),
        (3, "`relative_poses`: found 3, wanted a list, each Pose"),
        ([None] * 3, "`relative_poses`: found .*, wanted a list, each Pose"),
    ):
        assert_input_error(text, scan.localize_bundle, photos, given)
    (tmp_path / "bad.jpg").write_bytes(b"no picture")
    assert_input_error(r"bad\.jpg", scan.localize_bundle, [tmp_path / "bad.jpg"], poses[:1])
    guesses = [Photo(p, fov_deg=60.0, projection="pinhole", refine_focal=True) for p in photos]
    with pytest.raises(piccolo.InputError, match="found a focal length that is a guess, wanted a known one"):
        scan.localize_bundle(guesses, poses)
