import os
from pathlib import Path

import pytest

from piccolo.errors import InputError
from piccolo.runtime.atomic import check_output, write_atomically


def test_content_replaces_and_nothing_else_is_left(tmp_path):
    path = tmp_path / "with space.json"
    path.write_bytes(b"old")
    write_atomically(path, b"new")
    assert path.read_bytes() == b"new"
    assert [p.name for p in tmp_path.iterdir()] == ["with space.json"]


def test_failure_leaves_the_old_file_and_no_other(tmp_path, monkeypatch):
    path = tmp_path / "a.json"
    path.write_bytes(b"old")

    def fail(self, target):
        raise OSError("disk")

    monkeypatch.setattr(Path, "replace", fail)
    with pytest.raises(OSError, match="disk"):
        write_atomically(path, b"new")
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]


def test_permissions_follow_the_umask(tmp_path):
    before = os.umask(0o027)
    try:
        write_atomically(tmp_path / "a", b"")
    finally:
        os.umask(before)
    assert (tmp_path / "a").stat().st_mode & 0o777 == 0o640


def test_outputs_that_can_not_be_are_refused(tmp_path):
    source = tmp_path / "in.jpg"
    source.write_bytes(b"x")
    with pytest.raises(InputError, match="found no folder"):
        check_output(tmp_path / "no" / "a.json", [])
    with pytest.raises(InputError, match="found a folder"):
        check_output(tmp_path, [])
    with pytest.raises(InputError, match="an input as the output"):
        check_output(tmp_path / "." / "in.jpg", [source])
    check_output(tmp_path / "new.json", [source])
    assert not (tmp_path / "new.json").exists()
