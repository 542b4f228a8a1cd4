"""What is kept between runs: where, and what is trusted of it."""

import errno
import hashlib
import os
import resource
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rooms import scan_map

from piccolo.cli import progress
from piccolo.cloud import digest
from piccolo.cloud.settings import IN_METRES
from piccolo.coarse_to_fine import map_file, open_map
from piccolo.coarse_to_fine.map_file import save_map
from piccolo.coarse_to_fine.open_map import CachePolicy
from piccolo.errors import InputError
from piccolo.runtime import cache, file_facts, kernel_cache
from piccolo.runtime.atomic import replacing
from piccolo.runtime.jit import kernel
from piccolo.runtime.stopwatch import Stopwatch
from piccolo.runtime.threads import Workers

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
    with pytest.raises(OSError, match=r"others may write to it|File exists"):
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
    assert "others may write to it, and nothing there is trusted" in caplog.text


@pytest.mark.parametrize("how", ["open to the group", "a file", "no place", "full disk"])
def test_where_no_kernel_can_be_kept_one_warning_says_so(folders, tmp_path, monkeypatch, caplog, how):
    kernel_cache.warn_not_kept.cache_clear()
    monkeypatch.setattr(kernel_cache, "kernel_folder", kernel_cache.kernel_folder.__wrapped__)
    monkeypatch.setattr(kernel_cache, "cache_root", cache.cache_root.__wrapped__)
    root = _root()
    if how == "open to the group":
        (root / "kernels").mkdir()
        (root / "kernels").chmod(0o770)
    elif how == "a file":
        (root / "kernels").touch()
    elif how == "no place":
        root.chmod(0o777)
    else:
        monkeypatch.setattr(kernel_cache, "write_atomically", _full)
    for name in ("a", "b"):
        compiled = kernel(eval(f"lambda {name}: {name} + 1"))
        assert compiled(np.float64(3.0)) == 4.0
    (warning,) = [record.getMessage() for record in caplog.records]
    assert warning.endswith("compiled code is not kept, and each run takes a minute more")
    assert not list(root.rglob("*.kernel"))
    assert kernel_cache.is_first_use() == (how == "full disk")


def _full(*_):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


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
    folder, key = tmp_path / "new", 32 * "0"
    cache.own_folder(folder, kernel_cache.NAME)
    tag = (folder / "CACHEDIR.TAG").read_bytes()
    assert tag.startswith(b"Signature: 8a477f597d28d172789f06886806bc55\n")
    names = [
        f"{key}.kernel",
        f".{key}.kernel.{16 * 'a'}",
        f"{key[1:]}.kernel",
        "a.txt",
        "1" + f"{key[1:]}.kernel",
    ]
    for foreign in (folder, tmp_path / "foreign"):
        foreign.mkdir(exist_ok=True)
        for name in names:
            (foreign / name).touch()
            os.utime(foreign / name, (0, 0))
        (foreign / f"2{key[1:]}.kernel").symlink_to("a.txt")
        os.utime(foreign / f"2{key[1:]}.kernel", (0, 0), follow_symlinks=False)
        cache.mark_used(foreign / names[-1])
        before = sorted(foreign.iterdir())
        cache.own_folder(foreign, kernel_cache.NAME)
        gone = {path.name for path in set(before) - set(foreign.iterdir())}
        assert gone == ({names[0], names[1]} if foreign == folder else set())
    assert not (tmp_path / "foreign" / "CACHEDIR.TAG").exists()


