"""The focal length of a photo, fitted with its pose to the scan and to prior knowledge.

The photo is projected again with each of several focal lengths (and k1, if a guessed camera has it), and the
pose refined with each. The losses at the ends are the profile of the loss. Its minimum is the focal length on
which photo and scan agree; the slopes of the blocks' losses there give its covariance. The covariance of the
pose is marginal: it includes the error of the focal length.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache, partial
from typing import NamedTuple

import cv2
import numpy as np

from ..arrays import Array, Array32, Mask
from ..camera import Mount
from ..camera.model import MODELS, RADIAL
from ..confidence.focal_length import WRONG_SHARE, Opinion
from ..confidence.localization import FocalLength
from ..geometry.pose import Pose, rotate_points
from ..geometry.pose_gaussian import add, differentiate_rays, subtract
from ..geometry.sphere import compute_indices
from ..jobs.threads import Once
from ..local_features.matching import NO_MATCHES
from ..optimize.channel_loss import ChannelProblem
from ..optimize.normal_equations import LOSS
from ..panorama import Panorama
from ..views.view import Cells
from .comparison import compare, mask_occluders, score_pose
from .covariance import SCALE, remove_poles, sort_by_block, sum_by_block
from .ladder import FINE, LAST, descend, to_levels
from .last_descent import refine_best
from .photo import make_images
from .query import Features, Query, prepare_query
from .selection import Selection
from .verification import SURE_MATCHES, matches_near

WIDE = 0.05  # a focal length with a larger deviation is a guess: k1 is fitted too
K1_DEVIATION = 0.05  # of k1 where the camera is a guess
NUM_VALUES = 5  # of the parameter in a design of one
NUM_VALUES_OF_TWO = 4  # of each parameter in one of two
FIRST_REACH = 0.1  # of a design to either side, at first
LAST_REACH = 0.02  # where a design has a minimum
WIDER = 2.0  # times the reach, where it has none
LIMIT = 0.4  # of the change that is searched
END_DEVIATION = 0.05  # of a minimum that lies there or beyond
MATCH_SCALES = np.radians([3.0] * 4 + [1.0] * 3 + [0.5] * 3 + [0.25] * 5)  # of the loss of matches
STEP = 1e-4  # of the focal length's logarithm, with which rays are differentiated
AGREES = 0.25  # least weight of a match that agrees
MATCHED_DEVIATION = 0.015  # that errors in common add to a focal length by matches
DISAGREE = 2.0  # deviations between picture and what was given, by which chance parts them in one of twenty
CLEARLY = 2.5  # deviations by which matches must tell another one
MIN_SCORE_LEFT = 0.95  # fraction of the score that it must keep
MOST_DESIGNS = 8
INFLATION = 4.0  # of the covariance, so that 95 % of true focal lengths lie within two deviations
# [px] of the sphere at the picture's edge, which all blocks may have in common; with 0.4 a right calibration
# was called wrong in the real corridor of tests/data
EDGE_ERROR = 0.6
LEAST_BLOCKS = 4  # shown by a picture, per parameter: fewer give no deviation
MOST_OF_BLOCK = 0.7  # of a block in what fixes the focal length
AT_REST = 0.5  # deviations: a smaller change ends the fit
LEAST_CHANGE = 5e-4  # and so does a smaller fraction of the focal length
MAX_CALIBRATIONS = 4  # fits of a focal length
EDGE = 5  # [px] within the picture's edge that no point may come near
CLOSE = LAST.limits._replace(tolerance=1e-6)


class FocalFit(NamedTuple):
    """The focal length, and k1, fitted to a photo: changes of its camera."""

    change: Array  # (p,) logarithm of the focal length, and k1 if it is fitted: the likeliest
    covariance: Array  # (p, p) of these
    motion: Array  # (6, p) of a pose with it: rotation about the camera's axes [rad], centre in the map [m]
    opinion: Opinion | None  # what the picture alone says; None if it says nothing
    conflict: float  # deviations between that and what was given; 0 if it says nothing
    doubt: float = 0.0  # as of FocalLength

    @property
    def deviation(self) -> float:
        """Standard deviation of the logarithm of the focal length."""
        return math.sqrt(self.covariance[0, 0])

    @property
    def is_at_rest(self) -> bool:
        """True if the remaining change is too small to project the photo again."""
        deviations = np.sqrt(np.diag(self.covariance))
        return bool(np.all(np.abs(self.change) <= np.maximum(AT_REST * deviations, LEAST_CHANGE)))

    @property
    def pose_covariance(self) -> Array:
        """Covariance (6, 6) that the calibration adds to a pose: rotation, then centre in the map."""
        return np.asarray(self.motion @ self.covariance @ self.motion.T)

    def move(self, pose: Pose) -> Pose:
        """Move a pose in the map by the change of the calibration."""
        return add(pose, self.motion @ self.change)

    def focal_length(self, panorama: Panorama) -> FocalLength:
        """Return the focal length of a photo with its deviation, and its prior."""
        prior = panorama.focal_prior
        focal = panorama.cameras[0].camera.focal[0]
        assert prior is not None
        given_std = prior.deviation * prior.focal
        found = FocalLength(focal, self.deviation * focal, prior.focal, given_std, source=prior.source)
        if self.opinion is None:
            return replace(found, doubt=self.doubt)
        px = prior.focal * math.exp(self.opinion.off)
        std = math.sqrt(self.opinion.variance) * px
        return replace(found, doubt=self.doubt, picture_px=px, picture_std_px=std)


class Minimum(NamedTuple):
    """The calibration at which the loss of a profile is least."""

    change: Array  # (p,)
    information: Array  # (p, p) inverse of its covariance; 0 where the profile has no minimum
    motion: Array  # (6, p) as of FocalFit

    @property
    def variance(self) -> float:
        """Variance of the logarithm of the focal length; infinite where there is no minimum."""
        return float(np.linalg.pinv(self.information)[0, 0]) if self.information.any() else math.inf


def fit_focal(query: Query, pose: Pose, is_first: bool = True) -> FocalFit:
    """Fit the focal length of a photo with a focal_prior whose pose in the map is roughly known.

    Later fits (`is_first` false) begin from a focal length that is roughly known too.
    """
    prior = query.given.focal_prior
    camera = query.given.cameras[0].camera
    assert prior is not None
    names = MODELS[camera.model][1]
    num = 2 if prior.deviation > WIDE and RADIAL in names else 1
    expected = np.array([math.log(prior.focal / camera.focal[0])])
    if num > 1:
        k1 = names.index(RADIAL)
        expected = np.append(expected, prior.view.mount.camera.params[k1] - camera.params[k1])
    precision = np.diag([prior.deviation**-2, K1_DEVIATION**-2][:num])
    minimum = find_minimum(query, pose, num, FIRST_REACH if is_first else LAST_REACH)
    if minimum.information.any():
        per_px = math.tau * camera.focal[0] / (0.5 * camera.width * query.photo.panorama.rgb.shape[1])
        covariance = np.linalg.pinv(minimum.information)
        covariance[0, 0] += (EDGE_ERROR * per_px) ** 2
        minimum = minimum._replace(information=np.linalg.pinv(covariance))
    change, information, _ = fit_matches(query, pose)
    of_matches = np.diag([information, 0.0][:num])
    both = minimum.information + of_matches
    middle = np.linalg.pinv(both) @ (minimum.information @ minimum.change + of_matches[0] * change)
    minimum = minimum._replace(change=middle, information=both)
    conflict = 0.0
    doubt = WRONG_SHARE if prior.deviation <= WIDE else 0.0
    opinion = None
    wide = precision.copy()
    if minimum.information.any():
        opinion = Opinion(float(minimum.change[0] - expected[0]), minimum.variance)
        conflict = opinion.conflict(prior.deviation)
        if doubt:
            doubt = opinion.doubt(prior.deviation) * opinion.share_of_given(prior.deviation)
        spread = minimum.variance + prior.deviation**2
        # of the prior's variance, as by DerSimonian and Laird (1986)
        excess = 0.0 if prior.is_measured else max(opinion.off**2 - spread, 0.0)
        wide[0, 0] = 1.0 / (prior.deviation**2 + excess)
    if conflict > DISAGREE:
        precision = wide  # the picture says where to look next
    goal = minimum.information @ minimum.change + precision @ expected
    change = np.linalg.inv(minimum.information + precision) @ goal
    total = np.linalg.inv(minimum.information + wide)
    return FocalFit(change, np.asarray(total), minimum.motion, opinion, conflict, doubt)


def find_minimum(query: Query, pose: Pose, num: int, reach: float) -> Minimum:
    """Find the minimum of the profile about a pose in a wide and a narrow design, moved if they miss it.

    Of the designs that have a minimum, the one with the least variance counts. If none has, the picture does
    not determine the calibration: the information is 0. If the loss clearly falls to the end of the range,
    that is the minimum: it contradicts what was given.
    """
    middle = np.zeros(num)
    found: Minimum | None = None
    for _ in range(MOST_DESIGNS):
        changes = middle + make_design(num, reach)
        losses, ends = take_profile(query, pose, changes)
        minimum = fit_minimum(changes, losses, ends, pose)
        has_minimum = bool(minimum.information.any())
        is_inside = has_minimum and bool(np.all(np.abs(minimum.change - middle) <= reach))
        lowest = changes[int(losses.sum(axis=1).argmin())]
        if is_inside:
            found = min(minimum, found or minimum, key=lambda one: one.variance)
        is_lost = not has_minimum and bool(np.all(np.abs(lowest - middle) < 0.99 * reach))
        if reach <= LAST_REACH if is_inside else found or is_lost:
            break
        if abs(lowest[0]) > LIMIT:
            return minimum._replace(change=lowest, information=fit_end(changes, losses))
        middle = np.clip(minimum.change if has_minimum else lowest, middle - reach, middle + reach)
        pose = ends[int(np.argmin(np.abs(changes - middle).sum(axis=1)))]
        reach = LAST_REACH if is_inside else min(WIDER * reach, FIRST_REACH)
    return found or Minimum(np.zeros(num), np.zeros((num, num)), minimum.motion)


def fit_end(changes: Array, losses: Array) -> Array:
    """Return the information of the end of a profile: 0 unless most blocks' losses fall to it."""
    num = changes.shape[1]
    terms = np.column_stack([np.ones(len(changes)), changes])
    slopes = np.linalg.lstsq(terms, losses[:, losses.any(axis=0)], rcond=None)[0][1]
    if len(slopes) < LEAST_BLOCKS:
        return np.zeros((num, num))
    is_steep = abs(slopes.mean()) > 2.0 * math.sqrt(INFLATION / len(slopes)) * slopes.std()
    return np.diag([END_DEVIATION**-2 * is_steep, 0.0][:num])


