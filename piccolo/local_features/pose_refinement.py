"""The pose at which the bearings of many matches agree best, by Levenberg-Marquardt."""

import math

from ..geometry.vectors import dot, minus, rotate, row
from ..kernels.jit import kernel
from ..optimize.channel_loss import geman_mcclure
from ..optimize.levenberg_marquardt import levenberg_marquardt
from ..optimize.normal_equations import COUNT, GRADIENT, LOSS, MATRIX


@kernel
def angular_equations(problem, R_cam_from_map, center_map, sums):
    """Write the sums (29,) of normal_equations for bearings (N, 3), points (N, 3) [m], scale [rad].

    The scale is that of Geman and McClure's loss: what is off by much more hardly counts.
    The residual is u - b, with u the unit ray to the point and b the bearing. At distance r,
    du = w x u - (I - u u^T) d / r: its rows add up to products of u and b: no Jacobian is stored.
    """
    bearings, points, scale = problem
    inverse_scale2 = 1.0 / (scale * scale)
    sums[:] = 0.0
    for n in range(len(points)):
        offset = minus(row(points, n), center_map)
        inverse = 1.0 / max(math.sqrt(dot(offset, offset)), 1e-9)
        x, y, z = rotate(R_cam_from_map, offset)
        x *= inverse
        y *= inverse
        z *= inverse
        bx, by, bz = row(bearings, n)
        square = (x - bx) ** 2 + (y - by) ** 2 + (z - bz) ** 2
        loss, w = geman_mcclure(square, inverse_scale2)
        sums[LOSS] += loss
        sums[COUNT] += 1.0
        v = w * inverse
        along = x * bx + y * by + z * bz
        gradient = (
            w * (z * by - y * bz), w * (x * bz - z * bx), w * (y * bx - x * by),
            v * (bx - along * x), v * (by - along * y), v * (bz - along * z),
        )  # fmt: skip
        q = v * inverse
        matrix = (
            w * (1.0 - x * x), -w * x * y, -w * x * z, 0.0, v * z, -v * y,
            w * (1.0 - y * y), -w * y * z, -v * z, 0.0, v * x,
            w * (1.0 - z * z), v * y, -v * x, 0.0,
            q * (1.0 - x * x), -q * x * y, -q * x * z, q * (1.0 - y * y), -q * y * z, q * (1.0 - z * z),
        )  # fmt: skip
        for m in range(6):
            sums[GRADIENT + m] += gradient[m]
        for m in range(21):
            sums[MATRIX + m] += matrix[m]


descend_matches = kernel(levenberg_marquardt(angular_equations))
