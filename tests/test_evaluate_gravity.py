"""The command lines of tools/evaluate_gravity.py and tools/calibrate_gravity.py."""

import re

import calibrate_gravity
import evaluate_gravity
import numpy as np
import pytest
from calibrate_gravity import IN_USE, Choice

from piccolo.gravity.up_features import Weights


def test_a_table_of_kinds(capsys):
    arguments = ["--seeds", "1", "2", "--kinds", "bare", "attic", "--turns", "1", "--quiet"]
    assert evaluate_gravity.main(arguments) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(" | ")[0] for line in lines[2:]] == ["| bare", "| attic", "| all"]
    assert [line.split(" | ")[1] for line in lines[2:]] == ["1", "1", "2"]


def test_as_scanned_no_kind_of_place_is_turned(capsys):
    kinds = ["showroom", "racks", "stairs", "bare", "tunnel"]
    assert evaluate_gravity.main(["--seeds", "3", "4", "--as-scanned", "--quiet", "--kinds", *kinds]) == 0
    total = capsys.readouterr().out.splitlines()[-1].split(" | ")
    assert total[:2] == ["| all", str(len(kinds))]
    assert int(total[4]) == 0  # wrong


@pytest.mark.parametrize(
    ("tool", "arguments", "message"),
    [
        (evaluate_gravity, ["--turns", "0"], "--turns: found 0, wanted at least 1"),
        (evaluate_gravity, ["--seeds", "-1", "2"], "--seeds: found [-1, 2], wanted 0 or more"),
        (evaluate_gravity, ["--min-confidence", "2"], "--min-confidence"),
        (calibrate_gravity, ["--fit", "3", "3"], "--fit: 3 3 is no range"),
        (calibrate_gravity, ["--threads", "0"], "--threads"),
    ],
)
def test_wrong_usage(tool, arguments, message, capsys):
    assert tool.main(arguments) == 2
    assert message in capsys.readouterr().err


def test_the_fit_finds_the_cue_that_tells():
    rng = np.random.default_rng(1)
    choices = [
        Choice("room", rng.normal(size=(6, len(Weights._fields))), np.arange(6) == 0) for _ in range(300)
    ]
    for choice in choices:
        choice.cues[0, 3] += 3.0
    fitted = calibrate_gravity.fit(choices)
    assert fitted[3] > 5.0 * np.delete(fitted, 3).max()
    likelihoods, is_right = calibrate_gravity.log_likelihoods(fitted, choices)
    assert likelihoods.mean() > calibrate_gravity.log_likelihoods(IN_USE, choices)[0].mean()
    assert is_right.mean() > 0.8


def test_weights_are_printed_as_the_module_holds_them(monkeypatch, capsys):
    attic = {"attic": calibrate_gravity.BUILDINGS["attic"]}
    monkeypatch.setattr(calibrate_gravity, "BUILDINGS", attic)
    assert (
        calibrate_gravity.main(["--kinds", "attic", "--fit", "1", "2", "--check", "2", "3", "--quiet"]) == 0
    )
    weights, _, *table = capsys.readouterr().out.splitlines()
    assert tuple(re.findall(r"(\w+)=", weights)) == Weights._fields
    assert [line.split(" | ")[:2] for line in table[2:]] == [["| attic", "1"], ["| all", "1"]]
