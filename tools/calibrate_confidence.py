#!/usr/bin/env python3
"""Learn the confidence from trials, and check it, and the covariances, on others."""

import argparse
import json
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import _checkout  # noqa: F401
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.stats import chi2

from piccolo.cli.command import command, option
from piccolo.confidence.confidence import (
    AMBIGUOUS,
    DIRECTIONS,
    FEATURES,
    LOCALIZED,
    MIN_CONFIDENCE,
    MODEL,
    PAPER_MODEL,
    LogisticModel,
    classify,
    confidence_of,
    features_of,
)
from piccolo.confidence.covariance import PoseCovariance
from piccolo.confidence.score import Evidence
from piccolo.geometry.pose import Pose, is_correct, log_so3
from piccolo.result import Result
from piccolo.runtime.json_file import parse_lines, read_bytes

EPILOG = """\
example:
  python tools/calibrate_confidence.py --fit trials.jsonl --check others.jsonl bench.jsonl

Files are those of tools/evaluate_confidence.py. The weights printed go into
piccolo/confidence/confidence.py; the tables show how reliable the confidence in use is on each set, and the
fraction of true poses in the region of the covariance.
"""
PENALTY = 0.05  # on squared weights of features of deviation 1: without, easy trials ask for ever larger ones
LEVELS = (0.0, 0.5, 0.9, 0.99, 1.01)
Array = NDArray[np.float64]


class Outcome(NamedTuple):
    """One trial's evidence, and whether its pose was right."""

    case: str
    evidence: Evidence
    covariance: PoseCovariance | None
    has_alternatives: bool
    model: LogisticModel  # in use for the preset
    is_correct: bool
    error: Array  # (6,) of the pose, as PoseCovariance has it; NaN without truth


def read_outcomes(paths: Sequence[Path]) -> list[Outcome]:
    """The trials of some files that came to a pose."""
    wanted = "wanted a file of tools/evaluate_confidence.py"
    lines = [line for path in paths for line in parse_lines(path, read_bytes(path, wanted), outcome_of)]
    return [outcome for outcome in lines if outcome is not None]


def outcome_of(line: str) -> Outcome | None:
    """One line of tools/evaluate_confidence.py; None if no pose was found."""
    trial = json.loads(line)
    result, truth = Result.from_json(json.dumps(trial["result"])), trial["truth"]
    if result.best_pose is None or result.evidence is None:
        return None
    error, ok = np.full(6, np.nan), False
    if isinstance(truth, dict):
        true_pose = Pose(np.array(truth["R_cam_from_world"]), np.array(truth["center_world"]))
        turn = log_so3(true_pose.R_cam_from_world @ result.best_pose.R_cam_from_world.T)
        error = np.concatenate([turn, true_pose.center_world - result.best_pose.center_world])
        ok = is_correct(result.best_pose, true_pose)
    model = PAPER_MODEL if result.settings["preset"] == "paper" else MODEL
    has_alternatives = len(result.alternatives) > 0
    return Outcome(str(trial["case"]), result.evidence, result.covariance, has_alternatives, model, ok, error)


def fit(outcomes: Sequence[Outcome]) -> tuple[float, Array]:
    """Bias and weights of the logistic regression with the least penalised loss."""
    X = np.array([features_of(o.evidence, o.covariance)[: len(o.model.weights)] for o in outcomes])
    y = np.array([o.is_correct for o in outcomes], float)
    mean, deviation = X.mean(axis=0), X.std(axis=0)
    deviation[deviation == 0.0] = 1.0  # a feature that is the same in all trials
    Z = np.column_stack([np.ones(len(X)), (X - mean) / deviation])

    def loss(w: Array) -> tuple[float, Array]:
        logit = Z @ w
        p = 1.0 / (1.0 + np.exp(-logit))
        gradient = Z.T @ (p - y) + PENALTY * np.r_[0.0, w[1:]]
        return float(np.logaddexp(0.0, logit).sum() - y @ logit + 0.5 * PENALTY * w[1:] @ w[1:]), gradient

    ranges = [(0.0, None) if sign > 0 else (None, 0.0) for sign in DIRECTIONS[: X.shape[1]]]
    w = minimize(loss, np.zeros(Z.shape[1]), jac=True, method="L-BFGS-B", bounds=[(None, None), *ranges]).x
    weights = w[1:] / deviation
    return float(w[0] - weights @ mean), weights


