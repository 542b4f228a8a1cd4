"""Brief searches by whole views: few starts, and a few steps on the candidates' prepared views."""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from ..geometry.pose import Array, Pose
from ..jobs.threads import Once
from ..panorama.texels import Texels
from .query import Cache, Images, Query
from .refinement import FIRST_ITERATIONS, count_first_iterations, descend_all
from .search import Starts, search_poses

FIRST_STARTS = 300  # few are enough for a clear photo
NUM_SCORED = 64  # starts, if only the best score is needed
ACROSS = np.diag([1.0, -1.0, 1.0])  # mirrors a camera's axes left for right


class Ends(NamedTuple):
    """Ends of short descents, best first."""

    poses: Starts
    scores: Array  # (N,)

    @property
    def best_score(self) -> float:
        """Score of the best end; 0 if there is none."""
        return float(self.scores.max(initial=0.0))


def brief_query(query: Query, most: int = FIRST_STARTS) -> Query:
    """Return the query with fewer starts, at most so many."""
    settings = replace(query.settings, max_starts=min(most, FIRST_STARTS, query.settings.max_starts))
    return replace(query, settings=settings)


def descend_briefly(query: Query) -> Ends:
    """Search at the photo's tilt, and descend a few steps."""
    return descend_from(query, search_poses(query, "known"), count_first_iterations(query))


def descend_from(query: Query, starts: Starts, num_steps: int) -> Ends:
    """Descend a few steps from starts on their candidates' prepared views."""
    image = query.photo.images.search()
    return Ends(*descend_all(query.scan_map, image, starts, num_steps, query.workers))


def score_briefly(query: Query) -> float:
    """Return the best score of a brief search."""
    return descend_briefly(query).best_score


def score_near(query: Query, pose: Pose) -> float:
    """Return the score a few steps from a pose, on the prepared view of the candidate nearest to it."""
    distances = np.linalg.norm(query.scan_map.centers - pose.center_world, axis=1)
    nearest = np.array([distances.argmin()])
    start = Starts(pose.R_cam_from_world[None], pose.center_world[None], nearest)
    return descend_from(query, start, count_first_iterations(query)).best_score


def score_starts(query: Query, starts: Starts) -> float:
    """Return the best score after short descents from the best starts."""
    best = starts.take(np.arange(min(NUM_SCORED, len(starts.candidate))))
    return descend_from(query, best, FIRST_ITERATIONS).best_score


def mirror_query(query: Query) -> Query:
    """Return the query of the photo mirrored left to right, with all that whole views need.

    It has few starts, no features, and not the prior's heading.
    """
    photo = query.photo
    panorama = replace(
        photo.panorama, rgb=photo.panorama.rgb[:, ::-1], is_valid=photo.panorama.is_valid[:, ::-1]
    )
    images = Images(*(Once(partial(mirror_image, image)) for image in photo.images))
    level = ACROSS @ photo.R_cam_from_level @ ACROSS
    mirrored = replace(
        photo, panorama=panorama, images=images, small=photo.small.mirror(), R_cam_from_level=level
    )
    prior = query.settings.prior.without_heading()
    settings = replace(query.settings, prior=prior, max_starts=min(NUM_SCORED, query.settings.max_starts))
    rotations = ACROSS @ query.rotations @ ACROSS
    return replace(
        query,
        photo=mirrored,
        settings=settings,
        rotations=rotations,
        features=(),
        num_parts=0,
        beside=(),
        cache=Cache(query.cache.views),
    )


def mirror_image(image: Once[Texels]) -> Texels:
    """Return an image mirrored left for right."""
    return image().mirror()


def score_mirror(query: Query) -> float:
    """Search the mirrored photo, and return its best score."""
    return score_briefly(mirror_query(query))
