"""Where a command begins and how it ends: signals, streams, locale and memory, in processes of their own."""

import json
import os
import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest
from rooms import query, scan_map, write_room

from piccolo.cli import localize, start
from piccolo.cli.start import COMMANDS
from piccolo.scan_map.map_file import save_map

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A room in a folder whose name is not ASCII."""
    return write_room(tmp_path_factory.mktemp("зал"), "--seed 7 --points 20000 --panoramas 1 --width 256")


def _command(script, *arguments):
    return [sys.executable, str(ROOT / script), *map(str, arguments)]


def _shell(redirection, *words):
    """Exit code, stdout and stderr of a command of which a shell closes or turns some streams."""
    line = ["sh", "-c", f'"$@" {redirection}', "sh", *words]
    done = subprocess.run(line, capture_output=True, text=True, check=False, timeout=300)
    return done.returncode, done.stdout, done.stderr


COUNT_ARENAS = """
import ctypes, sys, threading
from piccolo.jobs.arenas import share_arenas
share_arenas()
barrier = threading.Barrier(6)
def allocate():
    barrier.wait()
    kept = [bytes(1000) for _ in range(1000)]
    barrier.wait()
threads = [threading.Thread(target=allocate) for _ in range(6)]
for thread in threads: thread.start()
for thread in threads: thread.join()
libc = ctypes.CDLL(None)
libc.fopen.restype = ctypes.c_void_p
file = ctypes.c_void_p(libc.fopen(sys.argv[1].encode(), b"w"))
libc.malloc_info(0, file)
libc.fclose(file)
"""


@pytest.mark.parametrize(
    ("told", "least", "most"),
    [({}, 2, 2), ({"MALLOC_ARENA_MAX": "8"}, 3, 8), ({"GLIBC_TUNABLES": "glibc.malloc.arena_max=6"}, 3, 6)],
)
def test_threads_share_two_arenas_unless_the_environment_says_more(tmp_path, told, least, most):
    of_malloc = ("MALLOC_ARENA_MAX", "GLIBC_TUNABLES")
    environment = {k: v for k, v in os.environ.items() if k not in of_malloc} | told
    command = [sys.executable, "-c", COUNT_ARENAS, tmp_path / "info.xml"]
    subprocess.run(command, check=True, env=environment, cwd=ROOT, timeout=60)
    assert least <= (tmp_path / "info.xml").read_text().count("<heap nr") <= most


def test_console_commands_begin_before_their_libraries():
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    assert scripts == {f"piccolo-{n.replace('_', '-')}": f"piccolo.cli.start:{n}" for n in COMMANDS}
    code = "import sys; from piccolo.cli.start import localize; sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0
    with pytest.raises(AttributeError, match="no command 'loclize'"):
        _ = start.loclize


@pytest.mark.parametrize(
    ("script", "number", "code", "word"),
    [
        ("localize.py", signal.SIGINT, 130, "interrupted"),
        ("tools/prepare_map.py", signal.SIGTERM, 143, "terminated"),
    ],
)
def test_signals_while_libraries_are_imported(script, number, code, word, tmp_path):
    (tmp_path / "numpy.py").write_text("import time\nprint('importing', flush=True)\ntime.sleep(60)\n")
    with subprocess.Popen(
        _command(script), env={"PYTHONPATH": str(tmp_path)}, stdout=-1, stderr=-1, text=True
    ) as process:
        assert process.stdout.readline() == "importing\n"
        process.send_signal(number)
        assert process.stderr.read() == f"{Path(script).name}: {word}\n"
    assert process.returncode == code


def test_a_library_that_cannot_be_loaded_is_one_line(tmp_path):
    (tmp_path / "numpy.py").write_text("raise MemoryError\n")
    done = subprocess.run(
        _command("localize.py"),
        env={"PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 3
    assert done.stderr == "localize.py: the libraries cannot be loaded (not enough memory)\n"


@pytest.mark.parametrize("redirection", [">&-", ">/dev/full"])
def test_a_result_that_cannot_be_written_is_an_error(scene, tmp_path, redirection):
    prepare = _command("tools/prepare_map.py", "--cloud", scene / "cloud.ply", "--out", tmp_path / "a.map")
    code, out, err = _shell(redirection, *prepare, "--quiet")
    assert (code, out) == (3, "")
    assert err.startswith("prepare_map.py: writing or reading failed (")
    assert err.count("\n") == 1


def test_stderr_closed_and_names_that_the_locale_does_not_know(scene, tmp_path):
    files = "--cloud", scene / "cloud.ply", "--out", tmp_path / "ж.map"
    environment = ["env", "LC_ALL=C", "PYTHONUTF8=0", "PYTHONCOERCECLOCALE=0"]
    code, out, err = _shell("2>&- <&-", *environment, *_command("tools/prepare_map.py", *files))
    assert (code, err) == (0, "")
    assert json.loads(out)["candidates"] > 0
    code, out, err = _shell("", *environment, *_command("localize.py", "--cloud", "ж.ply", "--pano", "ж.jpg"))
    assert (code, out) == (3, "")
    assert err.count("\n") == 1
    assert err.startswith("localize.py: ")


def test_little_address_space_is_refused_before_libraries_are_loaded(scene, tmp_path):
    command = _command("tools/prepare_map.py", "--cloud", scene / "cloud.ply", "--out", tmp_path / "a.map")
    done = subprocess.run(
        ["sh", "-c", 'ulimit -v 488281; exec "$@"', "sh", *command],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 3
    assert done.stderr.startswith("prepare_map.py: found ulimit -v 488281, wanted ")
    assert done.stderr.count("\n") == 1


def test_address_space_that_runs_out_is_one_line(scene, tmp_path):
    code = """
