"""Batches in processes of their own, watched by tests."""

import contextlib
import io
import re
import subprocess
import sys
import time
from importlib import import_module
from pathlib import Path

from piccolo.doors import COMMANDS

ROOT = Path(__file__).resolve().parents[1]
PAPER = ["--preset", "paper", "num_translations=4", "num_iterations=5", "max_points=5000"]

# by which photos that colour the scan of a room are aligned and compared
COARSE = {
    "alignment": {
        "LEAST_ALIGNED_POINTS": 5000,
        "POINTS_PER_PHOTO": 0,
        "ALIGNMENT_WIDTHS": (512, 1024),
        "SIGHT_WIDTH": 512,
    },
    "passersby": {"VOTE_WIDTH": 128, "LEAST_VOTING_POINTS": 50_000},
}
# localize.py with these values
COARSELY = f"""
import sys
from piccolo.cli.localize import main
from piccolo.together.coloring import alignment, passersby
vars(alignment).update({COARSE["alignment"]})
vars(passersby).update({COARSE["passersby"]})
sys.exit(main(sys.argv[1:]))
"""

WORK = (  # of the main commands, in a folder beside that of a room
    "prepare_map --cloud ../room/cloud.ply --out a.map",
    "localize --cloud a.map --pano ../room/images/clean_0.jpg --out poses.jsonl",
    "localize --cloud a.map --pano ../room/images --out poses.jsonl",
    "export_poses --results poses.jsonl --format tum --out poses.tum",
    "align_gravity --cloud ../room/cloud.ply --out aligned.ply",
    "report --results poses.jsonl --cloud a.map --cache none --out report",
)


def command_of(script, *words):
    """The command line of a script of the checkout."""
    return [sys.executable, str(ROOT / script), *map(str, words)]


def main_of(script):
    """The `main` of a script of the checkout, to run in this process."""
    text = (ROOT / script).read_text().splitlines()[-1]
    return import_module(re.search(r'"(.+)"', text)[1]).main


def start_localize(words, **options):
    """A process of localize.py whose messages can be read."""
    command = command_of("localize.py", *words)
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, bufsize=1, **options)


def run(command, **options):
    """A command that has ended, with what it printed."""
    return subprocess.run(command, capture_output=True, text=True, check=False, **options)


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


def work():
    """Run the commands in this process, with their files in its folder."""
    for line in WORK:
        name, *words = line.split()
        with contextlib.redirect_stdout(io.StringIO()):
            assert import_module(COMMANDS[name]).main([*words, "--quiet"]) == 0, line
