import math

import numpy as np
import pytest
import rooms
from made_up import at
from rooms import as_panorama

from piccolo.evidence.occlusion import Agreement, measure_agreement
from piccolo.geometry.nearness import Nearness
from piccolo.geometry.pose import exp_so3, step
from piccolo.judge import alternatives, probability as rule
from piccolo.judge.belief import make_belief
from piccolo.judge.pose_covariance import PoseCovariance, least_constrained_direction
from piccolo.judge.probability import Standing, classify, posterior
from piccolo.localization.paper import PaperSettings
from piccolo.problem.settings import CoarseToFineSettings
from piccolo.system.errors import InputError

SURE = 0.0005  # [rad] largest deviation
RIGHT, WRONG = Standing(1.0, 0.8, 60, "drawn scan"), Standing(1.0, 0.03, 3, "drawn scan")
ELSEWHERE = Standing(0.1, 0.05, 3, "drawn scan")
MODEL = rule.ChoiceModel((3.0, 1.0, 2.0), (10.0, 2.0))


def test_probabilities_are_those_of_the_formula_and_add_up_to_one():
    """A conditional logit by a pocket calculator, with made-up weights."""
    standings = [Standing(*values, "drawn scan") for values in ((1.0, 0.5, 12), (0.5, 0.1, 2))]
    p = posterior(standings, 0.01, model=MODEL)
    e = math.exp
    odds = [0.5 * 20.0**2, 0.5**3 * 0.1 * 10.0**2, e(10.0 - 2.0 * 2.0)]
    np.testing.assert_allclose(p, np.array(odds) / sum(odds), rtol=1e-12)


def test_right_and_wrong_evidence():
    for model in rule.MODELS.values():
        assert all(w > 0.0 for w in model.weights)
        assert model.none_weights[1] >= 0.0
    p = posterior([RIGHT, ELSEWHERE], SURE)
    assert p[0] > 0.98
    assert classify(p, 0.9) == rule.LOCALIZED
    p = posterior([WRONG, ELSEWHERE._replace(ratio=0.9)], None)
    assert p[0] < 0.2
    assert classify(p, 0.9) == rule.NOT_LOCALIZED


def test_each_kind_of_evidence_has_a_model_of_its_own():
    """Whole views alone have two features; local features count once asked, even if none agrees."""
    views = Standing(0.5, 0.2, None, "views")
    np.testing.assert_array_equal(rule.pose_features(views), np.log([0.5, 0.2]))
    asked = views._replace(num_matches=0, evidence="drawn scan")
    drawn = views._replace(drawn_score=0.05, evidence="shape")
    np.testing.assert_array_equal(rule.pose_features(drawn), np.log([0.5, 0.2, 0.05]))
    standings = [drawn, views, asked]
    assert [standing.evidence for standing in standings] == list(rule.MODELS)
    assert [len(model.weights) for model in rule.MODELS.values()] == [3, 2, 3]
    for standing in standings:
        model = rule.MODELS[standing.evidence]
        expected = rule.pose_features(standing) @ np.array(model.weights) - 2.0
        assert rule.log_odds(standing._replace(log_prior=-2.0)) == pytest.approx(expected)
        np.testing.assert_array_equal(posterior([standing], SURE), posterior([standing], SURE, model=model))
    right, wrong = (one._replace(num_matches=None, evidence="views") for one in (RIGHT, WRONG))
    assert classify(posterior([right], SURE), 0.9) == rule.LOCALIZED
    p = posterior([wrong], None)
    assert classify(p, 0.9) == rule.NOT_LOCALIZED


@pytest.mark.parametrize(
    ("mirrored", "factor"),
    [
        (ELSEWHERE._replace(score=0.001), 1.0),  # a mirrored photo that fits far worse tells nothing
        (RIGHT, 1.0 + 0.5 / rule.SYMMETRIC),  # one that fits as well does so by chance, or by symmetry
        (RIGHT._replace(num_matches=60_000), 1.0 + 1.0 / rule.SYMMETRIC),  # all the more, but with a bound
    ],
)
def test_a_photo_that_fits_as_well_mirrored_may_fit_by_chance(mirrored, factor):
    alone, none = posterior([RIGHT], SURE)
    p = posterior([RIGHT], SURE, mirrored=rule.Mirrored(mirrored))
    assert p[-1] / p[0] == pytest.approx(factor * none / alone, rel=1e-3)


