"""The focal length of a photo, fitted with its pose to the scan and to prior knowledge.

Pose and corrections of the lens (`self_calibration`) are optimised together. The optimum is the estimate by
photo and scan; the given values are a claim with deviations of its own. The focal length (and k1, if a
guessed camera has it) becomes the mean of estimate and claim. The other corrections are not applied, as a
photo hardly determines them, but their errors count: the covariance of the pose is marginal over all of them.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np

from ..geometry.pose import Pose, rotate_points
from ..geometry.pose_gaussian import PoseGaussian, add
from ..geometry.sphere import compute_indices
from ..judge.belief import UNCONFIRMED
from ..judge.candidate import Candidate
from ..judge.claim import Claim, marginal
from ..judge.consensus import WRONG_DEVIATION, WRONG_SHARE, Opinion
from ..judge.result_parts import WIDE, FocalLength
from ..local_features.matching import NO_MATCHES, Matches
from ..photo.camera import Camera
from ..photo.camera.corrections import FOCAL, LENS, Corrections
from ..photo.camera.model import MODELS, RADIAL
from ..photo.panorama import Panorama
from ..photo.panorama.panorama import FocalPrior
from ..problem.accuracy import Accuracy
from ..problem.problem import Problem
from ..problem.stages import Limits
from ..system.arrays import Array, Mask
from ..system.jobs.threads import Workers
from ..views.view import Cells
from .comparison import mask_occluders
from .covariance import compute_acting_range
from .lens_matches import MOST_LENS_CHANGE, MatchFit, add_matches, fit_matches
from .scan_errors import displacement_variance
from .self_calibration import (
    Freedom,
    FreeEnd,
    LensEstimate,
    descend_freely,
    displace_blocks,
    estimate_corrections,
    invert,
)
from .verification import draw_near

K1_DEVIATION = 0.05  # prior deviation of k1, if the camera is a guess
FITTED = [FOCAL, LENS.index("radial")]  # corrections that are applied; the others widen the covariance
UNCALIBRATED = 0.005  # deviation of a focal length's logarithm from which the camera is not calibrated
# deviations of the other corrections: of a calibration, and of a focal length alone
CALIBRATED = (0.002, 0.003, 0.003, 0.005)
NOT_CALIBRATED = (0.002, 0.005, 0.005, 0.008)
OTHERS_WRONG = (0.05, 0.05, 0.05, 0.2)  # chosen: deviations of the other corrections if the claim is wrong
OTHERS_SHARES = (0.01, 0.01, 0.01, 0.01)  # chosen: shares of wrong claims
FIRST_CHANGES = (-0.1, 0.1)  # of the focal length's logarithm: further starts of a first fit
CHANGES_BESIDE = (-0.03, 0.03)  # of the logarithm at an end: starts of further descents, as the loss is rough
NUM_FOCAL_VIEWS = 2  # times that a descent is repeated with the points seen from its end
FAR_AWAY = 0.5  # [m] from the pose: a descent that ends farther away shows that the photo fixes no pose
MOST_VARIANCE = 1.0  # of a focal length's logarithm: with more, the picture gives no estimate
# deviations of corrections by which matches are fitted: of the focal length, and of all where descents begin
FOCAL_WIDTHS = (0.5, *CALIBRATED)
ALL_WIDTHS = (0.1, 0.05, 0.02, 0.02, 0.1)
DISAGREE = 2.0  # deviations between picture and claim; by chance, one photo in twenty has more
AT_REST = 0.5  # deviations: a smaller change ends the fit
LEAST_CHANGE = 5e-4  # of the focal length's logarithm: a smaller change ends the fit too
EDGE_WIDTH = 17  # [px] of the sphere, around a point that shows nothing beyond the picture
NEAR_LIMITS = Limits(1.0, 8, 1e-3)  # on fine cells, from another focal length
CLOSE = Limits(0.7, 15, 1e-4)


class FocalFit(NamedTuple):
    """The focal length, and k1, fitted to a photo: changes of its camera."""

    change: Array  # (p,) logarithm of the focal length, and k1 if it is fitted: the likeliest
    covariance: Array  # (p, p) of these
    motion: Array  # (6, p) of a pose with it: rotation about the camera's axes [rad], centre in the map [m]
    opinion: Opinion | None  # the estimate of the picture alone; None if it gives none
    conflict: float  # deviations between that estimate and the claim; 0 without an estimate
    doubt: float = 0.0  # as in FocalLength; 0 if the focal length was taken from other photos of the camera
    of_rest: Array | None = None  # (6, 6) what the other corrections add to the covariance of a pose
    # (6, 6) what all corrections would add to it if the whole claim were wrong; None if it is a mere guess
    of_picture: Array | None = None
    worst_correction: str = "log_focal"  # the correction of LENS in which both differ most
    # (6, 6) added to the errors of the result if picture and claim differ by more than their deviations allow
    of_difference: Array | None = None

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
        own = self.motion @ self.covariance @ self.motion.T
        return np.asarray(own if self.of_rest is None else own + self.of_rest)

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


def doubt_unconfirmed(fit: FocalFit, gaussian: PoseGaussian | None, accuracy: Accuracy) -> FocalFit:
    """Return the fit of a photo by itself, with more doubt if the photo does not confirm the claim.

    If the claim is worth nothing, the position is only as exact as by the photo's own focal length, which may
    be less exact than is wanted.
    """
    if fit.of_picture is None or gaussian is None:
        return fit
    of_position, _ = accuracy.parts(gaussian.widen(fit.of_picture).covariance)
    missed = 1.0 - of_position
    return fit._replace(doubt=1.0 - (1.0 - fit.doubt) * (1.0 - UNCONFIRMED * missed))


def fit_focal(problem: Problem, best: Candidate, workers: Workers, is_first: bool = True) -> FocalFit:
    """Fit the focal length of a photo with a focal_prior whose pose in the map is roughly known.

    Later fits (`is_first` false) begin from a focal length that is roughly known too.
    """
    prior = problem.given.focal_prior
    mount = problem.given.cameras[0]
    camera = mount.camera
    assert prior is not None
    claim = make_claim(prior, camera)
    matches = list_matches(problem, best, workers)
    starts = fit_matches(problem.method, mount, best.pose, matches, ALL_WIDTHS)
    near, far, scatter = descend_lens(problem, best, claim, starts, workers, is_first)
    by_matches = fit_matches(problem.method, mount, best.pose, matches, FOCAL_WIDTHS)
    estimate = estimate_lens(problem, best.pose, near, scatter, by_matches)
    return weigh_claim(prior, camera, estimate, estimate_lens(problem, best.pose, far, scatter))


def weigh_claim(prior: FocalPrior, camera: Camera, estimate: LensEstimate, free: LensEstimate) -> FocalFit:
    """Weigh the claim about a camera against the estimates by the picture.

    `estimate` is that with the focal length free, `free` that with all corrections of the lens free.
    """
    claim = make_claim(prior, camera)
    by_picture = estimate.by_picture
    motion = estimate.motion
    off, variance = marginal(by_picture, claim, FOCAL)
    off -= claim.expected[FOCAL]
    opinion = Opinion(off, variance) if variance < MOST_VARIANCE else None
    opinions = by_picture, free.by_picture
    tests = [claim.contradict(one)[0] for one in opinions]
    worst = np.abs(tests).max(axis=0)
    change, total, difference = average(prior, claim, estimate, opinion, float(worst.max()))
    fitted = FITTED if fits_radial(prior, camera) else FITTED[:1]
    rest = [k for k in range(len(by_picture.values)) if k not in fitted]
    spread = total[np.ix_(rest, rest)] + np.outer(change[rest], change[rest])
    return FocalFit(
        change[fitted],
        np.asarray(total[np.ix_(fitted, fitted)]),
        motion[:, fitted],
        opinion,
        float(worst.max()),
        0.0 if prior.is_measured else max(claim.doubt(one) for one in opinions),
        np.asarray(motion[:, rest] @ spread @ motion[:, rest].T),
        None if prior.is_measured or prior.deviation > WIDE else find_errors_of_picture(free, claim),
        LENS[int(worst.argmax())],
        motion @ difference @ motion.T,
    )


def list_matches(problem: Problem, candidate: Candidate, workers: Workers) -> Matches:
    """Return the matches with the scan drawn near a candidate; none if the profile is without matches."""
    if not problem.profile.uses_matches:
        return NO_MATCHES
    return draw_near(problem, candidate.pose, candidate.drawn, workers).matches


def average(
    prior: FocalPrior, claim: Claim, estimate: LensEstimate, opinion: Opinion | None, conflict: float
) -> tuple[Array, Array, Array]:
    """Return the mean (5,) of picture and claim, its covariance (5, 5), and by how much they differ too much.

    If the difference is not by chance, the variance of the given focal length grows by it.
    """
    precision = claim.precision
    wide = precision.copy()
    if opinion is not None and not prior.is_measured:
        # as by DerSimonian and Laird (1986)
        wide[FOCAL] = 1.0 / max(opinion.off**2 - opinion.variance, prior.deviation**2)
    if conflict > DISAGREE:
        precision = wide  # the next fit begins where the picture points
    by_picture = estimate.by_picture
    goal = by_picture.information @ by_picture.values + precision * claim.expected
    total = np.linalg.inv(by_picture.information + np.diag(precision))
    return total @ goal, np.asarray(total), np.linalg.inv(by_picture.information + np.diag(wide)) - total


def find_errors_of_picture(estimate: LensEstimate, claim: Claim) -> Array:
    """Return what the corrections would add to a pose's covariance (6, 6) if the whole claim were wrong."""
    by_picture = estimate.by_picture
    covariance = np.linalg.inv(by_picture.information + np.diag(claim.wrong_deviations**-2.0))
    off = covariance @ by_picture.information @ (by_picture.values - claim.expected)
    return np.asarray(estimate.motion @ (covariance + np.outer(off, off)) @ estimate.motion.T)


