"""Poses of a camera from three matches.

A bearing is a unit ray in the camera's frame, anywhere on the sphere; a point is at a positive distance along
it. With distances d and unknown pose, sides of the triangle give d_i^2 + d_j^2 - 2 c_ij d_i d_j = a_ij.
"""

import math

import numpy as np

from ..kernels.jit import inline_kernel, kernel

LEAST_SINE2 = 1e-10  # of the angles of the triangle of points: below, they lie on a line
LEAST_GAP = 5e-13  # 1 - cosine of two bearings: below a microradian they are the same
ROUNDING = 1e-9  # by which the sides of a solution may miss, relative
POLISHING = 4  # Newton steps on the distances


@inline_kernel
def difference(rows, i, j):
    """Row i less row j of an array (3, 3)."""
    return rows[i, 0] - rows[j, 0], rows[i, 1] - rows[j, 1], rows[i, 2] - rows[j, 2]


@inline_kernel
def dot(a, b):
    """The product of two vectors (3,)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inline_kernel
def cross(a, b):
    """The cross product of two vectors (3,)."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inline_kernel
def axes_of(a, b):
    """Three axes: along the vector a (3,), across it on b's side, and along the cross product."""
    normal = cross(a, b)
    across = cross(normal, a)
    u, v, w = (
        1.0 / math.sqrt(dot(a, a)),
        1.0 / math.sqrt(dot(across, across)),
        1.0 / math.sqrt(dot(normal, normal)),
    )
    return (
        (u * a[0], u * a[1], u * a[2]),
        (v * across[0], v * across[1], v * across[2]),
        (w * normal[0], w * normal[1], w * normal[2]),
    )


@inline_kernel
def simple_cubic_root(b, c, d):
    """A real root of x^3 + b x^2 + c x + d that is outside the extrema: Newton comes to it from outside."""
    square = b * b - 3.0 * c
    x = -b / 3.0
    if square > 0.0:
        extremum = (-b - math.sqrt(square)) / 3.0
        value = ((extremum + b) * extremum + c) * extremum + d
        if value > 0.0:  # left of the maximum
            x = extremum - math.sqrt(-value / (3.0 * extremum + b))
        else:
            extremum = (-b + math.sqrt(square)) / 3.0
            value = ((extremum + b) * extremum + c) * extremum + d
            x = extremum + math.sqrt(max(-value, 0.0) / (3.0 * extremum + b))
    for _ in range(60):
        slope = (3.0 * x + 2.0 * b) * x + c
        change = (((x + b) * x + c) * x + d) / slope if slope != 0.0 else -1e-3 * (1.0 + abs(x))
        x -= change
        if abs(change) <= 1e-15 * abs(x):
            break
    return x


@inline_kernel
def adjugate(m):
    """The six cofactors 00, 01, 02, 11, 12, 22 of a symmetric matrix (3, 3)."""
    return (
        m[1, 1] * m[2, 2] - m[1, 2] * m[1, 2],
        m[0, 2] * m[1, 2] - m[0, 1] * m[2, 2],
        m[0, 1] * m[1, 2] - m[0, 2] * m[1, 1],
        m[0, 0] * m[2, 2] - m[0, 2] * m[0, 2],
        m[0, 1] * m[0, 2] - m[0, 0] * m[1, 2],
        m[0, 0] * m[1, 1] - m[0, 1] * m[0, 1],
    )


@inline_kernel
def trace_product(a, m):
    """The trace of a symmetric matrix of six entries times another, (3, 3)."""
    return (
        a[0] * m[0, 0]
        + a[3] * m[1, 1]
        + a[5] * m[2, 2]
        + 2.0 * (a[1] * m[0, 1] + a[2] * m[0, 2] + a[4] * m[1, 2])
    )


@inline_kernel
def degenerate_conic(conics):
    """Turn one of two conics (2, 3, 3) into a degenerate one of their pencil; returns the other's index."""
    first, second = adjugate(conics[0]), adjugate(conics[1])
    d0, d1 = trace_product(first, conics[0]) / 3.0, trace_product(second, conics[1]) / 3.0
    m, n, lead, last = 0, 1, d1, d0  # det(M_m + x M_n) is a cubic, its leading coefficient det M_n
    quadratic, linear = trace_product(second, conics[0]), trace_product(first, conics[1])
    if abs(d1) < abs(d0):
        m, n, lead, last = 1, 0, d0, d1
        quadratic, linear = linear, quadratic
    if not abs(lead) > 1e-15 * (abs(quadratic) + abs(linear)):
        return m  # M_n is degenerate already
    x = simple_cubic_root(quadratic / lead, linear / lead, last / lead)
    changed, kept, factor = m, n, x
    if abs(x) > 1.0:
        changed, kept, factor = n, m, 1.0 / x
    for i in range(3):
        for j in range(3):
            conics[changed, i, j] += factor * conics[kept, i, j]
    return kept