def test_damaged_compiled_code_is_noticed_and_made_anew(tmp_path, monkeypatch, caplog):
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
    path.write_bytes(whole[:100])
    anew = kernel(total)
    assert anew(values) == 10.0
    assert sum(anew.stats.cache_misses.values()) == 1
    assert kernel(total)(values) == 10.0  # it was written anew
    text = "damaged compiled code; it is compiled anew"
    assert [record.getMessage() for record in caplog.records] == [f"{tmp_path}: {text}"]
    other = path.with_name(32 * "0" + ".kernel")
    damaged = [b"", whole[: kernel_cache.DIGEST_SIZE], whole[:-1], whole + b"0"]
    for bit in np.random.default_rng(0).integers(8 * len(whole), size=300):
        flipped = bytearray(whole)
        flipped[bit // 8] ^= 1 << bit % 8
        damaged.append(bytes(flipped))
    for place, content in [*((path, content) for content in damaged), (other, whole)]:
        place.write_bytes(content)
        assert kernel_cache.read_whole(place) is None
    assert len(caplog.records) == 1  # however many are damaged
    assert kernel_cache.read_whole(tmp_path / "none") is None


def test_a_logged_warning_is_one_line_and_quiet_is_quiet(capsys):
    for is_quiet in (False, True):
        with progress.log_shown(is_quiet):
            for _ in range(3):
                kernel_cache.log.warning("%s: damaged", "a")
        assert capsys.readouterr().err == ("" if is_quiet else "warning: a: damaged\n")


@pytest.fixture(scope="module")
def cloud(tmp_path_factory):
    path, points = tmp_path_factory.mktemp("cloud") / "a.npy", np.random.default_rng(1).random((500, 3))
    np.save(path, np.hstack([points, np.full((500, 3), 100.0)]))
    return path


def _open(cloud, folder, monkeypatch, num_made=1):
    """The map by `open_map`, and the warnings; `prepare_map` is called so many times."""
    made, heard = [], []

    def prepare(*_, prior, has_features):
        made.append(1)
        return scan_map(1)

    monkeypatch.setattr(open_map, "prepare_map", prepare)
    workers = Workers(1, warn=heard.append)
    found = open_map.open_map([cloud], IN_METRES, CachePolicy(True, folder), workers, Stopwatch())
    np.testing.assert_array_equal(found.centers, scan_map(1).centers)
    assert found.scan_sha256 == hashlib.sha256(cloud.read_bytes()).hexdigest()
    assert len(made) == num_made
    assert found.warnings == (*scan_map(1).warnings, *heard)
    return heard


def test_maps_are_kept_in_a_folder_of_their_own(cloud, tmp_path, monkeypatch):
    """What lies in the user's folder is left, however old it is and whatever its name."""
    foreign = [tmp_path / f"{32 * 'a'}.piccolo-map", tmp_path / "notes.txt"]
    for path in foreign:
        path.touch()
        os.utime(path, (0, 0))
    assert _open(cloud, tmp_path, monkeypatch) == []
    assert _open(cloud, tmp_path, monkeypatch, 0) == []
    assert sorted(tmp_path.iterdir()) == sorted([*foreign, tmp_path / "piccolo-maps"])
    assert sorted(path.suffix for path in (tmp_path / "piccolo-maps").iterdir()) == [".TAG", ".piccolo-map"]


@pytest.mark.parametrize("how", ["flipped", "cut", "empty", "no directory", "another", "folder"])
def test_a_damaged_map_is_made_anew_with_one_warning(cloud, tmp_path, monkeypatch, how):
    assert _open(cloud, tmp_path, monkeypatch) == []
    (path,) = tmp_path.glob("*/*.piccolo-map")
    whole = path.read_bytes()
    middle, directory = len(whole) // 2, whole.rindex(b"PK\x01\x02")
    path.write_bytes(
        {
            "flipped": whole[:middle] + bytes([whole[middle] ^ 4]) + whole[middle + 1 :],
            "cut": whole[:middle],
            "empty": b"",
            "no directory": whole[:directory] + bytes(20) + whole[directory + 20 :],
        }.get(how, whole)
    )
    if how == "another":
        save_map(replace(scan_map(1), scan_sha256=64 * "1"), path)
    if how == "folder":
        path.unlink()
        path.mkdir()
    (warning,) = _open(cloud, tmp_path, monkeypatch)
    assert str(path) in warning
    assert warning.endswith("the prepared map is not kept" if how == "folder" else "it is made anew")
    assert how == "folder" or path.read_bytes() == whole
    assert how == "folder" or _open(cloud, tmp_path, monkeypatch, 0) == []


@pytest.mark.parametrize("how", ["a file", "its place is a file", "full disk", "link to nothing"])
def test_a_cache_that_can_not_be_used_is_a_warning(cloud, tmp_path, monkeypatch, how):
    folder, limit = tmp_path / "cache", resource.getrlimit(resource.RLIMIT_FSIZE)
    if how == "a file":
        folder.touch()
    elif how == "its place is a file":
        folder.mkdir()
        (folder / "piccolo-maps").touch()
    elif how == "link to nothing":
        folder.mkdir()
        (folder / "piccolo-maps").symlink_to("nothing")
    else:
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limit[1]))
    try:
        (warning,) = _open(cloud, folder, monkeypatch)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert str(folder) in warning
    assert warning.endswith("; the prepared map is not kept")
    assert [path.name for path in folder.rglob("*") if path.is_file()] in (
        [],
        ["CACHEDIR.TAG"],
        ["piccolo-maps"],
    )


