"""Poses of a camera from three matches: Persson and Nordberg, "Lambda Twist", ECCV 2018.

A bearing is a unit ray in the camera's frame, anywhere on the sphere; a point is at a positive distance d
along it. The triangle of the points is scaled so that its longest side is 1. With c_ij the cosine of two
bearings and a_ij the square of a side,
    (1)  d_i^2 + d_j^2 - 2 c_ij d_i d_j = a_ij.
    (2)  M_0, M_1: the equations of the sides 01 and 02, each less a_ij times that of 12: conics d^T M d = 0
    (3)  det(M_m + x M_n) = 0: a degenerate conic of their pencil, which is two lines
    (4)  the distances are where these meet the other conic, up to a factor that follows from (1).
The lines are found by the adjugate, as in Ding et al., "Revisiting the P3P Problem", CVPR 2023.
"""

import math

import numpy as np

from ..geometry.vectors import Triple, Vector, cross, dot, minus, row
from ..system.arrays import Array
from ..system.kernels.jit import Scalar, inline_kernel, kernel

LEAST_SINE2 = 1e-10  # squared sine of the angle at a corner: points of a smaller one lie on a line
LEAST_GAP = 5e-13  # 1 - cosine of two bearings: below a microradian they are the same
SIDE_ROUNDING = 1e-9  # largest relative error of a solution's squared sides
POLISHING = 4  # Newton steps on the distances

Cofactors = tuple[float, float, float, float, float, float]  # of a symmetric matrix: 00, 01, 02, 11, 12, 22


@inline_kernel
def scale(factor: Scalar, a: Vector) -> Triple:
    """Multiply a vector by a number."""
    return factor * a[0], factor * a[1], factor * a[2]


@inline_kernel
def compute_axes(a: Vector, b: Vector) -> tuple[Triple, Triple, Triple]:
    """Return three orthonormal axes: along a (3,), across it on the side of b (3,), and along a x b."""
    normal = cross(a, b)
    across = cross(normal, a)
    return (
        scale(1.0 / math.sqrt(dot(a, a)), a),
        scale(1.0 / math.sqrt(dot(across, across)), across),
        scale(1.0 / math.sqrt(dot(normal, normal)), normal),
    )


@inline_kernel
def simple_cubic_root(b: float, c: float, d: float) -> float:
    """Return a real root of x^3 + b x^2 + c x + d that is not between the extrema, by Newton's method."""
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
def adjugate(m: Array) -> Cofactors:
    """Return the six cofactors 00, 01, 02, 11, 12, 22 of a symmetric matrix (3, 3)."""
    a = m[0, 0]
    b = m[0, 1]
    c = m[0, 2]
    d = m[1, 1]
    e = m[1, 2]
    f = m[2, 2]
    return d * f - e * e, c * e - b * f, b * e - c * d, a * f - c * c, b * c - a * e, a * d - b * b


@inline_kernel
def trace_product(a: Cofactors, m: Array) -> float:
    """Return the trace of the product of two symmetric matrices, the first given by its six entries."""
    diagonal = a[0] * m[0, 0] + a[3] * m[1, 1] + a[5] * m[2, 2]
    trace: float = diagonal + 2.0 * (a[1] * m[0, 1] + a[2] * m[0, 2] + a[4] * m[1, 2])
    return trace


@inline_kernel
def degenerate_conic(conics: Array) -> int:
    """Replace one of two conics (2, 3, 3) by a degenerate one of their pencil (3); return the other's index.

    The factor x of (3) is a root of a cubic whose leading coefficient is det M_n.
    """
    first = adjugate(conics[0])
    second = adjugate(conics[1])
    det_0 = trace_product(first, conics[0]) / 3.0
    det_1 = trace_product(second, conics[1]) / 3.0
    mixed_01 = trace_product(second, conics[0])
    mixed_10 = trace_product(first, conics[1])
    n = 0 if abs(det_1) < abs(det_0) else 1
    lead = det_0 if n == 0 else det_1
    last = det_1 if n == 0 else det_0
    quadratic = mixed_10 if n == 0 else mixed_01
    linear = mixed_01 if n == 0 else mixed_10
    if not abs(lead) > 1e-15 * (abs(quadratic) + abs(linear)):
        return 1 - n  # M_n is degenerate already
    x = simple_cubic_root(quadratic / lead, linear / lead, last / lead)
    kept = 1 - n if abs(x) > 1.0 else n
    factor = 1.0 / x if abs(x) > 1.0 else x
    for i in range(3):
        for j in range(3):
            conics[1 - kept, i, j] += factor * conics[kept, i, j]
    return kept


