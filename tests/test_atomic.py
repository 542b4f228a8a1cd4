import contextlib
import errno
import os
import runpy
import signal
import subprocess
import sys
import threading
import types
from pathlib import Path

import numpy as np
import pytest
from batches import run
from poses import result, write_results
from refusals import assert_input_error

from piccolo.cli.command import UsageError, check_distinct, check_outputs, check_suffix, command
from piccolo.geometry.pose import Pose
from piccolo.system.errors import InputError
from piccolo.system.files import atomic, lock
from piccolo.system.files.line_file import open_locked, whole_lines, whole_size

ROOT = Path(__file__).resolve().parents[1]


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_content_replaces_and_nothing_else_is_left(tmp_path):
    path = tmp_path / ("with space " + "ä" * 110)  # 231 of the 255 bytes that a name may have
    path.write_bytes(b"old")
    atomic.write_atomically(path, b"new")
    assert path.read_bytes() == b"new"
    assert names(tmp_path) == [path.name]


def test_failure_leaves_the_old_file_and_no_other(tmp_path, monkeypatch):
    path = tmp_path / "a.json"
    path.write_bytes(b"old")

    def fail(self, target):
        raise OSError("disk")

    monkeypatch.setattr(Path, "replace", fail)
    with pytest.raises(OSError, match="disk"):
        atomic.write_atomically(path, b"new")
    assert path.read_bytes() == b"old"
    assert names(tmp_path) == ["a.json"]


def test_permissions_follow_the_umask_or_the_file_that_is_replaced(tmp_path):
    private, shared = tmp_path / "private", tmp_path / "shared"
    for path, mode in ((private, 0o600), (shared, 0o664)):
        path.touch()
        path.chmod(mode)
    before = os.umask(0o027)
    try:
        for path, mode in ((tmp_path / "new", 0o640), (private, 0o600), (shared, 0o664)):
            atomic.write_atomically(path, b"x")
            assert path.stat().st_mode & 0o777 == mode
    finally:
        os.umask(before)


@pytest.mark.parametrize("is_allowed", [True, False])
def test_the_owner_stays_where_that_is_allowed(tmp_path, monkeypatch, is_allowed):
    path = tmp_path / "a"
    given = []
    path.touch()
    if os.getuid() == 0:  # who alone may give files away
        os.chown(path, 1234, 1235)
    owner = (path.stat().st_uid, path.stat().st_gid)
    fchown = os.fchown

    def give(handle, uid, gid):
        given.append((uid, gid))
        if not is_allowed:
            raise PermissionError
        fchown(handle, uid, gid)

    monkeypatch.setattr(os, "fchown", give)
    atomic.write_atomically(path, b"x")
    assert given == [owner]
    assert path.read_bytes() == b"x"
    assert ((path.stat().st_uid, path.stat().st_gid) == owner) == (is_allowed or os.getuid() != 0)


@pytest.mark.parametrize("is_there", [True, False])
def test_a_link_stays_and_its_target_is_replaced(tmp_path, is_there):
    for name in ("links", "files"):
        (tmp_path / name).mkdir()
    link, second, target = tmp_path / "links" / "a", tmp_path / "links" / "b", tmp_path / "files" / "a"
    link.symlink_to("b")
    second.symlink_to("../files/a")
    if is_there:
        target.write_bytes(b"old")
    atomic.check_output(link)
    atomic.write_atomically(link, b"new")
    assert (str(link.readlink()), str(second.readlink())) == ("b", "../files/a")
    assert target.read_bytes() == b"new"
    assert not target.is_symlink()
    assert (names(tmp_path / "links"), names(tmp_path / "files")) == (["a", "b"], ["a"])
    folder = tmp_path / "links" / "folder"
    folder.symlink_to(tmp_path / "files" / "made")
    atomic.check_output_folder(folder)
    with atomic.replacing_folder(folder) as unfinished:
        (unfinished / "x").touch()
    assert folder.is_symlink()
    assert names(tmp_path / "files" / "made") == ["x"]


def test_a_fifo_is_written_to_and_stays(tmp_path):
    fifo = tmp_path / "fifo.json"
    read = []
    os.mkfifo(fifo)
    reader = threading.Thread(target=lambda: read.append(fifo.read_bytes()))
    reader.start()
    atomic.check_output(fifo)
    atomic.write_atomically(fifo, b"new" * 100_000)
    reader.join()
    assert read == [b"new" * 100_000]
    assert fifo.is_fifo()
    assert names(tmp_path) == ["fifo.json"]


@pytest.mark.parametrize("name", ["-", "/dev/stdout"])
def test_stdout_gets_bytes(name, capfdbinary):
    atomic.check_output(Path(name))
    sys.stdout.write("before\n")
    atomic.write_atomically(Path(name), b"\0\xff")
    assert capfdbinary.readouterr().out == b"before\n\0\xff"
    assert not Path("-").exists()