def test_importing_writes_nothing(tmp_path):
    folders = {"HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    environment = {**os.environ, **folders, "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-c", "import piccolo.cli.localize, piccolo.cli.evaluate"]
    subprocess.run(command, cwd=ROOT, env=environment, check=True)
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def facts(tmp_path, monkeypatch):
    folder = tmp_path / "facts"
    folder.mkdir(mode=0o700)
    monkeypatch.setattr(file_facts, "facts_folder", lambda: folder)
    return folder


def test_a_fact_holds_until_its_file_changes_in_any_way(facts, tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"one")
    before = path.stat()
    assert file_facts.recall("what", before) is None
    file_facts.remember("what", before, "a fact")
    assert file_facts.recall("what", path.stat()) == "a fact"
    assert file_facts.recall("another", path.stat()) is None
    path.write_bytes(b"two")
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))  # its time is put back, by who changed it
    assert path.stat().st_mtime_ns == before.st_mtime_ns
    assert file_facts.recall("what", path.stat()) is None


def test_facts_that_can_not_be_kept_or_read_are_lost(facts, tmp_path, monkeypatch):
    status = tmp_path.stat()
    file_facts.remember("what", status, "a fact")
    (kept,) = facts.iterdir()
    kept.write_bytes(b"\xff\xff")
    assert file_facts.recall("what", status) is None
    monkeypatch.setattr(file_facts, "write_atomically", _full)
    file_facts.remember("other", status, "a fact")
    monkeypatch.setattr(file_facts, "facts_folder", lambda: None)
    file_facts.remember("more", status, "a fact")
    assert file_facts.recall("more", status) is None
    assert [entry.name for entry in facts.iterdir()] == [kept.name]


def test_facts_are_kept_where_nobody_else_can_write(folders):
    kept = file_facts.facts_folder.__wrapped__
    folder = _root() / "facts"
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(file_facts, "cache_root", cache.cache_root.__wrapped__)
        assert kept() == folder
        assert folder.stat().st_mode & 0o777 == 0o700
        folder.chmod(0o777)
        assert kept() is None


def test_a_digest_is_taken_once_and_anew_when_the_file_changes(facts, tmp_path, monkeypatch):
    path, read = tmp_path / "a.ply", []
    path.write_bytes(b"one")
    of_file = hashlib.file_digest
    monkeypatch.setattr(hashlib, "file_digest", lambda *args: read.append(args) or of_file(*args))
    monkeypatch.setattr(digest, "TICK_NS", 10**15)
    assert digest.sha256_of_files([path], True) == hashlib.sha256(b"one").hexdigest()
    assert list(facts.iterdir()) == []  # it has changed just now, and may once more
    monkeypatch.setattr(digest, "TICK_NS", -(10**15))
    for _ in range(2):
        assert digest.sha256_of_files([path], True) == hashlib.sha256(b"one").hexdigest()
    assert len(read) == 2
    assert digest.sha256_of_files([path]) == hashlib.sha256(b"one").hexdigest()
    assert len(read) == 3
    path.write_bytes(b"two!")
    assert digest.sha256_of_files([path], True) == hashlib.sha256(b"two!").hexdigest()


def test_a_map_is_checked_once_by_who_remembers_it(facts, tmp_path, monkeypatch):
    path, checked = tmp_path / "a.map", []
    save_map(scan_map(1), path)
    check = map_file.check_arrays
    monkeypatch.setattr(map_file, "check_arrays", lambda *args: checked.append(args) or check(*args))
    for remembers, count in ((False, 1), (True, 2), (True, 2), (False, 3)):
        assert len(map_file.load_map(path, remembers).centers) == len(scan_map(1).centers)
        assert len(checked) == count
    content = bytearray(path.read_bytes())
    content[-5000] ^= 1
    path.write_bytes(content)
    with pytest.raises(InputError, match="damaged"):
        map_file.load_map(path, remembers=True)
