"""How exact a pose must be: what the user says decides, and says the same of every photo."""

import math
from dataclasses import replace

import numpy as np
import pytest
from refusals import assert_input_error
from results import RESULT

from piccolo.cli.command import new_parser, parse
from piccolo.cli.options import add_arguments
from piccolo.cli.settings_given import settings_from
from piccolo.geometry.nearness import RIGHT
from piccolo.geometry.pose import Pose, exp_so3
from piccolo.geometry.pose_gaussian import PoseGaussian, probability_of_ball
from piccolo.judge.accuracy_hint import explain_accuracy
from piccolo.judge.belief import make_belief
from piccolo.judge.pose_covariance import PoseCovariance
from piccolo.judge.reasons import Reason
from piccolo.judge.result_parts import FocalLength
from piccolo.problem.accuracy import PAPER_ACCURACY, Accuracy, Demand
from piccolo.problem.settings import CoarseToFineSettings

HERE = Pose(exp_so3(np.array([0.3, -0.2, 0.9])), np.array([1.0, 2.0, 3.0]))


def _errors(metres, degrees=0.1):
    """A covariance (6, 6) of one deviation along all axes of the position, and one about all axes."""
    return np.diag([math.radians(degrees) ** 2] * 3 + [metres**2] * 3)


def _found(metres, degrees=0.1):
    """A pose with half of its errors in common with others."""
    return PoseGaussian(HERE, 0.5 * _errors(metres, degrees), 0.5 * _errors(metres, degrees))


def _hint(place, metres, degrees=0.1, asked=PAPER_ACCURACY):
    return explain_accuracy(place, PoseCovariance(_errors(metres, degrees), ""), Demand(asked, 0.9))


def _settings(*numbers, preset="default"):
    """The settings of a command line with an accuracy."""
    parser = new_parser("localize", "", "")
    add_arguments(parser)
    words = ["--accuracy", *numbers] if numbers else []
    return settings_from(parse(parser, ["--cloud", "a.ply", "--preset", preset, *words]))


def test_a_position_is_within_a_distance_by_chi_square_of_three():
    assert PAPER_ACCURACY.probability(None) == 1.0
    along = np.diag([0.0, 0.0, 0.0, 0.05**2, 0.0, 0.0])
    found = PoseGaussian(HERE, 0.5 * along, 0.5 * along)
    assert PAPER_ACCURACY.probability(found) == pytest.approx(0.9545, abs=1e-4)
    assert PAPER_ACCURACY.probability(_found(0.05)) == pytest.approx(0.7385, abs=1e-4)
    assert Accuracy(0.25).probability(_found(0.125)) == pytest.approx(0.7385, abs=1e-4)
    assert Accuracy(0.25).probability(_found(0.05)) > 0.9999


def test_rotations_count_as_positions_do():
    by_position = Accuracy(1.0, 180.0).probability(_found(0.4))
    assert Accuracy(100.0, 2.5).probability(_found(0.4, 1.0)) == pytest.approx(by_position, abs=1e-4)
    of_both = Accuracy(1.0, 2.5).parts(_errors(0.4, 1.0))
    assert Accuracy(1.0, 2.5).probability(_found(0.4, 1.0)) == math.prod(of_both)


@pytest.mark.parametrize("std_deg", [0.1, 1.2])
def test_a_rotation_that_surely_is_exact_enough_changes_no_bit(std_deg):
    found = _found(0.05, std_deg)
    assert PAPER_ACCURACY.probability(found) == probability_of_ball(found.covariance[3:, 3:], 0.1)


def test_another_pose_is_as_exact_as_the_one_expected_less_the_gap():
    wide = _found(0.05)
    assert PAPER_ACCURACY.probability_at(HERE, wide) == pytest.approx(0.9545, abs=1e-4)
    away = Pose(HERE.R_cam_from_world, HERE.center_world + np.array([0.0, 0.3, 0.0]))
    assert PAPER_ACCURACY.probability_at(away, wide) < 1e-4
    assert Accuracy(0.5).probability_at(away, wide) > 0.999
    turned = Pose(exp_so3(np.array([0.0, 0.0, math.radians(8.0)])) @ HERE.R_cam_from_world, HERE.center_world)
    assert PAPER_ACCURACY.probability_at(turned, wide) < 1e-4
    assert Accuracy(0.1, 10.0).probability_at(turned, wide) == pytest.approx(0.9545, abs=1e-4)


