"""Corrections of a lens by the matches of a photo with the scan as it is drawn at a pose."""

from functools import partial
from typing import NamedTuple

import numpy as np

from ..geometry.gauss_newton import sum_observations
from ..geometry.pose import Pose
from ..geometry.pose_gaussian import LOOSE, add, differentiate_rays
from ..geometry.robust import geman_mcclure
from ..local_features.matching import Matches
from ..optimize.corrected_equations import NUM_OF_POSE
from ..photo.camera import Mount
from ..photo.camera.corrections import FOCAL, LENS, Corrections
from ..problem.method import Method
from ..system.arrays import Array
from .self_calibration import LensEstimate, invert
from .verification import LEAST_ERROR

MOST_LENS_CHANGE = np.array([0.5, 0.2, 0.3, 0.3, 0.6])  # corrections that are searched
# scale of the matches' loss in each step
MATCH_SCALES = np.radians([3.0] * 4 + [1.0] * 3 + [0.5] * 3 + [0.25] * 5)
AGREES = 0.25  # least weight of a match that agrees
MATCHED_DEVIATION = 0.015  # of errors that all matches share, of the logarithm of a focal length by matches
INFLATION = 4.0  # of the covariance by matches, so that 95 % of true focal lengths lie within two deviations
LIMIT = 0.4  # largest change of the logarithm by matches


class MatchFit(NamedTuple):
    """Corrections of a lens by the matches with the drawn scan."""

    values: Array  # (5,) of LENS
    information: float  # of the focal length's logarithm; 0 if few matches agree
    pose: Pose  # in the map, fitted together with the corrections


def add_matches(estimate: LensEstimate, by_matches: MatchFit) -> LensEstimate:
    """Return the estimate with the focal length by the matches as further evidence."""
    by_picture = estimate.by_picture
    of_matches = np.zeros_like(by_picture.information)
    of_matches[FOCAL, FOCAL] = by_matches.information
    both = by_picture.information + of_matches
    goal = by_picture.information @ by_picture.values + of_matches @ by_matches.values
    return estimate._replace(by_picture=by_picture._replace(values=invert(both) @ goal, information=both))


def fit_matches(
    method: Method, camera: Mount, pose: Pose, matches: Matches, widths: tuple[float, ...]
) -> MatchFit:
    """Fit corrections of the lens and the pose to the matches with the scan drawn at a pose.

    `widths` (5,) are the deviations of the corrections. A match's loss becomes narrower from step to step.
    """
    if len(matches.rays) < method.sure_matches:
        return MatchFit(np.zeros(len(LENS)), 0.0, pose)
    corrections = Corrections(camera)
    prior = np.diag([0.0] * NUM_OF_POSE + list((LEAST_ERROR / np.array(widths)) ** 2))
    end = pose
    values = np.zeros(len(LENS))
    for scale in MATCH_SCALES:
        rays, of_pose = differentiate_rays(matches.points, end)
        shown = corrections.displace(np.ascontiguousarray(rays.T, np.float32), values)
        is_shown = shown.is_shown[:, None].astype(np.float64)
        J = np.concatenate([of_pose, shown.moves.transpose(2, 1, 0)], axis=2) * is_shown[..., None]
        residuals = (shown.points.T - matches.rays) * is_shown
        robust = partial(geman_mcclure, inverse_scale2=scale**-2)
        found = sum_observations(residuals, J, robust)
        found = found.add_known(np.concatenate([np.zeros(NUM_OF_POSE), values]), prior)
        found = found.add_known(np.zeros(len(prior)), LOOSE * np.eye(len(prior)))
        step = found.solve()
        end = add(end, step[:NUM_OF_POSE])
        values = np.clip(values + step[NUM_OF_POSE:], -MOST_LENS_CHANGE, MOST_LENS_CHANGE)
    weights = is_shown[:, 0] * robust(np.square(residuals).sum(axis=1))[1]
    slopes = np.einsum("n,nij,ni->nj", weights, J, residuals)
    of_focal = np.linalg.inv(found.matrix)[NUM_OF_POSE + FOCAL]
    variance = INFLATION * float(np.square(slopes @ of_focal).sum()) + MATCHED_DEVIATION**2
    is_known = (weights > AGREES).sum() >= method.sure_matches and abs(values[FOCAL]) < LIMIT
    return MatchFit(values, float(is_known / variance), end)
