"""Places in the scale space of a picture where differences of Gaussians are extreme (Lowe, IJCV 2004).

An octave holds NUM_IMAGES pictures (h, w), each blurred more than the one before. The first of the next
octave is every second pixel of the one that is blurred twice as much as the first. The first octave is twice
as large as the picture. A layer is the difference of two pictures that follow each other. Columns are x, rows
are y, downwards; the centre of pixel [i, j] is at x = j, y = i.
"""

import math

import numpy as np

from ..geometry.vectors import Triple, cross, dot
from ..system.arrays import Array32, Bytes
from ..system.kernels.jit import F0, F1, HALF, Scalar, inline_kernel, kernel

NUM_LAYERS = 3  # of an octave that are searched
NUM_IMAGES = NUM_LAYERS + 3
FIRST_SIGMA = 1.6  # [px] blur of an octave's first picture
CAMERA_SIGMA = 0.5  # [px] blur of a picture as it is given
BLUR_REACH = 3.5  # standard deviations that a blur reaches, at least
TAPS = 3  # rows or columns on each side that are added at a time: a blur reaches a multiple of them
OCTAVE_BORDER = 5  # [px] around each octave, without keypoints
CONTRAST = np.float32(0.006)  # least contrast of a keypoint, of 1: faint ones on plain walls match well
EDGE_RATIO = np.float32(10.0)  # of the two curvatures of a keypoint, at most
MOST_STEPS = 5  # from an extreme pixel to the extreme place beside it
FAR = np.float32(100.0)  # [px] no extreme place is so far from a pixel
QUARTER = np.float32(0.25)
PER_BYTE = np.float32(1.0 / 255.0)
Rows = tuple[Array32, Array32, Array32]


def make_weights() -> tuple[Array32, ...]:
    """Return half of each Gaussian, from its middle outwards, by which the pictures of an octave are blurred.

    The first makes the first picture of the first octave, the others each picture from the one before.
    """
    blurs = [FIRST_SIGMA * 2.0 ** (k / NUM_LAYERS) for k in range(NUM_IMAGES)]
    before = [2.0 * CAMERA_SIGMA, *blurs]
    sigmas = [math.sqrt(own**2 - less**2) for less, own in zip(before, blurs, strict=False)]
    return tuple(half_gaussian(sigma) for sigma in sigmas)


def half_gaussian(sigma: float) -> Array32:
    """Return the weights (n,) of a blur by `sigma` [px] at distances of 0, 1, ... pixels."""
    distance = np.arange(TAPS * math.ceil(BLUR_REACH * sigma / TAPS) + 1)
    weights = np.exp(-0.5 * (distance / sigma) ** 2)
    return np.asarray(weights / (2.0 * weights.sum() - weights[0]), np.float32)


