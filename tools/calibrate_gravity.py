#!/usr/bin/env python3
"""Fit the weights of the features that tell up in a cloud, and try them on other seeds."""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from evaluate_gravity import ROUGH, rotated_cloud, rotations_of
from numpy.typing import NDArray
from scipy.optimize import minimize

from piccolo.cli.progress import shown
from piccolo.geometry.pose import Array
from piccolo.gravity.alignment import normals_of
from piccolo.gravity.up import up_hypotheses
from piccolo.gravity.up_features import SENSE_SHARING, WEIGHTS, Weights, log_odds
from piccolo.runtime.threads import Workers
from piccolo.scenes.synthetic.buildings import BUILDINGS, make_building

PENALTY = 0.002  # on the square of a weight times its cue's standard deviation; all kinds' losses add up to 1
EPILOG = """\
examples:
  python tools/calibrate_gravity.py
  python tools/calibrate_gravity.py --fit 0 100 --check 1100 1120

Every seed makes a place of each kind, turned at random. Each direction that flat points face is a hypothesis
with its cues (piccolo/gravity/up_features.py), one of them is the true up. The weights are those of the
conditional logit with the largest likelihood, in which each kind counts the same and large weights cost.
Printed as up_features.py holds them; then a Markdown table of how often the true up has the largest odds, on
the seeds to check, by the weights in use and by those fitted.
exit codes: 0 done, 2 wrong usage, 130 interrupted.
"""


@dataclass(frozen=True)
class Choice:
    """The hypotheses of one cloud."""

    kind: str
    cues: Array  # (H, 8)
    is_up: NDArray[np.bool_]  # (H,) one of them is true up, or none


def choice_of(case: tuple[str, int]) -> Choice:
    """The hypotheses for a place of a kind and a seed, turned at random."""
    kind, seed = case
    R = rotations_of(seed, 1)[0]
    cloud = rotated_cloud(make_building(kind, seed), R)
    hypotheses = up_hypotheses(normals_of(cloud.voxels(np.eye(3))))
    cosines = np.array([hypothesis.axis @ R[:, 2] for hypothesis in hypotheses])
    return Choice(
        kind, np.array([hypothesis.cues for hypothesis in hypotheses]), cosines > np.cos(np.radians(ROUGH))
    )


def choices_of(seeds: Sequence[int], workers: Workers) -> list[Choice]:
    """The clouds of all kinds with true up among their hypotheses."""
    cases = list(product(BUILDINGS, range(*seeds)))
    return [choice for choice in workers.each(choice_of, cases, "clouds") if choice.is_up.any()]


def log_likelihoods(parameters: Array, choices: Sequence[Choice]) -> Array:
    """Logarithm of the true up's part of the odds (C,), by weights (8) and sharing (1)."""
    values = []
    for choice in choices:
        logits = log_odds(choice.cues, parameters[:-1], float(parameters[-1]))
        values.append(logits[choice.is_up].max() - np.logaddexp.reduce(logits))
    return np.array(values)


def fit(choices: Sequence[Choice]) -> Array:
    """Weights and sharing (9,) of the largest likelihood, less what large weights cost."""
    kinds = [choice.kind for choice in choices]
    shares = np.array([1.0 / kinds.count(kind) for kind in kinds]) / len(set(kinds))
    deviations = np.concatenate([choice.cues - choice.cues.mean(axis=0) for choice in choices]).std(axis=0)

    def loss(parameters: Array) -> float:
        cost = PENALTY * float(np.sum((parameters[:-1] * deviations) ** 2))
        return cost - float(shares @ log_likelihoods(parameters, choices))

    start = np.array([*WEIGHTS, SENSE_SHARING])
    bounds = [(0.0, None)] * len(WEIGHTS) + [(0.0, 1.0)]
    return np.asarray(minimize(loss, start, method="L-BFGS-B", bounds=bounds).x)


def print_table(choices: Sequence[Choice], fitted: Array) -> None:
    """How often the true up wins in each kind, and its mean part of the odds."""
    used = np.array([*WEIGHTS, SENSE_SHARING])
    print("| kind | clouds | won, in use | won, fitted | mean odds, in use | mean odds, fitted |")
    print("|---|---:|---:|---:|---:|---:|")
    for kind in BUILDINGS:
        some = [choice for choice in choices if choice.kind == kind]
        parts = [np.exp(log_likelihoods(parameters, some)) for parameters in (used, fitted)]
        won = " | ".join(str(np.count_nonzero(part > 0.5)) for part in parts)
        odds = " | ".join(f"{part.mean():.2f}" for part in parts)
        print(f"| {kind} | {len(some)} | {won} | {odds} |")


def run(arguments: argparse.Namespace) -> int:
    """Fit, print the weights and check them."""
    workers = Workers(arguments.threads, shown(arguments.quiet))
    fitted = fit(choices_of(arguments.fit, workers))
    values = ", ".join(
        f"{name}={value:.2f}" for name, value in zip(Weights._fields, fitted[:-1], strict=True)
    )
    print(f"WEIGHTS = Weights({values})\nSENSE_SHARING = {fitted[-1]:.2f}\n")
    print_table(choices_of(arguments.check, workers), np.round(fitted, 2))
    return 0
