"""The places of the whole map that look like a frame: its likelihood over the grid of candidates.

Every candidate is scored in every heading, and the best start a short descent on their prepared views; what
they explain of the photo is compared with what the frame's own pose explains there.
"""

import math
from dataclasses import replace

import numpy as np

from ..confidence.confidence import MODELS, Standing, pose_features
from ..geometry.nearness import ONE_ANSWER
from ..geometry.pose import Pose
from ..geometry.rotations import uniform_yaws
from ..geometry.suppression import non_maximum_suppression
from ..localization.beam import Ends, brief_query, descend_briefly, score_near
from ..localization.query import Cache, Query

MOST_PLACES = 64  # of a frame: the rooms of a hotel that look alike

Place = tuple[Pose, float]  # in the map, as rough as the grid of candidates; log odds against the frame's own


def query_near(query: Query, pose: Pose, radius: float) -> Query:
    """Return the query of whole views that searches within a radius [m] of a pose: its tilt, any heading."""
    m = query.scan_map
    distances = np.linalg.norm(m.centers[m.sparse] - pose.center_world, axis=1)
    near = m if math.isinf(radius) else m.narrow(distances <= max(radius, float(distances.min())))
    level = pose.R_cam_from_world @ uniform_yaws(query.settings.num_yaws)
    close = replace(query.by_views(), scan_map=near, cache=Cache(query.cache.views), rotations=level)
    return brief_query(close, max(len(near.sparse), 1))


def find_places(query: Query, own: Pose) -> list[Place]:
    """Find the distinct poses in the map that look like a photo, best first, beside its own pose.

    They have the tilt of that, and any heading.
    """
    ends = descend_briefly(query_near(query, own, math.inf))
    return list_places(query, ends, score_near(query, own))


def list_places(query: Query, ends: Ends, own_score: float) -> list[Place]:
    """List the distinct ends with their odds to a pose of a score."""
    R, centers = ends.poses.R_cam_from_map, ends.poses.center_map
    kept = non_maximum_suppression(R, centers, MOST_PLACES, ONE_ANSWER)
    found = zip(ends.poses.take(kept).poses(), ends.scores[kept], strict=True)
    return [(pose, log_behind(query, float(score), own_score)) for pose, score in found]


def log_behind(query: Query, score: float, own_score: float) -> float:
    """Return the log odds of a pose against another by their scores, at most 0, by the model of views."""
    standing = Standing(score / max(own_score, 1e-9), 1.0, None, query.by_views().evidence)
    weight = MODELS[standing.evidence].weights[0]
    return min(weight * float(pose_features(standing)[0]), 0.0)
