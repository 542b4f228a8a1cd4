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
from batches import ROOT, command_of, run
from rooms import query, scan_map, write_room

from piccolo import doors
from piccolo.cli import localize
from piccolo.doors import COMMANDS
from piccolo.scan_map.map_file import save_map

TIER = "scene"


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A room in a folder whose name is not ASCII."""
    return write_room(tmp_path_factory.mktemp("зал"), "--seed 7 --points 20000 --panoramas 1 --width 256")


def _shell(redirection, *words):
    """Exit code, stdout and stderr of a command of which a shell closes or turns some streams."""
    done = run(["sh", "-c", f'{redirection[0]}"$@" {redirection[1]}', "sh", *words])
    return done.returncode, done.stdout, done.stderr


def _prepare(scene, out, *more):
    return command_of("tools/prepare_map.py", "--cloud", scene / "cloud.ply", "--out", out, *more)


COUNT_ARENAS = """
import ctypes, sys, threading
from piccolo.system.jobs.memory import share_arenas
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


@pytest.mark.process
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


@pytest.mark.process
def test_console_commands_begin_before_their_libraries():
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    assert scripts == {f"piccolo-{n.replace('_', '-')}": f"piccolo.doors:{n}" for n in COMMANDS}
    code = "import sys; from piccolo.doors import localize; sys.exit('numpy' in sys.modules)"
    assert run([sys.executable, "-c", code], cwd=ROOT).returncode == 0
    with pytest.raises(AttributeError, match="no command 'loclize'"):
        _ = doors.loclize


@pytest.mark.process
@pytest.mark.parametrize(
    ("script", "number", "code", "word"),
    [
        ("localize.py", signal.SIGINT, 130, "interrupted"),
        ("tools/prepare_map.py", signal.SIGTERM, 143, "terminated"),
    ],
)
def test_signals_while_libraries_are_imported(script, number, code, word, tmp_path):
    (tmp_path / "numpy.py").write_text("import time\nprint('importing', flush=True)\ntime.sleep(60)\n")
    options = {"env": {"PYTHONPATH": str(tmp_path)}, "stdout": -1, "stderr": -1, "text": True}
    with subprocess.Popen(command_of(script), **options) as process:
        assert process.stdout.readline() == "importing\n"
        process.send_signal(number)
        assert process.stderr.read() == f"{Path(script).name}: {word}\n"
    assert process.returncode == code


@pytest.mark.process
def test_a_library_that_cannot_be_loaded_is_one_line(tmp_path):
    (tmp_path / "numpy.py").write_text("raise MemoryError\n")
    done = run(command_of("localize.py"), env={"PYTHONPATH": str(tmp_path)})
    assert done.returncode == 3
    assert done.stderr == "localize.py: the libraries cannot be loaded (not enough memory)\n"


@pytest.mark.process
@pytest.mark.parametrize("redirection", [">&-", ">/dev/full"])
def test_a_result_that_cannot_be_written_is_an_error(scene, tmp_path, redirection):
    code, out, err = _shell(("", redirection), *_prepare(scene, tmp_path / "a.map", "--quiet"))
    assert (code, out) == (3, "")
    assert err.startswith("prepare_map.py: writing or reading failed (")
    assert err.count("\n") == 1


@pytest.mark.process
def test_stderr_closed_and_names_that_the_locale_does_not_know(scene, tmp_path):
    shell = "env LC_ALL=C PYTHONUTF8=0 PYTHONCOERCECLOCALE=0 "
    code, out, err = _shell((shell, "2>&- <&-"), *_prepare(scene, tmp_path / "ж.map"))
    assert (code, err) == (0, "")
    assert json.loads(out)["candidates"] > 0
    code, out, err = _shell((shell, ""), *command_of("localize.py", "--cloud", "ж.ply", "--pano", "ж.jpg"))
    assert (code, out) == (3, "")
    assert err.count("\n") == 1
    assert err.startswith("localize.py: ")


@pytest.mark.process
def test_little_address_space_is_refused_before_libraries_are_loaded(scene, tmp_path):
    code, _, err = _shell(("ulimit -v 488281; exec ", ""), *_prepare(scene, tmp_path / "a.map"))
    assert code == 3
    assert err.startswith("prepare_map.py: found ulimit -v 488281, wanted ")
    assert err.count("\n") == 1


@pytest.mark.process
def test_address_space_that_runs_out_is_one_line(scene, tmp_path):
    code = """
import resource, sys
from piccolo.cli.prepare_map import main
taken = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (taken + 100_000_000, -1))
sys.exit(main(sys.argv[1:]))
"""
    words = _prepare(scene, tmp_path / "a.map", "--quiet")[2:]
    done = run([sys.executable, "-c", code, *words], cwd=ROOT)
    assert (done.returncode, done.stderr.count("\n")) == (3, 1), done.stderr
    assert "not enough memory (ulimit -v leaves " in done.stderr
    assert not (tmp_path / "a.map").exists()


@pytest.mark.parametrize("name", ["one colour", "one point", "one wall"])
def test_scans_of_nearly_nothing_are_no_error(tmp_path, scene, capsys, name):
    rng = np.random.default_rng(0)
    points = rng.uniform(0.0, 4.0, (20_000, 3))
    colors = rng.integers(0, 256, (20_000, 3))
    points[np.arange(20_000), rng.integers(0, 3, 20_000)] = 4.0 * rng.integers(0, 2, 20_000)
    changed = {"one colour": colors, "one point": points, "one wall": points[:, 1]}
    changed[name][:] = 120
    np.savez(tmp_path / "scan.npz", points=points, colors=colors.astype(np.uint8))
    words = ["--cloud", str(tmp_path / "scan.npz"), "--pano", str(scene / "images/clean_0.jpg"), "--quiet"]
    assert localize.main([*words, "--cache", "none"]) == 1
    out, err = capsys.readouterr()
    result = json.loads(out)
    assert (err, result["status"]) == ("", "not_localized")
    if name != "one colour":
        assert result["warnings"][-1].startswith("the scan: found no place for a camera")


@pytest.mark.process
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
assert not {{"scipy.spatial", "scipy.sparse", "scipy.special", "scipy.optimize"}} & set(sys.modules)
sys.exit(code)
"""
    done = run([sys.executable, "-c", code], cwd=ROOT)
    assert (done.returncode, done.stderr) == (0, "")
    assert json.loads(done.stdout)["storey"] == 1
