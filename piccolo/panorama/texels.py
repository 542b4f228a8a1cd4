"""The panorama as texels, one int32 a pixel; and the points around a camera, a chunk at a time, on theirs.

In loops of their own: the arithmetic of `project` and of what follows `gather` is vectorised, the loads
between them are not, on processors that gather slowly (AMD up to Zen 3: three times faster so), and need not
be on others. What is kept of a chunk stays in the first cache.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..geometry.colors import pack_rgbx
from ..geometry.sphere import direction_to_pixel, solid_angles
from ..kernels.jit import F1, HALF, inline_kernel

BYTE = np.int32(255)
CHUNK = 512  # points


class Texels(NamedTuple):
    """An equirectangular image for gathering: a column is wrapped and a row clamped on each side."""

    rgbx: NDArray[np.int32]  # ((H + 2) * (W + 2),) R, G, B from the lowest byte up, X = 1 where valid
    width: int  # W [px], H = W / 2
    valid_share: float = 1.0  # of the sphere


def pack_texels(rgb: NDArray[np.uint8], is_valid: NDArray[np.bool_] | None = None) -> Texels:
    """Texels of an image (H, W, 3), W = 2 H, with the pixels that count (H, W), all if None."""
    height, width = rgb.shape[:2]
    padded = np.empty((height + 2, width + 2), np.int32)
    padded[1:-1, 1:-1] = pack_rgbx(rgb, is_valid)
    padded[:, 0], padded[:, -1] = padded[:, -2], padded[:, 1]
    padded[0], padded[-1] = padded[1], padded[-2]
    share = 1.0 if is_valid is None else float(solid_angles(width) @ is_valid.sum(axis=1)) / (4.0 * np.pi)
    return Texels(padded.reshape(-1), width, share)


@inline_kernel
def channel(texel, shift):
    """The 8-bit channel of a texel as float32; shift 0, 8 or 16."""
    return np.float32((texel >> shift) & BYTE)


@inline_kernel
def locate_texel(x, y, z, rho, width):
    """Index of the upper left of four texels around a camera direction, and the fraction (fu, fv) beyond it.

    rho = hypot(x, y). Texel centres are at half-integers of the pixel coordinates, and a column and a row of
    padding come before them. The other three are 1, stride and stride + 1 further.
    """
    u, v = direction_to_pixel(x, y, z, rho, np.float32(width))
    u, v = u + HALF, v + HALF
    j = np.int32(u)
    i = np.int32(v)
    return np.int32(i * np.int32(width + 2) + j), u - np.float32(j), v - np.float32(i)


@inline_kernel
def is_valid(t00, t10, t01, t11):
    """1 if all four texels count, 0 if one is masked; float32."""
    return np.float32(((t00 & t10 & t01 & t11) >> 24) & 1)


@inline_kernel
def bilinear_weights(fu, fv):
    """Weights of the texels (0, 0), (1, 0), (0, 1), (1, 1) at the fraction (fu, fv)."""
    w11 = fu * fv
    w10 = fu - w11
    w01 = fv - w11
    return F1 - fu - w01, w10, w01, w11


@inline_kernel
def blend(t00, t10, t01, t11, weights, shift):
    """Bilinear value of one channel of four texels."""
    value = weights[0] * channel(t00, shift) + weights[1] * channel(t10, shift)
    return value + weights[2] * channel(t01, shift) + weights[3] * channel(t11, shift)


@inline_kernel
def blend_with_gradient(t00, t10, t01, t11, fu, fv, shift):
    """Bilinear value of one channel of four texels and its derivatives by u and v."""
    c00 = channel(t00, shift)
    c10 = channel(t10, shift) - c00
    c01 = channel(t01, shift)
    c11 = channel(t11, shift) - c01
    top = c00 + fu * c10
    by_v = c01 + fu * c11 - top
    return top + fv * by_v, c10 + fv * (c11 - c10), by_v


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
    f = np.empty((5, CHUNK), np.float32)
    i = np.empty((5, CHUNK), np.int32)
    return Projected(f[0], f[1], f[2], f[3], f[4], i[0], i[1], i[2], i[3], i[4])


@inline_kernel
def pose_float32(R_cam_from_world, center_world):
    """A pose's rotation (3, 3), row by row, and centre (3,), as twelve float32 that registers hold."""
    f = np.float32
    R = R_cam_from_world
    t = center_world
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
    p = projected
    pose = pose_float32(R_cam_from_world, center_world)
    for n in range(len(X)):
        x, y, z = in_camera(X[n], Y[n], Z[n], pose)
        p.index[n], p.fu[n], p.fv[n] = locate_texel(x, y, z, math.sqrt(x * x + y * y), width)
        p.x[n] = x
        p.y[n] = y
        p.z[n] = z


@inline_kernel
def texels_around(projected, n):
    """The four texels around a projected point that `gather` has written."""
    return projected.t00[n], projected.t10[n], projected.t01[n], projected.t11[n]


@inline_kernel
def gather(texels, width, projected, count):
    """Write the four texels around each of `count` projected points."""
    p = projected
    stride = np.int32(width + 2)
    right = texels[1:]
    below = texels[stride:]
    below_right = texels[stride + 1 :]
    for n in range(count):
        k = np.uintp(p.index[n])  # an unsigned index needs no test for being negative
        p.t00[n] = texels[k]
        p.t10[n] = right[k]
        p.t01[n] = below[k]
        p.t11[n] = below_right[k]
