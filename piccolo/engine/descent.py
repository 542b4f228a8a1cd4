"""Gauss-Newton on image channels at projected points: the whole descent of one start is one kernel."""

import math

import numpy as np

from ..jit import F0, F1, HALF, kernel
from ..sampling import bilinear_weights, blend, blend_with_gradient
from ..sphere import atan2
from .channels import ZERO_LEVEL

MAX_TURN = 0.15  # [rad] a step
MAX_MOVE = 0.3  # [m] a step
BLOCK = 512  # float32 sums within a block, float64 over blocks
TINY = np.float32(1e-12)


@kernel
def add_block(X, Y, Z, A, B, C, weights, texels, width, R_cam_from_world, center_world, inverse_scale2, sums):
    """Add to `sums` (28,) the normal matrix (21, upper), gradient (6) and loss (1) of a block of points.

    With Ju, Jv the derivatives (6,) of the pixel by a turn and a move, and G the sum over channels of the
    outer products of the image gradient, the matrix is the sum of w [Ju Jv] G [Ju Jv]^T.
    """
    R, t = R_cam_from_world, center_world
    stride = np.int32(width + 2)
    scale = np.float32(width / (2.0 * math.pi))
    half_u, half_v = HALF * np.float32(width + 1), HALF * np.float32(width // 2 + 1)
    r00, r01, r02 = np.float32(R[0, 0]), np.float32(R[0, 1]), np.float32(R[0, 2])
    r10, r11, r12 = np.float32(R[1, 0]), np.float32(R[1, 1]), np.float32(R[1, 2])
    r20, r21, r22 = np.float32(R[2, 0]), np.float32(R[2, 1]), np.float32(R[2, 2])
    tx, ty, tz = np.float32(t[0]), np.float32(t[1]), np.float32(t[2])
    right, below, below_right = texels[1:], texels[stride:], texels[stride + 1 :]
    a00 = a01 = a02 = a03 = a04 = a05 = a11 = a12 = a13 = a14 = a15 = a22 = a23 = a24 = a25 = F0
    a33 = a34 = a35 = a44 = a45 = a55 = g0 = g1 = g2 = g3 = g4 = g5 = loss = F0
    for n in range(len(weights)):
        dx, dy, dz = X[n] - tx, Y[n] - ty, Z[n] - tz
        x = r00 * dx + r01 * dy + r02 * dz
        y = r10 * dx + r11 * dy + r12 * dz
        z = r20 * dx + r21 * dy + r22 * dz
        rho2 = max(x * x + y * y, TINY)
        rho = math.sqrt(rho2)
        u = half_u - scale * atan2(y, x)
        v = half_v - scale * atan2(z, rho)
        j, i = np.int32(u), np.int32(v)
        fu, fv = u - np.float32(j), v - np.float32(i)
        k = np.uintp(np.int32(i * stride + j))  # see loss.py
        t00, t10, t01, t11 = texels[k], right[k], below[k], below_right[k]
        validity = np.float32(((t00 & t10 & t01 & t11) >> 24) & 1)
        c0, u0, v0 = blend_with_gradient(t00, t10, t01, t11, fu, fv, 0)
        c1, u1, v1 = blend_with_gradient(t00, t10, t01, t11, fu, fv, 8)
        c2, u2, v2 = blend_with_gradient(t00, t10, t01, t11, fu, fv, 16)
        e0, e1, e2 = c0 - A[n], c1 - B[n], c2 - C[n]
        square = e0 * e0 + e1 * e1 + e2 * e2
        s = F1 / (F1 + square * inverse_scale2)
        loss += weights[n] * (validity * square * s + (F1 - validity) * HALF / inverse_scale2)
        w = weights[n] * s * s * validity
        guu, guv, gvv = (
            w * (u0 * u0 + u1 * u1 + u2 * u2),
            w * (u0 * v0 + u1 * v1 + u2 * v2),
            w * (v0 * v0 + v1 * v1 + v2 * v2),
        )
        bu, bv = w * (u0 * e0 + u1 * e1 + u2 * e2), w * (v0 * e0 + v1 * e1 + v2 * e2)
        per, per_v = scale / rho2, scale / (rho * (rho2 + z * z))
        ju3, ju4 = -y * per, x * per
        jv3, jv4, jv5 = -x * z * per_v, -y * z * per_v, rho2 * per_v
        ju0, ju1, ju2 = z * ju4, -z * ju3, y * ju3 - x * ju4
        jv0, jv1 = z * jv4 - y * jv5, x * jv5 - z * jv3
        l0, l1, l2, l3, l4 = (
            guu * ju0 + guv * jv0,
            guu * ju1 + guv * jv1,
            guu * ju2,
            guu * ju3 + guv * jv3,
            guu * ju4 + guv * jv4,
        )
        l5, m5 = guv * jv5, gvv * jv5
        m0, m1, m2, m3, m4 = (
            guv * ju0 + gvv * jv0,
            guv * ju1 + gvv * jv1,
            guv * ju2,
            guv * ju3 + gvv * jv3,
            guv * ju4 + gvv * jv4,
        )
        a00 += ju0 * l0 + jv0 * m0
        a01 += ju0 * l1 + jv0 * m1
        a02 += ju0 * l2 + jv0 * m2
        a03 += ju0 * l3 + jv0 * m3
        a04 += ju0 * l4 + jv0 * m4
        a05 += ju0 * l5 + jv0 * m5
        a11 += ju1 * l1 + jv1 * m1
        a12 += ju1 * l2 + jv1 * m2
        a13 += ju1 * l3 + jv1 * m3
        a14 += ju1 * l4 + jv1 * m4
        a15 += ju1 * l5 + jv1 * m5
        a22 += ju2 * l2
        a23 += ju2 * l3
        a24 += ju2 * l4
        a25 += ju2 * l5
        a33 += ju3 * l3 + jv3 * m3
        a34 += ju3 * l4 + jv3 * m4
        a35 += ju3 * l5 + jv3 * m5
        a44 += ju4 * l4 + jv4 * m4
        a45 += ju4 * l5 + jv4 * m5
        a55 += jv5 * m5
        g0 += ju0 * bu + jv0 * bv
        g1 += ju1 * bu + jv1 * bv
        g2 += ju2 * bu
        g3 += ju3 * bu + jv3 * bv
        g4 += ju4 * bu + jv4 * bv
        g5 += jv5 * bv
    block = (
        a00,
        a01,
        a02,
        a03,
        a04,
        a05,
        a11,
        a12,
        a13,
        a14,
        a15,
        a22,
        a23,
        a24,
        a25,
        a33,
        a34,
        a35,
        a44,
        a45,
        a55,
        g0,
        g1,
        g2,
        g3,
        g4,
        g5,
        loss,
    )
    for m in range(28):
        sums[m] += block[m]


@kernel
def normal_equations(points, features, weights, texels, width, R_cam_from_world, center_world, scale, sums):
    """Write the sums (28,) of `add_block` over all points; `scale` is that of the Geman-McClure loss."""
    R, t = R_cam_from_world, center_world
    sums[:] = 0.0
    inverse_scale2 = np.float32(1.0 / (scale * scale))
    for lo in range(0, len(weights), BLOCK):
        hi = min(lo + BLOCK, len(weights))
        add_block(
            points[0][lo:hi], points[1][lo:hi], points[2][lo:hi], features[0][lo:hi], features[1][lo:hi],
            features[2][lo:hi], weights[lo:hi], texels, width, R, t, inverse_scale2, sums,
        )  # fmt: skip


@kernel
def solve_damped(sums, damping, step):  # noqa: C901, PLR0912  # Cholesky by hand: LAPACK costs more for 6 x 6
    """Write the damped Gauss-Newton step (6,), by Cholesky; False if the matrix is not positive."""
    A = np.empty((6, 6))
    m = 0
    for a in range(6):
        for b in range(a, 6):
            A[a, b] = A[b, a] = sums[m]
            m += 1
    for a in range(6):
        A[a, a] += damping * A[a, a] + 1e-9
        step[a] = -sums[21 + a]
    for a in range(6):
        for b in range(a):
            A[a, a] -= A[a, b] * A[a, b]
        if A[a, a] <= 0.0:
            return False
        A[a, a] = math.sqrt(A[a, a])
        for c in range(a + 1, 6):
            for b in range(a):
                A[c, a] -= A[c, b] * A[a, b]
            A[c, a] /= A[a, a]
    for a in range(6):
        for b in range(a):
            step[a] -= A[a, b] * step[b]
        step[a] /= A[a, a]
    for k in range(6):
        a = 5 - k
        for b in range(a + 1, 6):
            step[a] -= A[b, a] * step[b]
        step[a] /= A[a, a]
    return True


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
