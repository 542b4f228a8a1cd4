"""The README's commands and lines of Python, run as they are written."""

import json
import os
import re
import subprocess
import sys
import textwrap
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text()


def _readme_commands():
    """The blocks of commands that begin with a made room."""
    blocks = re.findall(r"(?:^    (?:python|mkdir) .*\n)+", README, flags=re.MULTILINE)
    return [block.strip().splitlines() for block in blocks if "make_room" in block]


def _run_all(commands, folder):
    printed = []
    for command in commands:
        script = re.sub("^python ", f"'{sys.executable}' '{ROOT}'/", command.strip())
        done = subprocess.run(["bash", "-c", script], cwd=folder, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        printed.append(done.stdout)
    return "".join(printed)


def test_readme_python_prints_what_it_says_in_the_demo(tmp_path):
    (demo,) = re.findall(r"tools/make_room.py .* > /dev/null", (ROOT / "Makefile").read_text())
    _run_all([f"python {demo}"], tmp_path)
    lines = re.search(r"^    import piccolo\n(?:    .*\n)+", README, flags=re.MULTILINE)[0]
    command = [sys.executable, "-c", textwrap.dedent(lines)]
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    pose, document = done.stdout.splitlines()
    assert f"prints `{pose}`" in README
    assert all(f'"{key}": ' in README for key in json.loads(document))


def test_readme_room_runs_as_written(tmp_path):
    room, _ = _readme_commands()
    assert "| all | 2 | 2 | 1.000 |" in _run_all(room, tmp_path)
    assert (tmp_path / "room" / "risk.png").read_bytes().startswith(b"\x89PNG")
    assert len((tmp_path / "room" / "poses.csv").read_text().splitlines()) == 3


def test_readme_pipeline_runs_as_written(tmp_path):
    _, pipeline = _readme_commands()
    printed = _run_all(pipeline, tmp_path)
    assert len((tmp_path / "poses.jsonl").read_text().splitlines()) == 2
    assert '"fits": true' in printed
    assert '"status": "aligned"' in printed
    assert "| default.jsonl | 2 | 2 | 1.000 |" in printed
    assert (tmp_path / "aligned" / "room.map").stat().st_size > 100_000
    assert len((tmp_path / "paper.jsonl").read_text().splitlines()) == 2
