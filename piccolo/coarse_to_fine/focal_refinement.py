"""The focal length, and radial distortion, of a photo whose calibration is a first guess.

Matches tell it to a few per cent, from as much as a quarter off; then the picture itself, to half of one.
"""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera, Mount
from ..camera.model import MODELS
from ..camera.resampling import recalibrated
from ..confidence.localization import Localization
from ..errors import InputError
from ..geometry.pose import Array, Pose, rotate_points, step
from ..local_features.hypotheses import members_of
from ..local_features.matching import Matches
from ..panorama import Panorama
from ..panorama.model import shrink
from ..runtime.stopwatch import Stopwatch
from ..runtime.threads import Workers
from .descent import FINE_LOSS, FULL_LOSS, descend, score_on
from .localize import localize
from .query import Query, prepare_query, query_images
from .refinement import points_at, view_at
from .scan_map import ScanMap
from .settings import CoarseToFineSettings

# [rad] a match that is off by more takes no part, and the scale of the loss: wide, as a rim may be far off
ROUNDS = [(math.radians(gate), math.radians(scale)) for gate, scale in ((6.0, 1.0), (2.0, 0.4), (0.8, 0.2))]
LEAST_MATCHES = 16  # for the focal length
LEAST_FOR_DISTORTION = 60  # and for k1, where the model has it
MAX_CHANGE = 0.35  # of the focal length's logarithm, either way
MAX_DEVIATION = 0.04  # of the focal length, by itself: less sure, it stays as it was
PICTURE_ROUNDS, REFINED = 3, 0.005  # at most; a focal length that changes by less, of itself, stays
CHANGES = np.linspace(-0.03, 0.03, 9)  # of the focal length's logarithm that are tried on the picture
WIDTH, SMALL_WIDTH = 2048, 1024  # [px] of the sphere that is recalibrated, for localizing and for that
NEAR, CLOSE = (FINE_LOSS, 12, 1e-4), (FULL_LOSS, 15, 1e-5)
NOT_REFINED = "the focal length stays as it was given: matches are too few, or another explains no more"
FOCALS, RADIAL = ("f", "fx", "fy"), "k1"
POSE = 6  # parameters, of `step`; then come the logarithm of the focal length and k1


def localize_and_refine_focal(
    scan_map: ScanMap, panorama: Panorama, settings: CoarseToFineSettings, workers: Workers, watch: Stopwatch
) -> Localization:
    """Where a photo of one camera was taken, with its focal length as matches and then the picture say.

    It is localized anew with each; the camera is in the result, unless what was given explains as much.
    """
    if len(panorama.cameras) != 1:
        found = f"{len(panorama.cameras)} cameras" if panorama.cameras else "a part of a sphere"
        raise InputError(f"--refine-focal: found {found}, wanted the photo of one camera")
    panorama = at_width(panorama, WIDTH)
    first = result = localize(scan_map, panorama, settings, workers, watch)
    given = panorama.cameras[0]
    for by in (refine_by_matches, *[refine_by_picture] * PICTURE_ROUNDS):
        if result.pose is None:
            break
        with watch.stage("refine"):
            query = prepare_query(panorama, scan_map, settings, workers)
            mount = by(query, scan_map.from_world(result.pose), panorama)
        if mount is None:
            break
        change = mount.camera.focal[0] / panorama.cameras[0].camera.focal[0]
        panorama = taken_by(panorama, mount)
        result = localize(scan_map, panorama, settings, workers, watch)
        if abs(change - 1.0) < REFINED:
            break
    if panorama.cameras[0] == given or _score(result) <= _score(first):
        return replace(first, warnings=(*first.warnings, NOT_REFINED))
    mount = panorama.cameras[0]
    note = f"focal length {given.camera.focal[0]:.1f} px refined to {mount.camera.focal[0]:.1f} px"
    return replace(result, warnings=(*result.warnings, note), cameras=(mount,))


def _score(found: Localization) -> float:
    return -1.0 if found.evidence is None else found.evidence.score


def at_width(panorama: Panorama, width: int) -> Panorama:
    """A panorama no wider than that [px]."""
    small = shrink(panorama, width)
    return replace(panorama, rgb=small.rgb, is_valid=small.is_valid)


def taken_by(panorama: Panorama, mount: Mount) -> Panorama:
    """A panorama of one camera, by another calibration of it."""
    rgb, is_valid = recalibrated(panorama.rgb, panorama.is_valid, panorama.cameras[0], mount)
    return replace(panorama, rgb=rgb, is_valid=is_valid, cameras=(mount,))


