"""Folders of temporary files after a process was killed."""

import os
import subprocess
import sys
import time

import pytest

from piccolo.files import temporary
from piccolo.files.temporary import PREFIX, temporary_folder

HOLD = """
import sys, time
from piccolo.files.temporary import temporary_folder
with temporary_folder() as folder:
    (folder / "frame.jpg").touch()
    print(folder, flush=True)
    time.sleep(600)
"""


@pytest.fixture
def folders(tmp_path, monkeypatch):
    """A function that lists the temporary folders there are."""
    monkeypatch.setattr(temporary.tempfile, "tempdir", str(tmp_path))
    return lambda: [path for path in tmp_path.iterdir() if path.name.startswith(PREFIX)]


def test_a_folder_is_removed_at_the_end_and_after_an_error(folders):
    with temporary_folder() as folder:
        (folder / "a").touch()
        assert folders() == [folder]
    with pytest.raises(ValueError, match="x"), temporary_folder():
        raise ValueError("x")
    assert folders() == []


def test_what_a_killed_process_left_is_removed_and_what_a_living_one_has_stays(folders, tmp_path):
    command = [sys.executable, "-c", HOLD]
    where = os.environ | {"TMPDIR": str(tmp_path)}
    with subprocess.Popen(command, env=where, stdout=subprocess.PIPE, text=True) as process:
        folder = tmp_path / process.stdout.readline().strip()
        os.utime(folder, (time.time() - 60, time.time() - 60))
        with temporary_folder():
            assert folder in folders()
        process.kill()
    (tmp_path / f"{PREFIX}12345678").symlink_to(tmp_path)
    (tmp_path / f"{PREFIX}87654321").mkdir()  # made a moment ago
    with temporary_folder() as own:
        assert {path.name for path in folders()} == {own.name, f"{PREFIX}12345678", f"{PREFIX}87654321"}