def print_reliability(name: str, outcomes: Sequence[Outcome]) -> None:
    """How many poses were right in each range of confidence."""
    print(f"\n| confidence, {name} | poses | right | wrong |")
    print("|---|---:|---:|---:|")
    for low, high in pairwise(LEVELS):
        some = [o for o in outcomes if low <= confidence_of(o.evidence, o.covariance, o.model) < high]
        right = sum(o.is_correct for o in some)
        print(f"| {low} to {min(high, 1.0)} | {len(some)} | {right} | {len(some) - right} |")


def print_cases(name: str, outcomes: Sequence[Outcome]) -> None:
    """The statuses of each case with the confidence in use."""
    print(f"\n| case, {name} | poses | right | localized | ambiguous | false |")
    print("|---|---:|---:|---:|---:|---:|")
    for case in dict.fromkeys(o.case for o in outcomes):
        some = [o for o in outcomes if o.case == case]
        evidence = [(o.evidence, o.covariance, o.has_alternatives, MIN_CONFIDENCE, o.model) for o in some]
        called = [classify(*one)[0] for one in evidence]
        false = sum(s == LOCALIZED and not o.is_correct for s, o in zip(called, some, strict=True))
        counts = sum(o.is_correct for o in some), called.count(LOCALIZED), called.count(AMBIGUOUS), false
        print(f"| {case} | {len(some)} | {' | '.join(map(str, counts))} |")


def print_coverage(name: str, outcomes: Sequence[Outcome]) -> None:
    """The fraction of right poses whose error lies in the covariance's 95 % region."""
    some = [o for o in outcomes if o.is_correct and o.covariance is not None]
    if not some:
        return
    print(f"\n| covariance, {name} | right poses | in the 95 % region | in the 50 % region |")
    print("|---|---:|---:|---:|")
    errors = np.array([o.error for o in some])
    matrices = np.array([o.covariance.matrix for o in some if o.covariance is not None])
    parts = {"rotation and position": slice(6), "rotation": slice(3), "position": slice(3, 6)}
    for part, rows in parts.items():
        e = errors[:, rows, None]
        squares = np.sum(e * np.linalg.solve(matrices[:, rows, rows], e), axis=(1, 2))
        fractions = [np.mean(squares < chi2.ppf(p, e.shape[1])) for p in (0.95, 0.5)]
        print(f"| {part} | {len(some)} | {fractions[0]:.3f} | {fractions[1]:.3f} |")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """All options."""
    option(parser, "--fit FILE ...", "trials to learn from", default=[])
    option(parser, "--check FILE ...", "other trials", default=[])
    option(parser, "--without CASE ...", "leave these cases out", default=[])


@command(__file__, __doc__, EPILOG, add_arguments)
def main(arguments: argparse.Namespace) -> int:
    """Fit the weights, print the tables."""
    sets = {"learnt from": read_outcomes(arguments.fit), "others": read_outcomes(arguments.check)}
    sets = {k: [o for o in rows if o.case not in arguments.without] for k, rows in sets.items()}
    if arguments.fit:
        bias, weights = fit(sets["learnt from"])
        print(f"bias {bias:.2f}, weights " + ", ".join(f"{w:.2f}" for w in weights))
        print(f"of {', '.join(FEATURES[: len(weights)])}")
    for name, outcomes in sets.items():
        if outcomes:
            print_cases(name, outcomes)
            print_reliability(name, outcomes)
            print_coverage(name, outcomes)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
