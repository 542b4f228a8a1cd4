"""Rays against the boxes of a room: nearest hit and its lit colour, of patterns in metres on the surface."""

import math

import numpy as np

from piccolo.system.arrays import Array, Int64s, Integers
from piccolo.system.jobs.threads import Workers
from piccolo.system.kernels.jit import inline_kernel, kernel

from .layout import Room, box_distances

AMBIENT = 0.55  # of a surface's colour
LAMP = 0.9  # of it, head on and near
LAMP_DECAY = 0.15  # [1/m2]
CHUNK = 4_096  # rays
NUM_FIRST = 32  # boxes
MARGIN = 1e-6  # of a cone around rays [rad], and of a range [m]
# added to components of directions, of which it changes only zeros: their inverse stays finite, as infinity
# less infinity is NaN, and so does its product with lengths in metres
NO_ZERO = 1e-200

Integer = int | np.int64  # in a kernel


@inline_kernel
def hash_unit(i: Integer, j: Integer, seed: Integer) -> float:
    """Hash two integers and a seed to a pseudo-random number in [0, 1)."""
    h = (i * 374761393 + j * 668265263 + seed * 2147483647) & 0x7FFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0x7FFFFFFF
    h = ((h ^ (h >> 15)) * 1911520717) & 0x7FFFFFFF
    return ((h ^ (h >> 16)) & 0xFFFF) / 65536.0


@inline_kernel
def value_noise(s: float, t: float, seed: Integer) -> float:
    """Smooth noise in [0, 1] with cells of size 1."""
    i = np.int64(math.floor(s))
    j = np.int64(math.floor(t))
    x = s - i
    y = t - j
    x = x * x * (3.0 - 2.0 * x)
    y = y * y * (3.0 - 2.0 * y)
    top = hash_unit(i, j, seed) * (1.0 - x) + hash_unit(i + 1, j, seed) * x
    bottom = hash_unit(i, j + 1, seed) * (1.0 - x) + hash_unit(i + 1, j + 1, seed) * x
    return top * (1.0 - y) + bottom * y


@inline_kernel
def cloudy(s: float, t: float, seed: Integer) -> float:
    """Noise in [0, 1] of three scales: 1 m, 0.25 m, 0.06 m."""
    coarse = value_noise(s, t, seed)
    middle = value_noise(4.0 * s, 4.0 * t, seed + 1)
    return 0.55 * coarse + 0.3 * middle + 0.15 * value_noise(16.0 * s, 16.0 * t, seed + 2)


@inline_kernel
def second_color_fraction(pattern: Integer, s: float, t: float, scale: float, seed: Integer) -> float:
    """Fraction in [0, 1] of the second colour at (s, t) [m]; patterns as in layout.py."""
    i = np.int64(math.floor(s / scale))
    j = np.int64(math.floor(t / scale))
    x = s / scale - math.floor(s / scale)
    y = t / scale - math.floor(t / scale)
    noise = cloudy(s, t, seed)
    if pattern == 0:  # plain
        return 0.35 * noise
    if pattern == 1:  # planks: rows of boards with joints
        joint = 1.0 if x < 0.04 else 0.0
        board = np.int64(math.floor(t / 1.2 + 0.37 * (i % 3)))
        return max(joint, 0.5 * hash_unit(i, board, seed) + 0.3 * noise)
    if pattern == 2:  # tiles with gaps
        gap = 1.0 if min(x, y) < 0.05 else 0.0
        return max(gap, 0.3 * hash_unit(i, j, seed) + 0.2 * noise)
    if pattern == 3:  # stripes of several widths
        return 0.75 * hash_unit(i, 0, seed) + 0.2 * noise
    if pattern == 4:  # checks
        return 0.8 * ((i + j) & 1) + 0.2 * noise
    return min(1.0, max(0.0, 2.5 * value_noise(2.0 * s / scale, 2.0 * t / scale, seed) - 0.7))  # picture


@kernel
def hit_boxes(origin: Array, directions: Array, boxes: Array, ranges: Array, hits: Int64s) -> None:
    """Write the range [m] of each ray (N, 3) to its first hit or inf, and 3 * box + axis of the face or -1.

    A box around the origin is not hit. Boxes outside, rays inside: the inner loop has no branch to stop SIMD.
    """
    ranges[:] = np.inf
    hits[:] = -1
    for b in range(len(boxes)):
        ox = origin[0] - boxes[b, 0]
        oy = origin[1] - boxes[b, 1]
        oz = origin[2] - boxes[b, 2]
        c = math.cos(boxes[b, 6])
        s = math.sin(boxes[b, 6])
        px = c * ox + s * oy
        py = c * oy - s * ox
        half_x = boxes[b, 3]
        half_y = boxes[b, 4]
        half_z = boxes[b, 5]
        for n in range(len(directions)):
            dx = directions[n, 0]
            dy = directions[n, 1]
            dz = directions[n, 2]
            ix = 1.0 / (c * dx + s * dy + NO_ZERO)
            iy = 1.0 / (c * dy - s * dx + NO_ZERO)
            iz = 1.0 / (dz + NO_ZERO)
            hx = half_x * abs(ix)
            hy = half_y * abs(iy)
            hz = half_z * abs(iz)
            near_x = -px * ix - hx
            near_y = -py * iy - hy
            near_z = -oz * iz - hz
            near = max(near_x, near_y, near_z)
            far = min(hx - px * ix, hy - py * iy, hz - oz * iz)
            face = 0 if near == near_x else 1 if near == near_y else 2
            is_nearer = (near > 1e-6) & (near < ranges[n]) & (near <= far)
            ranges[n] = near if is_nearer else ranges[n]
            hits[n] = 3 * b + face if is_nearer else hits[n]