def make_design(num: int, reach: float) -> Array:
    """Return changes (K, num) of a camera, on a grid with a reach to either side."""
    values = np.linspace(-reach, reach, NUM_VALUES if num == 1 else NUM_VALUES_OF_TWO)
    return np.array(list(itertools.product(values, repeat=num)))


def take_profile(query: Query, pose: Pose, changes: Array) -> tuple[Array, list[Pose]]:
    """Descend from a pose with each of several calibrations (K, p) of the photo's camera.

    Return the losses (K, B) of each block of the sphere at the ends, and the ends.
    """
    shown = mask_occluders(query, compare(query, pose))
    whole = query.photo.panorama
    given = query.given.shrink_picture(whole.rgb.shape[1])
    is_left = shown.photo.panorama.is_valid | ~whole.is_valid  # what does not contradict the scan

    @cache
    def retake(*change: float) -> Panorama:
        found = given.resample(given.cameras[0].camera.change(*change), whole.rgb.shape[1])
        return replace(found, is_valid=found.is_valid & is_left)

    narrowest = retake(*changes.max(axis=0)).is_valid
    points = mask_edge(shown.view_at(pose, "points"), pose, narrowest)
    fine = shown.view_at(pose, "fine")
    around, begins = sort_by_block(remove_poles(points.around(pose.center_world), pose))
    levels = to_levels(around.channels)
    middle = changes.mean(axis=0)

    def end_with(change: Array) -> tuple[Pose, Array]:
        images = make_images(retake(*change), query.photo.scales)
        full = images.full()
        is_near = abs(changes - middle).max() <= 1.001 * LAST_REACH
        near = pose if is_near else descend(fine, images.fine(), pose, FINE.limits)
        end = descend(points, full, near, CLOSE)
        offsets = around.around(end.center_world).offsets
        problem = ChannelProblem(offsets, levels, around.weights, full.rgbx, full.width, SCALE)
        return end, sum_by_block(problem, end, begins)[:, LOSS]

    ends = query.workers.map(end_with, list(changes), "fit the focal length")
    return np.array([losses for _, losses in ends]), [end for end, _ in ends]


