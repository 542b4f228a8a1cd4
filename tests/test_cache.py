"""What is kept between runs: where, and what is trusted of it."""

import gc
import logging
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numba
import numpy as np
import pytest
from refusals import fill_disk

from piccolo.cli import terminal
from piccolo.optimize.channel_loss import add_channels
from piccolo.optimize.sampling_loss import add_packed
from piccolo.system.files import cache
from piccolo.system.files.atomic import PREFIX, replacing, temporary_folder
from piccolo.system.kernels import jit
from piccolo.system.kernels.jit import kernel

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    """The folder for temporary files."""
    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    return tmp_path / "tmp"


@pytest.fixture
def folders(tmp_path, home_cache, temporary, monkeypatch):
    """The user's cache folder, which can't be made, and the one for temporary files."""
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    return tmp_path / "file", temporary


def _root():
    return cache.cache_root.__wrapped__()


def test_the_users_cache_is_made_and_used(folders, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    assert _root() == tmp_path / "home" / "piccolo"
    assert _root().is_dir()
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert _root() == tmp_path / ".cache" / "piccolo"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")  # which the standard says to ignore
    assert _root() == tmp_path / ".cache" / "piccolo"
    monkeypatch.setattr(sys, "platform", "darwin")
    assert cache.caches_of_user() == tmp_path / "Library" / "Caches"
    monkeypatch.setattr(cache, "IS_WINDOWS", True)
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path / "local"))
    assert cache.caches_of_user() == tmp_path / "local"


def test_where_there_is_no_home_the_temporary_files_take_its_place(folders, monkeypatch):
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", "relative")
    assert _root() == folders[1] / f"piccolo-{os.getuid()}"


def test_where_it_can_not_be_made_a_private_folder_takes_its_place(folders):
    root = _root()
    assert root == folders[1] / f"piccolo-{os.getuid()}"
    assert root.stat().st_mode & 0o777 == 0o700
    assert _root() == root


@pytest.mark.parametrize("how", ["open to all", "readable", "link", "of another", "file", "replaceable"])
def test_a_folder_that_others_may_have_filled_is_not_trusted(folders, monkeypatch, how):
    name = folders[1] / f"piccolo-{os.getuid()}"
    if how == "link":
        (folders[1] / "elsewhere").mkdir(mode=0o700)
        name.symlink_to(folders[1] / "elsewhere")
    elif how == "file":
        name.touch()
    else:
        name.mkdir(mode=0o700)
        name.chmod({"open to all": 0o777, "readable": 0o755}.get(how, 0o700))
    if how == "replaceable":
        folders[1].chmod(0o777)
    if how == "of another":
        uid = os.getuid()
        monkeypatch.setattr(os, "getuid", iter([uid, uid + 1]).__next__)
    with pytest.raises(OSError, match=r"other users may write to it|File exists"):
        _root()
    folders[1].chmod(0o1777)
    if how == "replaceable":
        assert _root() == name  # as in /tmp, where a file's owner alone may rename it


