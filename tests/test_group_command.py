"""localize.py --together: photos of one place, in files; what is written, and refusals."""

import json
import math
import shutil

import cv2
import numpy as np
import pytest
import rooms
from groups import SEED, true_places
from pictures import encoded, write
from services import serving

from piccolo.api.result_files import read_results
from piccolo.cli.localize import main
from piccolo.geometry.pose import Pose, yaw_rotation
from piccolo.photo.camera import Mount
from piccolo.photo.camera.model import pinhole
from piccolo.photo.panorama.video import choose_distinct
from research.synthetic.walk_frames import writing_video
from research.synthetic.world import render_picture

TIER = "scene"

SIZE = (400, 300)
FOCAL = 0.5 * SIZE[0] / math.tan(math.radians(37.5))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Photos that overlap."""
    made = tmp_path_factory.mktemp("a phone")
    for k, pose in enumerate(true_places()):
        _take(made / f"{k}.png", pose)
    return made


def _near_first():
    """Place and radius [m] around the first photo."""
    return (*(round(x, 1) for x in true_places()[0].center_world.tolist()), 1.0)


def _take(path, pose):
    """Write a photo of the room."""
    camera = Mount(pinhole(*SIZE, FOCAL))
    write(path, encoded(render_picture(camera, rooms.room(SEED)[0].rooms[0], pose, rooms.WORKERS), ".png"))


def untimed_line(text):
    """A result as a dictionary, but for its times."""
    return json.loads(text) | {"seconds": None}


def _command(folder, *options):
    words = [
        "--cloud",
        rooms.map_path(SEED),
        "--pano",
        folder,
        "--focal",
        FOCAL,
        "--gravity",
        "known",
        "--near",
        *_near_first(),
        *options,
    ]
    return list(map(str, words))


@pytest.fixture(scope="module")
def client():
    with serving("--cloud", rooms.map_path(SEED), "--jobs", "1") as client:
        yield client


@pytest.fixture(scope="module")
def panoramas(tmp_path_factory):
    """Two panoramas, which cost little, and between them a file that is no photo."""
    made = tmp_path_factory.mktemp("panoramas")
    offsets = {k: np.array([0.2 * k, 0.1, 0.0]) for k in range(2)}
    for k, (panorama, _) in enumerate(rooms.take_photos(SEED, 360.0, offsets)):
        write(made / f"{2 * k}.png", encoded(panorama.rgb, ".png"))
    (made / "1.png").write_bytes(b"no photo")
    return made


@pytest.mark.process
def test_the_service_localizes_photos_together_as_the_command_does(client, panoramas, tmp_path):
    out = tmp_path / "poses.jsonl"
    words = ["--cloud", str(rooms.map_path(SEED)), "--gravity", "known", "--mask-nadir", "20", "--quiet"]
    given = ["--near", *map(str, _near_first()), "--pano", str(panoramas), "--together"]
    assert main([*words, *given, "--out", str(out)]) != 0, "one can't be read"
    lines = list(map(untimed_line, out.read_text().splitlines()))
    assert [line["status"] for line in lines] == ["localized", "unreadable", "localized"]
    assert all(line["settings"]["together"] for line in lines[::2])
    pictures = {path.name: path.read_bytes() for path in sorted(panoramas.iterdir())}
    *center, radius = _near_first()
    near = {"near": center, "radius": radius}
    asked = {"photo": {"mask_nadir_deg": 20}, "prior": near, "gravity": "known", "together": True}
    status, _, body = client.post_all("/localize", pictures, asked)
    assert client.post_all("/localize", pictures, asked | {"together": "yes"})[0] == 400
    assert status == 200
    for answer, line in zip(map(untimed_line, body.decode().splitlines()), lines, strict=True):
        assert answer["pano"] == line["pano"].rpartition("/")[2]
        assert answer["error"] == (line["error"] and line["error"].replace(f"{panoramas}/", ""))
        assert (answer["beside"] is None) == (line["beside"] is None)
        own = {"pano", "error", "beside"}
        assert {k: v for k, v in answer.items() if k not in own} == {
            k: v for k, v in line.items() if k not in own
        }


def test_a_batch_looks_at_photos_that_are_not_sure_together(folder, tmp_path, capsys):
    """One of three is localized alone; a second run has nothing to do.

    test_three_doors.py shows that the service says the same.
    """
    out = tmp_path / "poses.jsonl"
    first = true_places()[0]
    sure = Pose(first.R_cam_from_world @ yaw_rotation(math.radians(35.0)), first.center_world)
    photos = tmp_path / "photos"
    photos.mkdir()
    for name in ("0.png", "1.png"):
        shutil.copy(folder / name, photos)
    _take(photos / "2.png", sure)
    names = [photos / f"{name}.png" for name in range(3)]
    words = _command(folder)
    begin = words.index("--pano")
    words[begin + 1 : begin + 2] = list(map(str, names))
    main([*words, "--out", str(out)])
    lines = [untimed_line(line) for line in out.read_text().splitlines()]
    assert [line["status"] for line in lines] == ["localized"] * 3
    assert lines[2]["beside"] is None, "it is localized alone"
    beside = [[name.rpartition("/")[2] for name in line["beside"]["photos"]] for line in lines[:2]]
    assert [sorted(names) for names in beside] == [["1.png", "2.png"], ["0.png", "2.png"]]
    assert all(line["beside"]["is_together"] for line in lines[:2])
    capsys.readouterr()
    before = out.read_bytes()
    main([*words, "--out", str(out)])
    assert "nothing is left to do" in capsys.readouterr().err
    assert out.read_bytes() == before


def test_a_film_of_one_place_is_its_frames_together(folder, tmp_path, capsys):
    """A camera shows each of three views for half a second."""
    film = tmp_path / "film.mp4"
    out = tmp_path / "poses.jsonl"
    trace = tmp_path / "trace.jsonl"
    with writing_video(film, 2.0, SIZE) as add:
        for k in range(3):
            add(cv2.imread(str(folder / f"{k}.png"))[..., ::-1])
    words = _command(folder, "--together", "--overwrite", "--out", out)
    begin = words.index("--pano")
    words[begin : begin + 2] = ["--video", str(film)]
    main([*words, "--trace", str(trace)])
    results = read_results([out])
    frames = [f"{film}#t={time}" for time in ("0.000", "0.500", "1.000")]
    assert [one.pano for one in results] == frames
    assert [one.status for one in results] == ["localized"] * 3
    for one in results:
        assert list(one.beside.photos) == [name for name in frames if name != one.pano]
        assert one.settings["together"]
    steps = [json.loads(line) for line in trace.read_text().splitlines()]
    assert {step["pano"] for step in steps} == set(frames)
    said = capsys.readouterr().err
    assert "3 photos together in" in said
    assert "3 of them by others too" in said
    assert main([*words, "--max-speed", "2"]) == 2
    assert "--max-speed: not with --together: its photos are in no order" in capsys.readouterr().err


def test_of_many_frames_those_are_taken_between_which_the_picture_changes(tmp_path):
    """A camera stands still, turns, and stands still again."""
    rng = np.random.default_rng(0)
    wall = cv2.resize(rng.integers(0, 255, (30, 160), np.uint8), (2560, 480))
    at = [0] * 10 + [200 * k for k in range(10)] + [1800] * 10
    paths = [tmp_path / f"{k:02d}.jpg" for k in range(len(at))]
    for path, left in zip(paths, at, strict=True):
        cv2.imwrite(str(path), wall[:, left : left + 640])
    assert choose_distinct(paths, 30) == list(range(30))
    chosen = choose_distinct(paths, 8)
    assert len(chosen) == 8
    assert (at[chosen[0]], at[chosen[-1]]) == (0, 1800)
    assert [at[k] for k in chosen] == sorted({at[k] for k in chosen}), "no view twice"


@pytest.mark.parametrize("options", [["--walk"], ["--relative", "poses.txt"], ["--jobs", "2"]])
def test_what_does_not_go_with_it_is_refused_with_the_reason(folder, options, capsys):
    assert main(_command(folder, "--together", *options)) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{options[0]}: not with " in line
    assert line.rpartition(": ")[2].count(" ") > 2, "why"
