"""What holds of every result: checked for each that a test makes, and for each line that it writes."""

import functools
import json
from itertools import combinations
from pathlib import Path

import jsonschema
import numpy as np

from piccolo.geometry.nearness import RIGHT
from piccolo.judge.result import FAILED, FORMAT, UNREADABLE, Result
from piccolo.system.arguments import MIN_CONFIDENCE

SCHEMA = json.loads((Path(__file__).resolve().parents[1] / "docs" / "result.schema.json").read_text())
VALIDATOR = jsonschema.Draft202012Validator(SCHEMA)
ROUNDING = 1e-6  # of probabilities and rotations
SLACK = 0.3  # deviations that a focal length may lie outside of what was told, as its fit is not linear
NOT_READ = UNREADABLE, FAILED


def is_of_the_program(settings):
    """Return True for the settings of a result that the program made; those that tests make up have none."""
    return "cloud" in settings


def find_contradictions(result):
    """Return in words what contradicts itself in a result of the program; nothing if all is well."""
    checks = (
        check_probabilities, check_status, check_poses, check_alternatives, check_covariance,
        check_focal_length, check_times,
    )  # fmt: skip
    return [words for check in checks if is_of_the_program(result.settings) for words in check(result)]


def check_probabilities(result):
    """All of them lie within 0 and 1, and add up to 1 where they are known."""
    others = [one.probability for one in result.alternatives]
    known = [p for p in (result.confidence, result.probability_none, *others) if p is not None]
    if not all(-ROUNDING <= p <= 1.0 + ROUNDING for p in known):
        yield f"probabilities {known}, wanted 0 to 1"
    if result.probability_none is None or result.status in NOT_READ:
        return
    if abs(sum(known) - 1.0) > ROUNDING:
        yield f"probabilities {known} that add up to {sum(known)}"
    if result.best_pose is not None:
        told = [result.confidence, *others, result.probability_none]
        believed = result.belief.probabilities
        if len(believed) != len(told) or np.abs(believed - told).max() > ROUNDING:
            yield f"probabilities {told} beside the belief {result.belief}"


def check_status(result):
    """A status follows from the probabilities, and has a pose or a reason."""
    least = result.settings.get("min_confidence", MIN_CONFIDENCE)
    if result.status == "localized" and (result.confidence < least or result.best_pose is None):
        yield f"localized at {result.confidence}, least {least}, with the pose {result.best_pose}"
    if (result.error is None) == (result.status in NOT_READ):
        yield f"{result.status} with the error {result.error!r}"
    if result.status in NOT_READ and (result.best_pose is not None or result.confidence):
        yield f"{result.status} with a pose or a confidence"
    if result.best_pose is None and (result.alternatives or result.covariance or result.confidence):
        yield "alternatives, covariance or confidence without a pose"


def check_poses(result):
    """Each is a rotation and a finite place."""
    for pose in result.poses:
        R = pose.R_cam_from_world
        if not (np.abs(R @ R.T - np.eye(3)).max() < ROUNDING and np.linalg.det(R) > 0.0):
            yield f"{R.tolist()}, which is no rotation"
        if not np.isfinite(pose.center_world).all():
            yield f"a camera at {pose.center_world}"


def check_alternatives(result):
    """None is the best pose or another of them."""
    found = [result.best_pose, *(one.pose for one in result.alternatives)] if result.best_pose else []
    for (i, a), (k, b) in combinations(enumerate(found), 2):
        if RIGHT.holds(a, b):
            yield f"the poses {i} and {k} are one: where one is right, so is the other"


def check_covariance(result):
    """It is symmetric, and each direction has a variance."""
    if result.covariance is None:
        return
    matrix = result.covariance.matrix
    if matrix.shape != (6, 6) or not np.isfinite(matrix).all():
        yield f"a covariance {matrix.tolist()}"
        return
    if not np.array_equal(matrix, matrix.T):
        yield "a covariance that is not symmetric"
    deviations = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    if not (deviations > 0.0).all():
        yield f"deviations {deviations}, wanted above 0"
    elif np.linalg.eigvalsh(matrix / np.outer(deviations, deviations)).min() <= 0.0:  # unit by unit
        yield "a covariance that is not positive"


def check_focal_length(result):
    """What is reported lies between what was given, or others tell, and what the photo alone tells."""
    focal = result.focal_length
    if focal is None:
        return
    told = [px for px in (focal.given_px, focal.picture_px, focal.others_px) if px is not None]
    slack = SLACK * focal.std_px
    if len(told) > 1 and not min(told) - slack <= focal.px <= max(told) + slack:
        yield f"a focal length of {focal.px} +- {focal.std_px} px, where {told} were told"
    if (focal.picture_px is None) != (focal.picture_std_px is None):
        yield "a focal length of the photo alone without its deviation, or the reverse"
    if (focal.others_px is None) != (focal.others_std_px is None):
        yield "a focal length of others without its deviation, or the reverse"


def check_times(result):
    """None is negative."""
    if min(result.seconds.values(), default=0.0) < 0.0:
        yield f"times {result.seconds}"
    if result.walk and result.walk.time < 0.0:
        yield f"a frame at {result.walk.time} s"


@functools.lru_cache(maxsize=4096)  # a line is checked as it is written, and in its file
def contradictions_of_line(text):
    """Return what is wrong with a result's JSON: by the schema, or as it is another after it was read."""
    errors = [error.message for error in VALIDATOR.iter_errors(json.loads(text))]
    if errors:
        return errors
    result = Result.from_json(text)
    again = result.to_json()
    return [*find_contradictions(result), *([] if again == text else [f"{text} is read as {again}"])]


def lines_of_results(folder):
    """Return the whole lines of results that the program made, in all files of JSON in a folder."""
    files = [path for path in sorted(folder.rglob("*.json*")) if path.is_file()]
    lines = [line for path in files for line in path.read_text("utf-8", "replace").splitlines()]
    return [line for line in lines if line.startswith(f'{{"format": "{FORMAT}"') and _is_whole(line)]


def _is_whole(line):
    """True for JSON with settings of the program: no line that a test cut off or made up."""
    try:
        return is_of_the_program(json.loads(line)["settings"])
    except (ValueError, KeyError):
        return False
