"""Covariance of a pose from blocks of the sphere."""

import math
from collections.abc import Sequence
from functools import reduce

import numpy as np

from ..geometry.levenberg_marquardt import GRADIENT, MATRIX, NUM_SUMS
from ..geometry.nearness import ROOM_RANGE
from ..geometry.pose import Pose, rotate_points, step, step_between, yaw_rotation
from ..geometry.pose_gaussian import PoseGaussian, largest_std, turn_positions
from ..geometry.sphere import BLOCK_RINGS, compute_indices, find_cell, make_grid
from ..judge.candidate import Candidate
from ..judge.case import UNKNOWN_ERRORS, Errors
from ..optimize.channel_loss import ChannelProblem, channel_equations, descend_channels
from ..photo.panorama.local_normalization import LEVELS_PER_UNIT, to_levels
from ..photo.panorama.texels import Texels
from ..problem.photo_images import PhotoImages
from ..problem.problem import Problem
from ..problem.profile import Profile
from ..problem.stages import LAST
from ..system.arrays import Array, Int64s, Integers, Mask
from ..system.jobs.threads import Workers
from ..system.kernels.jit import kernel
from ..views.view import Cells
from .blocks import (
    ERROR_RINGS,
    block_gradients,
    fill_symmetric,
    sort_by_block,
    sort_by_column,
    sum_by_block,
    take,
)
from .comparison import mask_occluders
from .contradictions import contradictions
from .scan_errors import layer_covariance, scan_covariance
from .verification import draw_near, place_by_matches

LEAST_INFORMATION = 1e-12  # in any direction, as a fraction of that in the best-known direction
LEAST_BLOCKS = 13  # with fewer, errors in six dimensions can't be estimated
LEAST_STEP_RANGE = 0.005 / math.radians(0.1)  # [m] least range: steps for nearer points would drown in noise
LEAST_ACTING = 0.25  # [m] distance of points that count: nearer ones are noise, as cameras stand clear
POLE_DEG = 2.0  # around the photo's poles pixels are so narrow that one point's errors outweigh all others
TINY_VARIANCE = 1e-12  # [rad^2, m^2] least variance of errors of one photo alone
COVARIANCE_SCALE = LAST.limits.loss_scale * LEVELS_PER_UNIT
# normals (9, 3), in the camera's frame, of planes between halves: the seam of two lenses may have any azimuth
NORMALS = np.array([*(yaw_rotation(k * math.pi / 8.0)[0] for k in range(8)), (0.0, 0.0, 1.0)])
SEAMS = (0.25, 0.5, 0.75)  # share of the points on one side of a plane between parts of the scan
SEAM_SCORE = 4.5  # least score of parts that disagree; in a single scan, a fifth of the photos have more
NUM_TRIED_PLANES = 2  # planes whose halves descend by themselves
HALF_LIMITS = (15, 1e-5)  # iterations of a half's descent, and tolerance [rad + m]


@kernel
def write_gradients(problem: ChannelProblem, rotations: Array, centers: Array, gradients: Array) -> None:
    """Write the gradient (6,) of the robust loss, in the camera's frame, at each pose (N, 3, 3), (N, 3)."""
    sums = np.empty(NUM_SUMS)
    for k in range(len(rotations)):
        channel_equations(problem, rotations[k], centers[k], sums)
        for i in range(MATRIX - GRADIENT):  # see `copy_to`
            gradients[k, i] = sums[GRADIENT + i]


def remove_poles(points: Cells, pose: Pose) -> Cells:
    """Remove the points around a pose that lie within POLE_DEG of the photo's poles."""
    heights = pose.R_cam_from_world[2] @ points.offsets
    ranges = np.linalg.norm(points.offsets, axis=0)
    return take(points, np.abs(heights) < math.cos(math.radians(POLE_DEG)) * ranges)


def remove_hidden(points: Cells, is_valid: Mask, pose: Pose) -> Cells:
    """Remove the points around a pose that lie in pixels (H, W) of the photo that are not valid."""
    rays_cam = rotate_points(points.offsets.T.astype(np.float64), pose.R_cam_from_world)
    return take(points, is_valid[compute_indices(rays_cam, is_valid.shape[1])])


def compute_acting_range(points: Cells) -> float:
    """Return the distance [m] of a point that a move displaces in the picture as much as points in the mean.

    Its inverse is the root mean square of the points' inverse distances from the camera: near points
    distinguish moves from turns, and errors of surfaces displace them most.
    """
    squares = np.square(points.offsets).sum(axis=0, dtype=np.float64)
    return float(np.mean(1.0 / np.maximum(squares, LEAST_ACTING**2)) ** -0.5)