@inline_kernel
def split_conic(conic: Array, lines: Array) -> bool:
    """Split a degenerate conic (3, 3), which is changed, into two lines (2, 3); False if they are complex.

    The conic is g h^T + h g^T, its adjugate -p p^T with p = g x h, and the conic plus [p]x is 2 h g^T
    (Richter-Gebert, "Perspectives on Projective Geometry", 2011, section 11.1).
    """
    a = adjugate(conic)
    p = (a[0], a[1], a[2])
    square = a[0]
    if abs(a[3]) > abs(square):
        p = (a[1], a[3], a[4])
        square = a[3]
    if abs(a[5]) > abs(square):
        p = (a[2], a[4], a[5])
        square = a[5]
    if not square < SIDE_ROUNDING:
        return False
    scale = 1.0 / math.sqrt(-square) if square < 0.0 else 0.0
    conic[0, 1] -= scale * p[2]
    conic[1, 0] += scale * p[2]
    conic[0, 2] += scale * p[1]
    conic[2, 0] -= scale * p[1]
    conic[1, 2] -= scale * p[0]
    conic[2, 1] += scale * p[0]
    largest = 0.0
    for i in range(3):
        for j in range(3):
            if abs(conic[i, j]) > largest:
                largest = abs(conic[i, j])
                for k in range(3):
                    lines[0, k] = conic[i, k]
                    lines[1, k] = conic[k, j]
    return largest > 0.0


@inline_kernel
def meet(line: Array, conic: Array, ratios: Array) -> int:
    """Write the intersections (2, 3), homogeneous, of a line (3,) and a conic (3, 3); return their number."""
    k = 0
    for i in range(1, 3):
        if abs(line[i]) > abs(line[k]):
            k = i
    i = (k + 1) % 3
    j = (k + 2) % 3
    p = -line[i] / line[k]
    q = -line[j] / line[k]
    a = conic[i, i] + p * (p * conic[k, k] + 2.0 * conic[i, k])
    b = conic[i, j] + p * q * conic[k, k] + q * conic[i, k] + p * conic[j, k]
    c = conic[j, j] + q * (q * conic[k, k] + 2.0 * conic[j, k])
    discriminant = b * b - a * c
    if not discriminant >= -SIDE_ROUNDING * (b * b + abs(a * c)):
        return 0
    s = -(b + math.copysign(math.sqrt(max(discriminant, 0.0)), b))
    for n in range(2):
        ratios[n, i] = s if n == 0 else c
        ratios[n, j] = a if n == 0 else s
        ratios[n, k] = p * ratios[n, i] + q * ratios[n, j]
    return 2 if discriminant > 0.0 else 1


@inline_kernel
def polish_distances(ratios: Array, cosines: Triple, sides2: tuple[Scalar, Scalar]) -> bool:
    """Scale distances (3,), known up to a factor, and polish them by Newton's method on (1).

    Return False if they do not solve (1), or if one is not positive.
    """
    c01, c02, c12 = cosines
    a01, a02 = sides2
    d0 = ratios[0]
    d1 = ratios[1]
    d2 = ratios[2]
    total = 2.0 * (d0 * (d0 - c01 * d1 - c02 * d2) + d1 * (d1 - c12 * d2) + d2 * d2)
    scale = math.copysign(math.sqrt((a01 + a02 + 1.0) / total), d0 + d1 + d2)
    d0, d1, d2 = scale * d0, scale * d1, scale * d2  # at once: one by one, the compiler sums another way
    for left in range(POLISHING, -1, -1):
        e0 = d0 * d0 + d1 * d1 - 2.0 * c01 * d0 * d1 - a01
        e1 = d0 * d0 + d2 * d2 - 2.0 * c02 * d0 * d2 - a02
        e2 = d1 * d1 + d2 * d2 - 2.0 * c12 * d1 * d2 - 1.0
        if left == 0:
            break
        u = d0 - c01 * d1  # half the derivatives of e0, e1, e2
        v = d1 - c01 * d0
        w = d0 - c02 * d2
        x = d2 - c02 * d0
        y = d1 - c12 * d2
        z = d2 - c12 * d1
        half = -0.5 / (u * x * y + v * w * z)
        d0 += half * (e0 * x * y + v * (e1 * z - e2 * x))
        d1 += half * (w * z * e0 - u * (e1 * z - e2 * x))
        d2 += half * (u * y * e1 + v * w * e2 - w * y * e0)
    ratios[0] = d0
    ratios[1] = d1
    ratios[2] = d2
    is_fit: bool = abs(e0) + abs(e1) + abs(e2) < SIDE_ROUNDING * (1.0 + d0 * d0 + d1 * d1 + d2 * d2)
    return is_fit and d0 > 0.0 and d1 > 0.0 and d2 > 0.0


