"""The panorama as texels: one int32 a pixel, and the bilinear value and gradient at a continuous pixel."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..geometry.colors import pack_rgbx
from ..geometry.sphere import direction_to_pixel, solid_angles
from ..kernels.jit import F1, HALF, inline_kernel

BYTE = np.int32(255)


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
def texel_at(x, y, z, rho, width):
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