@pytest.mark.process
@pytest.mark.parametrize(("redirection", "found"), [("> out", "1\n2\n3\n"), (">&-", "found a closed stdout")])
def test_stdout_redirected_keeps_what_is_printed_around_it(tmp_path, redirection, found):
    code = (
        "from piccolo.system.files.atomic import *; print(1); write_atomically(Path('-'), b'2\\n'); print(3)"
    )
    command = f'cd "{tmp_path}" && PYTHONPATH="{ROOT}" "{sys.executable}" -c "{code}" {redirection}'
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    assert found in ((tmp_path / "out").read_text() if "out" in redirection else done.stderr)


def test_devices_are_written_to_and_a_full_one_is_named():
    before = Path("/dev/null").stat().st_rdev
    atomic.write_atomically(Path("/dev/null"), b"x")
    assert Path("/dev/null").stat().st_rdev == before
    with pytest.raises(OSError, match=r"No space left on device: '/dev/full'"):
        atomic.write_atomically(Path("/dev/full"), b"x")
    assert Path("/dev/full").is_char_device()


@pytest.mark.process
@pytest.mark.parametrize(("out", "why"), [("link.csv", "File too large"), ("-", "No space left on device")])
def test_a_full_disk_is_one_line_and_leaves_what_was_there(tmp_path, out, why):
    """A limit to the size of files stands for the disk, /dev/full for stdout."""
    (tmp_path / "p.csv").write_bytes(b"old")
    (tmp_path / "link.csv").symlink_to("p.csv")
    write_results(tmp_path / "r.jsonl", [result("a.jpg", Pose(np.eye(3), np.zeros(3)))])
    # -B: Python would keep compiled sources that are cut off at the limit
    tool = f'"{sys.executable}" -B "{ROOT}/tools/export_poses.py" --results r.jsonl --format csv'
    command = f"(ulimit -f {1 if out == '-' else 0}; {tool} --out {out} > /dev/full)"
    done = subprocess.run(["bash", "-c", command], cwd=tmp_path, capture_output=True, text=True, check=False)
    line = f"export_poses.py: {out}: cannot be used ({why})\n"
    assert (done.returncode, done.stderr) == (3, line)
    assert (tmp_path / "p.csv").read_bytes() == b"old"
    assert names(tmp_path) == ["link.csv", "p.csv", "r.jsonl"]


@pytest.mark.process
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_leaves_nothing(tmp_path, number, code):
    def run(arguments):
        with atomic.replacing_folder(tmp_path / "folder") as folder, atomic.replacing(folder / "a") as file:
            file.write(b"half")
            signal.raise_signal(number)
        return 0

    before = [signal.signal(signal.SIGINT, signal.default_int_handler), signal.getsignal(signal.SIGTERM)]
    try:
        assert command("prepare_map.py", None, "", lambda parser: None)(run)([]) == code
        assert signal.getsignal(signal.SIGTERM) is before[1]
    finally:
        signal.signal(signal.SIGINT, before[0])
    assert not names(tmp_path)


def test_outputs_that_can_not_be_are_refused(tmp_path, monkeypatch):
    source, loop = tmp_path / "in.jpg", tmp_path / "loop"
    source.write_bytes(b"x")
    loop.symlink_to("loop")
    (tmp_path / "dangling").symlink_to("no/a")
    for path, message in (
        (tmp_path / "no" / "a.json", "found no folder"),
        (tmp_path / "dangling", "found no folder"),
        (tmp_path, "found a folder"),
        (loop, "found a link that leads to itself"),
    ):
        assert_input_error(message, atomic.check_output, path)
    with pytest.raises(InputError, match="found stdout or a device, wanted a folder"):
        atomic.check_output_folder(Path("/dev/null"))
    assert_input_error("that leads to itself", atomic.write_atomically, loop, b"")
    atomic.check_output(tmp_path / "new.json")
    monkeypatch.setattr(atomic.os, "access", lambda path, mode: path not in (source, Path("/dev/full")))
    for path in (source, Path("/dev/full")):
        assert_input_error("write permission", atomic.check_output, path)
    assert names(tmp_path) == ["dangling", "in.jpg", "loop"]


