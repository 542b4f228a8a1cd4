"""Learn the confidence from trials, and check it, and the covariances, on others."""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.stats import chi2

from piccolo.cli.command import option
from piccolo.confidence.confidence import (
    AMBIGUOUS,
    CLEAR_MATCHES,
    FEATURES,
    LOCALIZED,
    MIN_CONFIDENCE,
    NONE_FEATURES,
    ChoiceModel,
    Standing,
    classify,
    features_of,
    none_features_of,
    posterior,
)
from piccolo.confidence.covariance import PoseCovariance
from piccolo.files.json_file import parse_lines, read_bytes
from piccolo.geometry.pose import Pose, is_correct, log_so3
from piccolo.result import Result

EPILOG = """\
example:
  python tools/benchmark.py calibration --fit trials.jsonl --check others.jsonl bench.jsonl

Files are those of tools/benchmark.py confidence. The weights printed go into
piccolo/confidence/confidence.py; the tables show how reliable the probabilities are on each set, by the model
just learnt or else the one in use, and the fraction of true poses in the region of the covariance.
"""
PENALTY = 0.05  # on squared weights of features of deviation 1: without, easy trials ask for ever larger ones
Array = NDArray[np.float64]


class Outcome(NamedTuple):
    """One trial's poses, and which of them was right."""

    case: str
    standings: list[Standing]  # the best first
    covariance: PoseCovariance | None
    right: int  # of the poses, or their number if none is
    probabilities: Array  # (K + 1,) as the result has them
    error: Array  # (6,) of the best pose, as PoseCovariance has it; NaN without truth

    @property
    def is_correct(self) -> bool:
        """True if the best pose is right."""
        return self.right == 0


def read_outcomes(paths: Sequence[Path]) -> list[Outcome]:
    """The trials of some files that came to a pose."""
    wanted = "wanted a file of tools/benchmark.py confidence"
    lines = [line for path in paths for line in parse_lines(path, read_bytes(path, wanted), outcome_of)]
    return [outcome for outcome in lines if outcome is not None]


def outcome_of(line: str) -> Outcome | None:
    """One line of tools/benchmark.py confidence; None if no pose was found, or one without probabilities."""
    trial = json.loads(line)
    result, truth = Result.from_json(json.dumps(trial["result"])), trial["truth"]
    if result.best_pose is None or result.evidence is None or result.probability_none is None:
        return None
    e, poses = result.evidence, [result.best_pose, *(a.pose for a in result.alternatives)]
    standings = [Standing(1.0, e.score, CLEAR_MATCHES if e.num_matches is None else e.num_matches)]
    standings += [
        Standing(a.share or 0.0, a.score, CLEAR_MATCHES if a.num_matches is None else a.num_matches)
        for a in result.alternatives
    ]
    error, right = np.full(6, np.nan), len(poses)
    if isinstance(truth, dict):
        true_pose = Pose(np.array(truth["R_cam_from_world"]), np.array(truth["center_world"]))
        turn = log_so3(true_pose.R_cam_from_world @ result.best_pose.R_cam_from_world.T)
        error = np.concatenate([turn, true_pose.center_world - result.best_pose.center_world])
        right = next((k for k, pose in enumerate(poses) if is_correct(pose, true_pose)), right)
    stated = [result.confidence, *(a.probability or 0.0 for a in result.alternatives)]
    is_refused = (
        result.confidence == 0.0 and result.probability_none == 1.0
    )  # as mirrored: no choice was made
    probabilities = posterior(standings, result.covariance)
    if is_refused:
        probabilities = np.array([*stated, 1.0])
    return Outcome(str(trial["case"]), standings, result.covariance, right, probabilities, error)


def fit(outcomes: Sequence[Outcome]) -> ChoiceModel:
    """The weights of the greatest penalised likelihood."""
    poses = [np.array([features_of(s) for s in o.standings]) for o in outcomes]
    nones = np.array([none_features_of(o.covariance) for o in outcomes])
    deviations = np.concatenate([np.concatenate(poses).std(axis=0), [1.0, max(nones[:, 1].std(), 1e-9)]])

    def loss(w: Array) -> tuple[float, Array]:
        total, gradient = 0.5 * PENALTY * w @ w, PENALTY * w
        v = w / deviations
        for features, none, o in zip(poses, nones, outcomes, strict=True):
            logits = np.append(features @ v[:-2], none @ v[-2:])
            p = np.exp(logits - logits.max())
            p /= p.sum()
            total -= np.log(max(p[o.right], 1e-300))
            p[o.right] -= 1.0
            gradient = gradient + np.append(p[:-1] @ features, p[-1] * none) / deviations
        return float(total), gradient

    bounds = [(0.0, None)] * len(FEATURES) + [(None, None), (0.0, None)]
    v = minimize(loss, np.zeros(len(bounds)), jac=True, method="L-BFGS-B", bounds=bounds).x / deviations
    return ChoiceModel(tuple(v[:-2].tolist()), (float(v[-2]), float(v[-1])))


def with_model(outcome: Outcome, model: ChoiceModel) -> Outcome:
    """The same by another model, but for photos that were refused before any choice."""
    is_refused = outcome.probabilities[-1] == 1.0
    chosen = posterior(outcome.standings, outcome.covariance, model)
    return outcome if is_refused else outcome._replace(probabilities=chosen)


def print_reliability(name: str, outcomes: Sequence[Outcome]) -> None:
    """How many of the poses listed, and of the answers none, were right in each tenth of the probability."""
    stated = np.concatenate([o.probabilities for o in outcomes])
    right = np.concatenate([np.arange(len(o.probabilities)) == o.right for o in outcomes])
    print(f"\n| probability, {name} | answers | mean stated | right |")
    print("|---|---:|---:|---:|")
    for low in np.arange(10) / 10:
        some = (stated >= low) & ((stated < low + 0.1) | (low == 0.9))
        if some.any():
            means = f"{stated[some].mean():.3f} | {right[some].mean():.3f}"
            print(f"| {low:.1f} to {low + 0.1:.1f} | {some.sum()} | {means} |")


def print_cases(name: str, outcomes: Sequence[Outcome]) -> None:
    """The statuses of each case with the model in use."""
    print(f"\n| case, {name} | trials | right | localized | ambiguous | false |")
    print("|---|---:|---:|---:|---:|---:|")
    for case in dict.fromkeys(o.case for o in outcomes):
        some = [o for o in outcomes if o.case == case]
        called = [classify(o.probabilities, MIN_CONFIDENCE) for o in some]
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


def run(arguments: argparse.Namespace) -> int:
    """Fit the weights, print the tables."""
    sets = {"learnt from": read_outcomes(arguments.fit), "others": read_outcomes(arguments.check)}
    sets = {k: [o for o in rows if o.case not in arguments.without] for k, rows in sets.items()}
    if arguments.fit:
        model = fit(sets["learnt from"])
        for names, weights in ((FEATURES, model.weights), (NONE_FEATURES, model.none_weights)):
            print(", ".join(f"{name} {w:.2f}" for name, w in zip(names, weights, strict=True)))
        sets = {k: [with_model(o, model) for o in rows] for k, rows in sets.items()}
    for name, outcomes in sets.items():
        if outcomes:
            print_cases(name, outcomes)
            print_reliability(name, outcomes)
            print_coverage(name, outcomes)
    return 0
