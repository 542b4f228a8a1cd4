"""SIFT (Lowe, IJCV 2004): keypoints of a picture, each with its size, orientation and descriptor.

Columns are x, rows are y, downwards; the centre of pixel [i, j] is at x = j, y = i. Angles turn from x to y.
A descriptor has the gradients around a keypoint by 4 rows and 4 columns of cells, in the keypoint's axes, and
8 directions. Kept are the square roots of their shares (RootSIFT: Arandjelovic and Zisserman, CVPR 2012).
"""

import math
from typing import NamedTuple

import numpy as np

from ..geometry.sphere import atan2
from ..system.arrays import Array32, Bytes, Int32s
from ..system.kernels.jit import F0, F1, HALF, Scalar, inline_kernel, kernel
from .scale_space import (
    FIRST_SIGMA,
    NUM_IMAGES,
    NUM_LAYERS,
    blur_picture,
    double,
    find_extremes,
    make_weights,
)

LEAST_SIDE = 16  # [px] of an octave: smaller ones have no room for keypoints
PIXELS_PER_EXTREME = 4  # at least
MOST_ORIENTATIONS = 4  # of an extreme place, in the mean of a picture
NUM_DIRECTIONS = 36  # in which an orientation is looked for
DIRECTIONS_PER_RADIAN = np.float32(NUM_DIRECTIONS / math.tau)
ORIENTATION_SIGMA = np.float32(1.5)  # times the keypoint's sigma, within which gradients tell its orientation
ORIENTATION_REACH = np.float32(4.5)  # times the keypoint's sigma
SECOND_PEAK = np.float32(0.8)  # of the highest: a place has a further orientation
DESCRIPTOR_CELLS = 4  # rows and columns of a descriptor
NUM_BINS = 8  # directions of a descriptor
BINS_PER_RADIAN = np.float32(NUM_BINS / math.tau)
FULL_TURN = np.float32(NUM_BINS)
DESCRIPTOR_SIZE = DESCRIPTOR_CELLS * DESCRIPTOR_CELLS * NUM_BINS
CELL_SIGMAS = np.float32(3.0)  # width of a descriptor's cell, times the keypoint's sigma
CELL_REACH = np.float32(0.5 * (DESCRIPTOR_CELLS + 1))  # of a descriptor, along its rows and columns
SQRT_2 = np.float32(math.sqrt(2.0))
FALL_OF_CELLS = np.float32(-2.0 / DESCRIPTOR_CELLS**2)  # weights fall with a sigma of half a descriptor
ROW_STEP = 2  # of gradients that are summed: pictures that are blurred by two pixels hold nothing finer
MOST_SHARE = np.float32(0.2)  # of a descriptor's length that is one direction's in one cell
# A gradient is divided among eight bins. So that they are always there, the cells have a row and a column
# more on each side, and a circle has a bin more.
BINS = np.int32(NUM_BINS + 1)
PADDED_CELLS = np.int32(DESCRIPTOR_CELLS + 2)
LAST_CELL = np.int32(DESCRIPTOR_CELLS)  # that is followed by another
LAST_BIN = np.int32(NUM_BINS - 1)
NEXT = np.uint32(1)  # from a bin to the next
RIGHT = np.uint32(BINS)  # and to that of the next column
BELOW = np.uint32(PADDED_CELLS * BINS)  # and of the next row
NUM_NEIGHBORS = 8
FLAT = np.float32(1e-6)  # slope of a line that has no end
ENDLESS = np.float32(1e6)  # [px]
FULL_BYTE = np.float32(255.0)
LEAST_TOTAL = np.float32(1e-20)
WEIGHTS = make_weights()


class Room(NamedTuple):
    """Arrays in which the gradients around one keypoint are summed, used again for the next."""

    lengths: Array32  # (w,) of the gradients in a row of the picture
    angles: Array32  # (w,) [rad]
    falls: Array32  # (w,) Gaussian weight of each column
    bins: Int32s  # (w,) first of the eight bins among which each is divided
    parts: Array32  # (8, w)
    directions: Array32  # (37,)
    sums: Array32  # (6 * 6 * 9,) rows and columns of cells, directions
    shares: Array32  # (128,)


class Place(NamedTuple):
    """A keypoint in a picture of an octave [px]."""

    x: Scalar
    y: Scalar
    sigma: Scalar


