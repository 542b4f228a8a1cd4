"""A twin of SIFT in float64: blurs by SciPy from the picture itself, histograms of all pixels at once."""

import itertools
import math

import numpy as np
from scipy import ndimage

from piccolo.local_features import scale_space, sift

SIGMAS = [
    scale_space.FIRST_SIGMA * 2.0 ** (k / scale_space.NUM_LAYERS) for k in range(scale_space.NUM_IMAGES)
]


def make_octaves(picture):
    """The pictures (6, h, w) of each octave of a picture (h, w), from 0 to 1, each with its pixels' size."""
    height, width = picture.shape
    rows = np.minimum(np.arange(2 * height) / 2, height - 1)
    columns = np.minimum(np.arange(2 * width) / 2, width - 1)
    places = np.meshgrid(rows, columns, indexing="ij")
    image = ndimage.map_coordinates(picture / 255.0, places, order=1)
    before = 2.0 * scale_space.CAMERA_SIGMA
    scale = 0.5
    while min(image.shape) >= sift.LEAST_SIDE:
        added = np.sqrt(np.square(SIGMAS) - before**2)
        images = np.stack([ndimage.gaussian_filter(image, s, mode="mirror", truncate=5.0) for s in added])
        yield images, scale
        height, width = image.shape
        image = images[scale_space.NUM_LAYERS][: height // 2 * 2 : 2, : width // 2 * 2 : 2]
        before = scale_space.FIRST_SIGMA
        scale *= 2.0


def find_extremes(images):
    """Layer, row and column (N, 3) of the extreme places of an octave."""
    layers = np.diff(images, axis=0)
    is_high = (layers > 0) & (layers == ndimage.maximum_filter(layers, 3))
    is_low = (layers < 0) & (layers == ndimage.minimum_filter(layers, 3))
    is_strong = np.abs(layers) > 0.5 * scale_space.CONTRAST / scale_space.NUM_LAYERS
    border = scale_space.OCTAVE_BORDER
    shape = np.array([scale_space.NUM_LAYERS + 2, *images.shape[1:]])
    lowest = np.array([1, border, border])
    highest = shape - [1, border, border]
    found = {}
    for pixel in np.argwhere((is_high | is_low) & is_strong):
        at = pixel
        for _ in range(scale_space.MOST_STEPS):
            if (at < lowest).any() or (at >= highest).any():
                break
            c = layers[tuple(slice(k - 1, k + 2) for k in at)]
            slope = np.array([c[2, 1, 1] - c[0, 1, 1], c[1, 2, 1] - c[1, 0, 1], c[1, 1, 2] - c[1, 1, 0]]) / 2
            curvature = np.array([[_second(c, i, j) for j in range(3)] for i in range(3)])
            step = -np.linalg.solve(curvature, slope)
            if np.abs(step).max() < 0.5:
                value = c[1, 1, 1] + slope @ step / 2
                small, large = np.sort(np.abs(np.linalg.eigvalsh(curvature[1:, 1:])))
                is_corner = np.linalg.det(curvature[1:, 1:]) > 0 and large < scale_space.EDGE_RATIO * small
                if abs(value) * scale_space.NUM_LAYERS >= scale_space.CONTRAST and is_corner:
                    found[tuple(at)] = at + step
                break
            at = at + np.rint(step).astype(int)
    return np.array(list(found.values())).reshape(-1, 3)


def _second(cube, i, j):
    """The second derivative by axes i and j in the middle of a cube (3, 3, 3)."""
    one, other = np.eye(3, dtype=int)[[i, j]]
    at = (lambda step: cube[tuple(1 + step)]) if i != j else None
    if i == j:
        return cube[tuple(1 + one)] + cube[tuple(1 - one)] - 2.0 * cube[1, 1, 1]
    return (at(one + other) - at(one - other) - at(other - one) + at(-one - other)) / 4.0


def gradients_around(image, x, y, reach):
    """Offsets across and down, lengths and angles of the gradients of every second row around a place."""
    height, width = image.shape
    rows = np.arange(
        max(1, int(np.ceil(y - reach))), min(height - 1, int(np.floor(y + reach)) + 1), sift.ROW_STEP
    )
    columns = np.arange(max(1, int(np.ceil(x - reach))), min(width - 1, int(np.floor(x + reach)) + 1))
    i, j = (values.ravel() for values in np.meshgrid(rows, columns, indexing="ij"))
    across = image[i, j + 1] - image[i, j - 1]
    down = image[i + 1, j] - image[i - 1, j]
    return j - x, i - y, np.hypot(across, down), np.arctan2(down, across)


def find_orientations(image, x, y, sigma):
    """The orientations [rad] of a keypoint."""
    reach = round(float(sift.ORIENTATION_REACH) * sigma)
    u, v, length, angle = gradients_around(image, round(x), round(y), reach)
    weight = np.exp(-(u**2 + v**2) / (2.0 * (1.5 * sigma) ** 2)) * length
    number = sift.NUM_DIRECTIONS
    bins = np.rint(angle / math.tau * number).astype(int) % number
    raw = np.bincount(bins, weight, number)
    smooth = sum(w * np.roll(raw, k) for k, w in zip(range(-2, 3), (1, 4, 6, 4, 1), strict=True))
    before = np.roll(smooth, 1)
    after = np.roll(smooth, -1)
    is_peak = (smooth > before) & (smooth > after) & (smooth >= sift.SECOND_PEAK * smooth.max())
    before, own, after = (values[is_peak] for values in (before, smooth, after))
    peaks = np.flatnonzero(is_peak) + (before - after) / (before - 2.0 * own + after) / 2.0
    return math.tau * peaks / number


def describe(image, x, y, sigma, angle):
    """The roots (128,) of the shares of gradients, times 255."""
    width = float(sift.CELL_SIGMAS) * sigma
    u, v, length, angles = gradients_around(image, x, y, np.sqrt(2.0) * float(sift.CELL_REACH) * width)
    axes = np.array([[-np.sin(angle), np.cos(angle)], [np.cos(angle), np.sin(angle)]]) / width
    cells = axes @ [u, v]
    inside = (np.abs(cells) < sift.CELL_REACH).all(axis=0)
    weight = length * np.exp(-(cells**2).sum(axis=0) / 8.0)
    turn = (angles - angle) % math.tau / math.tau * sift.NUM_BINS
    values = np.stack([*(cells + float(sift.CELL_REACH)), turn])[:, inside]
    whole = np.floor(values).astype(int)
    sums = np.zeros((sift.DESCRIPTOR_CELLS + 2, sift.DESCRIPTOR_CELLS + 2, sift.NUM_BINS))
    for corner in itertools.product((0, 1), repeat=3):
        share = np.abs(1 - np.array(corner)[:, None] - (values - whole)).prod(axis=0)
        i, j, k = whole + np.array(corner)[:, None]
        np.add.at(sums, (i, j, k % sift.NUM_BINS), share * weight[inside])
    inner = sums[1:-1, 1:-1].ravel()
    inner = np.minimum(inner, sift.MOST_SHARE * np.linalg.norm(inner))
    return 255.0 * np.sqrt(inner / inner.sum())


def find_sift(picture):
    """x, y, diameter [px] and angle [rad] (N, 4) and descriptors (N, 128) of a picture's keypoints."""
    keypoints = []
    descriptors = []
    for images, scale in make_octaves(picture):
        for layer, y, x in find_extremes(images):
            image = images[round(layer)]
            sigma = scale_space.FIRST_SIGMA * 2.0 ** (layer / scale_space.NUM_LAYERS)
            for angle in find_orientations(image, x, y, sigma):
                keypoints.append((x * scale, y * scale, 2.0 * sigma * scale, angle))
                descriptors.append(describe(image, x, y, sigma, angle))
    return np.array(keypoints), np.array(descriptors)
