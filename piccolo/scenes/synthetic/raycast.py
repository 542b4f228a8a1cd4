"""Rays against the boxes of a room: nearest hit and its lit colour."""

import math

import numpy as np
from numpy.typing import NDArray

from ...geometry.pose import Array
from ...runtime.jit import kernel
from ...runtime.threads import Workers
from .room import Room
from .texture import second_color_fraction

AMBIENT, LAMP, LAMP_DECAY = 0.55, 0.9, 0.15  # of a surface's colour; the decay [1/m2]
CHUNK = 4_096  # rays


@kernel
def hit_boxes(origin, directions, boxes, ranges, hits):
    """Write the range [m] of each ray (N, 3) to its first hit or inf, and 3 * box + axis of the face or -1.

    A box around the origin is not hit. Boxes outside, rays inside: the inner loop has no branch to stop SIMD.
    """
    ranges[:] = np.inf
    hits[:] = -1
    for b in range(len(boxes)):
        ox, oy, oz = origin[0] - boxes[b, 0], origin[1] - boxes[b, 1], origin[2] - boxes[b, 2]
        c, s = math.cos(boxes[b, 6]), math.sin(boxes[b, 6])
        px, py = c * ox + s * oy, c * oy - s * ox
        half_x, half_y, half_z = boxes[b, 3], boxes[b, 4], boxes[b, 5]
        for n in range(len(directions)):
            dx, dy, dz = directions[n, 0], directions[n, 1], directions[n, 2]
            # A ray along a face divides by zero on purpose: infinities compare as they should.
            ix, iy, iz = 1.0 / (c * dx + s * dy), 1.0 / (c * dy - s * dx), 1.0 / dz
            hx, hy, hz = half_x * abs(ix), half_y * abs(iy), half_z * abs(iz)
            near_x, near_y, near_z = -px * ix - hx, -py * iy - hy, -oz * iz - hz
            near = max(near_x, near_y, near_z)
            far = min(hx - px * ix, hy - py * iy, hz - oz * iz)
            face = 0 if near == near_x else 1 if near == near_y else 2
            is_nearer = (near > 1e-6) & (near < ranges[n]) & (near <= far)
            ranges[n] = near if is_nearer else ranges[n]
            hits[n] = 3 * b + face if is_nearer else hits[n]


@kernel
def shade(origin, directions, ranges, hits, boxes, materials, light, rgb):
    """Write the colour (N, 3) in [0, 1] of each hit; black where a ray hits nothing."""
    for n in range(len(directions)):
        rgb[n, :] = 0.0
        if hits[n] < 0:
            continue
        b, axis = hits[n] // 3, hits[n] % 3
        x = origin[0] + ranges[n] * directions[n, 0]
        y = origin[1] + ranges[n] * directions[n, 1]
        z = origin[2] + ranges[n] * directions[n, 2]
        c, s = math.cos(boxes[b, 6]), math.sin(boxes[b, 6])
        ox, oy, oz = x - boxes[b, 0], y - boxes[b, 1], z - boxes[b, 2]
        px, py = c * ox + s * oy, c * oy - s * ox
        along, up = (py, oz) if axis == 0 else (px, oz) if axis == 1 else (px, py)
        m = materials[b]
        fraction = second_color_fraction(np.int64(m[0]), along, up, m[1], np.int64(m[8]) + axis)
        lx, ly, lz = light[0] - x, light[1] - y, light[2] - z
        distance2 = lx * lx + ly * ly + lz * lz
        towards = abs((c * lx + s * ly) if axis == 0 else (c * ly - s * lx) if axis == 1 else lz)
        lit = AMBIENT + LAMP * towards / math.sqrt(distance2) / (1.0 + LAMP_DECAY * distance2)
        for k in range(3):
            rgb[n, k] = min(1.0, lit * (m[2 + k] * (1.0 - fraction) + m[5 + k] * fraction))


def cast_rays(
    room: Room, origin: Array, directions: NDArray[np.float64], workers: Workers, label: str
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Ranges (N,) [m], colours (N, 3) in [0, 1] and labels (N,) along unit world `directions` (N, 3).

    Where nothing is hit the range is inf, the colour black and the label 0.
    """
    ranges, rgb = np.empty(len(directions)), np.empty((len(directions), 3))
    labels = np.empty(len(directions), dtype=np.int64)

    def run(lo: int) -> None:
        part = slice(lo, lo + CHUNK)
        hits = np.empty(len(ranges[part]), dtype=np.int64)
        hit_boxes(origin, directions[part], room.boxes, ranges[part], hits)
        shade(origin, directions[part], ranges[part], hits, room.boxes, room.materials, room.light, rgb[part])
        labels[part] = np.where(hits < 0, 0, room.labels[hits // 3])

    list(workers.each(run, range(0, len(directions), CHUNK), label))
    return ranges, rgb, labels
