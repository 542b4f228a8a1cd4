"""Points around a camera, the pixels that they fall on, and the texels there, a chunk of points at a time.

In loops of their own: the arithmetic of `project` and of what follows `gather` is vectorised, the loads
between them are not, on processors that gather slowly (AMD up to Zen 3: three times faster so), and need not
be on others. What is kept of a chunk stays in the first cache.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from ..kernels.jit import inline_kernel
from .texels import texel_at

CHUNK = 512  # points


class Projected(NamedTuple):
    """Of a chunk of points, arrays (CHUNK,)."""

    x: Any  # camera coordinates, float32
    y: Any
    z: Any
    fu: Any  # fraction beyond the upper left of four texels, float32
    fv: Any
    index: Any  # of this texel, int32
    t00: Any  # the four texels, int32
    t10: Any
    t01: Any
    t11: Any


@inline_kernel
def make_projected():
    """Room for a chunk."""
    f, i = np.empty((5, CHUNK), np.float32), np.empty((5, CHUNK), np.int32)
    return Projected(f[0], f[1], f[2], f[3], f[4], i[0], i[1], i[2], i[3], i[4])


@inline_kernel
def pose_float32(R_cam_from_world, center_world):
    """A pose's rotation (3, 3), row by row, and centre (3,), as twelve float32 that registers hold."""
    f, R, t = np.float32, R_cam_from_world, center_world
    return (
        f(R[0, 0]), f(R[0, 1]), f(R[0, 2]), f(R[1, 0]), f(R[1, 1]), f(R[1, 2]),
        f(R[2, 0]), f(R[2, 1]), f(R[2, 2]), f(t[0]), f(t[1]), f(t[2]),
    )  # fmt: skip


@inline_kernel
def in_camera(x, y, z, pose):
    """Camera coordinates of a point, by a pose of `pose_float32`."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22, tx, ty, tz = pose
    dx, dy, dz = x - tx, y - ty, z - tz
    return (
        r00 * dx + r01 * dy + r02 * dz,
        r10 * dx + r11 * dy + r12 * dz,
        r20 * dx + r21 * dy + r22 * dz,
    )


@inline_kernel
def project(X, Y, Z, R_cam_from_world, center_world, width, projected):
    """Write the camera coordinates, and the texels in an image of `width`, of at most CHUNK points (n,)."""
    p, pose = projected, pose_float32(R_cam_from_world, center_world)
    for n in range(len(X)):
        x, y, z = in_camera(X[n], Y[n], Z[n], pose)
        p.index[n], p.fu[n], p.fv[n] = texel_at(x, y, z, math.sqrt(x * x + y * y), width)
        p.x[n], p.y[n], p.z[n] = x, y, z


@inline_kernel
def texels_around(projected, n):
    """The four texels around a projected point that `gather` has written."""
    return projected.t00[n], projected.t10[n], projected.t01[n], projected.t11[n]


@inline_kernel
def gather(texels, width, projected, count):
    """Write the four texels around each of `count` projected points."""
    p, stride = projected, np.int32(width + 2)
    right, below, below_right = texels[1:], texels[stride:], texels[stride + 1 :]
    for n in range(count):
        k = np.uintp(p.index[n])  # an unsigned index needs no test for being negative
        p.t00[n], p.t10[n], p.t01[n], p.t11[n] = texels[k], right[k], below[k], below_right[k]
