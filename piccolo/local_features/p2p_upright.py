"""Poses of a camera from two matches, where the vertical is known."""

import math

from ..runtime.jit import kernel

LEAST_SINE2 = (
    1e-10  # of an angle to the vertical, the horizon or each other, below which a case is degenerate
)


@kernel
def p2p_upright(bearings, points, yaws, centers):
    """Write the poses that see two points, R_level_from_map (2, 3, 3), centers (2, 3) [m]; returns how many.

    Bearings (2, 3) are in a level frame, which is the map's but for a turn about z: R_cam_from_map is
    R_cam_from_level R_level_from_map. Points (2, 3) [m] are a row each. One above the other leaves the yaw
    open, two at the camera's own height leave the distances open: neither has a pose (Kukelova, Bujnak and
    Pajdla, "Closed-Form Solutions to Minimal Absolute Pose Problems with Known Vertical Direction", ACCV
    2010; here in the distances).
    """
    a, b = bearings[0], bearings[1]
    ex, ey, ez = points[0, 0] - points[1, 0], points[0, 1] - points[1, 1], points[0, 2] - points[1, 2]
    level2, slope2 = ex * ex + ey * ey, a[2] * a[2] + b[2] * b[2]
    if not (level2 > LEAST_SINE2 * ez * ez and slope2 > LEAST_SINE2):
        return 0
    # d a - e b is ez high and sqrt(level2) across: d = f a_z + s b_z, e = s a_z - f b_z, with f = ez / slope2
    f = ez / slope2
    hx, hy = f * (a[2] * a[0] + b[2] * b[0]), f * (a[2] * a[1] + b[2] * b[1])
    kx, ky = b[2] * a[0] - a[2] * b[0], b[2] * a[1] - a[2] * b[1]
    k2, half = kx * kx + ky * ky, hx * kx + hy * ky
    discriminant = half * half - k2 * (hx * hx + hy * hy - level2)
    if not (k2 > LEAST_SINE2 * slope2 and discriminant >= 0.0):
        return 0
    count = 0
    for n in range(2):
        s = (-half + (1.0 - 2.0 * n) * math.sqrt(discriminant)) / k2
        d, e = f * a[2] + s * b[2], s * a[2] - f * b[2]
        if not (d > 0.0 and e > 0.0) or (n == 1 and discriminant == 0.0):
            continue
        x, y, R = hx + s * kx, hy + s * ky, yaws[count]
        cosine, sine = (x * ex + y * ey) / level2, (y * ex - x * ey) / level2
        R[:] = 0.0
        R[0, 0], R[0, 1], R[1, 0], R[1, 1], R[2, 2] = cosine, -sine, sine, cosine, 1.0
        for i in range(3):
            back = R[0, i] * (d * a[0] + e * b[0]) + R[1, i] * (d * a[1] + e * b[1])
            back += R[2, i] * (d * a[2] + e * b[2])
            centers[count, i] = 0.5 * (points[0, i] + points[1, i] - back)
        count += 1
    return count