def mask_edge(points: Cells, pose: Pose, is_valid: Mask) -> Cells:
    """Remove the points near the edge of what a photo (H, W) shows."""
    inner = cv2.erode(is_valid.view(np.uint8), np.ones((EDGE, EDGE), np.uint8))
    offsets = points.around(pose.center_world).offsets.T.astype(np.float64)
    rays = rotate_points(offsets / np.linalg.norm(offsets, axis=1, keepdims=True), pose.R_cam_from_world)
    is_kept = inner[compute_indices(rays, is_valid.shape[1])] > 0
    return points._replace(weights=points.weights * is_kept.astype(np.float32))


def fit_minimum(changes: Array, losses: Array, poses: Sequence[Pose], pose: Pose) -> Minimum:
    """Find the minimum of a profile by a quadratic function (least squares), and how poses follow the camera.

    The changes (K, p) of the camera have losses (K, B) by block, and poses; `pose` is that without a change.
    The covariance of the minimum is H^-1 (sum g g^T) H^-1, with the slope g of each block's loss there.
    """
    middle = changes.mean(axis=0)
    num = changes.shape[1]
    x = changes - middle
    rows, columns = np.triu_indices(num)
    terms = np.column_stack([np.ones(len(x)), x, x[:, rows] * x[:, columns]])
    fitted = np.linalg.lstsq(terms, losses, rcond=None)[0]
    hessians = np.zeros((losses.shape[1], num, num))
    hessians[:, rows, columns] += fitted[1 + num :].T
    hessians[:, columns, rows] += fitted[1 + num :].T
    H = hessians.sum(axis=0)
    moved = np.array([subtract(p, pose) for p in poses])
    motion = np.linalg.lstsq(terms[:, : 1 + num], moved, rcond=None)[0][1:].T
    num_blocks = int(losses.any(axis=0).sum())
    if num_blocks < LEAST_BLOCKS * num or not np.linalg.eigvalsh(H)[0] > 0.0:
        return Minimum(middle, np.zeros((num, num)), motion)
    offset = -np.linalg.solve(H, fitted[1 : 1 + num].sum(axis=1))
    slopes = fitted[1 : 1 + num].T + hessians @ offset
    shares = np.trace(hessians @ np.linalg.inv(H), axis1=1, axis2=2) / num
    slopes /= (1.0 - np.clip(shares, 0.0, MOST_OF_BLOCK))[:, None]  # as if each had been left out, as in CR3
    information = H @ np.linalg.pinv(INFLATION * slopes.T @ slopes) @ H
    return Minimum(middle + offset, information, motion)


