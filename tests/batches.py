"""Batches in processes of their own, watched by tests."""

import re
import time
from pathlib import Path


def untimed(out):
    """The text of a file of results without what differs from run to run."""
    return re.sub(r'"seconds": {[^}]*}', "", out.read_text())


def workers_of(process):
    """The ids of the processes that localize for another."""
    children = Path(f"/proc/{process.pid}/task").glob("*/children")
    ids = [int(word) for path in children for word in path.read_text().split()]
    return [id_ for id_ in ids if b"spawn_main" in Path(f"/proc/{id_}/cmdline").read_bytes()]


def wait_for_lines(process, out, count):
    """Return when a process has written so many lines to a file."""
    while not out.exists() or out.read_bytes().count(b"\n") < count:
        assert process.poll() is None
        time.sleep(0.01)