@inline_kernel
def split_conic(conic, lines):
    """Write the two lines (2, 3) that a degenerate conic (3, 3), which is changed, consists of.

    The conic is g h^T + h g^T, its adjugate -p p^T with p = g x h, and the conic plus [p]x is 2 h g^T
    (Richter-Gebert, "Perspectives on Projective Geometry", 2011, section 11.1). False if they are complex.
    """
    a = adjugate(conic)
    p, square = (a[0], a[1], a[2]), a[0]
    if abs(a[3]) > abs(square):
        p, square = (a[1], a[3], a[4]), a[3]
    if abs(a[5]) > abs(square):
        p, square = (a[2], a[4], a[5]), a[5]
    if not square < ROUNDING:
        return False
    scale = 1.0 / math.sqrt(-square) if square < 0.0 else 0.0
    conic[0, 1] -= scale * p[2]
    conic[1, 0] += scale * p[2]
    conic[0, 2] += scale * p[1]
    conic[2, 0] -= scale * p[1]
    conic[1, 2] -= scale * p[0]
    conic[2, 1] += scale * p[0]
    row, column, most = 0, 0, 0.0
    for i in range(3):
        for j in range(3):
            if abs(conic[i, j]) > most:
                row, column, most = i, j, abs(conic[i, j])
    for i in range(3):
        lines[0, i], lines[1, i] = conic[row, i], conic[i, column]
    return most > 0.0


@inline_kernel
def meet(line, conic, ratios):
    """Write where a line (3,) meets a conic (3, 3), at two homogeneous points (2, 3); returns how many."""
    k = 0
    for i in range(1, 3):
        if abs(line[i]) > abs(line[k]):
            k = i
    i, j = (k + 1) % 3, (k + 2) % 3
    p, q = -line[i] / line[k], -line[j] / line[k]
    a = conic[i, i] + p * (p * conic[k, k] + 2.0 * conic[i, k])
    b = conic[i, j] + p * q * conic[k, k] + q * conic[i, k] + p * conic[j, k]
    c = conic[j, j] + q * (q * conic[k, k] + 2.0 * conic[j, k])
    discriminant = b * b - a * c
    if not discriminant >= -ROUNDING * (b * b + abs(a * c)):
        return 0
    s = -(b + math.copysign(math.sqrt(max(discriminant, 0.0)), b))
    for n in range(2):
        ratios[n, i], ratios[n, j] = (s, a) if n == 0 else (c, s)
        ratios[n, k] = p * ratios[n, i] + q * ratios[n, j]
    return 2 if discriminant > 0.0 else 1


@inline_kernel
def polish_distances(ratios, cosines, sides2):
    """Scale distances (3,) known up to a factor, polish them by Newton; False if they do not fit."""
    (c01, c02, c12), (a01, a02) = cosines, sides2
    d0, d1, d2 = ratios[0], ratios[1], ratios[2]
    total = 2.0 * (d0 * (d0 - c01 * d1 - c02 * d2) + d1 * (d1 - c12 * d2) + d2 * d2)
    scale = math.copysign(math.sqrt((a01 + a02 + 1.0) / total), d0 + d1 + d2)
    d0, d1, d2 = scale * d0, scale * d1, scale * d2
    for left in range(POLISHING, -1, -1):
        e0 = d0 * d0 + d1 * d1 - 2.0 * c01 * d0 * d1 - a01
        e1 = d0 * d0 + d2 * d2 - 2.0 * c02 * d0 * d2 - a02
        e2 = d1 * d1 + d2 * d2 - 2.0 * c12 * d1 * d2 - 1.0
        if left == 0:
            break
        u, v, w = d0 - c01 * d1, d1 - c01 * d0, d0 - c02 * d2
        x, y, z = d2 - c02 * d0, d1 - c12 * d2, d2 - c12 * d1
        half = -0.5 / (u * x * y + v * w * z)
        d0 += half * (e0 * x * y + v * (e1 * z - e2 * x))
        d1 += half * (w * z * e0 - u * (e1 * z - e2 * x))
        d2 += half * (u * y * e1 + v * w * e2 - w * y * e0)
    ratios[0], ratios[1], ratios[2] = d0, d1, d2
    is_fit = abs(e0) + abs(e1) + abs(e2) < ROUNDING * (1.0 + d0 * d0 + d1 * d1 + d2 * d2)
    return is_fit and d0 > 0.0 and d1 > 0.0 and d2 > 0.0


