"""Walks made by tools/make_room.py."""

import json
import sys

import av
import cv2
import numpy as np
import pytest

from piccolo.geometry.pose import rotation_from_quaternion_wxyz
from piccolo.geometry.rotations import OPTICAL_FROM_CAM
from piccolo.scene import read_scene
from research.synthetic import make_room as tool
from research.synthetic.walk_frames import BAD_KINDS


def written(folder, words):
    command = f"--rooms 2 --size 4 3 2.5 --points 9000 --width 128 --frame-rate 1 --quiet {words}"
    return tool.main(["--out", str(folder), *command.split()])


def test_command_line_writes_walks_that_read_back(tmp_path, capsys):
    folder = tmp_path / "walks"
    assert written(folder, "--walk 12 --walks 2 --bad-frames 0.3 --video --twins 0.5") == 0
    assert json.loads(capsys.readouterr().out)["queries"] == len(list((folder / "images").iterdir()))
    queries = read_scene(folder).queries
    assert {query.walk for query in queries} == {"clean_walk_0", "clean_walk_1"}
    first = [query for query in queries if query.walk == "clean_walk_0"]
    assert [query.time for query in first] == list(range(len(first)))
    assert {query.variant for query in first if query.is_answerable} == {"clean"}
    assert {query.variant for query in first if not query.is_answerable} <= set(BAD_KINDS)
    assert sum(not query.is_answerable for query in first) == round(0.3 * len(first))
    rows = np.loadtxt(folder / "clean_walk_0_poses.tum")
    assert len(rows) == len(first)
    for query, (time, *center, x, y, z, w) in zip(first, rows.tolist(), strict=True):
        assert (query.time, query.pose.center_world.tolist()) == (time, center)
        R_world_from_optical = rotation_from_quaternion_wxyz(np.array([w, x, y, z]))
        np.testing.assert_allclose(
            R_world_from_optical, (OPTICAL_FROM_CAM @ query.pose.R_cam_from_world).T, atol=1e-9
        )
    with av.open(folder / "clean_walk_0.mp4") as video:
        shown = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
        assert video.streams.video[0].average_rate == 1
    assert len(shown) == len(first)
    for query, rgb in zip(first, shown, strict=True):
        assert np.abs(cv2.imread(str(query.image))[..., ::-1].astype(float) - rgb).mean() < 6.0


def test_a_video_without_its_library_is_refused_before_anything_is_made(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    assert written(tmp_path / "r", "--walk 5 --video") == 3
    assert "--video: needs av" in (message := capsys.readouterr().err)
    assert "pip install 'piccolo-localize[video]'" in message
    assert not (tmp_path / "r").exists()


def test_a_building_without_a_walk_has_single_panoramas(tmp_path, capsys):
    assert written(tmp_path, "--storeys 2 --panoramas 2 --variants clean tilt --labels") == 0
    capsys.readouterr()
    queries = read_scene(tmp_path).queries
    assert [query.variant for query in queries] == ["clean", "clean", "tilt", "tilt"]
    assert all(query.walk is None and query.is_answerable and query.labels.is_file() for query in queries)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--points 10", "--points: found 10, wanted at least 1000 per room"),
        ("--width 127", "--width: found 127, wanted an even number of at least 128"),
        ("--size nan 3 2.4", "--size: found [nan, 3.0, 2.4], wanted 2.0 to 50.0 m in each direction"),
        ("--rooms 257", "--rooms: found 257, wanted 1 to 256"),
        ("--seed -1", "--seed: found -1, wanted at least 0"),
        ("--twins 0.5", "--twins: only with --storeys or --walk"),
        ("--storeys 2 --variants change", "--variants: found change, wanted others in a building"),
        ("--people 2", "--people: only with --walk"),
        ("--bad-frames 0.1", "--bad-frames: only with --walk"),
        ("--walk nan", "--walk: found nan, wanted up to 100000 m"),
        ("--walk 5 --labels", "--labels, --camera: not with --walk"),
        ("--walk 5 --variants tilt", "--variants: found tilt, wanted clean or photo in a walk"),
        ("--walk 5 --frame-rate 0", "--frame-rate: found 0.0, wanted 0.1 to 120 per second"),
        ("--walk 5 --bad-frames 2", "--bad-frames: found 2.0, wanted 0 to 1"),
        ("--walk 5 --people 21", "--people: found 21, wanted 0 to 20"),
        ("--walk 5 --twins 1", "--twins: found 1.0, wanted at least 0 and less than 1"),
        ("--storeys 5", "--storeys: found 5, wanted 1 to 4"),
        ("--storeys 3", "--rooms: found 2, wanted one per storey to 256"),
        ("--storeys 1 --size 2.5 4 3", "--size: found [2.5, 4.0, 3.0], wanted [2.6, 2.6, 2.3] to 50.0 m"),
        ("--storeys 2 --size 4 4 9", "--size: rooms of [4.0, 4.0, 9.0] m are too high for stairs"),
    ],
)
def test_command_line_refuses_in_one_line_before_anything_is_written(words, message, tmp_path, capsys):
    assert written(tmp_path / "r", words) == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert err.startswith(f"make_room.py: {message}")
    assert not (tmp_path / "r").exists()