@inline_kernel
def order_corners(points: Array) -> tuple[int, int, int, Scalar]:
    """Return the corners' indices, the ends of the longest side last, and its squared length."""
    first = 0
    longest2: Scalar = -1.0
    for i in range(3):
        side = minus(row(points, (i + 1) % 3), row(points, (i + 2) % 3))
        if dot(side, side) > longest2:
            first = i
            longest2 = dot(side, side)
    return first, (first + 1) % 3, (first + 2) % 3, longest2


@inline_kernel
def pencil(cosines: Triple, sides2: tuple[Scalar, Scalar], conics: Array) -> None:
    """Write the conics (2, 3, 3) of equation (2), on which the distances lie."""
    conics[:] = 0.0
    for n in range(2):
        conics[n, 0, 0] = 1.0
        conics[n, 1, 1] = conics[n, 2, 2] = -sides2[n]
        conics[n, n + 1, n + 1] += 1.0
        conics[n, 1, 2] = conics[n, 2, 1] = sides2[n] * cosines[2]
    conics[0, 0, 1] = conics[0, 1, 0] = -cosines[0]
    conics[1, 0, 2] = conics[1, 2, 0] = -cosines[1]


@inline_kernel
def solve_triangle(d01: Vector, d02: Vector, e01: Vector, e02: Vector, R: Array) -> None:
    """Write R_cam_from_map (3, 3) from a triangle's edges at its corner 0: d in the camera, e in the map."""
    cam = compute_axes(d01, d02)
    world = compute_axes(e01, e02)
    for i in range(3):
        for j in range(3):
            R[i, j] = cam[0][i] * world[0][j] + cam[1][i] * world[1][j] + cam[2][i] * world[2][j]


@kernel
def p3p(bearings: Array, points: Array, rotations: Array, centers: Array) -> int:
    """Write up to four poses that see three points at three bearings; return their number.

    Bearings (3, 3) and points (3, 3) [m] are in rows. `rotations` (4, 3, 3) get R_cam_from_map, `centers`
    (4, 3) [m] the camera's centres in the map. Collinear points and equal bearings have no pose.
    """
    i0, i1, i2, longest2 = order_corners(points)
    b0 = bearings[i0]
    b1 = bearings[i1]
    b2 = bearings[i2]
    e01 = minus(row(points, i1), row(points, i0))
    e02 = minus(row(points, i2), row(points, i0))
    normal = cross(e01, e02)
    a01 = dot(e01, e01)
    a02 = dot(e02, e02)
    cosines = (dot(b0, b1), dot(b0, b2), dot(b1, b2))
    if not (dot(normal, normal) > LEAST_SINE2 * a01 * a02 and 1.0 - max(cosines) > LEAST_GAP):
        return 0
    work = np.empty((4, 3, 3))  # two conics, two lines, two points
    conics = work[:2]
    sides2 = (a01 / longest2, a02 / longest2)
    pencil(cosines, sides2, conics)
    other = degenerate_conic(conics)
    if not split_conic(conics[1 - other], work[2]):
        return 0
    count = 0
    for n in range(2):
        for k in range(meet(work[2, n], conics[other], work[3])):
            d = work[3, k]
            if not polish_distances(d, cosines, sides2):
                continue
            x, y, z = scale(math.sqrt(longest2), d)
            d01 = minus(scale(y, b1), scale(x, b0))
            d02 = minus(scale(z, b2), scale(x, b0))
            R = rotations[count]
            solve_triangle(d01, d02, e01, e02, R)
            for i in range(3):
                back = 0.0
                for j in range(3):
                    back += R[j, i] * (x * b0[j] + y * b1[j] + z * b2[j])
                centers[count, i] = (points[0, i] + points[1, i] + points[2, i] - back) / 3.0
            count += 1
    return count
