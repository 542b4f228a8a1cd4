"""Vectors of three numbers in kernels: tuples, or arrays (3,) that are read."""

from ..system.arrays import Floats
from ..system.kernels.jit import Scalar, inline_kernel

Triple = tuple[Scalar, Scalar, Scalar]
Vector = Triple | Floats


@inline_kernel
def row(rows: Floats, i: int) -> Triple:
    """Return row i of an array (N, 3)."""
    return rows[i, 0], rows[i, 1], rows[i, 2]


@inline_kernel
def minus(a: Vector, b: Vector) -> Triple:
    """Return the difference a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@inline_kernel
def dot(a: Vector, b: Vector) -> Scalar:
    """Return the scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inline_kernel
def cross(a: Vector, b: Vector) -> Triple:
    """Return the cross product a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inline_kernel
def rotate(R: Floats, v: Vector) -> Triple:
    """Return the product of a rotation (3, 3) and a vector."""
    return (
        R[0, 0] * v[0] + R[0, 1] * v[1] + R[0, 2] * v[2],
        R[1, 0] * v[0] + R[1, 1] * v[1] + R[1, 2] * v[2],
        R[2, 0] * v[0] + R[2, 1] * v[1] + R[2, 2] * v[2],
    )