def fits_radial(prior: FocalPrior, camera: Camera) -> bool:
    """Return True if the camera is a guess that has a k1, which is fitted too."""
    return prior.deviation > WIDE and RADIAL in MODELS[camera.model][1]


def make_claim(prior: FocalPrior, camera: Camera) -> Claim:
    """Return the claim about a camera with a prior focal length, calibrated or not."""
    names = MODELS[camera.model][1]
    expected = np.zeros(len(OTHERS_WRONG) + 1)
    expected[FOCAL] = math.log(prior.focal / camera.focal[0])
    others = CALIBRATED if prior.deviation < UNCALIBRATED else NOT_CALIBRATED
    deviations = np.array([prior.deviation, *others])
    shares = np.array([WRONG_SHARE if prior.deviation <= WIDE else 0.0, *OTHERS_SHARES])
    if fits_radial(prior, camera):
        expected[-1] = (
            prior.view.mount.camera.params[names.index(RADIAL)] - camera.params[names.index(RADIAL)]
        )
        deviations[-1] = K1_DEVIATION
        shares[-1] = 0.0
    return Claim(expected, deviations, np.array([WRONG_DEVIATION, *OTHERS_WRONG]), shares)


class LensDescents(NamedTuple):
    """Descents of a photo's lens and pose, on the scan that is seen from some place."""

    shown: Problem  # with the photo without what hides the scan
    is_valid: Mask  # (H, W) pixels that the photo has
    workers: Workers

    def find_points(self, place: Pose) -> Cells:
        """Return the points seen from a place."""
        return mask_edge(self.shown.view_at(place, "points"), place, self.is_valid)

    def begin(self, cells: Cells, freedom: Freedom, pose: Pose, change: float) -> FreeEnd:
        """Descend on cells seen from a pose, from a focal length whose logarithm differs by `change`."""
        values = np.where(np.arange(len(LENS)) == FOCAL, change, 0.0)
        return descend_freely(cells, self.shown.photo.image("fine"), freedom, pose, values, NEAR_LIMITS)

    def go_on(self, points: Cells, freedom: Freedom, start: tuple[Pose, Array]) -> FreeEnd:
        """Descend on points from a pose and corrections."""
        return descend_freely(points, self.shown.photo.image("full"), freedom, *start, CLOSE)

    def find_ends(
        self, points: Cells, freedom: Freedom, starts: Sequence[tuple[Pose, Array]]
    ) -> list[FreeEnd]:
        """Return the ends of descents on points from several starts, the lowest first."""
        ends = self.workers.map(partial(self.go_on, points, freedom), starts, "fit the focal length")
        return sorted(ends, key=lambda end: end.loss)


