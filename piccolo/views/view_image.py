"""Grey pictures of the scan at a pose, in which keypoints are found: surfaces closed, small gaps filled."""

import math
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np

from ..cloud.octree import Octree, collect, find_level
from ..geometry.cone import EVERYWHERE, Cone
from ..geometry.pose import Pose
from ..geometry.sphere import direction_to_pixel
from ..geometry.vectors import rotate
from ..system.arrays import Array, Array32, Bytes, Floats, Mask
from ..system.kernels.jit import F0, F1, HALF, Scalar, inline_kernel, kernel
from .view import Scratch, thread_scratch

DRAWN_VOXEL_PER_RANGE = 1.0 / 80.0  # largest voxel, divided by its distance
DRAWN_REACH = np.float32(0.7)  # half the width of the square drawn for a voxel, divided by the voxel's width
LEAST_REACH = np.float32(0.75)  # [px] half of that square's width, at least
MOST_REACH = np.float32(12.0)  # [px] and at most
FRONT = np.float32(1.05)  # a pixel's grey is the mean of voxels up to this times its nearest range,
FRONT_OFFSET = np.float32(0.05)  # [m] plus this
HIDDEN_BEHIND = np.float32(1.2)  # a pixel is hidden if all wider pixels around it are nearer by this factor
WIDER_PIXEL = 4  # [px] width of a wider pixel
FILL_LEVELS = 4  # gaps up to 16 px are filled
LEAST_FILLED_PIXEL = 0.25  # fraction of a wider pixel that must be known to fill finer ones
NOTHING_NEAR = np.float32(1e30)  # [m] range of a pixel in which nothing is seen
CONE_ROUNDING = 1e-3  # [rad] margin of a cone for rounding to float32
NEAREST = np.float32(0.1)  # least cosine of the angle between a pinhole's axis and what it shows


class ViewImage(NamedTuple):
    """The scan seen from a pose: a sphere's or a pinhole's picture, in the camera's axes."""

    gray: Bytes  # (H, W)
    is_filled: Mask  # (H, W) where the grey is known: seen, or filled from around
    ranges: Array32  # (H, W) [m], 0 where nothing is seen


@inline_kernel
def project_direction(
    x: Scalar, y: Scalar, z: Scalar, r: Scalar, focal: Scalar, height: int, width: int
) -> tuple[Any, Any, Any, Any]:
    """Return the pixel (u, v) of a direction of length r, pixels per radian there, and a radius.

    A voxel is drawn wider than high by r / radius. For a pinhole with focal length `focal` [px] the radius is
    r, and the pixel of a direction behind the camera is (-1, -1). If `focal` is 0, the picture is the
    sphere's, which stretches across towards the poles: the radius is the distance from the vertical axis.
    """
    if focal > F0:
        if x < NEAREST * r:
            return -F1, -F1, focal, r
        per_x = focal / x
        return HALF * np.float32(width) - y * per_x, HALF * np.float32(height) - z * per_x, r * per_x, r
    rho: Any = math.sqrt(x * x + y * y)  # compiled, float32
    u, v = direction_to_pixel(x, y, z, rho, np.float32(width))
    return u, v, np.float32(width / (2.0 * math.pi)), rho