@kernel
def shade(
    origin: Array,
    directions: Array,
    ranges: Array,
    hits: Int64s,
    boxes: Array,
    materials: Array,
    lights: Array,
    rgb: Array,
) -> None:
    """Write the colour (N, 3) in [0, 1] of each hit, lit by its box's lamp; black where nothing is hit.

    `lights` (B, 4) are positions of the lamps, and by how much their light decays [1/m2].
    """
    for n in range(len(directions)):
        rgb[n, :] = 0.0
        if hits[n] < 0:
            continue
        b = hits[n] // 3
        axis = hits[n] % 3
        x = origin[0] + ranges[n] * directions[n, 0]
        y = origin[1] + ranges[n] * directions[n, 1]
        z = origin[2] + ranges[n] * directions[n, 2]
        c = math.cos(boxes[b, 6])
        s = math.sin(boxes[b, 6])
        ox = x - boxes[b, 0]
        oy = y - boxes[b, 1]
        oz = z - boxes[b, 2]
        px = c * ox + s * oy
        py = c * oy - s * ox
        along, up = (py, oz) if axis == 0 else (px, oz) if axis == 1 else (px, py)
        m = materials[b]
        fraction = second_color_fraction(np.int64(m[0]), along, up, m[1], np.int64(m[8]) + axis)
        lx = lights[b, 0] - x
        ly = lights[b, 1] - y
        lz = lights[b, 2] - z
        distance2 = lx * lx + ly * ly + lz * lz
        towards = abs((c * lx + s * ly) if axis == 0 else (c * ly - s * lx) if axis == 1 else lz)
        lit = AMBIENT + LAMP * towards / math.sqrt(distance2) / (1.0 + lights[b, 3] * distance2)
        for k in range(3):
            rgb[n, k] = min(1.0, lit * (m[2 + k] * (1.0 - fraction) + m[5 + k] * fraction))


def boxes_ahead(origin: Array, directions: Array, boxes: Array) -> tuple[Integers, Array]:
    """Which boxes (B, 7) unit `directions` (N, 3) may hit, by their cone, and from what range on [m]."""
    axis = directions.mean(axis=0)
    axis /= max(float(np.linalg.norm(axis)), 1e-12)  # of opposite rays, for which the cone is the sphere
    width = math.acos(np.clip((directions @ axis).min(), -1.0, 1.0)) + MARGIN
    offset = boxes[:, :3] - origin
    distance = np.linalg.norm(offset, axis=1)
    radius = np.linalg.norm(boxes[:, 3:6], axis=1)  # of the sphere around a box, which is seen as a cone too
    reach = width + np.arcsin(np.minimum(radius / np.maximum(distance, radius), 1.0))
    is_ahead = offset @ axis >= distance * np.cos(np.minimum(reach, np.pi))
    ahead = np.flatnonzero(is_ahead | (distance <= radius))
    return ahead, np.maximum(box_distances(boxes[ahead], origin), 0.0)


def cast_rays(
    room: Room, origin: Array, directions: Array, workers: Workers, label: str
) -> tuple[Array, Array, Int64s]:
    """Ranges (N,) [m], colours (N, 3) in [0, 1] and labels (N,) along unit world `directions` (N, 3).

    Where nothing is hit the range is inf, the colour black or the sky's, and the label 0. Quickest where
    directions that follow each other are near each other: what lies elsewhere is not asked.
    """
    ranges = np.empty(len(directions))
    rgb = np.empty((len(directions), 3))
    labels = np.zeros(len(directions), dtype=np.int64)
    lights = np.full((len(room.boxes), 4), LAMP_DECAY if room.sky is None else 0.0)
    lights[:, :3] = room.light

    def run(lo: int) -> None:
        part = slice(lo, lo + CHUNK)
        rays = directions[part]
        hits = np.empty(len(ranges[part]), dtype=np.int64)
        ahead, least = boxes_ahead(origin, rays, room.boxes)
        if len(ahead) > NUM_FIRST:  # what the nearest boxes hide needs no look
            nearest = np.argpartition(least, NUM_FIRST)[:NUM_FIRST]
            hit_boxes(origin, rays, room.boxes[ahead[nearest]], ranges[part], hits)
            ahead = ahead[least <= ranges[part].max() + MARGIN]
        boxes = room.boxes[ahead]
        materials = room.materials[ahead]
        hit_boxes(origin, rays, boxes, ranges[part], hits)
        shade(origin, rays, ranges[part], hits, boxes, materials, lights[ahead], rgb[part])
        is_hit = hits >= 0
        if room.sky is not None:
            rgb[part][~is_hit] = room.sky
        labels[part][is_hit] = room.labels[ahead[hits[is_hit] // 3]]

    list(workers.map(run, range(0, len(directions), CHUNK), label))
    return ranges, rgb, labels
