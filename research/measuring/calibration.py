"""Fit the confidence to trials, and check it and the covariances on others."""

import json
from argparse import ArgumentParser
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.special import chdtri

from piccolo.cli.command import Arguments, option
from piccolo.geometry.nearness import RIGHT
from piccolo.geometry.pose import MAX_ANGLE, MAX_DISTANCE
from piccolo.geometry.pose_gaussian import probability_of_ball, subtract
from piccolo.judge import probability as confidence
from piccolo.judge.belief import make_belief
from piccolo.judge.pose_covariance import PoseCovariance
from piccolo.judge.probability import AMBIGUOUS, LOCALIZED, ChoiceModel, Standing
from piccolo.problem.profile import EvidenceKind
from piccolo.system.arguments import MIN_CONFIDENCE
from piccolo.system.arrays import Array
from piccolo.system.files.json_file import parse_lines, read_bytes

from ..evaluation.tables import Table, reliability_table
from ..scene import pose_of

EPILOG = """\
example:
  python tools/benchmark.py calibration --fit trials.jsonl --check others.jsonl bench.jsonl

The files are those of tools/benchmark.py confidence. Prints the fitted weights, to be copied to
piccolo/judge/probability.py, and tables for each set of trials: how reliable the probabilities of the
fitted model are (without --fit, of the model in use), the fraction of true poses inside the confidence
regions of the covariance, and for each case how many poses are within 0.05 to 1 m, as told and so, with the
chi squares a degree of freedom of those that are told with 0.9.
"""
PENALTY = 0.05  # on squared weights of features of deviation 1: without, easy trials ask for ever larger ones
TENTHS = [k / 10 for k in range(11)]
ACCURACIES = (0.05, 0.1, 0.25, 1.0)  # [m] that users may need
Case = tuple[str, str, bool]  # what was tried, the status, and whether the best pose is right


class Outcome(NamedTuple):
    """One trial's poses, and which of them was right."""

    case: str
    standings: list[Standing]  # the best first
    covariance: PoseCovariance | None
    std_of_fit: float | None  # [rad] of the best pose, as of Result
    right: int  # of the poses, or their number if none is
    is_refused: bool  # as mirrored: no choice was made
    error: Array  # (6,) of the best pose, as PoseCovariance has it; NaN without truth
    sound: float  # probability, as told, that the best pose's place and what was given are right

    @property
    def evidence(self) -> EvidenceKind:
        """Key in MODELS: what the photo was compared with."""
        return self.standings[0].evidence

    @property
    def std(self) -> float | None:
        """Largest deviation of the best pose [m]; None where it is not known."""
        return None if self.covariance is None else self.covariance.largest_std

    def probabilities(self, model: ChoiceModel | None) -> Array:
        """Return the probability of each pose, and of none (K + 1,); by default with the model in use."""
        if self.is_refused:
            return np.append(np.zeros(len(self.standings)), 1.0)
        within = 1.0
        if self.covariance is not None:
            within = probability_of_ball(self.covariance.matrix[3:, 3:], MAX_DISTANCE)
        places = confidence.posterior(self.standings, self.std_of_fit, model=model)[:-1]
        return make_belief(places, within).probabilities

    def told_within(self, accuracy: float) -> float:
        """Return the probability, as told, that the best pose is within an accuracy [m]."""
        if self.covariance is None:
            return 0.0
        return self.sound * probability_of_ball(self.covariance.matrix[3:, 3:], accuracy)

    def is_within(self, accuracy: float) -> bool:
        """Return True if the best pose is within an accuracy [m], and turned as little as a right one."""
        turn = float(np.linalg.norm(self.error[:3]))
        return bool(np.linalg.norm(self.error[3:]) < accuracy and turn < MAX_ANGLE)


def read_outcome(line: str) -> Outcome | None:
    """Read a line of tools/benchmark.py confidence; None if no pose was found."""
    trial = json.loads(line)
    poses = [pose_of(pose) for pose in trial["poses"]]
    if not poses:
        return None
    standings = [Standing(*standing) for standing in trial["standings"]]
    matrix = trial["covariance"]
    covariance = None if matrix is None else PoseCovariance(np.array(matrix), "")
    error = np.full(6, np.nan)
    right = len(poses)
    if trial["truth"] is not None:
        true_pose = pose_of(trial["truth"])
        error = subtract(true_pose, poses[0])
        right = next((k for k, pose in enumerate(poses) if RIGHT.holds(pose, true_pose)), right)
    return Outcome(
        case=str(trial["case"]),
        standings=standings,
        covariance=covariance,
        std_of_fit=trial["std_of_fit"],
        right=right,
        is_refused=trial["probabilities"][-1] == 1.0,
        error=error,
        sound=trial["sound"],
    )


def fit(outcomes: Sequence[Outcome]) -> ChoiceModel:
    """Return the weights of the greatest penalised likelihood."""
    poses = [np.array([confidence.pose_features(s) for s in o.standings]) for o in outcomes]
    nones = np.array([confidence.none_features(o.std_of_fit) for o in outcomes])
    deviations = np.concatenate([np.concatenate(poses).std(axis=0), [1.0, max(nones[:, 1].std(), 1e-9)]])

    def loss(w: Array) -> tuple[float, Array]:
        total = 0.5 * PENALTY * w @ w
        gradient = PENALTY * w
        v = w / deviations
        for features, none, o in zip(poses, nones, outcomes, strict=True):
            logits = np.append(features @ v[:-2], none @ v[-2:])
            p = np.exp(logits - logits.max())
            p /= p.sum()
            total -= np.log(max(p[o.right], 1e-300))
            p[o.right] -= 1.0
            gradient = gradient + np.append(p[:-1] @ features, p[-1] * none) / deviations
        return float(total), gradient

    bounds = [(0.0, None)] * poses[0].shape[1] + [(None, None), (0.0, None)]
    v = minimize(loss, np.zeros(len(bounds)), jac=True, method="L-BFGS-B", bounds=bounds).x / deviations
    return ChoiceModel(tuple(v[:-2].tolist()), (float(v[-2]), float(v[-1])))


