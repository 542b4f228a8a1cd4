"""Normal equations of image channels at projected points, and their damped solution."""

import math

import numpy as np

from ..geometry.sphere import atan2
from ..panorama.texels import blend_with_gradient
from ..runtime.jit import F0, F1, HALF, kernel

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
