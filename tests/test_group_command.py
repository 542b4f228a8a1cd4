"""localize.py --together: photos of one place, in files; what is written, and refusals."""

import json
import math

import cv2
import numpy as np
import pytest
import rooms
from pictures import cut_pinhole
from test_group import SEED, TURN

from piccolo.cli.localize import main
from piccolo.photo import Photo
from piccolo.result_files import read_results

SIZE = (320, 240)
FOCAL = 0.5 * SIZE[0] / math.tan(math.radians(37.5))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Photos that overlap, one of them mirrored under another name, and a file that is no photo."""
    made = tmp_path_factory.mktemp("a phone")
    offsets = {k: np.random.default_rng(int(10 * k)).uniform(-0.2, 0.2, 3) for k in TURN}
    for k, (taken, _) in enumerate(rooms.take_photos(SEED, 360.0, offsets, 1024)):
        picture = cut_pinhole(taken.rgb, *SIZE, FOCAL)
        cv2.imwrite(str(made / f"{k}.png"), picture[..., ::-1])
        if k == 0:
            cv2.imwrite(str(made / "mirrored.png"), picture[:, ::-1, ::-1])
    (made / "broken.png").write_bytes(b"no photo")
    return made


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
        *options,
    ]
    return list(map(str, words))


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

    scan = rooms.scan(SEED)
    three = list(by_name.values())[:3]
    photos = [Photo(result.pano, focal_px=FOCAL) for result in three]
    for one, other in zip(scan.localize_together(photos, gravity="known"), three, strict=True):
        assert (one.status, one.confidence) == (other.status, other.confidence)
        assert one.best_pose == other.best_pose


@pytest.mark.parametrize("options", [["--walk"], ["--relative", "poses.txt"], ["--jobs", "2"], ["--labels"]])
def test_what_does_not_go_with_it_is_refused_with_the_reason(folder, options, capsys):
    assert main(_command(folder, "--together", *options)) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{options[0]}: not with " in line
    assert line.rpartition(": ")[2].count(" ") > 2, "why"
