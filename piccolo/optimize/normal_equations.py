"""The normal equations of image residuals at projected points, for any robust loss of a residual's length.

A step (w, d), rotation [rad] then translation [m], acts as R <- exp([w]x) R and t <- t + R^T d, so that with
p = R (x - t): dp = w x p - d. A scalar image of gradient g = dI/dp has the row [p x g, -g]. With Ju, Jv (6,)
the derivatives of the pixel (u, v) by the step, and G (2, 2) the weighted sum over channels of the outer
products of the image gradients, a point adds [Ju Jv] G [Ju Jv]^T to the matrix: no row is ever stored.
"""

import math
from typing import Any

import numpy as np

from ..geometry.sphere import pixel_jacobian
from ..panorama.texels import blend_with_gradient, is_valid, texel_at
from ..runtime.jit import F0, inline_kernel, kernel

NUM_SUMS = 29  # loss, count, gradient (6), upper triangle of the normal matrix (21)
LOSS, COUNT, GRADIENT, MATRIX = 0, 1, 2, 8  # where they begin


@inline_kernel
def rotation_float32(R):
    """The nine entries of a rotation (3, 3)."""
    f = np.float32
    return (
        f(R[0, 0]), f(R[0, 1]), f(R[0, 2]),
        f(R[1, 0]), f(R[1, 1]), f(R[1, 2]),
        f(R[2, 0]), f(R[2, 1]), f(R[2, 2]),
    )  # fmt: skip


def block_adder(read_point: Any, robust: Any) -> Any:
    """A kernel that adds a block of points to the sums (29,) of the normal equations.

    read_point(colors, i) gives three channels [8-bit levels] and a weight; robust(square, scale) gives, for a
    residual's squared length, its loss and its weight, which is the loss' derivative by half the square.
    """

    @kernel
    def add_block(X, Y, Z, colors, texels, width, R_cam_from_world, center_world, scale, sums):
        r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation_float32(R_cam_from_world)
        t = center_world
        tx, ty, tz = np.float32(t[0]), np.float32(t[1]), np.float32(t[2])
        # An unsigned index needs no test for being negative; four bases and one 32-bit index gather fastest.
        stride, W = np.int32(width + 2), np.float32(width)
        right, below, below_right = texels[1:], texels[stride:], texels[stride + 1 :]
        a00 = a01 = a02 = a03 = a04 = a05 = a11 = a12 = a13 = a14 = a15 = a22 = a23 = a24 = a25 = F0
        a33 = a34 = a35 = a44 = a45 = a55 = g0 = g1 = g2 = g3 = g4 = g5 = total = count = F0
        for n in range(len(X)):
            dx, dy, dz = X[n] - tx, Y[n] - ty, Z[n] - tz
            x = r00 * dx + r01 * dy + r02 * dz
            y = r10 * dx + r11 * dy + r12 * dz
            z = r20 * dx + r21 * dy + r22 * dz
            rho2 = x * x + y * y
            at, fu, fv = texel_at(x, y, z, math.sqrt(rho2), width)
            k = np.uintp(at)
            t00, t10, t01, t11 = texels[k], right[k], below[k], below_right[k]
            c0, c1, c2, weight = read_point(colors, n)
            weight *= is_valid(t00, t10, t01, t11)
            e0, u0, v0 = blend_with_gradient(t00, t10, t01, t11, fu, fv, 0)
            e1, u1, v1 = blend_with_gradient(t00, t10, t01, t11, fu, fv, 8)
            e2, u2, v2 = blend_with_gradient(t00, t10, t01, t11, fu, fv, 16)
            e0, e1, e2 = e0 - c0, e1 - c1, e2 - c2
            loss, w = robust(e0 * e0 + e1 * e1 + e2 * e2, scale)
            total += weight * loss
            count += weight
            w *= weight
            guu = w * (u0 * u0 + u1 * u1 + u2 * u2)
            guv = w * (u0 * v0 + u1 * v1 + u2 * v2)
            gvv = w * (v0 * v0 + v1 * v1 + v2 * v2)
            bu, bv = w * (u0 * e0 + u1 * e1 + u2 * e2), w * (v0 * e0 + v1 * e1 + v2 * e2)
            ux, uy, vx, vy, vz = pixel_jacobian(x, y, z, rho2, W)
            # Rows [p x g, -g] of u and of v; du/dz is 0, and no turn about z moves v.
            p0, p1, p2, p3, p4 = -z * uy, z * ux, x * uy - y * ux, -ux, -uy
            q0, q1, q3, q4, q5 = y * vz - z * vy, z * vx - x * vz, -vx, -vy, -vz
            l0, m0 = guu * p0 + guv * q0, guv * p0 + gvv * q0
            l1, m1 = guu * p1 + guv * q1, guv * p1 + gvv * q1
            l2, m2 = guu * p2, guv * p2
            l3, m3 = guu * p3 + guv * q3, guv * p3 + gvv * q3
            l4, m4 = guu * p4 + guv * q4, guv * p4 + gvv * q4
            l5, m5 = guv * q5, gvv * q5
            a00 += p0 * l0 + q0 * m0
            a01 += p0 * l1 + q0 * m1
            a02 += p0 * l2 + q0 * m2
            a03 += p0 * l3 + q0 * m3
            a04 += p0 * l4 + q0 * m4
            a05 += p0 * l5 + q0 * m5
            a11 += p1 * l1 + q1 * m1
            a12 += p1 * l2 + q1 * m2
            a13 += p1 * l3 + q1 * m3
            a14 += p1 * l4 + q1 * m4
            a15 += p1 * l5 + q1 * m5
            a22 += p2 * l2
            a23 += p2 * l3
            a24 += p2 * l4
            a25 += p2 * l5
            a33 += p3 * l3 + q3 * m3
            a34 += p3 * l4 + q3 * m4
            a35 += p3 * l5 + q3 * m5
            a44 += p4 * l4 + q4 * m4
            a45 += p4 * l5 + q4 * m5
            a55 += q5 * m5
            g0 += p0 * bu + q0 * bv
            g1 += p1 * bu + q1 * bv
            g2 += p2 * bu
            g3 += p3 * bu + q3 * bv
            g4 += p4 * bu + q4 * bv
            g5 += q5 * bv
        block = (
            total, count, g0, g1, g2, g3, g4, g5, a00, a01, a02, a03, a04, a05, a11, a12, a13, a14, a15,
            a22, a23, a24, a25, a33, a34, a35, a44, a45, a55,
        )  # fmt: skip
        for m in range(NUM_SUMS):
            sums[m] += block[m]

    return add_block
