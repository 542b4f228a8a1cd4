"""From voxels to cells of the sphere: which voxels, where they fall, what is in front, how colours vary."""

import math

import numpy as np

from ..geometry.sphere import atan2
from ..kernels.jit import F0, F1, HALF, kernel
from ..panorama.local_normalization import inverse_std, opponent

PI = np.float32(math.pi)
FAR = np.float32(1e30)


@kernel
def locate(X, Y, Z, num_columns, first, cells, ranges, turns):
    """Write the cell and the range [m] of each position relative to the centre; `turns` is scratch."""
    num_rings = np.float32(len(num_columns))
    per_pi = np.float32(len(num_columns) / math.pi)
    per_turn = np.float32(0.5 / math.pi)
    # Two loops: the arithmetic is vectorised, the look-ups that follow can't be.
    for i in range(len(cells)):
        x, y, z = X[i], Y[i], Z[i]
        rho2 = x * x + y * y
        ring = (HALF * PI - atan2(z, math.sqrt(rho2))) * per_pi
        cells[i] = np.int32(min(max(ring, F0), num_rings - F1))
        turns[i] = atan2(y, x) * per_turn + HALF
        ranges[i] = math.sqrt(rho2 + z * z)
    for i in range(len(cells)):
        ring = cells[i]
        n = num_columns[ring]
        cells[i] = first[ring] + min(np.int32(turns[i] * np.float32(n)), n - np.int32(1))


@kernel
def average_cells(nodes, found, directions, cells, ranges, front, sums):
    """Write (cells, 8): sums of x, y, z, r, g, b and the count of each cell's front, and its range."""
    sums[:] = F0
    sums[:, 7] = FAR
    for i in range(len(cells)):
        cell = cells[i]
        sums[cell, 7] = min(sums[cell, 7], ranges[i])
    for i in range(len(cells)):
        cell = cells[i]
        if ranges[i] <= sums[cell, 7] * front:
            node = found[i]
            for k in range(3):
                sums[cell, k] += directions[k, i]
                sums[cell, k + 3] += nodes[node, k + 3]
            sums[cell, 6] += F1


@kernel
def average_colors(sums, view, shown, offsets, channels, weights, moments):
    """Write relative positions, opponent channels and weights of the cells shown; add up their moments."""
    moments[:] = F0
    for c in range(len(sums)):
        if shown[c] and sums[c, 6] > F0:
            per = F1 / sums[c, 6]
            for k in range(3):
                offsets[k, c] = sums[c, k] * per
            colors = opponent(sums[c, 3] * per, sums[c, 4] * per, sums[c, 5] * per)
            w = view.solid_angle[c]
            weights[c] = w
            m = moments[view.stats_cell[c]]
            m[0] += w
            for k in range(3):
                channels[k, c] = colors[k]
                m[1 + k] += w * colors[k]
                m[4 + k] += w * colors[k] * colors[k]
        else:
            weights[c] = F0
            for k in range(3):
                offsets[k, c] = F0
                channels[k, c] = F0


@kernel
def local_statistics(moments, view, weights, stats):
    """Write the local means of the channels and 1 / deviations (6, cells) around cells of positive weight.

    Taken at the wider cells that hold the moments, and interpolated between these.
    """
    row, neighbor, weight = view.neighbor_row, view.neighbor_cell, view.neighbor_weight
    coarse, around = np.zeros((view.num_stats, 8), np.float32), np.empty(8, np.float32)
    for c in range(view.num_stats):
        s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = F0
        for j in range(row[c], row[c + 1]):
            w = weight[j]
            m = moments[neighbor[j]]
            s0 += w * m[0]
            s1 += w * m[1]
            s2 += w * m[2]
            s3 += w * m[3]
            s4 += w * m[4]
            s5 += w * m[5]
            s6 += w * m[6]
            s7 += w * m[7]  # always 0: eight sums fill a vector register
        per = F1 / s0 if s0 > F0 else F0
        coarse[c, 0], coarse[c, 1], coarse[c, 2] = s1 * per, s2 * per, s3 * per
        coarse[c, 3] = inverse_std(s1 * per, s4 * per)
        coarse[c, 4] = inverse_std(s2 * per, s5 * per)
        coarse[c, 5] = inverse_std(s3 * per, s6 * per)
    for c in range(len(weights)):
        if weights[c] > F0:
            near, w = view.near_stats[c], view.near_weight[c]
            a, b, d, e = coarse[near[0]], coarse[near[1]], coarse[near[2]], coarse[near[3]]
            for k in range(8):  # two of them 0, as above; and stored apart, or each is read for itself
                around[k] = w[0] * a[k] + w[1] * b[k] + w[2] * d[k] + w[3] * e[k]
            for k in range(6):
                stats[k, c] = around[k]
