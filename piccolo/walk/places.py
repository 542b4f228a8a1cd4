"""The places of the whole map that look like a frame: its likelihood over the grid of candidates.

Every candidate is scored in every heading, and the best start a short descent on their prepared views; what
they explain of the photo is compared with what the frame's own pose explains there.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..confidence.alternatives import MIN_ANGLE, MIN_DISTANCE
from ..confidence.confidence import MODELS, Standing, pose_features
from ..geometry.pose import Array, Pose
from ..geometry.rotations import uniform_yaws
from ..geometry.sphere import wider_cells
from ..geometry.suppression import non_maximum_suppression
from ..localization.attempts import brief_query, is_whole, mirror_query, score_mirror, score_starts
from ..localization.correlation import masked_correlation, weigh_by_area
from ..localization.query import Query
from ..localization.refinement import FIRST_ITERATIONS, descend_all
from ..localization.search import Starts, best_poses, search_poses, turn_panorama, widen_samples
from ..views.candidate_views import WIDE_RINGS

NUM_STARTS = 16  # of these that begin a descent
NUM_NEAR = 256  # candidates around a pose, about 3 m, at which a photo is compared with its mirror image
MOST_PLACES = 64  # of a frame: the rooms of a hotel that look alike


class Place(NamedTuple):
    """A pose that may be a frame's, as rough as the grid of candidates."""

    pose: Pose  # in the map
    behind: float  # [log] of its odds to those of the frame's own pose


def find_places(query: Query, own: Pose) -> list[Place]:
    """Find the distinct poses in the map that look like a photo, best first, beside its own pose.

    They have the tilt of that, and any heading.
    """
    level = own.R_cam_from_world @ uniform_yaws(query.settings.num_yaws)
    first = brief_query(replace(query, rotations=level))
    starts = search_poses(first, "known")
    at_own = Starts(own.R_cam_from_world[None], own.center_world[None], nearest(query, own))
    image = query.photo.images.search()
    _, own_scores = descend_all(query.scan_map, image, at_own, FIRST_ITERATIONS, query.workers)
    ends, scores = descend_all(query.scan_map, image, starts, FIRST_ITERATIONS, query.workers)
    kept = non_maximum_suppression(ends.R_cam_from_map, ends.center_map, MOST_PLACES, MIN_DISTANCE, MIN_ANGLE)
    ratios = scores[kept] / max(float(own_scores[0]), 1e-9)
    return [
        Place(pose, log_behind(query, float(ratio)))
        for pose, ratio in zip(ends.take(kept).poses(), ratios, strict=True)
    ]


def log_behind(query: Query, ratio: float) -> float:
    """Return the log odds of a pose against another of which it explains a part, by the model of views."""
    standing = Standing(ratio, 1.0, None, is_shape=query.scan_map.has_shape)
    weight = MODELS[standing.kind].weights[0]
    return min(weight * float(pose_features(standing)[0]), 0.0)


def is_mirrored(query: Query, pose: Pose) -> bool:
    """Return True if the mirror image of a whole photo explains more near a pose than the photo."""
    if query.photo.is_partial:
        return False
    across = np.diag([1.0, -1.0, 1.0])
    R_mirrored = across @ pose.R_cam_from_world @ across
    return score_near(mirror_query(query), pose, R_mirrored) > score_near(query, pose, pose.R_cam_from_world)


def is_mirror_image(query: Query) -> bool:
    """Return True if the mirror image of a whole upright photo looks more like any place of the map."""
    if not is_whole(query):
        return False
    first = brief_query(query)
    return score_mirror(query) > score_starts(first, search_poses(first, "known"))


def score_near(query: Query, pose: Pose, R_cam_from_map: Array) -> float:
    """Return the best score after short descents near a pose, in a rotation turned about the vertical."""
    m = query.scan_map
    rotations = R_cam_from_map @ uniform_yaws(query.settings.num_yaws)
    samples, validity = turn_panorama(query.photo.images.search(), rotations)
    wide = widen_samples(samples, validity, query.workers)
    panorama = weigh_by_area(*wide, wider_cells(WIDE_RINGS)[1], 255)
    distances = np.linalg.norm(m.centers[m.sparse] - pose.center_world, axis=1)
    near = np.argsort(distances, kind="stable")[:NUM_NEAR]
    scores = masked_correlation(m.wide_features[near], m.wide_seen[near], panorama, query.workers)
    row, turn, _ = best_poses(scores, NUM_STARTS)
    candidate = m.sparse[near[row]]
    starts = Starts(rotations[turn], m.centers[candidate], candidate)
    image = query.photo.images.search()
    return float(descend_all(m, image, starts, FIRST_ITERATIONS, query.workers)[1].max())


def nearest(query: Query, pose: Pose) -> NDArray[np.int64]:
    """Return the number (1,) of the candidate nearest to a pose."""
    distances = np.linalg.norm(query.scan_map.centers - pose.center_world, axis=1)
    return np.array([distances.argmin()])
