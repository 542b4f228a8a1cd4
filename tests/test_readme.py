"""Commands and lines of Python of README and docs/TOOLS.md, run as they are written."""

import json
import re
import shlex
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
from batches import main_of

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text()
TOOLS = (ROOT / "docs" / "TOOLS.md").read_text()


def _tools_commands():
    """The blocks of commands that begin with a made room."""
    blocks = re.findall(r"(?:^    (?:python|mkdir) .*\n)+", TOOLS, flags=re.MULTILINE)
    return [block.strip().splitlines() for block in blocks if "make_room" in block]


def _expanded(word):
    return sorted(map(str, Path().glob(word)))


def _run_all(commands, folder, monkeypatch, capsys):
    """Run commands as a shell would do it in a folder, but in this process; returns what they print."""
    monkeypatch.chdir(folder)
    for command in commands:
        program, *words = shlex.split(command.partition(" > ")[0].strip().removeprefix("python "))
        words = [name for word in words for name in (_expanded(word) if "*" in word else [word])]
        if program == "mkdir":
            Path(*words).mkdir()
        else:
            assert main_of(program)(words) == 0, capsys.readouterr().err
    return capsys.readouterr().out


def test_readme_python_prints_what_it_says():
    lines = re.search(r"^    import piccolo\n(?:    .*\n)+", README, flags=re.MULTILINE)[0]
    command = [sys.executable, "-c", textwrap.dedent(lines)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    pose, document = done.stdout.splitlines()
    assert f"prints `{pose}`" in README
    assert json.loads(document)["status"] == "localized"


def test_readme_command_prints_and_writes_what_it_says(tmp_path, monkeypatch, capsys):
    (command,) = re.findall(r"^    (python localize.py .*) > pose.json$", README, flags=re.MULTILINE)
    out = _run_all(
        [command.replace("examples/", f"{shlex.quote(str(ROOT))}/examples/")], tmp_path, monkeypatch, capsys
    )
    result = json.loads(out)
    shown = "".join(
        re.search(r"^    {\"status\".*\n(?:     .*\n)+", README, flags=re.MULTILINE)[0].split("\n")
    )
    for name, value in json.loads(shown).items():
        if name == "alternatives":
            assert value[0]["center_world"] == pytest.approx(result[name][0]["center_world"], abs=1e-4)
        else:
            assert value == pytest.approx(result[name], abs=5e-3), name
    assert (tmp_path / "overlay.png").read_bytes().startswith(b"\x89PNG")


def test_room_runs_as_written(tmp_path, monkeypatch, capsys):
    room, _ = _tools_commands()
    assert "| all | 2 | 2 | 1.000 |" in _run_all(room, tmp_path, monkeypatch, capsys)
    assert (tmp_path / "room" / "risk.png").read_bytes().startswith(b"\x89PNG")
    assert len((tmp_path / "room" / "poses.csv").read_text().splitlines()) == 3


def test_pipeline_runs_as_written(tmp_path, monkeypatch, capsys):
    _, pipeline = _tools_commands()
    printed = _run_all(pipeline, tmp_path, monkeypatch, capsys)
    assert len((tmp_path / "poses.jsonl").read_text().splitlines()) == 2
    assert '"fits": true' in printed
    assert '"status": "aligned"' in printed
    assert "| default.jsonl | 2 | 2 | 1.000 |" in printed
    assert (tmp_path / "aligned" / "room.map").stat().st_size > 100_000
    assert len((tmp_path / "paper.jsonl").read_text().splitlines()) == 2