def refine_by_matches(query: Query, pose: Pose, panorama: Panorama) -> Mount | None:
    """The camera that matches of a photo agree with, from a pose of the map near the right one.

    Fits pose, focal length and, where the model has it and matches are many, k1, in rounds that look ever
    closer. None if matches are too few, or do not tell the focal length.
    """
    mount, matches = panorama.cameras[0], query.matches
    before = mount.camera
    pixels, _ = before.pixels(rotate_points(matches.rays.astype(np.float64), mount.rotation))
    camera, deviation = before, math.inf
    for gate, scale in ROUNDS:
        rays = rotate_points(camera.rays(pixels)[0], mount.rotation.T).astype(np.float32)
        kept = nearest_members(matches._replace(rays=rays), pose, gate)
        if len(kept) < LEAST_MATCHES:
            return None
        points = matches.points[kept].astype(np.float64)
        pose, camera, deviation = fit(points, pixels[kept], pose, mount.with_camera(camera), scale)
    change = abs(math.log(camera.focal[0] / before.focal[0]))
    if change > MAX_CHANGE or not deviation < MAX_DEVIATION:
        return None
    return mount.with_camera(camera)


def refine_by_picture(query: Query, pose: Pose, panorama: Panorama) -> Mount | None:
    """The camera by which the picture agrees best with the scan, near a pose of the map and a focal length.

    The crest of a parabola through the products of the channels of points and picture, after a descent each.
    None where it has none in reach.
    """
    small, cells = at_width(panorama, SMALL_WIDTH), points_at(query, pose)
    fine = view_at(query, pose, query.method.fine_view)

    def agreement(change: float) -> float:
        camera = changed(small.cameras[0].camera, np.array([change]))
        shown = taken_by(small, small.cameras[0].with_camera(camera))
        images = query_images(shown, query.method.scales)
        end = descend(cells, images.full, descend(fine, images.fine, pose, NEAR), CLOSE)
        return score_on(cells, np.zeros(cells.weights.shape, np.int32), images.full, end)

    values = list(query.workers.map(agreement, list(CHANGES), "refine focal length"))
    curvature, slope, _ = np.polyfit(CHANGES, values, 2)
    if not curvature < 0.0 or not abs(crest := -0.5 * slope / curvature) <= CHANGES[-1]:
        return None
    mount = panorama.cameras[0]
    return mount.with_camera(changed(mount.camera, np.array([crest])))


def fit(points: Array, pixels: Array, pose: Pose, mount: Mount, scale: float) -> tuple[Pose, Camera, float]:
    """Pose and camera at which points (N, 3) come nearest to pixels (N, 2), and the focal length's deviation.

    The least squares of Hartley and Zisserman, "Multiple View Geometry", 2nd ed., section 7.3, with Cauchy's
    loss of some scale [rad].
    """
    camera = mount.camera
    has_radial = RADIAL in MODELS[camera.model][1] and len(points) >= LEAST_FOR_DISTORTION
    f_scale = scale * camera.focal[0]

    def residuals(delta: Array) -> Array:
        of_lens = mount.pose(step(pose, delta[:POSE]))
        rays = rotate_points(points - of_lens.center_world, of_lens.R_cam_from_world)
        return np.asarray((changed(camera, delta[POSE:]).pixels(rays)[0] - pixels).ravel())

    start = np.zeros(POSE + 1 + has_radial)
    from scipy.optimize import least_squares  # noqa: PLC0415  # 0.2 s that only this option waits for

    found = least_squares(residuals, start, loss="cauchy", f_scale=f_scale, x_scale="jac")
    variance = covariance_of(found.jac, residuals(found.x), f_scale)[POSE, POSE]
    return step(pose, found.x[:POSE]), changed(camera, found.x[POSE:]), math.sqrt(variance)


def changed(camera: Camera, delta: Array) -> Camera:
    """A camera with another logarithm of its focal length, and another k1 if `delta` has two numbers."""
    params = dict(zip(MODELS[camera.model][1], camera.params, strict=True))
    for name in FOCALS:
        if name in params:
            params[name] *= math.exp(delta[0])
    if len(delta) > 1:
        params[RADIAL] += delta[1]
    return replace(camera, params=tuple(float(value) for value in params.values()))


def nearest_members(matches: Matches, pose: Pose, gate: float) -> NDArray[np.int64]:
    """Of each feature of the photo the match that agrees best with a pose, off by less than `gate`."""
    members = members_of(matches, pose, math.cos(gate))
    rays = rotate_points(matches.points[members] - pose.center_world, pose.R_cam_from_world)
    cosine = np.sum(rays * matches.rays[members], axis=1) / np.linalg.norm(rays, axis=1)
    ranked = members[np.lexsort((-cosine, matches.query[members]))]
    return np.asarray(ranked[np.unique(matches.query[ranked], return_index=True)[1]])


def covariance_of(jacobian: Array, residuals: Array, f_scale: float) -> Array:
    """Covariance of the parameters, of weighted rows (n, p) and residuals (n,) of Cauchy's loss."""
    num_rows, num_parameters = jacobian.shape
    weighted = residuals**2 / (1.0 + (residuals / f_scale) ** 2)
    variance = weighted.sum() / max(num_rows - num_parameters, 1)
    return np.asarray(variance * np.linalg.pinv(jacobian.T @ jacobian))