def calibrate(query: Query, found: Selection) -> tuple[Query, Selection, FocalFit]:
    """Fit the focal length at the best pose, and refine the poses with it, until it is at rest.

    The last fit to which the picture contributed counts.
    """
    query, found = follow_matches(query, found)
    fit = fit_focal(query, found.best.pose)
    for _ in range(MAX_CALIBRATIONS):
        if fit.is_at_rest:
            break
        query, found = refine_with(query, found, fit.change, fit.move(found.best.pose))
        after = fit_focal(query, found.best.pose, is_first=False)
        fit = after if after.conflict else fit._replace(change=np.zeros_like(fit.change))
    return query, found, fit


def refine_with(query: Query, found: Selection, change: Array, best: Pose) -> tuple[Query, Selection]:
    """Refine the poses with another calibration, of which the best is `best`."""
    query = recalibrate(query, change)
    poses = [best, *(h.pose for h in found.alternatives)]
    moved = query.workers.map(partial(score_pose, query), poses, "compare")
    return query, refine_best(query, moved)


def follow_matches(query: Query, found: Selection) -> tuple[Query, Selection]:
    """Begin with the focal length by which most matches agree, if that is clearly another."""
    change, information, end = fit_matches(query, found.best.pose)
    if abs(change) * math.sqrt(information) < CLEARLY:
        return query, found
    other = refine_with(query, found, np.array([change]), end)
    return other if other[1].best.score > MIN_SCORE_LEFT * found.best.score else (query, found)