def descend_lens(
    problem: Problem,
    best: Candidate,
    claim: Claim,
    by_matches: MatchFit,
    workers: Workers,
    is_first: bool,
) -> tuple[FreeEnd, FreeEnd, float]:
    """Descend with the focal length free, then with all corrections of the lens; return both lowest ends.

    The third value is the scatter (see `compute_scatter`) of the focal length's logarithm among ends near
    each other. The descents of the focal length begin with that of the last fit and, in a first fit, with
    others too. The descents of all corrections begin at the end of the former, and at the fit to the
    matches. The focal length descends again with the points that are seen from its end: points that are seen
    from another pose favour that pose.
    """
    pose = best.pose
    shown = problem.show(mask_occluders(problem, best.comparison, best.unoccluded).photo)
    descents = LensDescents(shown, problem.photo.panorama.is_valid, workers)
    corrections = Corrections(problem.given.cameras[0])
    wide = np.maximum(claim.wrong_deviations, claim.deviations)
    is_focal = np.arange(len(LENS)) == FOCAL
    of_focal = Freedom(corrections, np.where(is_focal, wide, claim.deviations), MOST_LENS_CHANGE)
    of_all = Freedom(corrections, wide, MOST_LENS_CHANGE)
    begin = partial(descents.begin, shown.view_at(pose, "fine"), of_focal, pose)
    others = workers.map(begin, FIRST_CHANGES, "fit the focal length") if is_first else []
    points = descents.find_points(pose)
    starts = [(pose, np.zeros(len(LENS))), *(end.start for end in others)]
    first = descents.find_ends(points, of_focal, starts)[0]
    beside = descents.find_ends(points, of_focal, start_beside(first))
    near = beside[0]
    for _ in range(NUM_FOCAL_VIEWS):
        if near.pose.distance(pose) > FAR_AWAY:
            break
        near = descents.go_on(descents.find_points(near.pose), of_focal, near.start)
    points = descents.find_points(near.pose)
    starts = [near.start, (by_matches.pose, by_matches.values)]
    far = descents.find_ends(points, of_all, starts[: 1 + int(by_matches.values.any())])[0]
    return near, far, compute_scatter(beside)


