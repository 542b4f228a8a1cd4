"""The options that say what a cloud is, what all commands share, and progress."""

import ctypes
import importlib.metadata
import json
import runpy
import signal
import sys
import time
from importlib import import_module
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from batches import ROOT
from rooms import errors, query, room

from piccolo.cli import localize, photo_run, prepare_map, terminal
from piccolo.cli.command import UsageError, checking_options, command, new_parser, parse
from piccolo.cli.options import add_arguments
from piccolo.cli.settings_given import cloud_settings_from
from piccolo.cloud.cloud_settings import BY_FILE, WITHOUT_COLORS, CloudSettings
from piccolo.doors import COMMANDS
from piccolo.judge.result import Result
from piccolo.system.errors import InputError, ResourceError, import_optional

TIER = "scene"

SCRIPTS = [ROOT / "localize.py", *sorted((ROOT / "tools").glob("[a-z]*.py"))]

ONE = ["--cloud", "a.ply", "--pano", "b.jpg"]


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A room in two scans, in feet and with y up, and a panorama."""
    folder = tmp_path_factory.mktemp("scene")
    cloud = room(1)[1]
    x, y, z = (cloud.points + cloud.origin_world).T / 0.3048
    rows = np.column_stack([x, z, -y, cloud.colors])
    for k in range(2):
        np.savetxt(folder / f"{k}.xyz", rows[k::2], fmt=["%.5f"] * 3 + ["%d"] * 3)
    cv2.imwrite(str(folder / "pano.png"), query(1).rgb[..., ::-1])
    return folder


def _parse(*options):
    parser = new_parser("localize", "", "")
    add_arguments(parser)
    return parse(parser, [*ONE, *options])


def _cloud(scene, *order):
    return ["--cloud", *(str(scene / f"{k}.xyz") for k in order), "--units", "ft", "--up", "y"]


def test_options_of_a_cloud(capsys):
    for options, expected in (
        ("", BY_FILE),
        ("--units mm", CloudSettings(scale=0.001)),
        ("--units 0.5 --up x", CloudSettings(scale=0.5, up="x")),
        ("--up -z --ignore-colors", CloudSettings(up="-z", channels=WITHOUT_COLORS)),
        ("--up=-y", CloudSettings(up="-y")),
    ):
        assert cloud_settings_from(_parse(*options.split())) == expected
    for options in ("--units yd", "--up w", "--up -q", "--up"):
        with pytest.raises(SystemExit, match="2"):
            _parse(*options.split())
        assert "usage" in capsys.readouterr().err


def test_several_files_in_feet_with_y_up(scene, tmp_path, capsys):
    pano = ["--pano", str(scene / "pano.png"), "--quiet"]
    cache = ["--cache", str(tmp_path)]
    results = []
    for order in ((0, 1), (1, 0)):
        assert localize.main([*_cloud(scene, *order), *pano, *cache]) == 0
        results.append(Result.from_json(capsys.readouterr().out))
    assert results[0].cloud == (str(scene / "0.xyz"), str(scene / "1.xyz"))
    assert len(list(tmp_path.glob("*/*.piccolo-map"))) == 1  # the order of the files matters not
    turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    found, truth = results[0].pose, query(1).pose
    assert np.linalg.norm(turn.T @ found.center_world - truth.center_world) < 0.01
    np.testing.assert_allclose(found.R_cam_from_world @ turn, truth.R_cam_from_world, atol=0.003)
    assert errors(results[1].pose, found) == (0.0, 0.0)


def test_a_map_is_prepared_of_several_files_and_stands_alone(scene, tmp_path, capsys):
    built = str(tmp_path / "scan.map")
    assert prepare_map.main([*_cloud(scene, 1, 0), "--out", built, "--quiet"]) == 0
    assert json.loads(capsys.readouterr().out)["candidates"] > 50
    pano = ["--pano", str(scene / "pano.png"), "--quiet"]
    assert localize.main(["--cloud", built, *pano]) == 0
    assert Result.from_json(capsys.readouterr().out).status == "localized"
    for options in (["--units", "ft"], ["--up", "-y"], [str(scene / "0.xyz")]):
        assert localize.main(["--cloud", built, *options, *pano]) == 3
        assert "found a prepared map, wanted it alone, without options" in capsys.readouterr().err


def test_no_file_of_a_cloud_is_overwritten(scene, capsys):
    second = scene / "1.xyz"
    before = second.read_bytes()
    assert localize.main([*_cloud(scene, 0, 1), "--pano", "b.jpg", "--out", str(second)]) == 2
    assert "an input as the output" in capsys.readouterr().err
    assert prepare_map.main([*_cloud(scene, 0, 1), "--out", str(second)]) == 2
    assert second.read_bytes() == before


@pytest.mark.parametrize("quiet", [False, True])
def test_a_warning_is_written_once_whenever_it_comes(monkeypatch, capsys, quiet):
    def opened(localizer, workers):
        workers.warn("early")
        prepared = SimpleNamespace(scan_sha256="")
        return SimpleNamespace(warnings=("early", "set `up` to -y"), prepared=prepared)

    monkeypatch.setattr(photo_run.Localizer, "open_scan", opened)
    run = photo_run.prepare_run(_parse(*["--quiet"] * quiet))
    with terminal.showing_log(quiet):
        photo_run.open_scan_of_run(run, run.localizer, 1)
    assert capsys.readouterr().err == ("" if quiet else "warning: early\nwarning: set --up to -y\n")


@pytest.mark.parametrize(
    ("error", "code", "text"),
    [
        (UsageError("--a: wrong"), 2, "--a: wrong"),
        (InputError("a: wanted a map of tools/prepare_map.py"), 3, "a: wanted a map of piccolo-prepare-map"),
        (FileNotFoundError(2, "No such file", "b.ply"), 3, "b.ply: cannot be used (No such file)"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (ZeroDivisionError("c"), 4, "internal error: ZeroDivisionError('c'); --debug shows where"),
    ],
)
def test_errors_have_codes_and_name_the_command_as_it_was_started(monkeypatch, capsys, error, code, text):
    def fail(arguments):
        raise error

    monkeypatch.setattr("sys.argv", ["/usr/bin/piccolo-report"])
    assert command("report.py", "", "", lambda parser: None)(fail)([]) == code
    err = capsys.readouterr().err
    assert err.startswith(f"piccolo-report: {text}")
    assert err.count("\n") == 1
    assert "Traceback" not in err
    command("report.py", "", "", lambda parser: None)(fail)(["--debug"])
    assert "Traceback" in capsys.readouterr().err
    with pytest.raises(UsageError), checking_options():
        raise InputError("in an option")


@pytest.mark.parametrize(
    ("number", "code", "text"), [(signal.SIGINT, 130, "interrupted"), (signal.SIGTERM, 143, "terminated")]
)
@pytest.mark.parametrize("fails", [False, True])
def test_a_signal_during_a_callback_from_c_is_not_lost(capsys, number, code, text, fails):
    callback = ctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(number))  # its exception goes nowhere

    def compiled(arguments):
        callback()
        if fails:
            raise RuntimeError("no compiled object yet")
        time.sleep(20.0)

    assert command("report.py", "", "", lambda parser: None)(compiled)([]) == code
    assert capsys.readouterr().err == f"report.py: {text}\n"


SLOW = """
import signal, sys
try:
    signal.raise_signal(signal.{number})
    done = True