def fit_matches(query: Query, pose: Pose) -> tuple[float, float, Pose]:
    """Fit focal length and pose to the matches with the scan drawn at a pose, from a wide to a narrow loss.

    Return the change of the focal length's logarithm, its information (0 if few matches agree), and the pose.
    """
    matches = matches_near(query, pose) if query.uses_matches else NO_MATCHES
    before = query.given.cameras[0]

    def find_rays(change: float) -> Array32:
        return _turn_rays(matches.rays, before, before.with_camera(before.camera.change(change)))

    if len(matches.rays) < SURE_MATCHES:
        return 0.0, 0.0, pose
    known: tuple[float, float, Pose] | None = query.cache.fits.get(pose.key)
    if known is not None:
        return known
    end = pose
    change = 0.0
    for scale in MATCH_SCALES:
        rays, of_pose = differentiate_rays(matches.points, end)
        of_focal = (find_rays(change - STEP) - find_rays(change + STEP)) / (2.0 * STEP)
        J = np.concatenate([of_pose, of_focal[..., None]], axis=2)
        residuals = rays - find_rays(change)
        weights = 1.0 / (1.0 + (residuals**2).sum(axis=1) / scale**2) ** 2  # of Geman and McClure's loss
        slopes = np.einsum("n,nij,ni->nj", weights, J, residuals)
        inverse = np.linalg.inv(np.einsum("n,nij,nik->jk", weights, J, J) + 1e-6 * np.eye(7))
        step = inverse @ slopes.sum(axis=0)
        end = add(end, -step[:6])
        change = float(np.clip(change - step[6], -1.0, 1.0))  # the focal length stays one
    variance = INFLATION * float((inverse @ slopes.T @ slopes @ inverse)[6, 6]) + MATCHED_DEVIATION**2
    is_known = (weights > AGREES).sum() >= SURE_MATCHES and abs(change) < LIMIT
    fit = change, is_known / variance, end
    query.cache.fits[pose.key] = fit
    return fit


def recalibrate(query: Query, change: Array) -> Query:
    """Prepare the query again with another calibration; its matches stay, and their rays follow."""
    given = query.given
    before = given.cameras[0]
    after = before.with_camera(before.camera.change(*change))
    taken = given.resample(after.camera, given.rgb.shape[1])
    fresh = prepare_query(taken, query.scan_map, query.settings, query.workers)
    features = tuple(Once(_turn_features, part, before, after) for part in query.features)
    beside = tuple(m._replace(rays=_turn_rays(m.rays, before, after)) for m in query.beside)
    found = replace(fresh, features=features, beside=beside)
    return found if query.uses_matches else found.by_views()


def _turn_features(found: Features, before: Mount, after: Mount) -> Features:
    """Give the features the rays that another calibration gives to their pixels."""
    keypoints = found.keypoints._replace(rays=_turn_rays(found.keypoints.rays, before, after))
    return Features(keypoints, found.matches._replace(rays=_turn_rays(found.matches.rays, before, after)))


def _turn_rays(rays: Array32, before: Mount, after: Mount) -> Array32:
    pixels, _ = before.camera.pixels(rotate_points(rays.astype(np.float64), before.rotation))
    found, _ = after.camera.rays(pixels)
    return np.asarray(rotate_points(found, before.rotation.T), np.float32)