@kernel
def double(image: Bytes, doubled: Array32) -> None:
    """Write a picture (h, w) at twice its size, from 0 to 1; pixel [i, j] goes to [2 i, 2 j]."""
    height, width = image.shape
    line = np.empty(width + 1, np.float32)
    for i in range(2 * height):
        above = image[i // 2]
        below = image[min((i + 1) // 2, height - 1)]
        for j in range(width):
            line[j] = HALF * PER_BYTE * (np.float32(above[j]) + np.float32(below[j]))
        line[width] = line[width - 1]
        target = doubled[i]
        for j in range(width):
            target[2 * j] = line[j]
            target[2 * j + 1] = HALF * (line[j] + line[j + 1])


@inline_kernel
def reflect(k: int, size: int) -> int:
    """Return the row or column within `size` that stands for one beyond the border."""
    k = -k if k < 0 else k
    return 2 * size - 2 - k if k >= size else k


@inline_kernel
def three_rows(image: Array32, y: int, k: int) -> Rows:
    """Return the row of a picture k rows from row y, and the next two away from it."""
    step = 1 if k > 0 else -1
    height = len(image)
    first, second = reflect(y + k, height), reflect(y + k + step, height)
    return image[first], image[second], image[reflect(y + k + 2 * step, height)]


@inline_kernel
def add_taps(total: Array32, weights: Array32, k: int, before: Rows, after: Rows) -> None:
    """Add three rows before and three after a row to it, weighted by their distances k to k + 2."""
    u, v, w = weights[k], weights[k + 1], weights[k + 2]
    a, b, c = before
    d, e, f = after
    for x in range(len(total)):
        total[x] += u * (a[x] + d[x]) + v * (b[x] + e[x]) + w * (c[x] + f[x])


@kernel
def blur_picture(image: Array32, weights: Array32, blurred: Array32) -> None:
    """Blur a picture (h, w) by half a Gaussian; beyond its border it is reflected."""
    height, width = image.shape
    reach = len(weights) - 1
    line = np.empty(width + 2 * reach, np.float32)
    middle = line[reach : reach + width]
    for y in range(height):
        own = image[y]
        for x in range(width):
            middle[x] = weights[0] * own[x]
        for k in range(1, reach, TAPS):
            add_taps(middle, weights, k, three_rows(image, y, -k), three_rows(image, y, k))
        for k in range(1, reach + 1):
            line[reach - k] = middle[k]
            line[reach + width - 1 + k] = middle[width - 1 - k]
        target = blurred[y]
        for x in range(width):
            target[x] = weights[0] * middle[x]
        for k in range(1, reach, TAPS):
            before = line[reach - k :], line[reach - k - 1 :], line[reach - k - 2 :]
            after = line[reach + k :], line[reach + k + 1 :], line[reach + k + 2 :]
            add_taps(target, weights, k, before, after)


@inline_kernel
def write_differences(images: Array32, y: int, differences: Array32) -> None:
    """Write row y of all layers to place y modulo 3 of (3, 5, w)."""
    for k in range(NUM_IMAGES - 1):
        less = images[k, y]
        more = images[k + 1, y]
        target = differences[y % 3, k]
        for x in range(len(target)):
            target[x] = more[x] - less[x]


@inline_kernel
def write_extremes(differences: Array32, lowest: Array32, highest: Array32) -> None:
    """Write the least and the largest values (5, w) of three rows of all layers (3, 5, w)."""
    for k in range(NUM_IMAGES - 1):
        a, b, c = differences[0, k], differences[1, k], differences[2, k]
        low = lowest[k]
        for x in range(len(low)):
            low[x] = min(a[x], b[x], c[x])
        high = highest[k]
        for x in range(len(high)):
            high[x] = max(a[x], b[x], c[x])


@inline_kernel
def mark_extremes(own: Array32, lowest: Array32, highest: Array32, room: Array32, is_extreme: Bytes) -> None:
    """Mark where a row (w,) of a layer is exceeded by nothing around.

    `lowest` and `highest` (3, w) are those of three rows, in its layer and the two beside it. `room` (2, w)
    is room to work in.
    """
    least = HALF * CONTRAST / np.float32(NUM_LAYERS)
    a, b, c = lowest[0], lowest[1], lowest[2]
    low = room[0]
    for x in range(len(low)):
        low[x] = min(a[x], b[x], c[x])
    a, b, c = highest[0], highest[1], highest[2]
    high = room[1]
    for x in range(len(high)):
        high[x] = max(a[x], b[x], c[x])
    for x in range(1, len(low) - 1):
        value = own[x]
        is_high = value > least and value >= max(high[x - 1], high[x], high[x + 1])
        is_low = value < -least and value <= min(low[x - 1], low[x], low[x + 1])
        is_extreme[x] = np.uint8(is_high or is_low)


@inline_kernel
def read_cube(images: Array32, layer: int, y: int, x: int, cube: Array32) -> None:
    """Write the values around a pixel of a layer to a cube (3, 3, 3) of layers, rows and columns."""
    for k in range(3):
        for i in range(3):
            for j in range(3):
                more = images[layer + k, y + i - 1, x + j - 1]
                cube[k, i, j] = more - images[layer + k - 1, y + i - 1, x + j - 1]


@inline_kernel
def step_to_extreme(cube: Array32) -> tuple[Triple, Scalar]:
    """Return the step from the middle of a cube (3, 3, 3) to the extreme place beside it, and its value.

    The values are taken for quadratic (equations 2 and 3); where that tells no place the step is not finite.
    """
    c = cube
    slope = (
        HALF * (c[2, 1, 1] - c[0, 1, 1]),
        HALF * (c[1, 2, 1] - c[1, 0, 1]),
        HALF * (c[1, 1, 2] - c[1, 1, 0]),
    )
    twice = c[1, 1, 1] + c[1, 1, 1]
    kk = c[2, 1, 1] + c[0, 1, 1] - twice
    ii = c[1, 2, 1] + c[1, 0, 1] - twice
    jj = c[1, 1, 2] + c[1, 1, 0] - twice
    ki = QUARTER * (c[2, 2, 1] - c[2, 0, 1] - c[0, 2, 1] + c[0, 0, 1])
    kj = QUARTER * (c[2, 1, 2] - c[2, 1, 0] - c[0, 1, 2] + c[0, 1, 0])
    ij = QUARTER * (c[1, 2, 2] - c[1, 2, 0] - c[1, 0, 2] + c[1, 0, 0])
    a = cross((ki, ii, ij), (kj, ij, jj))
    b = cross((kj, ij, jj), (kk, ki, kj))
    d = cross((kk, ki, kj), (ki, ii, ij))
    per = -F1 / dot((kk, ki, kj), a)
    step = (
        per * (a[0] * slope[0] + b[0] * slope[1] + d[0] * slope[2]),
        per * (a[1] * slope[0] + b[1] * slope[1] + d[1] * slope[2]),
        per * (a[2] * slope[0] + b[2] * slope[1] + d[2] * slope[2]),
    )
    return step, c[1, 1, 1] + HALF * dot(slope, step)


@inline_kernel
def is_corner(cube: Array32) -> bool:
    """Tell whether both curvatures of the middle layer of a cube (3, 3, 3) are alike, as no edge's are."""
    c = cube[1]
    twice = c[1, 1] + c[1, 1]
    ii = c[2, 1] + c[0, 1] - twice
    jj = c[1, 2] + c[1, 0] - twice
    ij = QUARTER * (c[2, 2] - c[2, 0] - c[0, 2] + c[0, 0])
    determinant = ii * jj - ij * ij
    trace = ii + jj
    limit = (EDGE_RATIO + F1) * (EDGE_RATIO + F1)
    return bool(determinant > F0 and trace * trace * EDGE_RATIO < limit * determinant)


@inline_kernel
def find_extreme(images: Array32, layer: int, y: int, x: int, cube: Array32) -> Triple:
    """Return layer, row and column of the extreme place beside an extreme pixel; layer 0 if there is none.

    `cube` (3, 3, 3) is room to work in.
    """
    height, width = images.shape[1:]
    for _ in range(MOST_STEPS):
        read_cube(images, layer, y, x, cube)
        (up, down, right), value = step_to_extreme(cube)
        farthest = max(up, -up, down, -down, right, -right)
        if not farthest < FAR:  # or not a number
            break
        if farthest < HALF:
            is_clear = max(value, -value) * np.float32(NUM_LAYERS) >= CONTRAST and is_corner(cube)
            found = np.float32(layer) + up if is_clear else F0
            return found, np.float32(y) + down, np.float32(x) + right
        layer += round(up)
        y += round(down)
        x += round(right)
        is_inside = OCTAVE_BORDER <= y < height - OCTAVE_BORDER and OCTAVE_BORDER <= x < width - OCTAVE_BORDER
        if not (is_inside and 1 <= layer <= NUM_LAYERS):
            break
    return F0, F0, F0


@inline_kernel
def is_shown(place: Triple, scale: Scalar, shown: Bytes) -> bool:
    """Tell whether the picture's pixel at a place of an octave is shown."""
    i = min(round(place[1] * scale), shown.shape[0] - 1)
    j = min(round(place[2] * scale), shown.shape[1] - 1)
    return bool(shown[i, j])


@kernel
def find_extremes(images: Array32, scale: Scalar, shown: Bytes, places: Array32) -> int:
    """Write layer, row and column (N, 3) of the extreme places of an octave (6, h, w); return their number.

    A pixel of the octave is `scale` pixels of the picture. Places are kept where its mask `shown` is not 0,
    and as many as there is room for.
    """
    height, width = images.shape[1:]
    differences = np.empty((3, NUM_IMAGES - 1, width), np.float32)
    lowest = np.empty(differences.shape[1:], np.float32)
    highest = np.empty(differences.shape[1:], np.float32)
    room = np.empty((2, width), np.float32)
    is_extreme = np.zeros(width, np.uint8)
    is_taken = np.zeros((NUM_IMAGES, height, width), np.uint8)  # two pixels may lead to one place
    cube = np.empty((3, 3, 3), np.float32)
    count = 0
    for below in range(OCTAVE_BORDER - 1, height - OCTAVE_BORDER + 1):
        write_differences(images, below, differences)
        y = below - 1
        if y < OCTAVE_BORDER:
            continue
        write_extremes(differences, lowest, highest)
        for layer in range(1, NUM_LAYERS + 1):
            around = slice(layer - 1, layer + 2)
            mark_extremes(differences[y % 3, layer], lowest[around], highest[around], room, is_extreme)
            for x in range(OCTAVE_BORDER, width - OCTAVE_BORDER):
                if is_extreme[x] == 0:
                    continue
                place = find_extreme(images, layer, y, x, cube)
                taken = is_taken[round(place[0]), round(place[1]), round(place[2]) :]
                if place[0] > F0 and taken[0] == 0 and is_shown(place, scale, shown) and count < len(places):
                    taken[0] = 1
                    for k in range(3):
                        places[count, k] = place[k]
                    count += 1
    return count