@pytest.mark.parametrize("mode", [0o720, 0o702])
def test_a_users_cache_that_others_may_write_to_is_told_and_left(
    folders, tmp_path, monkeypatch, mode, caplog
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    (tmp_path / "piccolo").mkdir()
    (tmp_path / "piccolo").chmod(mode)
    assert _root().parent == folders[1]
    assert "other users may write to it, so it is not used" in caplog.text


@pytest.mark.parametrize("how", ["open to the group", "a file", "no place", "full disk"])
def test_where_no_kernel_can_be_kept_one_warning_says_so(folders, tmp_path, monkeypatch, caplog, how):
    root = _root()
    if how == "open to the group":
        (root / "kernels").mkdir()
        (root / "kernels").chmod(0o770)
    elif how == "a file":
        (root / "kernels").touch()
    elif how == "no place":
        root.chmod(0o777)
    else:
        monkeypatch.setattr(jit, "write_atomically", fill_disk)
    for name in ("a", "b"):
        compiled = kernel(eval(f"lambda {name}: {name} + 1"))
        assert compiled(np.float64(3.0)) == 4.0
    (warning,) = [record.getMessage() for record in caplog.records]
    assert warning.endswith("compiled code is not kept, and each run takes half a minute longer")
    assert not list(root.rglob("*.kernel"))


@pytest.mark.parametrize("ending", ["kernel", "fact", "piccolo-map"])
def test_what_a_killed_process_was_writing_has_a_name_of_ours(tmp_path, ending):
    name = cache.own_names(ending)
    with replacing(tmp_path / f"{32 * 'c'}.{ending}") as file:
        file.write(b"whole")
        (begun,) = tmp_path.iterdir()
    (whole,) = tmp_path.iterdir()
    for path in (begun, whole):
        assert name.fullmatch(path.name)
        assert not name.fullmatch(path.name[1:])
        assert not name.fullmatch(f"{path.name}~")


def test_only_stale_files_of_ours_go_and_only_from_a_folder_that_is_marked(tmp_path):
    """Not the user's own, not a link, not a fresh one; what a killed process was writing goes too."""
    folder = tmp_path / "new"
    key = 32 * "0"
    cache.own_folder(folder, jit.NAME)
    tag = (folder / "CACHEDIR.TAG").read_bytes()
    assert tag.startswith(b"Signature: 8a477f597d28d172789f06886806bc55\n")
    names = [f"{key}.kernel", f".{key}.kernel.{16 * 'a'}", f"{key[1:]}.kernel", "a.txt", f"1{key[1:]}.kernel"]
    for foreign in (folder, tmp_path / "foreign"):
        foreign.mkdir(exist_ok=True)
        for name in names:
            (foreign / name).touch()
            os.utime(foreign / name, (0, 0))
        (foreign / f"2{key[1:]}.kernel").symlink_to("a.txt")
        os.utime(foreign / f"2{key[1:]}.kernel", (0, 0), follow_symlinks=False)
        cache.mark_used(foreign / names[-1])
        before = sorted(foreign.iterdir())
        cache.own_folder(foreign, jit.NAME)
        gone = {path.name for path in set(before) - set(foreign.iterdir())}
        assert gone == ({names[0], names[1]} if foreign == folder else set())
    assert not (tmp_path / "foreign" / "CACHEDIR.TAG").exists()


def test_damaged_compiled_code_is_noticed_and_made_anew(home_cache, caplog):
    folder = home_cache / "kernels"

    def total(values):
        return values.sum()

    values = np.arange(5.0)
    assert kernel(total)(values) == 10.0
    (path,) = folder.glob("*.kernel")
    whole = path.read_bytes()
    os.utime(path, (0, 0))
    loaded = kernel(total)
    assert loaded(values) == 10.0
    assert sum(loaded.stats.cache_hits.values()) == 1
    assert path.stat().st_mtime > 0  # in use
    path.write_bytes(whole[:100])
    anew = kernel(total)
    assert anew(values) == 10.0
    assert sum(anew.stats.cache_misses.values()) == 1
    assert kernel(total)(values) == 10.0  # it was written anew
    text = "damaged compiled code; it is compiled again"
    assert [record.getMessage() for record in caplog.records] == [f"{folder}: {text}"]
    other = path.with_name(32 * "0" + ".kernel")
    damaged = [b"", whole[: jit.DIGEST_SIZE], whole[:-1], whole + b"0"]
    for bit in np.random.default_rng(0).integers(8 * len(whole), size=300):
        flipped = bytearray(whole)
        flipped[bit // 8] ^= 1 << bit % 8
        damaged.append(bytes(flipped))
    for place, content in [*((path, content) for content in damaged), (other, whole)]:
        place.write_bytes(content)
        assert jit.read_whole(place) is None
    assert len(caplog.records) == 1  # however many are damaged
    assert jit.read_whole(folder / "none") is None


def test_a_kernel_is_compiled_with_another_that_was_loaded(home_cache):
    def scaled_sum(values, factor):
        return factor * values.sum()

    def made():
        inner = kernel(scaled_sum)

        def first(values):
            return inner(values, 2.0) + 1.0

        def second(values):
            return inner(values, 2.0) - 1.0

        return inner, kernel(first), kernel(second)

    values = np.array([1.0, 2.0, 4.0])
    inner, first, second = made()
    assert (first(values), inner(values, 3.0)) == (15.0, 21.0)
    inner, first, second = made()
    assert (inner(values, 3.0), second(values), first(values)) == (21.0, 13.0, 15.0)
    was_loaded = [sum(each.stats.cache_hits.values()) for each in (inner, first, second)]
    assert was_loaded == [1, 1, 0]
    (loaded,) = inner.overloads.values()
    names = loaded.fndesc
    found = {function.name for function in loaded.library._shared_module.functions}
    assert found == {names.llvm_func_name, names.llvm_cpython_wrapper_name}


@pytest.mark.parametrize("fails", ["rebuild", "serialize"])
def test_where_numba_is_not_as_it_was_kernels_are_compiled(home_cache, monkeypatch, caplog, fails):
    def total(values):
        return values.sum()

    values = np.arange(5.0)
    if fails == "rebuild":
        kernel(total)(values)
    monkeypatch.setattr(jit, fails, None)
    assert kernel(total)(values) == 10.0
    (warning,) = [record.getMessage() for record in caplog.records]
    assert warning.startswith(f"Numba {numba.__version__}: ")
    assert warning.endswith("compiled code is not kept, and each run takes half a minute longer")


def test_bounds_are_checked_where_code_without_is_kept(home_cache, monkeypatch):
    def third(values):
        return values[2]

    values = np.zeros(3)
    kernel(third)(values)
    monkeypatch.setattr(numba.config, "BOUNDSCHECK", 1)
    with pytest.raises(IndexError):
        kernel(third)(values[:2])
    assert len(list((home_cache / "kernels").glob("*.kernel"))) == 2


def test_a_kernel_outside_the_package_is_compiled_again_where_its_source_has_changed(tmp_path, home_cache):
    """Compiled code of the one before was used: kernels of research/ did what they no longer said."""
    source = tmp_path / "outside.py"
    for added in (1.0, 2.0):
        source.write_text(f"ADDED = {added}\ndef add(x):\n    return x + ADDED\n")
        jit.own_digest.cache_clear()
        made = {}
        exec(compile(source.read_text(), str(source), "exec"), made)
        assert kernel(made["add"])(np.float64(3.0)) == 3.0 + added


def test_losses_of_one_making_are_kept_apart_on_disk():
    """Compiled code is looked up by the names of all that is compiled in."""
    names = {adder._cache.name for adder in (add_channels, add_packed)}
    assert len(names) == 2
    assert any("geman_mcclure" in name for name in names)


def test_who_waits_for_kernels_is_told(monkeypatch, capsys):
    seconds = iter([10.0, 11.0, 14.0])
    monkeypatch.setattr(jit.time, "monotonic", lambda: next(seconds))
    for is_quiet in (False, True):
        compiling = jit.Compiling()
        with terminal.showing_log(is_quiet):
            compiling.begin()
            compiling.begin()
            assert not gc.isenabled()
            compiling.finish()
            compiling.finish()
            assert gc.isenabled()
        text = "compiling kernels (only once): 2 so far, half a minute on one core\n"
        assert capsys.readouterr().err == ("" if is_quiet else text)
        seconds = iter([10.0, 11.0, 14.0])
    assert logging.getLogger("piccolo").level == logging.NOTSET


@pytest.mark.process
def test_importing_writes_nothing(tmp_path):
    folders = {"HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    environment = {**os.environ, **folders, "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-c", "import piccolo.cli.photo_run, research.evaluation.evaluate"]
    subprocess.run(command, cwd=ROOT, env=environment, check=True)
    assert list(tmp_path.iterdir()) == []


HOLD = """
import sys, time
from piccolo.system.files.atomic import temporary_folder
with temporary_folder() as folder:
    (folder / "frame.jpg").touch()
    print(folder, flush=True)
    time.sleep(600)
"""


@pytest.fixture
def temporary_folders(temporary):
    """A function that lists the temporary folders there are."""
    return lambda: [path for path in temporary.iterdir() if path.name.startswith(PREFIX)]


def test_a_folder_is_removed_at_the_end_and_after_an_error(temporary_folders):
    with temporary_folder() as folder:
        (folder / "a").touch()
        assert temporary_folders() == [folder]
    with pytest.raises(ValueError, match="x"), temporary_folder():
        raise ValueError("x")
    assert temporary_folders() == []


@pytest.mark.process
def test_what_a_killed_process_left_is_removed_and_what_a_living_one_has_stays(temporary_folders, temporary):
    command = [sys.executable, "-c", HOLD]
    where = os.environ | {"TMPDIR": str(temporary)}
    with subprocess.Popen(command, env=where, stdout=subprocess.PIPE, text=True) as process:
        folder = temporary / process.stdout.readline().strip()
        os.utime(folder, (time.time() - 60, time.time() - 60))
        with temporary_folder():
            assert folder in temporary_folders()
        process.kill()
    (temporary / f"{PREFIX}12345678").symlink_to(temporary)
    (temporary / f"{PREFIX}87654321").mkdir()  # made a moment ago
    with temporary_folder() as own:
        others = {f"{PREFIX}12345678", f"{PREFIX}87654321"}
        assert {path.name for path in temporary_folders()} == {own.name, *others}