def test_no_pose_is_surer_than_that_the_photo_was_not_mirrored():
    share = rule.share_unmirrored
    assert share([RIGHT], None) == share([RIGHT], rule.Mirrored(None)) == 1.0
    assert share([RIGHT], rule.Mirrored(ELSEWHERE._replace(score=0.001))) > 0.999
    alike = rule.Mirrored(RIGHT)
    assert share([RIGHT], alike) == pytest.approx(1.0 / (1.0 + rule.TURNED_OVER))
    assert share([WRONG, RIGHT], alike) == share([RIGHT], alike), "against the pose that fits best"
    twice = rule.Mirrored(RIGHT._replace(num_matches=2 * RIGHT.num_matches + rule.METHOD.noise_matches))
    weight = rule.MODELS[RIGHT.evidence].weights[2]
    assert share([RIGHT], twice) == pytest.approx(1.0 / (1.0 + rule.TURNED_OVER * 2.0**weight))


@pytest.mark.parametrize("copies", [2, 3, 5])
def test_copies_share_the_probability_alike_and_none_of_them_is_localized(copies):
    p = posterior([RIGHT] * copies, SURE)
    np.testing.assert_allclose(p[:-1], (1.0 - p[-1]) / copies)
    assert p[-1] < 0.05
    assert classify(p, 0.9) == rule.AMBIGUOUS


@pytest.mark.parametrize(("name", "more"), [("score", 0.1), ("num_matches", 5), ("ratio", 0.1)])
def test_more_evidence_is_more_probability(name, more):
    middling = Standing(1.0, 0.15, 8, "drawn scan")
    stronger = middling._replace(**{name: getattr(middling, name) + more})
    assert posterior([middling], SURE)[0] < posterior([stronger], SURE)[0]
    assert posterior([middling], None)[0] < posterior([middling], SURE)[0]
    pair = [posterior([middling, e], SURE)[0] for e in (middling, stronger)]
    assert pair[1] < pair[0] < posterior([middling], SURE)[0]


@pytest.mark.parametrize("within", [0.954, 0.5])
def test_a_pose_that_may_be_a_decimetre_off_is_doubtful_whatever_the_evidence(within):
    p = make_belief(posterior([RIGHT._replace(num_matches=10**7)], SURE)[:-1], within).probabilities
    assert p[0] == pytest.approx(within, abs=0.002)
    assert p.sum() == pytest.approx(1.0)


@pytest.mark.parametrize(("a", "b"), [(0.25, 12.5), (0.00075, 0.00025)])
def test_numbers_beyond_reason_change_nothing_more(a, b):
    np.testing.assert_array_equal(*(rule.none_features(std) for std in (a, b)))
    assert (rule.none_features(None) == rule.none_features(0.075)).all()
    least, less = (Standing(*values, 0, "drawn scan") for values in ((0.0, 0.02), (-0.5, -0.3)))
    faint, nothing = (rule.pose_features(standing) for standing in (least, less))
    np.testing.assert_array_equal(faint, nothing)
    np.testing.assert_array_equal(faint, np.log([0.1, 0.02, 8.0]))


def test_the_line_moves():
    p = np.array([0.6, 0.3, 0.1])
    for line, status in ((0.6, rule.LOCALIZED), (0.61, rule.AMBIGUOUS), (0.9, rule.AMBIGUOUS)):
        assert classify(p, line) == status
    assert classify(p, 0.91) == rule.NOT_LOCALIZED


@pytest.mark.parametrize("settings", [CoarseToFineSettings, PaperSettings])
@pytest.mark.parametrize("value", [0.0, 1.0, -1.0, float("nan")])
def test_lines_that_mean_nothing_are_refused(settings, value):
    with pytest.raises(InputError, match=f"`min_confidence`: found {value}, wanted above 0 and below 1"):
        settings(min_confidence=value)
    assert settings(min_confidence=0.01).min_confidence == 0.01


