#!/usr/bin/env python3
"""Fit the weights of the features that tell up in a cloud, and try them on other seeds."""

import argparse
from collections.abc import Iterable, Sequence
from itertools import product
from typing import NamedTuple

import _checkout  # noqa: F401
import numpy as np
from evaluate_gravity import ROUGH, rotated_cloud, rotations_of
from numpy.typing import NDArray
from scipy.optimize import minimize

from piccolo.cli.command import check_least, command, option
from piccolo.cli.errors import UsageError
from piccolo.cli.progress import progress_bar
from piccolo.geometry.pose import Array
from piccolo.gravity.alignment import normals_of
from piccolo.gravity.up import up_hypotheses
from piccolo.gravity.up_features import WEIGHTS, Weights
from piccolo.runtime.threads import Workers, num_cores
from piccolo.scenes.synthetic.buildings import BUILDINGS

PENALTY = 0.001  # on the square of a weight times its cue's standard deviation; all kinds' losses add up to 1
IN_USE = np.array(WEIGHTS)
EPILOG = """\
example:
  python tools/calibrate_gravity.py --fit 0 10 --check 1100 1120

Every seed makes a place of each kind, turned at random. Each direction that flat points face is a hypothesis
with its cues (piccolo/gravity/up_features.py), one of them is the true up. The weights are those of the
conditional logit with the largest likelihood, in which each kind counts the same and large weights cost.
Printed as up_features.py holds them; then a Markdown table of how often the true up has the largest odds, on
the seeds to check, by the weights in use and by those fitted.
"""


class Choice(NamedTuple):
    """The hypotheses of one cloud."""

    kind: str
    cues: Array  # (H, 9)
    is_up: NDArray[np.bool_]  # (H,) one of them is true up, or none


def choice_of(case: tuple[str, int]) -> Choice:
    """The hypotheses for a place of a kind and a seed, turned at random."""
    kind, seed = case
    R = rotations_of(seed, 1)[0]
    cloud = rotated_cloud(BUILDINGS[kind](seed), R)
    hypotheses = up_hypotheses(normals_of(cloud.voxels(np.eye(3))))
    is_up = [hypothesis.axis @ R[:, 2] > np.cos(np.radians(ROUGH)) for hypothesis in hypotheses]
    return Choice(kind, np.array([hypothesis.cues for hypothesis in hypotheses]), np.array(is_up))


def choices_of(kinds: Iterable[str], seeds: Sequence[int], workers: Workers) -> list[Choice]:
    """The clouds of the kinds with true up among their hypotheses."""
    cases = list(product(kinds, range(*seeds)))
    return [choice for choice in workers.map(choice_of, cases, "clouds") if choice.is_up.any()]


def log_likelihoods(weights: Array, choices: Sequence[Choice]) -> tuple[Array, NDArray[np.bool_]]:
    """Logarithm of true up's part of the odds, and whether it is the largest, by weights (9,)."""
    values = []
    for choice in choices:
        logits = choice.cues @ weights
        true_logit = logits[choice.is_up].max()
        values.append((true_logit - np.logaddexp.reduce(logits), true_logit == logits.max()))
    likelihoods, is_right = np.array(values).T
    return likelihoods, is_right > 0.0


def fit(choices: Sequence[Choice]) -> Array:
    """Weights (9,) of the largest likelihood, less what large ones cost; none below 0."""
    kinds = [choice.kind for choice in choices]
    kind_weights = np.array([1.0 / kinds.count(kind) for kind in kinds]) / len(set(kinds))
    deviations = np.concatenate([choice.cues - choice.cues.mean(axis=0) for choice in choices]).std(axis=0)

    def loss(weights: Array) -> float:
        cost = PENALTY * float(np.sum((weights * deviations) ** 2))
        return cost - float(kind_weights @ log_likelihoods(weights, choices)[0])

    return np.asarray(minimize(loss, IN_USE, method="L-BFGS-B", bounds=[(0.0, None)] * len(WEIGHTS)).x)


def print_table(choices: Sequence[Choice], fitted: Array) -> None:
    """How often the true up has the largest odds, by kind, and the mean logarithm of its part of the odds."""
    by_weights = [log_likelihoods(weights, choices) for weights in (IN_USE, fitted)]
    print("| kind | clouds | right, in use | right, fitted | log-likelihood, in use | fitted |")
    print("|---|---:|---:|---:|---:|---:|")
    for kind in [*BUILDINGS, "all"]:
        is_kind = np.array([kind in (choice.kind, "all") for choice in choices])
        if is_kind.any():
            right = [np.count_nonzero(is_right[is_kind]) for _, is_right in by_weights]
            mean = [f"{likelihoods[is_kind].mean():.2f}" for likelihoods, _ in by_weights]
            print(f"| {kind} | {np.count_nonzero(is_kind)} | {' | '.join(map(str, [*right, *mean]))} |")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """All options."""
    option(parser, "--fit FIRST END", "seeds to learn from", default=[10, 20])
    option(parser, "--check FIRST END", "other seeds", default=[1100, 1120])
    text = "kinds to learn from (default all); the others are checked too"
    option(parser, "--kinds", text, nargs="+", choices=BUILDINGS, default=list(BUILDINGS))
    option(parser, "--threads N", default=num_cores())


@command(__file__, __doc__, EPILOG, add_arguments)
def main(arguments: argparse.Namespace) -> int:
    """Fit, print the weights and check them."""
    for name in ("fit", "check"):
        first, end = getattr(arguments, name)
        if not 0 <= first < end:
            raise UsageError(f"--{name}: {first} {end} is no range of seeds, such as 0 60")
    check_least(arguments, threads=1)
    workers = Workers(arguments.threads, progress_bar(arguments.quiet))
    fitted = np.round(fit(choices_of(arguments.kinds, arguments.fit, workers)), 2)
    values = [f"{name}={value:g}" for name, value in zip(Weights._fields, fitted, strict=True)]
    print(f"WEIGHTS = Weights({', '.join(values)})\n")
    print_table(choices_of(BUILDINGS, arguments.check, workers), fitted)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