import resource, sys
from piccolo.cli.prepare_map import main
taken = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (taken + 100_000_000, -1))
sys.exit(main(sys.argv[1:]))
"""
    files = "--cloud", scene / "cloud.ply", "--out", tmp_path / "a.map", "--quiet"
    done = subprocess.run(
        [sys.executable, "-c", code, *map(str, files)], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr.count("\n")) == (3, 1), done.stderr
    assert "not enough memory (ulimit -v leaves " in done.stderr
    assert not (tmp_path / "a.map").exists()


@pytest.mark.parametrize("name", ["one colour", "one point", "one wall"])
def test_scans_of_nearly_nothing_are_no_error(tmp_path, scene, capsys, name):
    rng = np.random.default_rng(0)
    points, colors = rng.uniform(0.0, 4.0, (20_000, 3)), rng.integers(0, 256, (20_000, 3))
    points[np.arange(20_000), rng.integers(0, 3, 20_000)] = 4.0 * rng.integers(0, 2, 20_000)
    if name == "one colour":
        colors[:] = 120
    elif name == "one point":
        points[:] = 1.5
    else:
        points[:, 1] = 0.0
    np.savez(tmp_path / "scan.npz", points=points, colors=colors.astype(np.uint8))
    words = ["--cloud", str(tmp_path / "scan.npz"), "--pano", str(scene / "images/clean_0.jpg"), "--quiet"]
    assert localize.main([*words, "--cache", "none"]) == 1
    out, err = capsys.readouterr()
    result = json.loads(out)
    assert (err, result["status"]) == ("", "not_localized")
    if name != "one colour":
        assert result["warnings"][-1].startswith("the scan: found no place for a camera")


def test_a_photo_in_a_prepared_map_does_not_wait_for_scipy(tmp_path):
    """It takes longer to import than the photo."""
    prepared, image = tmp_path / "a.map", tmp_path / "a.png"
    save_map(scan_map(1), prepared)
    cv2.imwrite(str(image), query(1).rgb[..., ::-1])
    code = f"""
import sys
from piccolo.cli.localize import main
sys.argv = ["localize.py", "--cloud", {str(prepared)!r}, "--pano", {str(image)!r}, "--quiet"]
code = main()
assert not {{"scipy.spatial", "scipy.sparse", "scipy.optimize"}} & set(sys.modules)
sys.exit(code)
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert json.loads(done.stdout)["storey"] == 1