def test_alternatives_are_apart_from_the_best_and_from_each_other():
    best = at(0.0, 0.9)
    near, turned, far, beside_far = at(0.4, 0.8), at(0.1, 0.3, 20.0), at(3.0, 0.5), at(3.2, 0.4)
    assert alternatives.alternative_poses(best, [best, near, turned, far, beside_far]) == [far, turned]
    found = alternatives.alternative_poses(at(0, 1.0), [at(2.0 * k, 0.5) for k in range(1, 20)])
    assert len(found) == alternatives.MAX_ALTERNATIVES


def test_best_distinct_keeps_the_better_of_two_that_are_near():
    a, b, c = at(0.0, 0.5), at(0.05, 0.6), at(1.0, 0.1)
    assert alternatives.best_distinct([a, b, c], 5, Nearness(0.1, 0.1)) == [b, c]
    assert alternatives.best_distinct([a, b, c], 1, Nearness(0.1, 0.1)) == [b]


def _words(std_ratio=3.0, tilt_deg=0.0, turn=0.0):
    """Words for a camera least sure along heading 50 deg."""
    R = exp_so3(np.array([0.0, 0.0, np.radians(40.0)]))
    direction = R @ exp_so3(np.array([0.0, -np.radians(tilt_deg), 0.0]))[:, 0]
    covariance = 1e-6 * (np.eye(3) + (std_ratio**2 - 1.0) * np.outer(direction, direction))
    R_world_from_map = exp_so3(np.array([0.0, 0.0, turn]))
    in_world = R_world_from_map @ covariance @ R_world_from_map.T
    return least_constrained_direction(covariance, in_world)


@pytest.mark.parametrize(
    ("case", "expected"),
    [
        ({"std_ratio": 1.45}, "much the same in all directions"),
        ({"std_ratio": 1.55}, "along heading 50/230 deg"),
        ({"tilt_deg": 61.0}, "up and down"),
        ({"tilt_deg": 59.0}, "along heading 50/230 deg"),
        ({"turn": np.radians(-90.0)}, "along heading 140/320 deg"),  # the world's, not the map's
    ],
)
def test_direction_in_words(case, expected):
    assert _words(**case) == expected


def test_deviations():
    covariance = PoseCovariance(np.diag([1e-4, 4e-4, 9e-4, 1e-6, 4e-6, 9e-6]), "")
    np.testing.assert_allclose(covariance.std_deg, np.degrees([0.01, 0.02, 0.03]))
    np.testing.assert_allclose(covariance.std_mm, [1.0, 2.0, 3.0])
    assert np.isclose(covariance.largest_std, 0.003)


@pytest.fixture(scope="module")
def scene():
    return rooms.scene(1)


def test_true_pose_scores_high_and_explains_most_of_the_panorama(scene):
    points, panorama, true_pose = scene
    assert measure_agreement(points, panorama, true_pose).score > 0.5
    for delta in ([0, 0, 1.0, 0, 0, 0], [0, 0, 0, 1.0, 0.5, 0]):
        assert measure_agreement(points, panorama, step(true_pose, np.array(delta))).score < 0.25
    right = measure_agreement(points, panorama, true_pose)
    wrong = measure_agreement(points, panorama, step(true_pose, np.array([0, 0, 1.0, 0, 0, 0])))
    assert right.correlation > 0.5 > wrong.correlation
    assert 0.9 < right.seen_fraction <= 1.0


@pytest.mark.parametrize("level", [0, 128, 255])
def test_a_blank_wall_can_not_win(scene, level):
    points, panorama, true_pose = scene
    blank = as_panorama(np.full_like(panorama.rgb, level))
    assert abs(measure_agreement(points, blank, true_pose).score) < 0.05


def test_score_and_value_charge_a_view_of_which_little_is_seen():
    for seen, value, score in ((0.25, 0.3, 0.3), (0.64, 0.6, 0.48), (1.0, 0.6, 0.6)):
        agreement = Agreement(correlation=0.6, seen_fraction=seen)
        assert (agreement.value, agreement.score) == (pytest.approx(value), pytest.approx(score))