@inline_kernel
def take_gradients(image: Array32, y: int, begin: int, end: int, room: Room) -> None:
    """Write the gradients of row y from column `begin` to `end`."""
    above = image[y - 1, begin:end]
    below = image[y + 1, begin:end]
    left = image[y, begin - 1 : end - 1]
    right = image[y, begin + 1 : end + 1]
    lengths = room.lengths
    angles = room.angles
    for k in range(len(above)):
        across = right[k] - left[k]
        down = below[k] - above[k]
        lengths[k] = math.sqrt(across * across + down * down)
        angles[k] = atan2(down, across)


@inline_kernel
def write_falls(begin: int, end: int, middle: Scalar, fall: Scalar, falls: Array32) -> None:
    """Write the Gaussian weights of columns from `begin` to `end` by their distances from `middle`."""
    for k in range(end - begin):
        u = np.float32(begin + k) - middle
        falls[k] = math.exp(fall * u * u)


@inline_kernel
def sum_directions(image: Array32, place: Place, room: Room) -> None:
    """Sum the gradients around a keypoint by direction, from -pi to pi; the last bin is the first."""
    height, width = image.shape
    x = round(place.x)
    y = round(place.y)
    reach = round(ORIENTATION_REACH * place.sigma)
    fall = -HALF / (ORIENTATION_SIGMA * place.sigma * ORIENTATION_SIGMA * place.sigma)
    begin = max(1, x - reach)
    end = min(width - 1, x + reach + 1)
    write_falls(begin, end, np.float32(x), fall, room.falls)
    room.directions[:] = F0
    for i in range(max(1, y - reach), min(height - 1, y + reach + 1), ROW_STEP):
        take_gradients(image, i, begin, end, room)
        weight = np.float32(math.exp(fall * np.float32((i - y) * (i - y))))
        for k in range(end - begin):
            turn = room.angles[k] * DIRECTIONS_PER_RADIAN + np.float32(0.5 * NUM_DIRECTIONS)
            room.directions[np.uint32(turn + HALF)] += weight * room.falls[k] * room.lengths[k]
    room.directions[0] += room.directions[NUM_DIRECTIONS]


@inline_kernel
def smooth_directions(raw: Array32, smooth: Array32) -> None:
    """Write a smoothed histogram (36,) of directions from 0 to 2 pi, by the sums (37,) from -pi to pi."""
    for k in range(NUM_DIRECTIONS):
        own = k + NUM_DIRECTIONS // 2
        beside = raw[(own + 1) % NUM_DIRECTIONS] + raw[(own - 1) % NUM_DIRECTIONS]
        beyond = raw[(own + 2) % NUM_DIRECTIONS] + raw[(own - 2) % NUM_DIRECTIONS]
        smooth[k] = np.float32(6.0) * raw[own % NUM_DIRECTIONS] + np.float32(4.0) * beside + beyond


@inline_kernel
def find_ends(slope: Scalar, offset: Scalar) -> tuple[Scalar, Scalar]:
    """Return between which u the sum slope * u + offset is a row or column of a descriptor."""
    if -FLAT < slope < FLAT:
        return (-ENDLESS, ENDLESS) if -CELL_REACH < offset < CELL_REACH else (ENDLESS, -ENDLESS)
    one = (-CELL_REACH - offset) / slope
    other = (CELL_REACH - offset) / slope
    return min(one, other), max(one, other)


@inline_kernel
def locate_in_cells(
    k: int, start: tuple[Scalar, Scalar], slope: tuple[Scalar, Scalar]
) -> tuple[Scalar, Scalar, np.int32, np.int32]:
    """Return row and column of the cells, as floats, at pixel k of a line, and the whole ones before."""
    row = start[0] + np.float32(k) * slope[0]
    column = start[1] + np.float32(k) * slope[1]
    return row, column, min(np.int32(row), LAST_CELL), min(np.int32(column), LAST_CELL)


@inline_kernel
def divide_gradients(
    count: int, start: tuple[Scalar, Scalar], slope: tuple[Scalar, Scalar], angle: Scalar, room: Room
) -> None:
    """Divide the gradients of a line among the nearest rows, columns and directions of a keypoint's axes.

    `start` and `slope` are those of `locate_in_cells`, `angle` is the keypoint's. These loops are vectorised;
    adding the parts can't be.
    """
    lengths, turns, bins, parts = room.lengths, room.angles, room.bins, room.parts
    for k in range(count):
        turn = (turns[k] - angle) * BINS_PER_RADIAN
        turn = turn + FULL_TURN if turn < F0 else turn
        turns[k] = turn + FULL_TURN if turn < F0 else turn
    for k in range(count):
        _, _, i, j = locate_in_cells(k, start, slope)
        bins[k] = (i * PADDED_CELLS + j) * BINS + min(np.int32(turns[k]), LAST_BIN)
    for k in range(count):
        row, column, i, j = locate_in_cells(k, start, slope)
        below = lengths[k] * (row - np.float32(i))
        above = lengths[k] - below
        right = column - np.float32(j)
        further = turns[k] - np.float32(min(np.int32(turns[k]), LAST_BIN))
        above_right = above * right
        below_right = below * right
        parts[1, k] = (above - above_right) * further
        parts[0, k] = above - above_right - parts[1, k]
        parts[3, k] = above_right * further
        parts[2, k] = above_right - parts[3, k]
        parts[5, k] = (below - below_right) * further
        parts[4, k] = below - below_right - parts[5, k]
        parts[7, k] = below_right * further
        parts[6, k] = below_right - parts[7, k]