def compute_scatter(ends: Sequence[FreeEnd]) -> float:
    """Return the mean square of how far ends of descents lie from the first in the focal length's logarithm.

    The loss is rough at a minimum, and its curvature there does not tell by how much: another picture of the
    same place would have had another of these ends as its lowest.
    """
    values = np.array([end.values[FOCAL] for end in ends])
    return float(np.square(values - values[0]).mean())


def start_beside(end: FreeEnd) -> list[tuple[Pose, Array]]:
    """Return the end of a descent and starts beside it, with other focal lengths and the poses that fit."""
    motion = estimate_corrections(end).motion[:, FOCAL]
    unit = np.eye(len(LENS))[FOCAL]
    return [
        end.start,
        *((add(end.pose, motion * change), end.values + unit * change) for change in CHANGES_BESIDE),
    ]


def mask_edge(points: Cells, pose: Pose, is_valid: Mask) -> Cells:
    """Remove the points near the edge of what a photo (H, W) shows: corrections would move them across it."""
    inner = cv2.erode(is_valid.view(np.uint8), np.ones((EDGE_WIDTH, EDGE_WIDTH), np.uint8))
    offsets = points.around(pose.center_world).offsets.T.astype(np.float64)
    rays = rotate_points(offsets / np.linalg.norm(offsets, axis=1, keepdims=True), pose.R_cam_from_world)
    is_kept = inner[compute_indices(rays, is_valid.shape[1])] > 0
    return points._replace(weights=points.weights * is_kept.astype(np.float32))


def estimate_lens(
    problem: Problem, pose: Pose, end: FreeEnd, scatter: float, by_matches: MatchFit | None = None
) -> LensEstimate:
    """Estimate the corrections of a lens at the end of a descent from a pose.

    A descent that ended far from the pose gives no information. Errors of the picture's edge are added, which
    all blocks may share, the `scatter` of the focal length among the ends of descents, and errors of the
    scan, which the matches share too.
    """
    estimate = estimate_corrections(end)
    if end.pose.distance(pose) > FAR_AWAY:
        estimate = inform(estimate, np.zeros_like(estimate.by_picture.information))
    camera = problem.given.cameras[0].camera
    per_px = math.tau * camera.focal[0] / (0.5 * camera.width * problem.photo.panorama.rgb.shape[1])
    errors = (problem.method.edge_error * per_px) ** 2 * np.eye(len(LENS))
    errors[FOCAL, FOCAL] += scatter
    estimate = add_errors(estimate, errors)
    if by_matches is not None:
        estimate = add_matches(estimate, by_matches)
    acting_range = compute_acting_range(problem.view_at(pose, "points"))
    variance = displacement_variance(problem.scan_map, pose, acting_range)
    return add_errors(estimate, displace_blocks(end, variance))


def add_errors(estimate: LensEstimate, errors: Array) -> LensEstimate:
    """Return an estimate with further errors (5, 5); corrections without information stay without."""
    is_known = estimate.by_picture.information.any(axis=1)
    covariance = invert(estimate.by_picture.information) + errors * np.outer(is_known, is_known)
    return inform(estimate, invert(covariance))


def inform(estimate: LensEstimate, information: Array) -> LensEstimate:
    """Return an estimate with its information (5, 5) replaced."""
    return estimate._replace(by_picture=estimate.by_picture._replace(information=information))