def print_cases(title: str, rows: Sequence[Case]) -> int:
    """Print the statuses of each case; returns the number of false answers."""
    table = []
    num_false = 0
    for case in dict.fromkeys(case for case, _, _ in rows):
        own = [(status, is_right) for other, status, is_right in rows if other == case]
        statuses = [status for status, _ in own]
        false = own.count((LOCALIZED, False))
        right = sum(is_right for _, is_right in own)
        counts = (len(own), right, statuses.count(LOCALIZED), statuses.count(AMBIGUOUS), false)
        table.append((case, *map(str, counts)))
        num_false += false
    print(Table("", (title, "trials", "right", "localized", "ambiguous", "false"), tuple(table)).markdown())
    return num_false


def print_coverage(title: str, outcomes: Sequence[Outcome]) -> None:
    """Print the fraction of right poses whose error lies in the covariance's regions."""
    known = [(o.error, o.covariance.matrix) for o in outcomes if o.right == 0 and o.covariance is not None]
    if not known:
        return
    errors, matrices = (np.array(values) for values in zip(*known, strict=True))
    rows = []
    parts = {"rotation and position": slice(6), "rotation": slice(3), "position": slice(3, 6)}
    for part, own in parts.items():
        e = errors[:, own, None]
        squares = np.sum(e * np.linalg.solve(matrices[:, own, own], e), axis=(1, 2))
        fractions = [f"{np.mean(squares < chdtri(e.shape[1], 1.0 - p)):.3f}" for p in (0.95, 0.5)]
        rows.append((part, str(len(known)), *fractions))
    columns = (title, "right poses", "in the 95 % region", "in the 50 % region")
    print(Table("", columns, tuple(rows)).markdown())


def print_accuracies(title: str, outcomes: Sequence[Outcome]) -> None:
    """Print for each case and accuracy what was told and what is so, and chi squares a degree of freedom."""
    rows = []
    for case in dict.fromkeys(o.case for o in outcomes):
        own = [o for o in outcomes if o.case == case]
        for accuracy in ACCURACIES:
            told = np.array([o.told_within(accuracy) for o in own])
            holds = np.array([o.is_within(accuracy) for o in own])
            is_sure = told >= MIN_CONFIDENCE
            sure = [o for o, is_one in zip(own, is_sure, strict=True) if is_one]
            shares = f"{told.mean():.2f}", f"{holds.mean():.2f}"
            counts = str(is_sure.sum()), str((is_sure & ~holds).sum())
            rows.append((case, f"{accuracy:g}", str(len(own)), *shares, *counts, *compute_chi_squares(sure)))
    columns = "within [m]", "trials", "told", "is so", "told 0.9", "wrong", "chi2 position", "chi2 rotation"
    print(Table("", (title, *columns), tuple(rows)).markdown())


def compute_chi_squares(outcomes: Sequence[Outcome]) -> tuple[str, str]:
    """Return the mean chi squares a degree of freedom of positions and of rotations, in words."""
    found = []
    for part in (slice(3, 6), slice(3)):
        squares = [
            o.error[part] @ np.linalg.solve(o.covariance.matrix[part, part], o.error[part]) / 3.0
            for o in outcomes
            if o.covariance is not None and np.isfinite(o.error).all()
        ]
        found.append(f"{np.mean(squares):.2f}" if squares else "")
    return found[0], found[1]


def add_arguments(parser: ArgumentParser) -> None:
    """Add all options."""
    option(parser, "--fit FILE ...", "trials to which the weights are fitted", default=[])
    option(parser, "--check FILE ...", "other trials, on which they are checked", default=[])
    option(parser, "--without CASE ...", "leave these cases out", default=[])


def run(arguments: Arguments) -> int:
    """Fit the weights, print the tables."""

    def read(paths: Sequence[Path]) -> list[Outcome]:
        wanted = "wanted a file of tools/benchmark.py confidence"
        found = [o for path in paths for o in parse_lines(path, read_bytes(path, wanted), read_outcome)]
        return [o for o in found if o is not None and o.case not in arguments.without]

    learnt = read(arguments.fit)
    sets = {"learnt from": learnt, "others": read(arguments.check)}
    models: dict[EvidenceKind, ChoiceModel] = {}
    for kind in sorted({o.evidence for o in learnt}):
        models[kind] = model = fit([o for o in learnt if o.evidence == kind])
        print(f"{kind}:")
        for names, weights in (
            (confidence.FEATURES, model.weights),
            (confidence.NONE_FEATURES, model.none_weights),
        ):
            print(", ".join(f"{name} {w:.2f}" for name, w in zip(names, weights, strict=False)))
    for name, outcomes in sets.items():
        if not outcomes:
            continue
        stated = [o.probabilities(models.get(o.evidence)) for o in outcomes]
        right = [np.arange(len(p)) == o.right for p, o in zip(stated, outcomes, strict=True)]
        called = [confidence.classify(p, MIN_CONFIDENCE) for p in stated]
        rows = [(o.case, status, o.right == 0) for o, status in zip(outcomes, called, strict=True)]
        print_cases(f"case, {name}", rows)
        all_stated = np.concatenate(stated).tolist()
        table = reliability_table(f"probability, {name}", all_stated, np.concatenate(right).tolist(), TENTHS)
        print(table.markdown())
        print_coverage(f"covariance, {name}", outcomes)
        print_accuracies(f"accuracy, {name}", outcomes)
    return 0
