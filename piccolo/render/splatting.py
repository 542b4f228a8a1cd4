"""Surfels drawn into rows of an equirectangular picture: nearest range first, then weighted colours near it.

A surfel is a disc around a point. A pixel's ray sees it where it meets the disc's plane within the radius; a
surfel smaller than a pixel is seen by the ray nearest to it.
"""

import math

import numpy as np

from ..panorama.texels import channel
from ..runtime.jit import F0, F1, inline_kernel, kernel

MIN_RADIUS_PX = np.float32(0.75)  # every surfel reaches the centre of a pixel
# Layers nearer to each other than this are one surface: noise of a scanner.
BAND = np.float32(1.01)
BAND_OFFSET = np.float32(0.02)  # [m]
LEAST_WEIGHT = np.float32(1e-4)  # at the rim: whatever is seen has a colour
MAX_SLOPE = np.float32(1.25)  # of the range within a surfel or a pixel
TWO = np.float32(2.0)


@inline_kernel
def hit(surfel, dx, dy, dz, px_angle2):
    """Squared distance of the unit ray (dx, dy, dz) from a surfel's centre by its radius, and range [m]."""
    x, y, z, nx, ny, nz, along, per_radius2, distance = surfel
    facing = nx * dx + ny * dy + nz * dz
    t = along / facing
    ex, ey, ez = t * dx - x, t * dy - y, t * dz - z
    q = (ex * ex + ey * ey + ez * ez) * per_radius2
    if not facing * along > F0:  # a plane along the ray divides by zero: NaN is no hit
        q, t = TWO, distance
    # What the ray meets beside the surfel, in the same pixel: the surface goes on, but nobody knows how far.
    t = min(max(t, distance / MAX_SLOPE), distance * MAX_SLOPE)
    ex, ey, ez = dx - x / distance, dy - y / distance, dz - z / distance
    return min(q, (ex * ex + ey * ey + ez * ez) / px_angle2), t


@inline_kernel
def half_width(elevation, of_center, angle):
    """Azimuths [rad] on a row to each side of a centre that are within `angle` of it; -1 if none are."""
    over = math.sin(0.5 * angle) ** 2 - math.sin(0.5 * (elevation - of_center)) ** 2
    if over < 0.0:
        return -1.0
    fraction = over / max(math.cos(elevation) * math.cos(of_center), 1e-12)
    return math.pi if fraction >= 1.0 else 2.0 * math.asin(math.sqrt(fraction))


@kernel
def splat(surfels, rgbx, directions, angles, first_row, depth, sums):
    """Draw surfels into the rows from `first_row` on: into `depth`, or into `sums` if that is not empty.

    surfels (N, 9): centre [m], normal, product of both, 1 / radius^2, range [m], in the camera's frame;
    directions (N, 2): azimuth and elevation, angles (N,): radius as seen [rad].
    The nearest range [m] is written into depth (rows, W), which holds inf before; then sums (rows, W, 5) gets
    R, G, B [8-bit levels], range [m] and 1 of what is near that range, each times a weight, added.
    """
    width = depth.shape[1]
    step = 2.0 * math.pi / width
    px_angle2 = np.float32((MIN_RADIUS_PX * step) ** 2)
    cosines, sines = np.empty(width, np.float32), np.empty(width, np.float32)
    for j in range(width):
        cosines[j], sines[j] = math.cos(math.pi - (j + 0.5) * step), math.sin(math.pi - (j + 0.5) * step)
    for n in range(len(surfels)):
        d, c = surfels[n], rgbx[n]
        surfel = (d[0], d[1], d[2], d[3], d[4], d[5], d[6], d[7], d[8])
        azimuth, elevation = directions[n, 0], directions[n, 1]
        top = math.ceil((0.5 * math.pi - elevation - angles[n]) / step - 0.5) - first_row
        bottom = math.floor((0.5 * math.pi - elevation + angles[n]) / step - 0.5) - first_row
        for i in range(max(top, 0), min(bottom + 1, len(depth))):
            of_row = 0.5 * math.pi - (first_row + i + 0.5) * step
            half = half_width(of_row, elevation, angles[n])
            left = math.ceil((math.pi - azimuth - half) / step - 0.5)
            right = min(math.floor((math.pi - azimuth + half) / step - 0.5), left + width - 1)
            cosine, sine = np.float32(math.cos(of_row)), np.float32(math.sin(of_row))
            for at in range(left, right + 1):
                j = (at + width) % width
                q, t = hit(surfel, cosine * cosines[j], cosine * sines[j], sine, px_angle2)
                if q >= F1:
                    continue
                if len(sums) == 0:
                    depth[i, j] = min(depth[i, j], t)
                elif t <= depth[i, j] * BAND + BAND_OFFSET:
                    weight = (F1 - q) * (F1 - q) * (F1 - q) + LEAST_WEIGHT
                    s = sums[i, j]
                    s[0] += weight * channel(c, 0)
                    s[1] += weight * channel(c, 8)
                    s[2] += weight * channel(c, 16)
                    s[3] += weight * t
                    s[4] += weight
