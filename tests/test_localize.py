"""The command line, in processes of its own where signals and streams matter."""

import contextlib
import json
import os
import pty
import re
import signal
import subprocess
import termios
from dataclasses import replace

import cv2
import numpy as np
import pytest
import rooms
from batches import command_of, start_localize
from results import RESULT
from rooms import errors, query

from piccolo.cli import execution, localize, prepare_map
from piccolo.judge.belief import make_belief
from piccolo.judge.reasons import Reason
from piccolo.judge.result import Result
from piccolo.judge.result_parts import FocalLength
from piccolo.photo.camera import Mount
from piccolo.photo.camera.model import pinhole
from research.scene import read_scene

TIER = "scene"

PAPER = ["--preset", "paper", "num_translations=30", "num_iterations=60", "max_points=30000"]


def _arguments(scene, *more):
    pano = str(scene / "images" / "clean_0.jpg")
    return ["--cloud", str(scene / "cloud.ply"), "--pano", pano, "--cache", str(scene.parent / "maps"), *more]


def _truth(scene):
    return read_scene(scene).by_name["clean_0.jpg"].pose


def test_pose_on_stdout_and_a_summary_on_stderr(scene, capsys):
    assert localize.main(_arguments(scene)) == 0
    out, err = capsys.readouterr()
    result = Result.from_json(out)
    rooms.assert_near(result.pose, _truth(scene), 0.03, 0.5)
    assert set(result.seconds) == {"read", "search", "refine"}  # a clear photo: no features are matched
    assert "localized at" in err
    assert out.count("\n") == 1


def test_map_is_cached_prepared_and_read_back_to_the_same_bits(scene, tmp_path, capsys):
    built = str(tmp_path / "scan.map")
    assert prepare_map.main(["--cloud", str(scene / "cloud.ply"), "--out", built, "--quiet"]) == 0
    assert json.loads(capsys.readouterr().out)["candidates"] > 50
    cached = ["--cache", str(tmp_path)]
    poses = set()
    for more in (cached, cached, ["--cloud", built]):
        assert localize.main(_arguments(scene, "--quiet", *more)) == 0
        poses.add(str(json.loads(capsys.readouterr().out)["center_world"]))
    assert len(poses) == 1
    assert len(list(tmp_path.glob("piccolo-maps/*.piccolo-map"))) == 1


def test_prior_narrows_the_search_and_stands_in_the_result(scene, capsys):
    x, y, z = _truth(scene).center_world
    near = ["--near", f"{x + 0.4:.2f}", f"{y:.2f}", f"{z:.2f}", "1", "--height", "0.5", "2"]
    assert localize.main(_arguments(scene, "--quiet", *near)) == 0
    result = Result.from_json(capsys.readouterr().out)
    assert errors(result.pose, _truth(scene))[0] < 0.03
    assert result.settings["prior"]["radius"] == 1.0
    assert localize.main(_arguments(scene, "--quiet", "--near", "900", "0", "0", "1")) == 1
    nothing = json.loads(capsys.readouterr().out)
    assert nothing["center_world"] is None
    assert "`near` allows 0; the nearest to `near` is" in nothing["warnings"][-1]


def test_a_tilted_photo_is_clear_by_its_gravity_in_a_table(scene, tmp_path, capsys):
    taken = query(7, "tilt")
    photo = tmp_path / "tilted.png"
    cv2.imwrite(str(photo), taken.rgb[..., ::-1])
    down = taken.pose.R_cam_from_world @ [0.0, 0.0, -9.81]
    table = tmp_path / "priors.csv"
    table.write_text(f"name,gravity_x,gravity_y,gravity_z\ntilted.png,{down[0]},{down[1]},{down[2]}\n")
    assert localize.main(_arguments(scene, "--pano", str(photo), "--priors", str(table))) == 0
    result = Result.from_json(capsys.readouterr().out)
    assert errors(result.pose, taken.pose)[0] < 0.03
    assert set(result.seconds) == {"read", "search", "refine"}  # as upright: no features are matched
    assert result.settings["panorama"]["gravity_vector"] == pytest.approx(down.tolist())