def test_two_outputs_that_are_one_and_inputs_are_refused(tmp_path):
    new, there, folder = tmp_path / "new.png", tmp_path / "there.png", tmp_path / "photos"
    folder.mkdir()
    for path in (there, folder / "mask.png", folder / "poses.jsonl"):
        path.touch()
    (tmp_path / "hard.png").hardlink_to(there)
    (tmp_path / "soft.png").symlink_to(new)
    for first, second in (
        (new, tmp_path / "photos" / ".." / "new.png"),
        (new, tmp_path / "soft.png"),
        (there, tmp_path / "hard.png"),
        (Path("-"), Path("-")),
        (Path("-"), Path("/dev/stdout")),
        (tmp_path / "frames", tmp_path / "frames" / "a.png"),
    ):
        for pair in ((first, second), (second, first)):
            with pytest.raises(UsageError, match="found the same output as --out for --depth, wanted two"):
                check_distinct(dict(zip(("--out", "--depth"), pair, strict=True)))
    for output, source in ((there, tmp_path / "hard.png"), (folder / "mask.png", folder)):
        with pytest.raises(UsageError, match="found an input as the output, wanted another name"):
            check_outputs({"--out": new, "--depth": output}, [tmp_path / "none", source])
    nothing = Path("/dev/null")
    outputs = {"a": new, "b": folder / "poses.jsonl", "c": nothing, "d": nothing, "e": None}
    check_outputs(outputs, [folder, there])
    check_suffix("--overlay", nothing, (".png",))
    check_suffix("--overlay", Path("A.PNG"), (".png",))
    for name in ("x.jpg", "x", ".png"):
        with pytest.raises(UsageError, match=rf"--overlay {name}: wanted a name that ends with \.png"):
            check_suffix("--overlay", Path(name), (".png",))


def test_two_processes_do_not_write_one_file(tmp_path):
    out = tmp_path / "poses.jsonl"
    for line in ('{"a": 1}', '{"b": 2}'):
        with open_locked(out) as file:
            file.append(line)
            with pytest.raises(InputError, match="another process is writing it"), open_locked(out):
                pass
    assert list(whole_lines(out, whole_size(out, b"{", "a test"))) == [b'{"a": 1}\n', b'{"b": 2}\n']
    with open_locked(tmp_path / "new"):
        pass
    assert not (tmp_path / "new").exists()


def test_a_lock_whose_file_was_removed_before_it_was_taken_is_taken_again(tmp_path, monkeypatch):
    """The first of two ends, and removes the lock's file, which the second has opened before."""
    out = tmp_path / "poses.jsonl"
    lock_descriptor = atomic.lock_descriptor
    first = contextlib.ExitStack()
    first.enter_context(open_locked(out))

    def lock_late(number):
        first.close()
        return lock_descriptor(number)

    monkeypatch.setattr(atomic, "lock_descriptor", lock_late)
    with open_locked(out) as file:
        file.append("{}")
        assert len(list(tmp_path.iterdir())) == 2
    assert list(tmp_path.iterdir()) == [out]
    assert out.read_text() == "{}\n"


def test_windows_locks_a_byte_and_says_so_if_another_has_it(monkeypatch):
    taken = set()

    def locking(number, mode, size):
        assert (mode, size) == (msvcrt.LK_NBLCK, 1)
        if number in taken:
            raise PermissionError(errno.EACCES, "Permission denied")
        taken.add(number)

    msvcrt = types.SimpleNamespace(LK_NBLCK=2, locking=locking)
    monkeypatch.setitem(sys.modules, "msvcrt", msvcrt)
    monkeypatch.setattr(sys, "platform", "win32")
    lock_descriptor = runpy.run_path(lock.__file__)["lock_descriptor"]
    assert [lock_descriptor(number) for number in (7, 8, 7)] == [True, True, False]


HOLD = """
import sys, time
from pathlib import Path
from piccolo.system.files.line_file import open_locked
with open_locked(Path(sys.argv[1])) as file:
    file.append("{}")
    print(flush=True)
    time.sleep(600)
"""


@pytest.mark.process
def test_the_lock_of_a_killed_process_is_free(tmp_path):
    out = tmp_path / "poses.jsonl"
    with subprocess.Popen([sys.executable, "-c", HOLD, out], cwd=ROOT, stdout=subprocess.PIPE) as process:
        process.stdout.readline()
        with pytest.raises(InputError, match="another process is writing it"), open_locked(out):
            pass
        process.kill()
    with open_locked(out) as file:
        file.append("[]")
    assert out.read_text() == "{}\n[]\n"
    assert list(tmp_path.iterdir()) == [out]


def test_lines_are_rearranged_and_more_follow(tmp_path):
    out = tmp_path / "a.jsonl"
    with open_locked(out) as file:
        for line in "abc":
            file.append(line)
        file.rearrange([(4, 6), (0, 2)])
        file.append("d")
        assert file.read(0, file.size) == b"c\na\nd\n"
    assert out.read_text() == "c\na\nd\n"


@pytest.mark.process
def test_a_full_disk_keeps_the_lines_before(tmp_path):
    out = tmp_path / "poses.jsonl"
    code = """
import resource, sys
from pathlib import Path
from piccolo.system.files.line_file import open_locked
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
with open_locked(Path(sys.argv[1])) as file:
    for k in range(9):
        file.append(str(k) * 300)
"""
    done = run([sys.executable, "-B", "-c", code, str(out)], cwd=ROOT)
    assert "File too large" in done.stderr
    assert out.read_text() == "".join(f"{str(k) * 300}\n" for k in range(3))