@inline_kernel
def add_parts(count: int, bins: Int32s, parts: Array32, sums: Array32) -> None:
    """Add the parts (8, w) of some gradients to the bins of rows, columns and directions."""
    for k in range(count):
        at = np.uint32(bins[k])  # an unsigned index is not compared with zero
        sums[at] += parts[0, k]
        sums[at + NEXT] += parts[1, k]
        sums[at + RIGHT] += parts[2, k]
        sums[at + RIGHT + NEXT] += parts[3, k]
        sums[at + BELOW] += parts[4, k]
        sums[at + BELOW + NEXT] += parts[5, k]
        sums[at + BELOW + RIGHT] += parts[6, k]
        sums[at + BELOW + RIGHT + NEXT] += parts[7, k]


@inline_kernel
def sum_gradients(image: Array32, place: Place, angle: Scalar, room: Room) -> None:
    """Sum the gradients around a keypoint by rows and columns of cells in its axes, and directions."""
    room.sums[:] = F0
    height, width = image.shape
    per = F1 / (CELL_SIGMAS * place.sigma)
    cosine = per * np.float32(math.cos(angle))
    sine = per * np.float32(math.sin(angle))
    fall = FALL_OF_CELLS * per * per
    reach = SQRT_2 * CELL_REACH / per
    first = max(1, math.ceil(place.x - reach))
    last = min(width - 2, math.floor(place.x + reach))
    write_falls(first, last + 1, place.x, fall, room.falls)
    for i in range(
        max(1, math.ceil(place.y - reach)), min(height - 1, math.floor(place.y + reach) + 1), ROW_STEP
    ):
        v = np.float32(i) - place.y
        low, high = find_ends(cosine, v * sine)
        least, most = find_ends(-sine, v * cosine)
        begin = max(first, math.ceil(place.x + max(low, least)))
        count = min(last, math.floor(place.x + min(high, most))) + 1 - begin
        if count <= 0:
            continue
        take_gradients(image, i, begin, begin + count, room)
        weight = np.float32(math.exp(fall * v * v))
        for k in range(count):
            room.lengths[k] *= weight * room.falls[begin - first + k]
        u = np.float32(begin) - place.x
        start = CELL_REACH + v * cosine - u * sine, CELL_REACH + u * cosine + v * sine
        divide_gradients(count, start, (-sine, cosine), angle, room)
        add_parts(count, room.bins, room.parts, room.sums)


@inline_kernel
def write_descriptor(room: Room, descriptor: Bytes) -> None:
    """Write the roots of the shares of all directions in all cells, times 255; none counts too much."""
    sums, shares = room.sums, room.shares
    count = 0
    square = F0
    for i in range(1, DESCRIPTOR_CELLS + 1):
        for j in range(1, DESCRIPTOR_CELLS + 1):
            first = (i * PADDED_CELLS + j) * BINS
            sums[first] += sums[first + NUM_BINS]
            for k in range(NUM_BINS):
                shares[count] = sums[first + k]
                square += shares[count] * shares[count]
                count += 1
    most = MOST_SHARE * np.float32(math.sqrt(square))
    total = F0
    for k in range(DESCRIPTOR_SIZE):
        shares[k] = min(shares[k], most)
        total += shares[k]
    per = F1 / max(total, LEAST_TOTAL)
    for k in range(DESCRIPTOR_SIZE):
        descriptor[k] = np.uint8(FULL_BYTE * np.float32(math.sqrt(per * shares[k])) + HALF)