def compute_std_of_fit(covariance: Array, acting_range: float) -> float:
    """Return the largest deviation of a position by its covariance (6, 6), as an angle [rad].

    It is the angle under which the deviation is seen from `acting_range` [m], or from the far end of a large
    room if that range is shorter.
    """
    return largest_std(covariance) / max(acting_range, ROOM_RANGE)


def compute_hessian(problem: ChannelProblem, pose: Pose, turn: float, acting_range: float) -> Array:
    """Return the Hessian (6, 6) of the robust loss, by differences over steps as large as errors are.

    The Gauss-Newton matrix ignores that the loss flattens, and would make deviations several times too small.
    The points of the problem surround the pose. Steps of the position are `turn` [rad] times their acting
    range [m], so that they displace points as much as steps of the rotation do: steps that suit far points
    would displace near ones, which tell most of a position, to where the loss is flat.
    """
    sizes = np.repeat([turn, turn * max(acting_range, LEAST_STEP_RANGE)], 3)
    ends = [step(pose, sign * delta) for delta in np.diag(sizes) for sign in (1.0, -1.0)]
    rotations = np.array([end.R_cam_from_world for end in ends])
    centers = np.array([end.center_world for end in ends]) - pose.center_world
    gradients = np.empty((len(ends), 6))
    write_gradients(problem, rotations, centers, gradients)
    rows = (gradients[::2] - gradients[1::2]) / (2.0 * sizes[:, None])
    return np.asarray(0.5 * (rows + rows.T))


def sandwich_covariance(hessian: Array, gradients: Array) -> Array | None:
    """Return the covariance (6, 6) [rad, m] in the camera's frame, for errors correlated within blocks.

    It is the sandwich H^-1 (sum g g^T) H^-1 (Huber 1967; Liang and Zeger 1986 for clusters). None where the
    points do not fix the pose.
    """
    variances, axes = np.linalg.eigh(hessian)
    if len(gradients) < LEAST_BLOCKS or variances[0] <= 1e-9 * variances[-1]:
        return None
    inverse = (axes / variances) @ axes.T
    return np.asarray(inverse @ (gradients.T @ gradients) @ inverse)


def few_blocks_factor(num_blocks: int) -> float:
    """Return the factor by which a covariance that is estimated from few blocks is too small in the mean.

    It is that of the mean of the inverse of a Wishart matrix in six dimensions.
    """
    return num_blocks / (num_blocks - 7.0)


def merge_covariances(one: Array, other: Array) -> Array:
    """Return the covariance (6, 6) that is in each direction that of the two which tells more.

    The directions are those in which neither has correlations; `shares` are how much of the information of
    both is by the first. A mean would follow the image that tells less, and may be several times too large.
    """
    by_one = np.linalg.inv(one)
    information, axes = np.linalg.eigh(by_one + np.linalg.inv(other))
    axes = axes / np.sqrt(np.maximum(information, LEAST_INFORMATION * information[-1]))
    shares, turns = np.linalg.eigh(axes.T @ by_one @ axes)
    axes = axes @ turns
    return np.asarray((axes / np.maximum(shares, 1.0 - shares)) @ axes.T)


def make_problem(points: Cells, image: Texels) -> ChannelProblem:
    """Make the problem of points, and the image that they are compared with."""
    return ChannelProblem(
        points.offsets, to_levels(points.channels), points.weights, image.rgbx, image.width, COVARIANCE_SCALE
    )


def score_halves(sums: Array, is_ahead: Mask, wide: Integers) -> Array:
    """Score (S,) how much two halves disagree about a pose, by blocks' sums (B, 29); by chance 1 in the mean.

    `is_ahead` (S, B) is True for the blocks of one half. The score is the sum of g^T A^-1 g over both halves,
    g their gradients at the pose of all points, as in the test of Rao (1948), divided by what is expected of
    it from the gradients of wide blocks, of which each block is in number `wide` (B,); 0 where a half has too
    few blocks.
    """
    gradients = sums[:, GRADIENT:MATRIX]
    matrices = fill_symmetric(sums[:, MATRIX:])
    inverse = np.linalg.pinv(matrices.sum(axis=0))
    of_wide = np.zeros((int(wide.max()) + 1, NUM_SUMS))
    np.add.at(of_wide, wide, sums)
    left_out = block_gradients(of_wide)
    gradients = gradients - matrices @ (inverse @ gradients.sum(axis=0))
    scores = np.zeros(len(is_ahead))
    for is_half in (is_ahead.astype(float), 1.0 - is_ahead):
        g = is_half @ gradients
        inverses = np.linalg.pinv(np.tensordot(is_half, matrices, 1), hermitian=True)
        has_enough = is_half @ gradients.any(axis=1) >= LEAST_BLOCKS
        scores = np.where(has_enough, scores + np.einsum("si,sij,sj->s", g, inverses, g), -np.inf)
    return np.asarray(np.maximum(scores, 0.0) / np.trace(inverse @ left_out.T @ left_out))


