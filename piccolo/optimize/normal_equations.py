"""The normal equations of image residuals at projected points, for any robust loss of a residual's length.

A step (w, d), rotation [rad] then translation [m], acts as R <- exp([w]x) R and t <- t + R^T d, so that with
p = R (x - t): dp = w x p - d. A scalar image of gradient g = dI/dp has the row [p x g, -g]. With Ju, Jv (6,)
the derivatives of the pixel (u, v) by the step, and G (2, 2) the weighted sum over channels of the outer
products of the image gradients, a point adds [Ju Jv] G [Ju Jv]^T to the matrix: no row is ever stored.
"""

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from ..geometry.levenberg_marquardt import NUM_SUMS
from ..geometry.sphere import pixel_jacobian
from ..photo.panorama.texels import TEXEL_CHUNK, Projected, blend_with_gradient, is_valid, make_chunk, project
from ..system.arrays import Array, Array32, Int32s
from ..system.kernels.jit import F0, Scalar, inline_kernel, kernel

Colors = TypeVar("Colors")
Coordinates = tuple[Array32, Array32, Array32]  # x, y, z (N,)
Adder = Callable[[Coordinates, Colors, Int32s, int, Array, Array, Scalar, Array], None]


def block_adder(
    read_point: Callable[[Colors, np.uintp], tuple[Scalar, Scalar, Scalar, Scalar]],
    robust: Callable[[Scalar, Scalar], tuple[Scalar, Scalar]],
) -> Adder[Colors]:
    """Make a kernel that adds points to the sums (29,) of the normal equations, in float32 within chunks.

    read_point(colors, i) returns three channels [8-bit levels] and a weight. robust(square, scale) takes the
    squared length of a residual and returns its loss and its weight, the derivative of the loss by half the
    square. The kernel takes coordinates, colours, texels and width of the image, rotation and centre of the
    pose, the scale of `robust`, and the sums.
    """

    @inline_kernel
    def add_chunk(
        points: Projected, count: int, colors: Colors, first: int, width: Scalar, scale: Scalar, sums: Array
    ) -> None:
        a00 = a01 = a02 = a03 = a04 = a05 = a11 = a12 = a13 = a14 = a15 = a22 = a23 = a24 = a25 = F0
        a33 = a34 = a35 = a44 = a45 = a55 = g0 = g1 = g2 = g3 = g4 = g5 = total = loaded = F0
        for n in range(count):
            x = points.x[n]
            y = points.y[n]
            z = points.z[n]
            fu = points.fu[n]
            fv = points.fv[n]
            t00, t10, t01, t11 = points.t00[n], points.t10[n], points.t01[n], points.t11[n]
            rho2 = x * x + y * y
            c0, c1, c2, weight = read_point(colors, np.uintp(first + n))
            weight *= is_valid(t00, t10, t01, t11)
            e0, u0, v0 = blend_with_gradient(t00, t10, t01, t11, fu, fv, 0)
            e1, u1, v1 = blend_with_gradient(t00, t10, t01, t11, fu, fv, 8)
            e2, u2, v2 = blend_with_gradient(t00, t10, t01, t11, fu, fv, 16)
            e0 -= c0
            e1 -= c1
            e2 -= c2
            loss, w = robust(e0 * e0 + e1 * e1 + e2 * e2, scale)
            total += weight * loss
            loaded += weight
            w *= weight
            guu = w * (u0 * u0 + u1 * u1 + u2 * u2)
            guv = w * (u0 * v0 + u1 * v1 + u2 * v2)
            gvv = w * (v0 * v0 + v1 * v1 + v2 * v2)
            bu = w * (u0 * e0 + u1 * e1 + u2 * e2)
            bv = w * (v0 * e0 + v1 * e1 + v2 * e2)
            ux, uy, vx, vy, vz = pixel_jacobian(x, y, z, rho2, width)
            # Rows [p x g, -g] of u and of v; du/dz is 0, and no turn about z moves v.
            p0 = -z * uy
            p1 = z * ux
            p2 = x * uy - y * ux
            p3 = -ux
            p4 = -uy
            q0 = y * vz - z * vy
            q1 = z * vx - x * vz
            q3 = -vx
            q4 = -vy
            q5 = -vz
            l0 = guu * p0 + guv * q0
            l1 = guu * p1 + guv * q1
            l2 = guu * p2
            l3 = guu * p3 + guv * q3
            l4 = guu * p4 + guv * q4
            l5 = guv * q5
            m0 = guv * p0 + gvv * q0
            m1 = guv * p1 + gvv * q1
            m2 = guv * p2
            m3 = guv * p3 + gvv * q3
            m4 = guv * p4 + gvv * q4
            m5 = gvv * q5
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
            total, loaded, g0, g1, g2, g3, g4, g5, a00, a01, a02, a03, a04, a05, a11, a12, a13, a14, a15,
            a22, a23, a24, a25, a33, a34, a35, a44, a45, a55,
        )  # fmt: skip
        for m in range(NUM_SUMS):
            sums[m] += block[m]

    @kernel
    def add_points(
        xyz: Coordinates,
        colors: Colors,
        texels: Int32s,
        width: int,
        R_cam_from_world: Array,
        center_world: Array,
        scale: Scalar,
        sums: Array,
    ) -> None:
        points = make_chunk()
        X, Y, Z = xyz
        for lo in range(0, len(X), TEXEL_CHUNK):
            hi = min(lo + TEXEL_CHUNK, len(X))
            project(X[lo:hi], Y[lo:hi], Z[lo:hi], R_cam_from_world, center_world, texels, width, points)
            add_chunk(points, hi - lo, colors, lo, np.float32(width), scale, sums)

    return add_points
