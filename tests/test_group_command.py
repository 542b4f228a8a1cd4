"""localize.py --together: photos of one place, in files; what is written, and refusals."""

import json
import math

import cv2
import numpy as np
import pytest
import rooms
from groups import SEED, taken_photos
from pictures import encoded, write
from services import serving

from piccolo.camera import Mount
from piccolo.camera.model import pinhole
from piccolo.cli.localize import main
from piccolo.panorama.video import choose_distinct
from piccolo.result_files import read_results
from research.synthetic.walk_frames import writing_video
from research.synthetic.world import render_picture

TIER = "scene"

SIZE = (480, 360)
NEAR = (*(round(x, 1) for x in taken_photos()[0][1].center_world.tolist()), 1.0)  # [m] place and radius
FOCAL = 0.5 * SIZE[0] / math.tan(math.radians(37.5))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Photos that overlap, one of them mirrored under another name, and a file that is no photo."""
    made = tmp_path_factory.mktemp("a phone")
    camera = Mount(pinhole(*SIZE, FOCAL))
    for k, (_, pose) in enumerate(taken_photos()):
        picture = render_picture(camera, rooms.room(SEED)[0].rooms[0], pose, rooms.WORKERS)
        write(made / f"{k}.png", encoded(picture, ".png"))
        if k == 0:
            write(made / "mirrored.png", encoded(np.ascontiguousarray(picture[:, ::-1]), ".png"))
    (made / "broken.png").write_bytes(b"no photo")
    return made


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
        *NEAR,
        *options,
    ]
    return list(map(str, words))


@pytest.mark.process
def test_photos_of_a_folder_are_localized_together_and_named(folder, tmp_path, capsys):
    out = tmp_path / "poses.jsonl"
    trace = tmp_path / "trace.jsonl"
    assert main(_command(folder, "--together", "--out", out, "--trace", trace)) != 0, "one can't be read"
    by_name = {result.pano.rpartition("/")[2]: result for result in read_results([out])}
    assert list(by_name) == ["0.png", "1.png", "2.png", "broken.png", "mirrored.png"]
    assert [by_name[f"{k}.png"].status for k in range(3)] == ["localized"] * 3
    assert by_name["broken.png"].status == "unreadable"
    assert by_name["mirrored.png"].status == "not_localized"
    for k in range(3):
        others = by_name[f"{k}.png"].beside.photos
        assert [name.rpartition("/")[2] for name in others] == [f"{n}.png" for n in range(3) if n != k]
        assert by_name[f"{k}.png"].settings["together"]
    assert by_name["mirrored.png"].beside is None
    said = capsys.readouterr().err
    assert "5 photos together in" in said
    assert "3 of them by others too" in said
    steps = [json.loads(line) for line in trace.read_text().splitlines()]
    assert {step["pano"].rpartition("/")[2] for step in steps} == {"0.png", "1.png", "2.png", "mirrored.png"}

    lines = [untimed_line(result.to_json()) for result in by_name.values()]
    pictures = {name: (folder / name).read_bytes() for name in by_name}
    near = {"near": NEAR[:3], "radius": NEAR[3]}
    asked = {"photo": {"focal_px": FOCAL}, "prior": near, "gravity": "known", "together": True}
    with serving("--cloud", rooms.map_path(SEED), "--jobs", "1") as client:
        status, _, body = client.post_all("/localize", pictures, asked)
        assert client.post_all("/localize", pictures, asked | {"together": "yes"})[0] == 400
    assert status == 200
    for answer, line in zip(map(untimed_line, body.decode().splitlines()), lines, strict=True):
        assert answer["pano"] == line["pano"].rpartition("/")[2]
        assert answer["error"] == (line["error"] and line["error"].replace(f"{folder}/", ""))
        assert (answer["beside"] is None) == (line["beside"] is None)
        own = {"pano", "error", "beside"}
        assert {k: v for k, v in answer.items() if k not in own} == {
            k: v for k, v in line.items() if k not in own
        }


@pytest.mark.process
def test_a_batch_looks_at_photos_that_are_not_sure_together(folder, tmp_path, capsys):
    """One of three is localized alone; the service says the same, and a second run has nothing to do."""
    out = tmp_path / "poses.jsonl"
    names = [folder / f"{name}.png" for name in range(3)]
    words = _command(folder)
    begin = words.index("--pano")
    words[begin + 1 : begin + 2] = list(map(str, names))
    main([*words, "--out", str(out)])
    lines = [untimed_line(line) for line in out.read_text().splitlines()]
    assert [line["status"] for line in lines] == ["localized"] * 3
    assert lines[2]["beside"] is None, "it is localized alone"
    beside = [[name.rpartition("/")[2] for name in line["beside"]["photos"]] for line in lines[:2]]
    assert sorted(beside[0]) == ["1.png", "2.png"], "together"
    assert beside[1] == ["2.png"], "beside the one that is sure"
    assert [line["beside"]["is_together"] for line in lines[:2]] == [True, False]
    capsys.readouterr()
    before = out.read_bytes()
    main([*words, "--out", str(out)])
    assert "nothing is left to do" in capsys.readouterr().err
    assert out.read_bytes() == before
    pictures = {name.name: name.read_bytes() for name in names}
    with serving("--cloud", rooms.map_path(SEED), "--jobs", "1") as client:
        near = {"near": NEAR[:3], "radius": NEAR[3]}
        asked = {"photo": {"focal_px": FOCAL}, "prior": near, "gravity": "known"}
        _, _, body = client.post_all("/localize", pictures, asked)
    for answer, line in zip(map(untimed_line, body.decode().splitlines()), lines, strict=True):
        assert answer | {"pano": line["pano"], "beside": line["beside"]} == line
        assert (answer["beside"] or {}).get("is_together") == (line["beside"] or {}).get("is_together")


def test_a_film_of_one_place_is_its_frames_together(folder, tmp_path, capsys):
    """A camera shows each of three views for half a second."""
    film = tmp_path / "film.mp4"
    with writing_video(film, 2.0, SIZE) as add:
        for k in range(3):
            add(cv2.imread(str(folder / f"{k}.png"))[..., ::-1])
    words = _command(folder, "--together", "--overwrite", "--out", tmp_path / "poses.jsonl")
    begin = words.index("--pano")
    words[begin : begin + 2] = ["--video", str(film)]
    main(words)
    results = read_results([tmp_path / "poses.jsonl"])
    assert [one.pano for one in results] == [f"{film}#t={time}" for time in ("0.000", "0.500", "1.000")]
    assert [one.status for one in results].count("localized") >= 2
    named = {name for one in results if one.beside for name in one.beside.photos}
    assert named
    assert named <= {one.pano for one in results}
    assert "3 photos together in" in capsys.readouterr().err
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


@pytest.mark.parametrize("options", [["--walk"], ["--relative", "poses.txt"], ["--jobs", "2"], ["--labels"]])
def test_what_does_not_go_with_it_is_refused_with_the_reason(folder, options, capsys):
    assert main(_command(folder, "--together", *options)) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{options[0]}: not with " in line
    assert line.rpartition(": ")[2].count(" ") > 2, "why"
