"""The geometry that a panorama claims, compared with the scan: how much of the sphere it shows.

A picture twice as wide as high claims to show 360 by 180 degrees with the horizon in the middle. If rows were
cut off before it was resized, the claim is wrong: walls, floor and ceiling then look nearer or farther
together, and a pose a few decimetres off fits best. So width, height and horizon are optimised together with
the pose. The claimed values are used as long as the photo agrees with them. Else they are searched from
several starts, and the photo is projected again with the values found.
"""

import itertools
import math
from typing import NamedTuple

import numpy as np

from ..geometry.pose import Pose
from ..judge.claim import Claim
from ..judge.result_parts import SphereGeometry
from ..photo.camera import Camera, Mount
from ..photo.camera.corrections import Corrections
from ..problem.problem import Problem
from ..problem.stages import Limits
from ..system.arrays import Array
from ..system.jobs.threads import Workers
from .self_calibration import Freedom, FreeEnd, LensEstimate, descend_freely, invert

NO_CORRECTION = np.zeros(3)
CLAIM = Claim(
    NO_CORRECTION,
    deviations=np.array([0.005, 0.005, math.radians(0.3)]),  # chosen: errors of claims of stitched panoramas
    wrong_deviations=np.array([0.05, 0.1, 0.1]),  # chosen
    wrong_shares=np.array([0.005, 0.005, 0.005]),  # chosen
)
SPHERE_CURVATURE = 0.5  # CURVATURE of self_calibration for whole panoramas, whose loss flattens less
BY_CHANCE = 12.0  # sum of the squared deviations of all corrections that a right claim may have by chance
MOST_SPHERE_CHANGE = np.array([0.2, 0.6, 0.4])  # corrections that are searched
ANY = np.full(3, np.inf)
HEIGHT_STARTS = -np.log([1.0, 0.9, 0.8, 0.72])  # corrections of the height from which descents begin
WIDTH_STARTS = -np.log([0.9, 0.8])  # corrections of the width, where the height is as claimed
LEAST_CUT = 0.1  # part of the height, at least, by whose cut the horizons of starts are spread
HORIZONS = (-1.0, -0.5, 0.0, 0.5, 1.0)  # of starts: all, three quarters or half of the cut is at one end
NUM_ENDS = 3  # of the descents on coarse cells: the best, which go on on finer ones
COARSE_LIMITS = Limits(1.2, 10, 5e-3)
MIDDLE_LIMITS = Limits(1.2, 12, 1e-3)
FINE_LIMITS = Limits(1.0, 15, 1e-3)


class SphereFit(NamedTuple):
    """The geometry of a panorama, with its errors."""

    camera: Camera  # as found, or as claimed
    estimate: LensEstimate  # corrections of this camera by the photo and the scan alone
    is_claimed: bool  # the camera is as the picture claims
    conflict: float = 0.0  # deviations between claim and picture, if the claim is used
    doubt: float = 0.0  # probability that the claim is wrong and has pulled the pose along

    @property
    def covariance(self) -> Array:
        """Covariance (3, 3) of the corrections, with the claim as further evidence if it is used."""
        precision = np.diag(CLAIM.precision) if self.is_claimed else 1e-6 * np.eye(3)
        return np.asarray(np.linalg.inv(self.estimate.by_picture.information + precision))

    @property
    def pose_covariance(self) -> Array:
        """Covariance (6, 6) that the geometry adds to a pose: rotation, then centre in the map."""
        covariance = self.covariance
        values = self.estimate.by_picture.values
        information = self.estimate.by_picture.information
        motion = self.estimate.motion
        off = covariance @ information @ values  # the photo's correction, which is not applied
        beyond = max(1.0 - BY_CHANCE / max(float(values @ information @ values), BY_CHANCE), 0.0)
        return np.asarray(motion @ (covariance + beyond * np.outer(off, off)) @ motion.T)

    def describe(self) -> SphereGeometry:
        """Return the part of the sphere that the panorama shows."""
        across, down = self.camera.focal
        width, height, horizon = np.sqrt(np.diag(self.covariance))
        shown = self.camera.width / across, self.camera.height / down
        return SphereGeometry(
            width_deg=math.degrees(shown[0]),
            height_deg=math.degrees(shown[1]),
            horizon_deg=math.degrees((self.camera.center[1] - 0.5 * self.camera.height) / down),
            std_deg=(
                math.degrees(shown[0] * width),
                math.degrees(shown[1] * height),
                math.degrees(horizon),
            ),
        )


def make_freedom(camera: Camera) -> Freedom:
    """Free all corrections of a panorama."""
    return Freedom(Corrections(Mount(camera)), ANY, MOST_SPHERE_CHANGE)


def count_deviations(estimate: LensEstimate) -> float:
    """Return by how many deviations the claim is wrong, in the correction that contradicts it most."""
    variances = np.diag(invert(estimate.by_picture.information))
    return float((np.abs(estimate.by_picture.values) / np.sqrt(CLAIM.deviations**2 + variances)).max())


def list_geometries() -> list[Array]:
    """List the corrections (3,) from which descents begin: of the width alone, or of height and horizon."""
    starts = [np.array([width, 0.0, 0.0]) for width in WIDTH_STARTS]
    for height, share in itertools.product(HEIGHT_STARTS, HORIZONS):
        horizon = share * max(1.0 - math.exp(-height), LEAST_CUT) * 0.5 * math.pi
        starts.append(np.array([0.0, height, horizon]))
    return starts


def search_geometry(problem: Problem, pose: Pose, claimed: Camera, workers: Workers) -> FreeEnd:
    """Search the corrections of a panorama from several starts, on coarse cells, then on finer ones."""
    freedom = make_freedom(claimed)
    cells = problem.view_at(pose, "middle")

    def begin(values: Array) -> FreeEnd:
        return descend_freely(cells, problem.photo.image("search"), freedom, pose, values, COARSE_LIMITS)

    def go_on(end: FreeEnd) -> FreeEnd:
        middle = problem.view_at(end.pose, "middle")
        image = problem.photo.image("middle")
        end = descend_freely(middle, image, freedom, end.pose, end.values, MIDDLE_LIMITS)
        fine = problem.view_at(end.pose, "fine")
        return descend_freely(fine, problem.photo.image("fine"), freedom, end.pose, end.values, FINE_LIMITS)

    ends = sorted(workers.map(begin, list_geometries(), "fit the panorama"), key=lambda end: end.loss)
    return min(workers.map(go_on, ends[:NUM_ENDS], "fit the panorama"), key=lambda end: end.loss)
