"""The command line of tools/evaluate_gravity.py."""

import evaluate_gravity as gravity_trials
import pytest


def test_a_table_of_kinds(capsys):
    assert (
        gravity_trials.main(["--seeds", "1", "2", "--kinds", "bare", "attic", "--turns", "1", "--quiet"]) == 0
    )
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(" | ")[0] for line in lines[2:]] == ["| bare", "| attic"]
    assert lines[2].split(" | ")[1] == "1"


@pytest.mark.parametrize("arguments", [["--turns", "0"], ["--seeds", "-1", "2"], ["--min-confidence", "2"]])
def test_wrong_usage(arguments, capsys):
    assert gravity_trials.main(arguments) == 2
    assert "found" in capsys.readouterr().err