def descend_half(points: Cells, images: Sequence[Texels], pose: Pose) -> tuple[float, Array]:
    """Descend from a pose on points of one half; return the loss, and the step (6,) as of `pose.step`.

    One descent goes through the images from coarse to fine, another uses the finest alone; the one with the
    lower loss counts. The finest alone can't correct degrees, and a coarse one misleads in flat places.
    """
    start = Pose(pose.R_cam_from_world, np.zeros(3))  # the points' offsets are from its centre
    ends = []
    for way in (images, images[-1:]):
        R = start.R_cam_from_world.copy()
        t = start.center_world.copy()
        losses = [descend_channels(make_problem(points, image), *HALF_LIMITS, R, t) for image in way]
        ends.append((losses[-1], step_between(start, Pose(R, t))))
    return min(ends, key=lambda end: end[0])


def split_by_planes(points: Cells, begins: Int64s) -> Mask:
    """Return masks (S, B) of the blocks beyond upright planes that have a quarter to three of all points."""
    ends = np.concatenate([np.zeros((1, 3)), np.cumsum(points.offsets.T, axis=0, dtype=np.float64)])[begins]
    middles = np.diff(ends, axis=0) / np.maximum(np.diff(begins), 1)[:, None]
    limits = np.quantile(NORMALS[:-1] @ points.offsets, SEAMS, axis=1)
    return np.asarray((NORMALS[:-1] @ middles.T > limits[..., None]).reshape(-1, len(middles)))


def disagreement(
    photo: PhotoImages, points: Cells, pose: Pose, covariance: Array, least: float, workers: Workers
) -> Array:
    """Return the covariance (6, 6) to be added to that of a whole photo if its parts disagree about the pose.

    Lenses stitched with an error and scans out of shape leave a pose between those of two halves of the
    photo, far from both. For these, the covariance and the mean square of the steps to the halves' poses are
    added. Parts of a scan that were moved against each other may lie on the two sides of any plane, and the
    pose is right by one of the parts: the product of the two steps is added in all directions. Both terms
    vanish as the score falls to that of chance: `least` for halves of the photo, SEAM_SCORE for the scan's.
    """
    points, begins = sort_by_block(points)
    blocks_map = make_grid(ERROR_RINGS).directions[: len(begins) - 1]
    is_ahead = NORMALS @ pose.R_cam_from_world @ blocks_map.T > 0.0
    wide = find_cell(blocks_map, BLOCK_RINGS)
    images = photo.image("fine"), photo.image("full")
    sums = sum_by_block(make_problem(points, images[-1]), pose, begins)

    def separate(is_part: Mask) -> tuple[float, Array]:
        is_in_part = np.repeat(is_part, np.diff(begins))
        ends = [descend_half(take(points, part), images, pose) for part in (is_in_part, ~is_in_part)]
        return ends[0][0] + ends[1][0], np.array([delta for _, delta in ends])

    added = np.zeros((6, 6))
    scores = score_halves(sums, is_ahead, wide)
    tried = [k for k in np.argsort(-scores)[:NUM_TRIED_PLANES] if scores[k] > least]
    if tried:
        ends = workers.map(separate, list(is_ahead[tried]), "covariance")
        steps = min(ends, key=lambda end: end[0])[1]
        added += (1.0 - (least / scores[tried[0]]) ** 2) * (covariance + 0.5 * steps.T @ steps)
    is_beyond = split_by_planes(points, begins)
    scores = score_halves(sums, is_beyond, wide)
    seam = int(scores.argmax())
    if scores[seam] > SEAM_SCORE:
        one, other = np.linalg.norm(separate(is_beyond[seam])[1].reshape(2, 2, 3), axis=2)
        added += (1.0 - (SEAM_SCORE / scores[seam]) ** 2) * np.diag(np.repeat(one * other, 3)) / 3.0
    return added


def compute_covariance(photo: PhotoImages, points: Cells, pose: Pose, profile: Profile) -> Array | None:
    """Return the covariance (6, 6) [rad, m] in the camera's frame.

    Noise and stitching roughen the loss in the finest image, until it tells nothing of some direction; in the
    next one it is smoother. Of both images the one that tells more of a direction counts, without one whose
    loss is too rough; if both are too rough, a third image is used. Occluders may be masked in `photo`. If
    the unmasked photo shows a part of the sphere only, the covariance is enlarged, as it rests on few blocks
    (`few_blocks_factor`). The points surround the pose.
    """
    if points.offsets.shape[1] == 0:
        return None
    acting_range = compute_acting_range(points)
    points, begins = sort_by_block(points) if profile.has_few_blocks else sort_by_column(points)
    found: list[Array] = []
    for steps in (*profile.steps, profile.rough_steps):
        if found and steps is profile.rough_steps:
            break
        problem = make_problem(points, photo.image(steps.image))
        hessian = compute_hessian(problem, pose, steps.turn, acting_range)
        gradients = block_gradients(sum_by_block(problem, pose, begins))
        covariance = sandwich_covariance(hessian, gradients)
        if covariance is not None:
            factor = few_blocks_factor(len(gradients)) if profile.has_few_blocks else 1.0
            found.append(steps.inflation * factor * covariance)
    return reduce(merge_covariances, found) if found else None


