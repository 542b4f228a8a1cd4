"""The panorama as texels, an int32 for each pixel; points are projected to them a chunk at a time.

`project` has two loops: the arithmetic of the first is vectorised, the loads of the second are not. That is
three times faster on processors that gather slowly (AMD up to Zen 3), and not slower on others. The arrays of
a chunk fit into the first-level cache.
"""

import math
from typing import NamedTuple

import numpy as np

from ...geometry.colors import pack_rgbx
from ...geometry.sphere import direction_to_pixel, solid_angles
from ...system.arrays import Array32, Bytes, Floats, Int32s, Mask
from ...system.kernels.jit import F1, HALF, Scalar, inline_kernel, whole

BYTE = np.int32(255)
TEXEL_CHUNK = 512  # points of a chunk
Weights = tuple[Scalar, Scalar, Scalar, Scalar]  # of four texels
Pose32 = tuple[
    np.float32, np.float32, np.float32, np.float32, np.float32, np.float32,
    np.float32, np.float32, np.float32, np.float32, np.float32, np.float32,
]  # fmt: skip


class Texels(NamedTuple):
    """An equirectangular image to gather from, padded by a column on each side, which wraps, and by a row."""

    rgbx: Int32s  # ((H + 2) * (W + 2),) R, G, B from the lowest byte up, X = 1 where valid
    width: int  # W [px], H = W / 2
    valid_share: float = 1.0  # fraction of the sphere that is valid

    def mirror(self) -> "Texels":
        """Return the image mirrored left to right."""
        rows = self.rgbx.reshape(-1, self.width + 2)
        return self._replace(rgbx=np.ascontiguousarray(rows[:, ::-1]).reshape(-1))


def pack_texels(rgb: Bytes, is_valid: Mask | None = None) -> Texels:
    """Pack an image (H, W, 3), W = 2 H, into texels, with a mask (H, W); if that is None, all are valid."""
    height, width = rgb.shape[:2]
    padded = np.empty((height + 2, width + 2), np.int32)
    padded[1:-1, 1:-1] = pack_rgbx(rgb, is_valid)
    padded[:, 0], padded[:, -1] = padded[:, -2], padded[:, 1]
    padded[0], padded[-1] = padded[1], padded[-2]
    share = 1.0 if is_valid is None else float(solid_angles(width) @ is_valid.sum(axis=1)) / (4.0 * np.pi)
    return Texels(padded.reshape(-1), width, share)


def find_valid(image: Texels) -> Mask:
    """Return the mask (H, W) of the valid pixels."""
    padded = image.rgbx.reshape(-1, image.width + 2)
    return np.asarray((padded[1:-1, 1:-1] >> 24) & 1 == 1)


@inline_kernel
def channel(texel: np.int32, shift: int) -> np.float32:
    """Return the 8-bit channel of a texel as float32; shift 0, 8 or 16."""
    return np.float32((texel >> shift) & BYTE)


@inline_kernel
def locate_texel(x: Scalar, y: Scalar, z: Scalar, rho: Scalar, width: int) -> tuple[np.int32, Scalar, Scalar]:
    """Return the index of the upper left of four texels around a direction, and the fractions (fu, fv).

    The direction (x, y, z) is in the camera's axes, and rho = hypot(x, y). Fractions are from that texel's
    centre to the next one's. Texel centres are at half-integers of the pixel coordinates, and a column and a
    row of padding come before them. The indices of the other three are 1, stride and stride + 1 higher.
    """
    u, v = direction_to_pixel(x, y, z, rho, np.float32(width))
    u, v = u + HALF, v + HALF
    j = whole(u)
    i = whole(v)
    return np.int32(i * np.int32(width + 2) + j), u - np.float32(j), v - np.float32(i)


@inline_kernel
def is_valid(t00: np.int32, t10: np.int32, t01: np.int32, t11: np.int32) -> np.float32:
    """Return 1 if all four texels are valid, 0 if one is masked."""
    return np.float32(((t00 & t10 & t01 & t11) >> 24) & 1)


@inline_kernel
def bilinear_weights(fu: Scalar, fv: Scalar) -> Weights:
    """Return the weights of the texels (0, 0), (1, 0), (0, 1), (1, 1) at the fractions (fu, fv)."""
    w11 = fu * fv
    w10 = fu - w11
    w01 = fv - w11
    return F1 - fu - w01, w10, w01, w11


