"""Progress on stderr."""

import sys
import time

from piccolo.cli import terminal


def test_progress_says_step_and_time_left(capsys, monkeypatch):
    monkeypatch.setattr(terminal, "DELAY", 0.0)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    show = terminal.progress_bar(is_quiet=False)
    for label, title in (("find features", "prepare, 3 of 4: find features: "), ("write", "write: ")):
        shown = show(iter([1, 2]), 2, label)
        next(shown)
        time.sleep(0.2)
        next(shown)
        assert list(shown) == []
        printed = capsys.readouterr().err
        assert title in printed
        assert " left" in printed
    assert list(show(iter([1]), None, "read")) == [1]
    assert "read: 0 in 00:00" in capsys.readouterr().err
    monkeypatch.setattr(sys.stderr, "isatty", lambda: False)
    assert list(show(iter([1, 2]), 2, "write")) == [1, 2]
    assert capsys.readouterr().err == ""