except BaseException as error:
    raise {made}("no backend") from None
"""


@pytest.mark.parametrize(
    ("number", "code", "text"), [("SIGINT", 130, "interrupted"), ("SIGTERM", 143, "terminated")]
)
@pytest.mark.parametrize("made", ["RuntimeError", "ImportError"])
@pytest.mark.parametrize("is_optional", [True, False])
def test_a_signal_while_a_library_is_imported_is_no_error_of_it(
    tmp_path, monkeypatch, capsys, number, code, text, made, is_optional
):
    """As pycolmap, whose compiled part can't be loaded then, and modules of C that ask for NumPy."""
    (tmp_path / "slow_library.py").write_text(SLOW.format(number=number, made=made))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "slow_library", raising=False)

    def run(arguments):
        import_optional("this", "slow_library") if is_optional else import_module("slow_library")
        return 0

    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    assert command("report.py", "", "", lambda parser: None)(run)([]) == code
    assert capsys.readouterr().err == f"report.py: {text}\n"
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before
    assert ("slow_library" in sys.modules) == is_optional  # whole, where the signal has waited


def test_a_library_that_can_not_be_imported_is_one_line_whatever_it_raises(tmp_path, monkeypatch):
    (tmp_path / "broken_library.py").write_text("raise OSError('no such\\nsymbol')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ResourceError, match=r"^a: needs broken_library, .* imported \(no such symbol\)"):
        import_optional("a", "broken_library")


def _help(monkeypatch, capsys, program, start):
    monkeypatch.setattr("sys.argv", [f"bin/{program}", "--help"])
    with pytest.raises(SystemExit):
        start()
    text = capsys.readouterr().out
    assert text.startswith(f"usage: {program} ")
    assert "4 internal error" in text
    return text


@pytest.mark.parametrize("name", COMMANDS)
def test_help_of_an_installed_command_names_no_scripts(monkeypatch, capsys, name):
    program = f"piccolo-{name.replace('_', '-')}"
    text = _help(monkeypatch, capsys, program, import_module(COMMANDS[name]).main)
    assert "\n  piccolo-" in text
    assert ".py" not in text


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.name)
def test_help_of_a_script_names_no_installed_commands(monkeypatch, capsys, script):
    monkeypatch.syspath_prepend(script.parent)
    text = _help(monkeypatch, capsys, script.name, lambda: runpy.run_path(str(script), run_name="__main__"))
    assert "  python " in text
    assert "piccolo-" not in text


def test_progress_says_step_and_time_left(capsys, monkeypatch):
    is_terminal = True
    monkeypatch.setattr(sys.stderr, "isatty", lambda: is_terminal, raising=False)
    show = terminal.progress_bar(is_quiet=False)
    for label, title in (("render views", "prepare, 2 of 2: render views: "), ("write", "write: ")):
        shown = show(iter([1, 2]), 2, label)
        next(shown)
        time.sleep(terminal.DELAY + 0.2)
        next(shown)
        assert list(shown) == []
        printed = capsys.readouterr().err
        assert title in printed
        assert " left" in printed
    shown = show(iter([1, 2]), None, "read")
    next(shown)
    time.sleep(terminal.DELAY + 0.2)
    assert list(shown) == [2]
    assert "read: 1 in 00:00" in capsys.readouterr().err
    is_terminal = False
    assert list(show(iter([1, 2]), 2, "write")) == [1, 2]
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("package", ["opencv-python", "nothing"])
def test_two_packages_of_opencv_are_told_of_in_a_line(monkeypatch, capsys, package):
    distribution = importlib.metadata.distribution
    installed = lambda name: distribution("opencv-python-headless" if name == package else name)  # noqa: E731
    monkeypatch.setattr(importlib.metadata, "distribution", installed)
    main = command("a.py", None, "", lambda parser: None)(lambda arguments: 0)
    assert main([]) == 0
    line = "warning: found opencv-python and opencv-python-headless, which overwrite each other; "
    assert capsys.readouterr().err.startswith(line) == (package == "opencv-python")
