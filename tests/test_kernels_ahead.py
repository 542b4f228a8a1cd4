"""Kernels that helping processes compile: the list of them, and who compiles which."""

import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from piccolo.system.files.atomic import hold_lock, write_atomically
from piccolo.system.kernels import ahead
from piccolo.system.kernels.jit import kernel

TIER = "process"

ROOT = Path(__file__).parents[1]
FLAT = ROOT / "examples" / "flat"
# runs a command and prints, a line each, the kernels that it asked for by themselves
ASKING = r"""
import sys
from numba.core.dispatcher import Dispatcher
from piccolo.cli.start import run
from piccolo.system.kernels import ahead, jit

asked = []
within = []
load = jit.KernelCache.load_overload
compile = Dispatcher.compile

def note(self, signature, context):
    if len(within) == 1:
        asked.append(f"{self.name} | {' '.join(map(ahead.describe_type, signature))}")
    return load(self, signature, context)

def enter(self, signature):
    within.append(self)
    try:
        return compile(self, signature)
    finally:
        within.pop()

jit.KernelCache.load_overload = note
Dispatcher.compile = enter
code = run("piccolo.cli.localize")
print(*asked, sep="\n", file=sys.stderr)
sys.exit(code)
"""


def test_each_kernel_of_the_list_is_there_once_with_types_that_it_can_be_compiled_for():
    listed = [line for line in ahead.LISTED.read_text().splitlines() if not line.startswith("#")]
    found = [
        f"{d._cache.name} | {' '.join(map(ahead.describe_type, types))}" for d, types in ahead.list_kernels()
    ]
    assert found == listed
    assert len(set(found)) == len(found) > 40


def test_the_list_has_what_photos_ask_for():
    photos = [FLAT / "images" / name for name in ("phone.jpg", "living_room.jpg")]
    options = ["--cloud", FLAT / "cloud.ply", "--pano", *photos, "--threads", "1", "--quiet"]
    command = [sys.executable, "-c", ASKING, *map(str, options)]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert ended.returncode == 0
    asked = ended.stderr.splitlines()
    missing = sorted(set(asked) - set(ahead.LISTED.read_text().splitlines()))
    assert not missing, "add these lines to piccolo/system/kernels/signatures.txt"
    assert len(asked) > 25


@pytest.fixture
def folder(home_cache):
    return home_cache / "kernels"


def total(values):
    return values.sum()


def test_a_kernel_that_another_process_compiles_is_waited_for(folder):
    values = np.arange(5.0)
    kernel(total)(values)
    (path,) = folder.glob("*.kernel")
    whole = path.read_bytes()
    path.unlink()
    waiting = kernel(total)
    ends = []
    with hold_lock(path):
        thread = threading.Thread(target=lambda: ends.append((waiting(values), time.monotonic())))
        thread.start()
        thread.join(0.2)
        assert not ends
        write_atomically(path, whole)
        released = time.monotonic()
    thread.join()
    ((value, end),) = ends
    assert value == 10.0
    assert end > released
    assert sum(waiting.stats.cache_hits.values()) == 1
    assert list(folder.glob("*.kernel")) == [path]


def test_helpers_compile_what_nobody_has_begun(folder):
    def doubled(values):
        return 2.0 * values.sum()

    first = kernel(total)
    second = kernel(doubled)
    arguments = ahead.parse_types("float64[1C]")
    both = [(first, arguments), (second, arguments)]
    codegen = ahead.cpu_target.target_context.codegen()
    paths = [each._cache.file(arguments, codegen) for each in (first, second)]
    with hold_lock(paths[0]):
        ahead.compile_missing(both)
        assert [path.exists() for path in paths] == [False, True]
    ahead.compile_missing(both)
    assert [path.exists() for path in paths] == [True, True]


def test_types_that_kernels_take_are_read_as_they_are_written():
    text = "float32[2C] float64[3A] int64 bool (float32[1C] float32[1C]) "
    text += "piccolo.photo.panorama.texels.Texels(int32[1C] int64 float64)"
    assert " ".join(map(ahead.describe_type, ahead.parse_types(text))) == text


def test_help_ends_with_the_process_that_asked_for_it():
    (helper,) = ahead.start_helpers(1)
    assert helper.stdin is not None
    helper.stdin.close()
    assert helper.wait(60.0) == 0


def test_compiling_all_beforehand_ends_well():
    command = [sys.executable, "-m", "piccolo.system.kernels.ahead"]
    assert subprocess.run(command, cwd=ROOT, check=False).returncode == 0
