"""The places of the whole map that look like a frame: its likelihood over the grid of candidates.

Every candidate is scored in every heading, and the best start a short descent on their prepared views; what
they explain of the photo is compared with what the frame's own pose explains there.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..confidence.alternatives import MIN_ANGLE, MIN_DISTANCE
from ..confidence.confidence import MODELS, Standing, pose_features
from ..geometry.pose import Array, Pose
from ..geometry.rotations import uniform_yaws
from ..geometry.suppression import non_maximum_suppression
from ..localization.attempts import brief_query, mirror_query
from ..localization.query import Cache, Query
from ..localization.refinement import count_first_iterations, descend_all
from ..localization.search import Starts, search_poses

MOST_PLACES = 64  # of a frame: the rooms of a hotel that look alike


class Place(NamedTuple):
    """A pose that may be a frame's, as rough as the grid of candidates."""

    pose: Pose  # in the map
    behind: float  # [log] of its odds to those of the frame's own pose


class Ends(NamedTuple):
    """Ends of short descents, best first."""

    poses: Starts
    scores: Array  # (N,)

    @property
    def best_score(self) -> float:
        """Score of the best end; 0 if there is none."""
        return float(self.scores.max(initial=0.0))


def query_near(query: Query, pose: Pose, radius: float) -> Query:
    """Return the query of whole views that searches within a radius [m] of a pose: its tilt, any heading."""
    m = query.scan_map
    distances = np.linalg.norm(m.centers[m.sparse] - pose.center_world, axis=1)
    near = m if math.isinf(radius) else m.narrow(distances <= max(radius, float(distances.min())))
    level = pose.R_cam_from_world @ uniform_yaws(query.settings.num_yaws)
    close = replace(query, scan_map=near, cache=Cache(query.cache.views), num_parts=0, rotations=level)
    return brief_query(close, max(len(near.sparse), 1))


def descend_briefly(query: Query) -> Ends:
    """Search, and descend a few steps on the candidates' prepared views."""
    return descend_from(query, search_poses(query, "known"))


def descend_from(query: Query, starts: Starts) -> Ends:
    """Descend a few steps from starts on their candidates' prepared views."""
    num = count_first_iterations(query)
    return Ends(*descend_all(query.scan_map, query.photo.images.search(), starts, num, query.workers))


def is_mirrored(query: Query, ends: Ends) -> bool:
    """Return True if the mirror image of a whole photo looks more like the map than the photo's ends."""
    if query.photo.is_partial:
        return False
    across = np.diag([1.0, -1.0, 1.0])
    mirror = replace(mirror_query(query), rotations=across @ query.rotations @ across)
    return descend_briefly(mirror).best_score > ends.best_score


def find_places(query: Query, own: Pose) -> list[Place]:
    """Find the distinct poses in the map that look like a photo, best first, beside its own pose.

    They have the tilt of that, and any heading.
    """
    ends = descend_briefly(query_near(query, own, math.inf))
    return list_places(query, ends, descend_near(query, own).best_score)


def descend_near(query: Query, pose: Pose) -> Ends:
    """Descend a few steps from a pose on the prepared view of the candidate nearest to it."""
    start = Starts(pose.R_cam_from_world[None], pose.center_world[None], nearest(query, pose))
    return descend_from(query, start)


def list_places(query: Query, ends: Ends, own_score: float) -> list[Place]:
    """List the distinct ends with their odds to a pose of a score."""
    R, centers = ends.poses.R_cam_from_map, ends.poses.center_map
    kept = non_maximum_suppression(R, centers, MOST_PLACES, MIN_DISTANCE, MIN_ANGLE)
    ratios = ends.scores[kept] / max(own_score, 1e-9)
    poses = ends.poses.take(kept).poses()
    return [Place(p, log_behind(query, float(ratio))) for p, ratio in zip(poses, ratios, strict=True)]


def log_behind(query: Query, ratio: float) -> float:
    """Return the log odds of a pose against another of which it explains a part, by the model of views."""
    standing = Standing(ratio, 1.0, None, is_shape=query.scan_map.has_shape)
    weight = MODELS[standing.kind].weights[0]
    return min(weight * float(pose_features(standing)[0]), 0.0)


def nearest(query: Query, pose: Pose) -> NDArray[np.int64]:
    """Return the number (1,) of the candidate nearest to a pose."""
    distances = np.linalg.norm(query.scan_map.centers - pose.center_world, axis=1)
    return np.array([distances.argmin()])