@inline_kernel
def blend(t00: np.int32, t10: np.int32, t01: np.int32, t11: np.int32, weights: Weights, shift: int) -> Scalar:
    """Interpolate one channel of four texels by their bilinear weights."""
    value = weights[0] * channel(t00, shift) + weights[1] * channel(t10, shift)
    return value + weights[2] * channel(t01, shift) + weights[3] * channel(t11, shift)


@inline_kernel
def blend_with_gradient(
    t00: np.int32, t10: np.int32, t01: np.int32, t11: np.int32, fu: Scalar, fv: Scalar, shift: int
) -> tuple[Scalar, Scalar, Scalar]:
    """Interpolate one channel of four texels; return it and its derivatives by u and v."""
    c00 = channel(t00, shift)
    c10 = channel(t10, shift) - c00
    c01 = channel(t01, shift)
    c11 = channel(t11, shift) - c01
    top = c00 + fu * c10
    by_v = c01 + fu * c11 - top
    return top + fv * by_v, c10 + fv * (c11 - c10), by_v


class Projected(NamedTuple):
    """A chunk of projected points, and the texels around each; arrays (TEXEL_CHUNK,)."""

    x: Array32  # camera coordinates [m]
    y: Array32
    z: Array32
    fu: Array32  # fractions from the upper left of four texels
    fv: Array32
    texel: Int32s  # index of the upper left texel
    t00: Int32s  # the four texels
    t10: Int32s
    t01: Int32s
    t11: Int32s


@inline_kernel
def make_chunk() -> Projected:
    """Return uninitialised arrays for a chunk."""
    f = np.empty((5, TEXEL_CHUNK), np.float32)
    i = np.empty((5, TEXEL_CHUNK), np.int32)
    return Projected(f[0], f[1], f[2], f[3], f[4], i[0], i[1], i[2], i[3], i[4])


@inline_kernel
def pose_float32(R_cam_from_world: Floats, center_world: Floats) -> Pose32:
    """Return a pose's rotation (3, 3), row by row, and centre (3,) as twelve float32, to be in registers."""
    f = np.float32
    R = R_cam_from_world
    t = center_world
    return (
        f(R[0, 0]), f(R[0, 1]), f(R[0, 2]), f(R[1, 0]), f(R[1, 1]), f(R[1, 2]),
        f(R[2, 0]), f(R[2, 1]), f(R[2, 2]), f(t[0]), f(t[1]), f(t[2]),
    )  # fmt: skip


@inline_kernel
def in_camera(x: Scalar, y: Scalar, z: Scalar, pose: Pose32) -> tuple[Scalar, Scalar, Scalar]:
    """Transform a point to camera coordinates by a pose from `pose_float32`."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22, tx, ty, tz = pose
    dx, dy, dz = x - tx, y - ty, z - tz
    return (r00 * dx + r01 * dy + r02 * dz, r10 * dx + r11 * dy + r12 * dz, r20 * dx + r21 * dy + r22 * dz)


@inline_kernel
def project(
    X: Array32,
    Y: Array32,
    Z: Array32,
    R_cam_from_world: Floats,
    center_world: Floats,
    texels: Int32s,
    width: int,
    projected: Projected,
) -> None:
    """Write the camera coordinates of a chunk of points (n,), and the texels of an image around each."""
    p = projected
    pose = pose_float32(R_cam_from_world, center_world)
    for n in range(len(X)):
        x, y, z = in_camera(X[n], Y[n], Z[n], pose)
        p.texel[n], p.fu[n], p.fv[n] = locate_texel(x, y, z, math.sqrt(x * x + y * y), width)
        p.x[n] = x
        p.y[n] = y
        p.z[n] = z
    stride = np.int32(width + 2)
    right = texels[1:]
    below = texels[stride:]
    below_right = texels[stride + 1 :]
    for n in range(len(X)):
        k = np.uintp(p.texel[n])  # an unsigned index needs no test for being negative
        p.t00[n] = texels[k]
        p.t10[n] = right[k]
        p.t01[n] = below[k]
        p.t11[n] = below_right[k]


@inline_kernel
def sample(projected: Projected, n: int) -> tuple[Scalar, Scalar, Scalar, np.float32]:
    """Return the three channels [levels] at a projected point, and 1 if all of its texels are valid."""
    p = projected
    weights = bilinear_weights(p.fu[n], p.fv[n])
    t00, t10, t01, t11 = p.t00[n], p.t10[n], p.t01[n], p.t11[n]
    a = blend(t00, t10, t01, t11, weights, 0)
    b = blend(t00, t10, t01, t11, weights, 8)
    c = blend(t00, t10, t01, t11, weights, 16)
    return a, b, c, is_valid(t00, t10, t01, t11)