def test_files_are_written_and_look_right(scene, tmp_path, capsys):
    out, overlay, occlusion = (tmp_path / name for name in ("pose.json", "overlay.png", "occlusion.png"))
    pictures = ["--overlay", str(overlay), "--occlusion-mask", str(occlusion)]
    assert localize.main(_arguments(scene, "--out", str(out), *pictures, "--quiet")) == 0
    assert capsys.readouterr() == ("", "")
    assert Result.from_json(out.read_text()).status == "localized"
    mask = cv2.imread(str(occlusion), cv2.IMREAD_UNCHANGED)
    assert mask.shape == cv2.imread(str(scene / "images" / "clean_0.jpg")).shape[:2]
    assert np.mean(mask == 255) < 0.05
    photo, cloud, checkerboard = np.split(cv2.imread(str(overlay)).astype(float), 3)
    assert photo.shape == (512, 1024, 3)
    assert np.abs(photo - cloud).mean() < 20
    tile = np.s_[128:192, 0:64], np.s_[128:192, 64:128]
    assert (checkerboard[tile[0]] == photo[tile[0]]).all()
    assert (checkerboard[tile[1]] == cloud[tile[1]]).all()


def test_a_pose_must_be_as_exact_as_the_user_says(scene, tmp_path, capsys):
    """The place is certain all the same: a line says which accuracy would accept the pose."""
    out = tmp_path / "poses.jsonl"
    assert localize.main(_arguments(scene, "--out", str(out), "--accuracy", "0.0001")) == 1
    told = capsys.readouterr().err
    found = Result.from_json(out.read_text())
    assert (found.status, found.best_guess is None) == ("not_localized", False)
    assert found.place_probability > 0.9
    assert found.confidence < 0.1
    assert found.hint.startswith("the place is certain, the position only to ")
    assert found.hint.replace("`accuracy`", "--accuracy") in told
    assert "look at the --overlay" not in told
    assert localize.main(_arguments(scene, "--out", str(out))) == 3
    assert "made with --accuracy 0.0001 5, now --accuracy 0.1 5" in capsys.readouterr().err


WANTS_MORE = {"accuracy": {"metres": 0.001, "degrees": 5.0}, "min_confidence": 0.9}
GUESSED = FocalLength(700.0, 9.0, 804.0, 160.8)


@pytest.mark.parametrize(
    ("change", "advice"),
    [
        ({"status": "localized"}, []),
        ({"status": "ambiguous", "belief": make_belief([0.05])}, ["  to decide, give --near or --heading"]),
        ({"belief": make_belief([0.1])}, ["  to be sure, look at the --overlay, give --near"]),
        (
            {"status": "ambiguous", "belief": make_belief([0.5]), "focal_length": GUESSED},
            ["  if other photos of this"],
        ),
        ({"belief": make_belief([0.09])}, ["  it fits nowhere well: another scan, or bare walls?"]),
        (
            {"belief": make_belief([0.09]), "cameras": (Mount(pinhole(4, 3, 4.0)),)},
            ["  it fits nowhere .* focal length"],
        ),
        (
            {"confidence": 0.0, "belief": make_belief([0.9]).rule_out(Reason.MIRRORED)},
            [],
        ),  # a warning says why
        ({"belief": make_belief([0.5]), "settings": {"preset": "paper"}}, []),
        (
            {"belief": make_belief([0.99]), "settings": WANTS_MORE},
            ["  the place is certain, .*: --accuracy 0.0"],
        ),
    ],
)
def test_a_doubtful_result_says_what_to_do(change, advice):
    found = execution.advise(replace(RESULT, **{"status": "not_localized", **change}))
    assert len(found) == len(advice)
    assert all(map(re.match, advice, found))


