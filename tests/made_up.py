"""Made-up candidates and what speaks for them, for tests in which one rule decides."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from piccolo.evidence.verification import round_pose
from piccolo.geometry.pose import Pose, yaw_rotation
from piccolo.geometry.sphere import CHANCE_CORRELATION
from piccolo.judge.alternatives import Hypothesis
from piccolo.judge.candidate import Candidate, Comparison, Drawn, Selection
from piccolo.local_features.keypoints import join_keypoints
from piccolo.local_features.matching import Located, Matches
from piccolo.photo.photo import NOTHING_KNOWN
from piccolo.problem.problem import Problem
from piccolo.problem.profile import PROFILES

WHOLE, PARTIAL, WHOLE_SHAPE, PARTIAL_SHAPE = PROFILES
VIEWS = SimpleNamespace(averages=lambda *_: None, points=lambda *_: None, surroundings=lambda *_: None)
PROBLEM = Problem(  # of a photo of which nothing else is asked
    source=None,
    given=None,
    photo=SimpleNamespace(has_tilt=False),
    colors=lambda: None,
    scan_map=SimpleNamespace(octree=None, to_world=lambda pose: pose, has_shape=False),
    views=VIEWS,
    profile=WHOLE,
    prior=NOTHING_KNOWN,
    gravity="auto",
)


def at(x, score, yaw_deg=0.0):
    return Hypothesis(Pose(yaw_rotation(np.radians(yaw_deg)), np.array([x, 0.0, 0.0])), score)


def make_candidate(x, score, num_matches=0, explains=None, yaw_deg=0.0, **evidence):
    """A candidate at x with its evidence; it explains as much as its score says, unless told otherwise."""
    comparison = seen(score if explains is None else explains)
    return Candidate(at(x, score, yaw_deg).pose, score, comparison, num_matches=num_matches, **evidence)


def make_selection(best, *others, rival_ratio=0.0):
    """A selection of candidates, the best first."""
    return Selection(best, others, rival_ratio)


def move(candidate, metres, score=None):
    """A candidate with the same evidence farther along x, perhaps with another score."""
    pose = replace(candidate.pose, center_world=candidate.pose.center_world + np.array([metres, 0.0, 0.0]))
    if score is None:
        return replace(candidate, pose=pose)
    return replace(candidate, pose=pose, score=score, comparison=seen(score))


def place(pose):
    return round(float(pose.center_world[0]), 6)


def places(candidates):
    return [place(h.pose) for h in candidates]


def seen(explains, num_blocks=4):
    """A comparison that explains a part of each of some blocks of a hundredth of the sphere."""
    beyond = CHANCE_CORRELATION + (1.0 - CHANCE_CORRELATION) * explains
    area = np.full(num_blocks, 0.01)
    return Comparison(np.full(num_blocks, beyond), area, area, 0.01 * num_blocks)


def drawn_at(pose, matches):
    """What was drawn at a pose, a picture of which nothing is asked, with the matches of a photo."""
    key, on_grid = round_pose(pose)
    return Drawn(key, Located(join_keypoints([]), np.empty(0, np.float32), on_grid), matches)


def exact_matches(pose, count, num_wrong=0, seed=0):
    """Matches that a camera at the pose would have, seen from right there; the last ones of any points."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-3, 3, (count, 3))
    directions = points - pose.center_world
    ranges = np.linalg.norm(directions, axis=1)
    directions /= ranges[:, None]
    tangents = np.cross(directions, rng.normal(size=(count, 3)))
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    angles = rng.uniform(0.02, 0.2, count)
    rays = directions @ pose.R_cam_from_world.T
    ray_tangents = tangents @ pose.R_cam_from_world.T
    wrong = slice(count - num_wrong, count)
    points[wrong] = rng.uniform(-3, 3, (num_wrong, 3))
    values = rays, ray_tangents, angles, points, directions, tangents, angles * ranges
    some = [np.asarray(a, np.float32) for a in values]
    return Matches(np.arange(count, dtype=np.int32), *some)
