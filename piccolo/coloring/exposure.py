"""Gains of photos, by which their exposures and white balances agree where they see the same points."""

import numpy as np

from ..arrays import Array, Array32, Int64s

DARKEST = 8.0  # [8-bit levels] darker and brighter colours say nothing of gains
BRIGHTEST = 247.0
SCALE = 0.2  # of the logarithm of a ratio, beyond which it counts little: the photos show different things
NUM_ROUNDS = 4


def balance(point: Int64s, photo: Int64s, values: Array32, num_photos: int) -> Array32:
    """Return the gains (photos, 3) by which the colours of photos are multiplied to be alike.

    `values` (S, 3) are what `photo` (S,) shows at `point` (S,), sorted by points. The logarithms of gains are
    found by robust least squares on those of ratios, their mean is 0.
    """
    is_plain = np.asarray(np.all((values > DARKEST) & (values < BRIGHTEST), axis=1))  # not NaN either
    logs = np.log(np.where(is_plain[:, None], values, 1.0).astype(np.float64))
    pairs = [np.empty((0, 2), np.int64)]
    for apart in range(1, num_photos):
        a = np.arange(len(point) - apart)
        a = a[point[a] == point[a + apart]]
        if not len(a):
            break
        pairs.append(np.stack([a, a + apart], axis=1)[is_plain[a] & is_plain[a + apart]])
    a, b = np.concatenate(pairs).T
    i, j = photo[a], photo[b]
    ratios = logs[b] - logs[a]
    gains = np.zeros((num_photos, 3))
    for _ in range(NUM_ROUNDS):
        errors = ratios - (gains[i] - gains[j])
        weights = 1.0 / (1.0 + (errors**2).sum(axis=1) / SCALE**2) ** 2
        gains = solve(i, j, ratios * weights[:, None], weights, num_photos)
    return np.exp(gains).astype(np.float32)


def solve(i: Int64s, j: Int64s, loads: Array, weights: Array, count: int) -> Array:
    """Return x (count, 3) of least squares weights (P,) on x[i] - x[j] = loads / weights (P, 3), mean 0."""
    cross = np.bincount(i * count + j, weights, count * count).reshape(count, count)
    cross = cross + cross.T
    matrix = np.diag(cross.sum(axis=1) + 1.0) - cross  # one observation that a photo is like others
    right = [np.bincount(i, load, count) - np.bincount(j, load, count) for load in loads.T]
    found = np.linalg.solve(matrix, np.stack(right, axis=1))
    return np.asarray(found - found.mean(axis=0))