@kernel
def describe_octave(
    images: Array32, extremes: Array32, scale: Scalar, room: Room, keypoints: Array32, descriptors: Bytes
) -> int:
    """Write the keypoints at extreme places of an octave, one for each orientation; return their number.

    `extremes` (N, 3) are those of `find_extremes`, `scale` is that of the octave. What is written are
    keypoints (M, 4) and descriptors (M, 128) as `find_sift` returns them, as many as there is room for.
    """
    smooth = np.empty(NUM_DIRECTIONS, np.float32)
    count = 0
    for n in range(len(extremes)):
        layer = extremes[n, 0]
        image = images[round(layer)]
        sigma = np.float32(FIRST_SIGMA) * np.float32(2.0) ** (layer / np.float32(NUM_LAYERS))
        place = Place(extremes[n, 2], extremes[n, 1], sigma)
        sum_directions(image, place, room)
        smooth_directions(room.directions, smooth)
        least = SECOND_PEAK * smooth.max()
        for k in range(NUM_DIRECTIONS):
            before, own, after = smooth[k - 1], smooth[k], smooth[(k + 1) % NUM_DIRECTIONS]
            if own < least or own <= before or own <= after or count == len(keypoints):
                continue
            peak = np.float32(k) + HALF * (before - after) / (before - own - own + after)
            angle = peak / DIRECTIONS_PER_RADIAN
            sum_gradients(image, place, angle, room)
            write_descriptor(room, descriptors[count])
            keypoints[count, 0] = place.x * scale
            keypoints[count, 1] = place.y * scale
            keypoints[count, 2] = (sigma + sigma) * scale
            keypoints[count, 3] = angle
            count += 1
    return count


def make_room(width: int) -> Room:
    """Make room for the gradients of an octave `width` [px] wide."""
    lengths, angles, falls = np.empty((3, width), np.float32)
    return Room(
        lengths,
        angles,
        falls,
        np.empty(width, np.int32),
        np.empty((NUM_NEIGHBORS, width), np.float32),
        np.empty(NUM_DIRECTIONS + 1, np.float32),
        np.empty(PADDED_CELLS * PADDED_CELLS * BINS, np.float32),
        np.empty(DESCRIPTOR_SIZE, np.float32),
    )


def find_in_octave(images: Array32, scale: np.float32, shown: Bytes) -> tuple[Array32, Bytes]:
    """Find the keypoints of an octave (6, h, w), as `find_sift` returns them.

    Its pictures are made from the first. A pixel of the octave is `scale` pixels of the picture.
    """
    for k in range(1, NUM_IMAGES):
        blur_picture(images[k - 1], WEIGHTS[k], images[k])
    extremes = np.empty((images[0].size // PIXELS_PER_EXTREME, 3), np.float32)
    extremes = extremes[: find_extremes(images, scale, shown, extremes)]
    keypoints = np.empty((MOST_ORIENTATIONS * len(extremes), 4), np.float32)
    descriptors = np.empty((len(keypoints), DESCRIPTOR_SIZE), np.uint8)
    count = describe_octave(images, extremes, scale, make_room(images.shape[2]), keypoints, descriptors)
    return keypoints[:count], descriptors[:count]


def begin_octave(image: Bytes) -> Array32:
    """Make the first octave (6, 2 h, 2 w) of a picture (h, w); only its first picture is written."""
    height, width = image.shape
    images = np.empty((NUM_IMAGES, 2 * height, 2 * width), np.float32)
    double(image, images[1])
    blur_picture(images[1], WEIGHTS[0], images[0])
    return images


def follow_octave(larger: Array32) -> Array32:
    """Make the next octave (6, h / 2, w / 2) of one (6, h, w); only its first picture is written."""
    height = larger.shape[1] // 2
    width = larger.shape[2] // 2
    images = np.empty((NUM_IMAGES, height, width), np.float32)
    images[0] = larger[NUM_LAYERS, : 2 * height : 2, : 2 * width : 2]
    return images


def find_sift(image: Bytes, shown: Bytes) -> tuple[Array32, Bytes]:
    """Return x, y, diameter [px] and angle [rad] (N, 4) and descriptors (N, 128) of a picture's keypoints.

    They are those of a picture (h, w) where its mask `shown` (h, w) is not 0.
    """
    if 2 * min(image.shape) < LEAST_SIDE:
        return np.empty((0, 4), np.float32), np.empty((0, DESCRIPTOR_SIZE), np.uint8)
    images = begin_octave(image)
    scale = HALF
    found = []
    while min(images.shape[1:]) >= LEAST_SIDE:
        found.append(find_in_octave(images, scale, shown))
        images = follow_octave(images)
        scale += scale
    keypoints, descriptors = zip(*found, strict=True)
    return np.concatenate(keypoints), np.concatenate(descriptors)
