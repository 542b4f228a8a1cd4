"""Levenberg-Marquardt on image channels at projected points: the whole descent of one start is one kernel."""

import math

import numpy as np

from ..geometry.sphere import atan2
from ..panorama.channels import ZERO_LEVEL
from ..panorama.texels import bilinear_weights, blend
from ..runtime.jit import F0, HALF, kernel
from .normal_equations import normal_equations, solve_damped

MAX_TURN = 0.15  # [rad] a step
MAX_MOVE = 0.3  # [m] a step


@kernel
def take_step(R_cam_from_world, center_world, step, R_new, t_new):
    """Write R <- exp([w]x) R and t <- t + R^T d, the step limited in length."""
    R, t = R_cam_from_world, center_world
    turn = math.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
    move = math.sqrt(step[3] ** 2 + step[4] ** 2 + step[5] ** 2)
    limit = min(1.0, MAX_TURN / max(turn, 1e-30), MAX_MOVE / max(move, 1e-30))
    angle = turn * limit
    wx, wy, wz = step[0] * limit, step[1] * limit, step[2] * limit
    a = 1.0 - angle * angle / 6.0 + angle**4 / 120.0
    b = 0.5 - angle * angle / 24.0 + angle**4 / 720.0
    E = np.empty((3, 3))
    E[0, 0] = 1.0 - b * (wy * wy + wz * wz)
    E[1, 1] = 1.0 - b * (wx * wx + wz * wz)
    E[2, 2] = 1.0 - b * (wx * wx + wy * wy)
    E[0, 1], E[1, 0] = b * wx * wy - a * wz, b * wx * wy + a * wz
    E[0, 2], E[2, 0] = b * wx * wz + a * wy, b * wx * wz - a * wy
    E[1, 2], E[2, 1] = b * wy * wz - a * wx, b * wy * wz + a * wx
    for i in range(3):
        t_new[i] = t[i] + limit * (R[0, i] * step[3] + R[1, i] * step[4] + R[2, i] * step[5])
        for j in range(3):
            R_new[i, j] = E[i, 0] * R[0, j] + E[i, 1] * R[1, j] + E[i, 2] * R[2, j]
    return angle + move * limit


@kernel
def descend(
    points, features, weights, texels, width, scale, num_iterations, tolerance, R_cam_from_world, center_world
):
    """Levenberg-Marquardt from (R, t), which end at the best pose found. Returns the loss there."""
    R, t = R_cam_from_world, center_world
    sums, new_sums, step = np.empty(28), np.empty(28), np.empty(6)
    R_new, t_new = np.empty((3, 3)), np.empty(3)
    damping = 1e-3
    normal_equations(points, features, weights, texels, width, R, t, scale, sums)
    for _ in range(num_iterations):
        if not solve_damped(sums, damping, step):
            break
        length = take_step(R, t, step, R_new, t_new)
        normal_equations(points, features, weights, texels, width, R_new, t_new, scale, new_sums)
        if new_sums[27] < sums[27]:
            R[:], t[:] = R_new, t_new
            sums[:] = new_sums
            damping = max(damping * 0.2, 1e-5)
        else:
            damping = damping * 8.0
        if length < tolerance or damping > 1e4:
            break
    return sums[27]


@kernel
def correlate(points, features, weights, texels, width, R_cam_from_world, center_world):
    """Correlation of the points' channels with the image's at the pose, and the weight of what both show."""
    R, t = R_cam_from_world, center_world
    stride = np.int32(width + 2)
    scale = np.float32(width / (2.0 * math.pi))
    half_u, half_v = HALF * np.float32(width + 1), HALF * np.float32(width // 2 + 1)
    product = points_energy = image_energy = shared = 0.0
    for n in range(len(weights)):
        dx, dy, dz = points[0, n] - t[0], points[1, n] - t[1], points[2, n] - t[2]
        x = np.float32(R[0, 0] * dx + R[0, 1] * dy + R[0, 2] * dz)
        y = np.float32(R[1, 0] * dx + R[1, 1] * dy + R[1, 2] * dz)
        z = np.float32(R[2, 0] * dx + R[2, 1] * dy + R[2, 2] * dz)
        u = half_u - scale * atan2(y, x)
        v = half_v - scale * atan2(z, math.sqrt(x * x + y * y))
        j, i = np.int32(u), np.int32(v)
        bilinear = bilinear_weights(u - np.float32(j), v - np.float32(i))
        k = i * stride + j
        t00, t10, t01, t11 = texels[k], texels[k + 1], texels[k + stride], texels[k + stride + 1]
        w = weights[n] * np.float32(((t00 & t10 & t01 & t11) >> 24) & 1)
        shared += w
        for c in range(3):
            value = blend(t00, t10, t01, t11, bilinear, 8 * c) - np.float32(ZERO_LEVEL)
            feature = features[c, n] - np.float32(ZERO_LEVEL)
            product += w * value * feature
            points_energy += w * feature * feature
            image_energy += w * value * value
    return product / math.sqrt(max(points_energy * image_energy, 1e-12)), shared


@kernel
def descend_starts(
    offsets,
    unit,
    features,
    is_seen,
    solid_angle,
    centers,
    texels,
    width,
    scale,
    num_iterations,
    candidate,
    R_cam_from_world,
    center_world,
    scores,
):
    """Descend from each start, (n, 3, 3) and (n, 3) in place, on the cells of its candidate's view."""
    R, t = R_cam_from_world, center_world
    n = len(solid_angle)
    points, levels = np.empty((3, n), np.float32), np.empty((3, n), np.float32)
    weights = np.empty(n, np.float32)
    for k in range(len(candidate)):
        c = candidate[k]
        for i in range(3):
            for j in range(n):
                points[i, j] = np.float32(offsets[c, i, j]) * unit[c]
                levels[i, j] = np.float32(features[c, i, j]) + np.float32(ZERO_LEVEL)
        for j in range(n):
            weights[j] = solid_angle[j] if is_seen[c, j] else F0
        for i in range(3):
            t[k, i] -= centers[c, i]
        descend(points, levels, weights, texels, width, scale, num_iterations, 2e-3, R[k], t[k])
        score, shared = correlate(points, levels, weights, texels, width, R[k], t[k])
        scores[k] = score * math.sqrt(shared)
        for i in range(3):
            t[k, i] += centers[c, i]


@kernel
def descend_shaken(
    points,
    levels,
    weights,
    wide,
    wide_width,
    texels,
    width,
    scale,
    steps,
    R_cam_from_world,
    center_world,
    scores,
):
    """Descend from each step (n, 6) away from (n, 3, 3), (n, 3): on the wide image, then on the other."""
    R, t = R_cam_from_world, center_world
    for k in range(len(steps)):
        take_step(R[k].copy(), t[k].copy(), steps[k], R[k], t[k])
        if k > 0:
            descend(points, levels, weights, wide, wide_width, scale, 6, 1e-3, R[k], t[k])
        descend(points, levels, weights, texels, width, scale, 8, 1e-3, R[k], t[k])
        score, shared = correlate(points, levels, weights, texels, width, R[k], t[k])
        scores[k] = score * math.sqrt(shared)