@kernel
def project_voxels(
    tree: Octree,
    center: Array,
    R_cam_from_map: Array32,
    focal: np.float32,
    is_drawn: Mask,
    cone: Cone,
    scratch: Scratch,
) -> int:
    """Project the voxels whose middles are in the mask (H, W) of the picture; return their number.

    The cone, in the map's frame, contains all that the mask shows. For each voxel the arrays of `scratch`
    get: `nodes` the node; `directions` the pixel u, v and the range [m]; `ranges` and `turns` half the height
    and half the width [px] of the rectangle drawn for it.
    """
    height, width = is_drawn.shape
    nodes = scratch.nodes
    pixels = scratch.directions
    up = scratch.ranges
    across = scratch.turns
    count = collect(tree, center, DRAWN_VOXEL_PER_RANGE, cone, nodes, pixels)
    num = 0
    for k in range(count):
        x, y, z = rotate(R_cam_from_map, (pixels[0, k], pixels[1, k], pixels[2, k]))
        r: Any = math.sqrt(x * x + y * y + z * z)
        u, v, px_per_rad, rho = project_direction(x, y, z, r, focal, height, width)
        is_outside = u < F0 or v < F0 or u >= np.float32(width) or v >= np.float32(height)
        if focal > F0 and is_outside:
            continue
        if not is_drawn[min(int(v), height - 1), min(int(u), width - 1)]:
            continue
        level = find_level(tree, nodes[k])
        size = np.float32(tree.leaf_size * 2.0 ** (len(tree.level_start) - 2 - level))
        reach = DRAWN_REACH * size / max(r, np.float32(0.05)) * px_per_rad
        up[num] = min(max(reach, LEAST_REACH), MOST_REACH)
        across[num] = min(up[num] * r / max(rho, np.float32(1e-3)), np.float32(0.25) * np.float32(width))
        pixels[0, num] = u
        pixels[1, num] = v
        pixels[2, num] = r
        nodes[num] = nodes[k]
        num += 1
    return num


@kernel
def draw_voxels(
    tree: Octree, scratch: Scratch, count: int, wraps: bool, ranges: Array32, sums: Array32
) -> None:
    """Write the nearest range (H, W), and sums (H, W, 2) of weighted grey and of weights near that range.

    `scratch` holds `count` voxels from `project_voxels`. A picture that wraps continues at the other side.
    """
    height, width = ranges.shape
    ranges[:] = NOTHING_NEAR
    sums[:] = F0
    for is_second in range(2):
        for k in range(count):
            u = scratch.directions[0, k]
            v = scratch.directions[1, k]
            r = scratch.directions[2, k]
            reach = scratch.ranges[k]
            across = scratch.turns[k]
            top: Any = max(np.int32(math.ceil(v - reach - HALF)), 0)
            bottom: Any = min(np.int32(math.floor(v + reach - HALF)), height - 1)
            left: Any = np.int32(math.ceil(u - across - HALF))
            right: Any = np.int32(math.floor(u + across - HALF))
            if not wraps:
                left = max(left, 0)
                right = min(right, width - 1)
            for i in range(top, bottom + 1):
                dv = (np.float32(i) + HALF - v) / reach
                for at in range(left, right + 1):
                    j = at + width if at < 0 else at
                    j = j - width if j >= width else j
                    if is_second == 0:
                        ranges[i, j] = min(ranges[i, j], r)
                    elif r <= ranges[i, j] * FRONT + FRONT_OFFSET:
                        du = (np.float32(at) + HALF - u) / across
                        weight = max(F1 - HALF * (du * du + dv * dv), np.float32(0.02))
                        weight = weight * weight * weight
                        node = tree.nodes[scratch.nodes[k]]  # read only here, as most voxels are hidden
                        gray = (
                            np.float32(0.299) * node[3]
                            + np.float32(0.587) * node[4]
                            + np.float32(0.114) * node[5]
                        )
                        sums[i, j, 0] += weight * gray
                        sums[i, j, 1] += weight


def is_in_front(ranges: Array32, wraps: bool = True) -> Mask:
    """Return the mask (H, W) of the pixels that show a surface, not what lies behind a gap in a nearer one.

    `ranges` (H, W) [m] are the nearest, NOTHING_NEAR where nothing is seen. A pixel is behind a gap if all
    wider pixels around it show something much nearer.
    """
    nearest = ranges[::WIDER_PIXEL, ::WIDER_PIXEL].copy()
    for i, j in np.ndindex(WIDER_PIXEL, WIDER_PIXEL):
        np.minimum(nearest, ranges[i::WIDER_PIXEL, j::WIDER_PIXEL], out=nearest)
    sides: Literal["wrap", "edge"] = "wrap" if wraps else "edge"
    around = np.pad(np.pad(nearest, ((0, 0), (1, 1)), mode=sides), ((1, 1), (0, 0)), mode="edge")
    farthest = cv2.dilate(around, np.ones((3, 3), np.uint8))[1:-1, 1:-1]
    limit = np.repeat(np.repeat(farthest, WIDER_PIXEL, axis=0), WIDER_PIXEL, axis=1)
    return np.asarray((ranges < NOTHING_NEAR) & (ranges <= limit * HIDDEN_BEHIND))


