"""What is kept between runs: where, and what is trusted of it."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest

from piccolo.runtime import cache, kernel_cache
from piccolo.runtime.jit import kernel

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def folders(tmp_path, monkeypatch):
    """The user's cache folder, which can't be made, and the one for temporary files."""
    (tmp_path / "file").touch()
    (tmp_path / "tmp").mkdir()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    return tmp_path / "file", tmp_path / "tmp"


def _root():
    return cache.cache_root.__wrapped__()


def test_the_users_cache_is_made_and_used(folders, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    assert _root() == tmp_path / "home" / "piccolo"
    assert _root().is_dir()
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert _root() == tmp_path / ".cache" / "piccolo"


def test_where_it_can_not_be_made_a_private_folder_takes_its_place(folders):
    root = _root()
    assert root == folders[1] / f"piccolo-{os.getuid()}"
    assert root.stat().st_mode & 0o777 == 0o700
    assert _root() == root


@pytest.mark.parametrize("how", ["open to all", "link", "of another", "file"])
def test_a_folder_that_others_may_have_filled_is_not_trusted(folders, monkeypatch, how):
    name = folders[1] / f"piccolo-{os.getuid()}"
    if how == "open to all":
        name.mkdir()
        name.chmod(0o777)
    elif how == "link":
        (folders[1] / "elsewhere").mkdir(mode=0o700)
        name.symlink_to(folders[1] / "elsewhere")
    elif how == "file":
        name.touch()
    else:
        name.mkdir(mode=0o700)
        uid = os.getuid()
        monkeypatch.setattr(os, "getuid", iter([uid, uid + 1, uid + 1]).__next__)
    root = _root()
    assert root != name
    assert root.parent == folders[1]
    assert root.stat().st_mode & 0o777 == 0o700
    assert list(root.iterdir()) == []


def test_files_unused_for_a_month_go_and_others_stay(tmp_path):
    names = (f"{'0' * 32}.kernel", f"{'1' * 32}.kernel", "a.txt", f"{'2' * 32}.kernel")
    old, used, foreign, fresh = (tmp_path / name for name in names)
    for path in (old, used, foreign):
        path.touch()
        os.utime(path, (0, 0))
    fresh.touch()
    os.utime(fresh, (fresh.stat().st_mtime - 29 * 24 * 3600,) * 2)
    cache.mark_used(used)
    cache.remove_stale(tmp_path, kernel_cache.NAME)
    kept = sorted(path.name for path in (used, foreign, fresh))
    assert sorted(path.name for path in tmp_path.iterdir()) == kept


def test_a_flipped_byte_in_compiled_code_is_noticed(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(kernel_cache, "kernel_folder", lambda: tmp_path)

    def total(values):
        return values.sum()

    assert kernel_cache.is_first_use()
    values = np.arange(5.0)
    assert kernel(total)(values) == 10.0
    (path,) = tmp_path.iterdir()
    assert not kernel_cache.is_first_use()
    whole = path.read_bytes()
    os.utime(path, (0, 0))
    loaded = kernel(total)
    assert loaded(values) == 10.0
    assert sum(loaded.stats.cache_hits.values()) == 1
    assert path.stat().st_mtime > 0  # in use
    for at in (0, len(whole) // 2):
        damaged = bytearray(whole)
        damaged[at] ^= 1
        path.write_bytes(damaged)
        caplog.clear()
        anew = kernel(total)
        assert anew(values) == 10.0
        assert sum(anew.stats.cache_misses.values()) == 1
        message = f"{path}: damaged compiled code; it is compiled anew"
        assert [record.getMessage() for record in caplog.records] == [message]
        assert kernel(total)(values) == 10.0
        assert len(caplog.records) == 1  # it was written anew


def test_importing_writes_nothing(tmp_path):
    folders = {"HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    environment = {**os.environ, **folders, "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-c", "import piccolo.cli.localize, piccolo.cli.evaluate"]
    subprocess.run(command, cwd=ROOT, env=environment, check=True)
    assert list(tmp_path.iterdir()) == []