def test_the_default_is_the_line_of_the_paper():
    assert PAPER_ACCURACY.nearness == RIGHT
    assert CoarseToFineSettings().demand == Demand(PAPER_ACCURACY, 0.9)
    assert (str(PAPER_ACCURACY), str(Accuracy(0.25)), str(Accuracy(1, 2.5))) == ("0.1", "0.25", "1 2.5")


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ((0.0,), "found 0 m, wanted metres above 0"),
        ((math.nan,), "found nan m, wanted metres above 0"),
        ((math.inf,), "found inf m"),
        ((0.1, 0.0), "found 0 degrees, wanted above 0 and at most 180"),
        ((0.1, 200.0), "found 200 degrees"),
        (("near",), "`metres`: found 'near', wanted a number"),
    ],
)
def test_an_accuracy_that_means_nothing_is_refused(numbers, words):
    assert_input_error(words, Accuracy, *numbers)


@pytest.mark.parametrize(
    ("place", "metres", "degrees", "words"),
    [
        (0.98, 0.07, 0.1, "the position only to 0.19 m: `accuracy` 0.25 would accept it"),
        (0.98, 0.3, 0.1, "the position only to 0.78 m: `accuracy` 1 would accept it"),
        (0.98, 0.02, 2.5, "the rotation only to 6.5 deg: `accuracy` 0.1 10 would accept it"),
        (
            0.98,
            0.07,
            2.5,
            "0.19 m and the rotation only to 6.6 deg: `accuracy` 0.25 10 would accept it",
        ),
        (0.905, 0.03, 0.1, "the position only to 0.11 m"),  # what the place lacks, the position must have
        (0.89, 0.07, 0.1, None),  # the place is not certain
        (0.98, 0.02, 0.1, None),  # it is exact enough
        (0.98, 90.0, 0.1, None),  # nothing would accept it
    ],
)
def test_a_certain_place_is_told_the_accuracy_that_would_accept_it(place, metres, degrees, words):
    hint = _hint(place, metres, degrees)
    assert (hint is None) == (words is None)
    if hint is not None:
        assert hint.startswith("the place is certain, ")
        assert words in hint


@pytest.mark.parametrize("metres", [0.01, 0.06, 0.1, 0.4, 3.0])
def test_what_a_hint_proposes_is_accepted(metres):
    asked = Accuracy(0.005)
    enough = asked.relax(_errors(metres), 0.95)
    assert enough.probability(_found(metres)) >= 0.95 > asked.probability(_found(metres))


def test_a_result_says_whether_the_place_is_right_and_whether_it_is_exact():
    wanted = {"accuracy": {"metres": 0.001, "degrees": 5.0}, "min_confidence": 0.9}
    belief = make_belief([0.98, 0.01], within=0.3, doubt=0.01)
    told = replace(RESULT, settings=wanted).take_belief(belief, 0.9)
    assert told.status == "not_localized"
    assert told.place_probability == 0.98
    assert told.confidence == pytest.approx(0.3 * 0.98 * 0.99)
    assert told.hint.endswith("would accept it")
    assert told.hint in told._repr_html_().replace("&#x27;", "'")
    assert told.take_belief(replace(belief, within=1.0), 0.9).hint is None, "it is localized"
    doubted = told.take_belief(replace(belief, doubt=0.1), 0.9)
    assert doubted.hint is None, "what was given may be wrong"
    by_focal = replace(doubted, focal_length=FocalLength(700.0, 9.0, 800.0, 9.0))
    assert by_focal.hint.endswith(told.hint[-32:]), "what is less exact needs less confirmation"
    assert told.take_belief(belief.rule_out(Reason.MIRRORED), 0.9).place_probability == 0.0
    assert replace(told, settings={}).hint is None
    assert replace(told, best_pose=None, belief=make_belief([])).place_probability == 0.0


@pytest.mark.parametrize(
    ("words", "expected"),
    [([], PAPER_ACCURACY), (["0.25"], Accuracy(0.25)), (["1", "2.5"], Accuracy(1.0, 2.5))],
)
def test_an_option_asks_for_it(words, expected):
    assert _settings(*words).accuracy == expected


def test_an_option_of_three_numbers_or_of_the_paper_is_refused():
    assert_input_error(
        "`accuracy`: found 3 numbers, wanted METRES or METRES DEGREES", _settings, "1", "2", "3"
    )
    assert_input_error("`accuracy`: not an option of the preset paper", _settings, "1", preset="paper")