@inline_kernel
def pose_of_triangle(d01, d02, e01, e02, R):
    """Write R_cam_from_map (3, 3) of a triangle's edges from its corner 0, in the camera and in the map."""
    cam, world = axes_of(d01, d02), axes_of(e01, e02)
    for i in range(3):
        for j in range(3):
            R[i, j] = cam[0][i] * world[0][j] + cam[1][i] * world[1][j] + cam[2][i] * world[2][j]


@inline_kernel
def order_of_corners(points):
    """The corners with the longest side between the last two, and that side's squared length."""
    first, longest2 = 0, -1.0
    for i in range(3):
        side = difference(points, (i + 1) % 3, (i + 2) % 3)
        if dot(side, side) > longest2:
            first, longest2 = i, dot(side, side)
    return first, (first + 1) % 3, (first + 2) % 3, longest2


@inline_kernel
def pencil(cosines, sides2, conics):
    """Write the conics (2, 3, 3) on which the distances lie: the sides 01 and 02, less the side 12 = 1."""
    c01, c02, c12 = cosines
    conics[:] = 0.0
    for n in range(2):
        side2 = sides2[n]
        conics[n, 0, 0], conics[n, 1, 1], conics[n, 2, 2] = 1.0, -side2, -side2
        conics[n, n + 1, n + 1] += 1.0
        conics[n, 1, 2] = conics[n, 2, 1] = side2 * c12
    conics[0, 0, 1] = conics[0, 1, 0] = -c01
    conics[1, 0, 2] = conics[1, 2, 0] = -c02


@kernel
def p3p(bearings, points, rotations, centers):
    """Write the poses that see three points, R_cam_from_map (4, 3, 3), centers (4, 3) [m]; returns how many.

    Bearings (3, 3) and points (3, 3) [m] are a row each. Points on a line and equal bearings have none. The
    two conics of the distances meet on two lines, a degenerate conic of their pencil (Persson and Nordberg,
    "Lambda Twist", ECCV 2018; the lines by the adjugate, as in Ding et al., "Revisiting the P3P Problem",
    CVPR 2023).
    """
    i0, i1, i2, longest2 = order_of_corners(points)
    e01, e02 = difference(points, i1, i0), difference(points, i2, i0)
    normal, a01, a02 = cross(e01, e02), dot(e01, e01), dot(e02, e02)
    c01, c02, c12 = (
        dot(bearings[i0], bearings[i1]),
        dot(bearings[i0], bearings[i2]),
        dot(bearings[i1], bearings[i2]),
    )
    if not (dot(normal, normal) > LEAST_SINE2 * a01 * a02 and 1.0 - max(c01, c02, c12) > LEAST_GAP):
        return 0
    work = np.empty((4, 3, 3))  # two conics, two lines, two points
    conics, lines, ratios = work[:2], work[2], work[3]
    cosines, sides2, length = (c01, c02, c12), (a01 / longest2, a02 / longest2), math.sqrt(longest2)
    pencil(cosines, sides2, conics)
    other = degenerate_conic(conics)
    if not split_conic(conics[1 - other], lines):
        return 0
    count = 0
    for k in range(4):
        if k % 2 == 0:
            num_met = meet(lines[k // 2], conics[other], ratios)
        d = ratios[k % 2]
        if k % 2 >= num_met or not polish_distances(d, cosines, sides2):
            continue
        x, y, z = length * d[0], length * d[1], length * d[2]
        b0, b1, b2 = bearings[i0], bearings[i1], bearings[i2]
        d01 = y * b1[0] - x * b0[0], y * b1[1] - x * b0[1], y * b1[2] - x * b0[2]
        d02 = z * b2[0] - x * b0[0], z * b2[1] - x * b0[1], z * b2[2] - x * b0[2]
        R = rotations[count]
        pose_of_triangle(d01, d02, e01, e02, R)
        for i in range(3):
            back = 0.0
            for j in range(3):
                back += R[j, i] * (x * b0[j] + y * b1[j] + z * b2[j])
            centers[count, i] = (points[0, i] + points[1, i] + points[2, i] - back) / 3.0
        count += 1
    return count