USAGE = [
    ("--threads 0", "--threads: found 0, wanted at least 1"),
    ("--units -1", "--units: found -1.0"),
    ("--preset odd", "--preset: found 'odd', wanted default or paper"),
    ("--preset paper num_translations=0", "num_translations: found 0"),
    ("--preset default num_translations=9", "found 'num_translations=9', wanted NAME"),
    ("--preset paper solver=both", "found 'solver=both', wanted one of gauss-newton, lbfgs, adam"),
    ("--preset paper use_visibility=no", "found 'use_visibility=no', wanted one of true, fal"),
    ("--preset paper max_points=many", "found 'max_points=many', wanted int"),
    ("--preset paper --near 0 0 0 1", "--near: not an option of the preset paper"),
    ("--preset paper --gravity-vector 0 0 -1", "--gravity-vector: not an option of the preset paper"),
    ("--preset paper --up -y", "--up: not an option of the preset paper"),
    ("--preset paper --refine-focal", "--refine-focal: not an option of the preset paper"),
    ("--preset paper --gravity auto", "gravity: found auto"),
    ("--height 2 1", "--height: found [2.0, 1.0]"),
    ("--gravity-vector 0 0 0", "--gravity-vector: found (0.0, 0.0, 0.0), wanted three finite numbers"),
    ("--preset default num_yaws=1000000", "num_yaws: found 1000000, wanted 1 to 3600"),
    ("--near nan 0 0 1", "found nan or inf, wanted finite numbers"),
    ("--overlay x.png --pano a b", "found 2 photos, wanted one photo or a folder"),
    ("--occlusion-mask x.jpg", "--occlusion-mask x.jpg: wanted a name that ends with .png"),
    ("--occlusion-mask x.png --overlay x.png", "the same output as --overlay"),
    ("--overwrite", "--overwrite: only with --out"),
]
FILES = [
    ("--pano @no-such.txt", "no-such.txt"),
    ("--priors no-such.csv", "no-such.csv"),
    ("--cloud no-such.ply", "no-such.ply"),
    ("--out /no-such/pose.json", "found no folder /no-such"),
]


@pytest.mark.parametrize(("code", "cases"), [(2, USAGE), (3, FILES)])
def test_bad_input_is_one_line_and_a_code(scene, code, cases, capsys):
    for options, message in cases:
        assert localize.main(_arguments(scene, "--quiet", *options.split())) == code, options
        out, err = capsys.readouterr()
        assert (out, err.count("\n")) == ("", 1)
        assert err.startswith("localize.py: ")
        assert message in err


def test_usage_and_version(capsys):
    for words, code in (("--version", 0), ("--help", 0), ("", 2), ("--cloud a --odd", 2)):
        with pytest.raises(SystemExit) as stop:
            localize.main(words.split())
        assert stop.value.code == code
    text = capsys.readouterr().out
    assert len(re.findall("^  -", text, flags=re.MULTILINE)) <= 50


@pytest.mark.process
def test_a_signal_leaves_nothing_half_written(scene, tmp_path):
    arguments = _arguments(scene, "--out", str(tmp_path / "pose.json"), *PAPER, "num_translations=5000")
    terminal, stderr = pty.openpty()
    termios.tcsetwinsize(terminal, (24, 80))
    with subprocess.Popen(command_of("localize.py", *arguments), stderr=stderr, cwd=tmp_path) as process:
        os.close(stderr)
        err = os.read(terminal, 1)  # the bar of the search, which a terminal gets: imports are over
        process.send_signal(signal.SIGTERM)
        with contextlib.suppress(OSError):  # the end
            while part := os.read(terminal, 4096):
                err += part
    os.close(terminal)
    assert process.returncode == 143
    assert b"Traceback" not in err
    assert b"localize.py: ended by SIGTERM after 0 results" in err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.process
def test_closed_pipe_is_no_error_message(scene):
    with start_localize(_arguments(scene, "--quiet"), stdout=subprocess.PIPE) as process:
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 141


@pytest.mark.process
def test_first_use_is_announced_and_two_processes_may_share_it(scene, tmp_path):
    """The first one waits, where it begins to compile, until the second has come as far.

    Each has one core, so that no helper compiles what neither needs.
    """
    options = {"env": {**os.environ, "XDG_CACHE_HOME": str(tmp_path)}, "stdout": subprocess.PIPE}
    arguments = _arguments(scene, *PAPER)
    cores = sorted(os.sched_getaffinity(0))

    def start(core):
        return start_localize(arguments, **options, preexec_fn=lambda: os.sched_setaffinity(0, {core}))

    first, second = map(start, (cores[0], cores[-1]))
    try:
        assert any("compiling kernels (only once)" in line for line in first.stderr)
        first.send_signal(signal.SIGSTOP)
        assert any("compiling kernels (only once)" in line for line in second.stderr)
    finally:
        first.send_signal(signal.SIGCONT)
    poses = [json.loads(process.communicate(timeout=120)[0])["center_world"] for process in (first, second)]
    assert poses[0] == poses[1]
    out, err = start_localize(arguments, **options).communicate(timeout=60)
    assert "compiling" not in err
    assert json.loads(out)["center_world"] == poses[0]
