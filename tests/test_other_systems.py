"""Commands on systems that lack what only Linux has."""

import ast
import json
import re
import sys

from batches import ROOT, run, work
from rooms import write_room

TIER = "process"

SYSTEMS_OWN = {"fcntl", "resource", "pwd", "grp", "termios", "msvcrt", "winreg"}
VARYING = rb'"seconds": ?{[^}]*}|[0-9a-f]{32}'
# Modules and functions of Linux are taken away, when what knows each system has been imported.
ELSEWHERE = f"""
import os, signal, sys
import concurrent.futures.process, multiprocessing.resource_tracker, numba, psutil, tempfile, tqdm
import piccolo.system.files.lock
for name in {SYSTEMS_OWN}:
    sys.modules[name] = None
for name in "getuid fchmod fchown pread sched_getaffinity register_at_fork sysconf O_NOFOLLOW".split():
    delattr(os, name)
del signal.pthread_sigmask, psutil.RLIMIT_AS
sys.path.insert(0, {str(ROOT / "tests")!r})
from piccolo.system.files import atomic
atomic.IS_WINDOWS = True
from batches import work
os.chdir(sys.argv[1])
work()
"""


def _files(folder):
    """Name and content of each file, without what differs from run to run: times, and names made of these."""
    paths = [path for path in folder.rglob("*") if path.is_file() and path.suffix != ".lock"]
    texts = {str(path.relative_to(folder)): re.sub(VARYING, b"", path.read_bytes()) for path in paths}
    return sorted((re.sub("[0-9a-f]{32}", "", name), text) for name, text in texts.items())


def test_commands_make_the_same_files_without_what_only_linux_has(tmp_path, monkeypatch):
    write_room(tmp_path / "room", "--seed 7 --points 12000 --panoramas 2 --width 256 --size 3 2.5 2.4")
    for name in ("here", "elsewhere"):
        (tmp_path / name).mkdir()
    done = run([sys.executable, "-c", ELSEWHERE, tmp_path / "elsewhere"], cwd=ROOT)
    assert (done.returncode, done.stderr) == (0, ""), done.stderr
    monkeypatch.chdir(tmp_path / "here")
    work()
    assert _files(tmp_path / "elsewhere") == _files(tmp_path / "here")
    lines = (tmp_path / "here/poses.jsonl").read_text().splitlines()
    assert [json.loads(line)["status"] for line in lines] == ["localized", "localized"]


def test_only_two_modules_know_what_one_system_has():
    for path in (ROOT / "piccolo").rglob("*.py"):
        source = path.read_text()
        if path.name in ("memory.py", "lock.py") or not any(
            word in source for word in (*SYSTEMS_OWN, "/proc", "/sys/")
        ):
            continue
        nodes = list(ast.walk(ast.parse(source)))
        imported = {a.name for n in nodes if isinstance(n, ast.Import) for a in n.names}
        imported |= {str(n.module) for n in nodes if isinstance(n, ast.ImportFrom)}
        assert not imported & SYSTEMS_OWN, path
        texts = [n.value for n in nodes if isinstance(n, ast.Constant) and isinstance(n.value, str)]
        assert not any("/proc" in text or "/sys/" in text for text in texts), path
