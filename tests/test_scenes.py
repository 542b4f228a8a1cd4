"""Scenes on disk: written, read back, found, refused."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from refusals import assert_input_error, assert_refused

from piccolo.geometry.pose import Pose, exp_so3
from piccolo.system.errors import InputError
from research.scene import Query, find_scenes, read_scene, write_queries

pytestmark = pytest.mark.research

POSE = Pose(exp_so3(np.array([0.3, -1.2, 2.0])), np.array([500_123.25, -3.5, 1.125]))


def _written(folder, names=("images/a.jpg",)):
    folder.mkdir(parents=True, exist_ok=True)
    write_queries(folder, [Query(folder / name, "robot", POSE) for name in names])
    return folder


def test_a_scene_comes_back_as_it_was_written(tmp_path):
    frame = {"walk": "w", "time": 1.5, "is_answerable": False}
    queries = [
        Query(tmp_path / "images/a.jpg", "handheld", POSE),
        Query(tmp_path / "images/b c.png", "robot", POSE, tmp_path / "labels" / "b c.png", **frame),
    ]
    write_queries(tmp_path, queries, source="made up")
    scene = read_scene(tmp_path, "room")
    assert (scene.name, scene.cloud) == ("room", tmp_path / "cloud.ply")
    assert [scene.name_of(query) for query in scene.queries] == ["images/a.jpg", "images/b c.png"]
    for query, found in zip(queries, scene.queries, strict=True):
        assert replace(found, pose=POSE) == query
    for query in scene.queries:
        assert np.array_equal(query.pose.R_cam_from_world, POSE.R_cam_from_world)
        assert np.array_equal(query.pose.center_world, POSE.center_world)
    assert json.loads((tmp_path / "queries.json").read_text())["source"] == "made up"


def test_images_may_stand_elsewhere_and_beside_a_linked_folder(tmp_path):
    image = tmp_path / "raw" / "a.jpg"
    for folder in (tmp_path / "raw", tmp_path / "room", tmp_path / "deep" / "er"):
        folder.mkdir(parents=True)
    (tmp_path / "link").symlink_to(tmp_path / "deep" / "er")
    image.touch()
    for folder in (tmp_path / "room", tmp_path / "link"):
        write_queries(folder, [Query(image, "robot", POSE)])
        assert read_scene(folder).queries[0].image.samefile(image)
    scene = read_scene(tmp_path / "room")
    assert scene.name_of(scene.queries[0]) == "../raw/a.jpg"


def test_scenes_are_found_at_any_depth_and_named_by_it(tmp_path):
    for name in ("area_1/office 1", "area_1/hall", "area_2/hall"):
        _written(tmp_path / name)
    names = [scene.name for scene in find_scenes([tmp_path])]
    assert names == ["area_1/hall", "area_1/office 1", "area_2/hall"]
    alone = find_scenes([tmp_path / "area_1" / "hall" / "queries.json"])
    assert [(scene.name, scene.cloud.parent.name) for scene in alone] == [("hall", "hall")]
    with pytest.raises(InputError, match="found a second scene named hall"):
        find_scenes([tmp_path / "area_1", tmp_path / "area_2"])


def test_what_lacks_a_field_or_comes_twice_or_is_not_there_is_named(tmp_path):
    assert_input_error(r"found no queries\.json in or below it", find_scenes, [tmp_path])
    assert_refused(r"queries\.json: cannot be read \(No such file", read_scene, tmp_path)
    document = json.loads((_written(tmp_path, ("images/a.jpg", "images/b.jpg")) / "queries.json").read_text())
    del document["queries"][1]["variant"]
    (tmp_path / "queries.json").write_text(json.dumps(document))
    assert_refused(r"queries\[1\] without one of image, variant", read_scene, tmp_path)
    document["queries"][1] = document["queries"][0]
    (tmp_path / "queries.json").write_text(json.dumps(document))
    assert_refused("an image twice", read_scene, tmp_path)
    assert_input_error("found a file, wanted a folder with scenes", lambda: find_scenes([Path(__file__)]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"R_cam_from_world": np.diag([1.0, 1.0, -1.0]).tolist()}, "is no rotation"),
        ({"R_cam_from_world": [1, 0, 0]}, r"found float64 \(3,\) and float64 \(3,\), wanted arrays"),
        ({"center_world": [0, 0, 1e30]}, "found a position .*, wanted finite numbers"),
        ({"center_world": [0, 0, float("inf")]}, "found a position .*, wanted finite numbers"),
        ({"center_world": "here"}, "wanted a queries.json"),
        ({"image": 3}, r"queries\[0\] with an image, a variant or labels that are no plain text"),
        ({"image": None}, "no plain text"),
        ({"image": "a\0b.jpg"}, "no plain text"),
        ({"variant": "\ud800"}, "no plain text"),
        ({"center_world": [10**400, 0, 0]}, "wanted a queries.json"),
        ({"walk": None}, "a walk without a time"),
        ({"walk": 3}, "a walk that is no plain text"),
        ({"time": "soon"}, "a time that is no finite number"),
        ({"time": True}, "a time that is no finite number"),
        ({"answerable": 1}, "an answerable that is not true or false"),
    ],
)
def test_what_is_no_pose_is_refused(tmp_path, change, message):
    document = json.loads((_written(tmp_path) / "queries.json").read_text())
    document["queries"][0].update({"walk": "w", "time": 1.5, **change})
    (tmp_path / "queries.json").write_text(json.dumps(document))
    assert_refused(message, read_scene, tmp_path)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"queries": 1}', '{"queries": [1]}', "\xff", "[" * 2000])
def test_what_is_no_document_is_refused(tmp_path, text):
    (tmp_path / "queries.json").write_bytes(text.encode("latin-1"))
    assert_refused(r"queries\.json: found .*wanted a queries\.json with true poses", read_scene, tmp_path)