def common_covariance(problem: Problem, pose: Pose, acting_range: float) -> Array:
    """Return the covariance (6, 6) of errors of the scan, which all photos at a pose in the map share."""
    of_layers = layer_covariance(problem.scan_map, pose, acting_range)
    return scan_covariance(problem.scan_map) + of_layers


def grid_covariance(problem: Problem) -> Array:
    """Return the covariance (6, 6) of errors of pixels and stitching, alike in all blocks.

    Rows and columns that are displaced together turn the photo. How far they move it is among the errors of
    its geometry: of its horizon or principal point.
    """
    turn = problem.method.pixel_share * problem.pixel
    return np.diag(np.repeat([turn**2, 0.0], 3))


def split_errors(problem: Problem, pose: Pose, covariance: Array) -> PoseGaussian:
    """Return a pose in the map with its covariance (6, 6), split into errors of the scan and of the photo."""
    acting_range = compute_acting_range(problem.view_at(pose, "points"))
    common = common_covariance(problem, pose, acting_range)
    variances, axes = np.linalg.eigh(covariance - common)
    return PoseGaussian(pose, (axes * np.maximum(variances, TINY_VARIANCE)) @ axes.T, common)


def estimate_pose_errors(problem: Problem, candidate: Candidate, workers: Workers) -> Errors:
    """Estimate the errors of a candidate's pose, by the photo alone.

    For a photo of a part of the sphere, the pose is averaged with the pose by its matches with the drawn
    scan, unless the mean contradicts the prior. Where the points do not fix the pose, many matches do.
    """
    pose = candidate.pose
    errors = estimate_covariance(problem, candidate, workers)
    if not problem.profile.is_narrow:
        return errors
    drawn = draw_near(problem, pose, candidate.drawn, workers)
    by_matches = place_by_matches(problem.method, pose, drawn.matches)
    if by_matches is None:
        return errors
    acting_range = compute_acting_range(problem.view_at(pose, "points"))
    of_layers = layer_covariance(problem.scan_map, pose, acting_range)
    if errors.gaussian is not None:
        found = errors.gaussian.fuse(PoseGaussian(*by_matches, errors.gaussian.common))
    elif (candidate.num_matches or 0) >= problem.method.sure_matches:
        found = PoseGaussian(*by_matches, scan_covariance(problem.scan_map) + of_layers)
    else:
        return errors
    if contradictions(problem.scan_map, found.pose, problem.prior):
        return errors
    return Errors(found, compute_std_of_fit(found.covariance - of_layers, acting_range))


def estimate_covariance(
    problem: Problem, candidate: Candidate, workers: Workers, seen_from: Pose | None = None
) -> Errors:
    """Estimate the covariance of a candidate's pose in the map.

    Errors of the scan are common to all photos. In a scan without colours most errors are, as its edges are
    displaced from those of all photos in the same way. `seen_from` is a pose so near that the same points are
    seen from there; for a whole photo, the points behind occluders are then left out, which takes less time
    than to mask the occluders and normalise the photo again.
    """
    pose = candidate.pose
    profile = problem.profile
    leaves_out = seen_from is not None and not profile.settles_near
    masked = mask_occluders(problem, candidate.comparison, candidate.unoccluded).photo
    if seen_from is None:
        points = problem.show(masked).view_at(pose, "points")
    else:
        points = problem.view_at(seen_from, "points")
    points = remove_poles(points.around(pose.center_world), pose)
    if leaves_out and candidate.comparison.contradicts.any():
        points = remove_hidden(points, masked.panorama.is_valid, pose)
    photo = problem.photo if leaves_out else masked
    covariance = compute_covariance(photo, points, pose, profile)
    if covariance is None:
        return UNKNOWN_ERRORS
    turned = pose.R_cam_from_world.T  # R_map_from_cam
    acting_range = compute_acting_range(points)
    own = turn_positions(covariance, turned) + grid_covariance(problem)
    common = scan_covariance(problem.scan_map)
    common = common + (1.0 - profile.own_share) * own
    own = profile.own_share * own
    std_of_fit = compute_std_of_fit(own + common, acting_range)
    if profile.compares_halves:
        added = disagreement(photo, points, pose, covariance, problem.method.halves_score, workers)
        own = own + turn_positions(added, turned)
    common = common + layer_covariance(problem.scan_map, pose, acting_range)
    return Errors(PoseGaussian(pose, own, common), std_of_fit)