def fill_gaps(gray: Floats, weight: Floats) -> tuple[Floats, Mask]:
    """Fill the gaps of a grey picture (H, W) from around them; return it with the mask of the known pixels.

    `gray` is multiplied by `weight` (H, W), which is 1 where a surface is seen and 0 in gaps.

    Pull and push over a pyramid of means (Gortler et al., "The Lumigraph", SIGGRAPH 1996, section 3.4.2).
    """
    pyramid = [(gray, weight)]
    for _ in range(FILL_LEVELS):
        size = gray.shape[1] >> len(pyramid), gray.shape[0] >> len(pyramid)
        pyramid.append((_resize_image(pyramid[-1][0], size), _resize_image(pyramid[-1][1], size)))
    total, known = pyramid.pop()
    filled: Floats = total / np.maximum(known, 1e-6)
    counts: Floats = (known > LEAST_FILLED_PIXEL).astype(np.float32)
    for total, known in reversed(pyramid):
        size = total.shape[1], total.shape[0]
        wider = _resize_image(filled * counts, size)
        counts = known + (1.0 - known) * _resize_image(counts, size)
        filled = (total + (1.0 - known) * wider) / np.maximum(counts, 1e-6)
        counts = (counts > LEAST_FILLED_PIXEL).astype(np.float32)
    return filled, counts > 0.0


def _resize_image(image: Floats, size: tuple[int, int]) -> Floats:
    """Resize an image to (width, height): by means if it becomes smaller, else bilinearly."""
    how = cv2.INTER_AREA if size[0] < image.shape[1] else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, size, interpolation=how))


def cone_of_picture(shape: tuple[int, int], focal: float) -> Cone:
    """Return the cone, in the camera's frame, around a pinhole's picture (H, W) with a focal length [px]."""
    half_diagonal = 0.5 * math.hypot(*shape)
    return Cone(1.0, 0.0, 0.0, focal / math.hypot(focal, half_diagonal)).widen(CONE_ROUNDING)


def render_gray(octree: Octree, pose: Pose, is_drawn: Mask, focal: float = 0.0) -> ViewImage:
    """Draw the scan at a pose in the map, where a mask (H, W) of the picture is True and a little beyond.

    The picture is a pinhole's with focal length `focal` [px], or the sphere's, W = 2 H, if `focal` is 0. H
    and W must be multiples of 16.
    """
    scratch = thread_scratch()
    ranges = np.empty(is_drawn.shape, np.float32)
    sums = np.empty((*is_drawn.shape, 2), np.float32)
    center = np.asarray(pose.center_world, np.float64)
    R = np.asarray(pose.R_cam_from_world, np.float32)
    wraps = focal == 0.0
    cone = EVERYWHERE if wraps else cone_of_picture(is_drawn.shape, focal).turn(R.T)
    count = project_voxels(octree, center, R, np.float32(focal), is_drawn, cone, scratch)
    draw_voxels(octree, scratch, count, wraps, ranges, sums)
    weight = is_in_front(ranges, wraps).astype(np.float32)
    gray = weight * sums[..., 0] / np.maximum(sums[..., 1], np.float32(1e-6))
    filled, is_filled = fill_gaps(gray, weight)
    levels = np.rint(np.clip(filled, 0.0, 1.0) * np.float32(255.0)).astype(np.uint8)
    return ViewImage(levels, is_filled, ranges * weight)
