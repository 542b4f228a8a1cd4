"""Colours: sRGB and linear light, packed as kernels read them, made of edges."""

import cv2
import numpy as np

from ..system.arrays import Array, Bytes, Floats, Int32s, Mask


def srgb_to_linear(colors: Bytes) -> Array:
    """Convert sRGB bytes to linear light in [0, 1] (IEC 61966-2-1)."""
    levels = np.arange(256) / 255.0
    return np.asarray(np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4)[colors])


def linear_to_srgb(linear: Array) -> Array:
    """Convert linear light in [0, 1] to sRGB in [0, 1]."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1.0 / 2.4) - 0.055)


def to_bytes(colors: Array, is_linear: bool = True) -> Bytes:
    """Convert colours (..., 3) in [0, 1], of linear light or else sRGB, to sRGB bytes; others are clipped."""
    levels = linear_to_srgb(colors) if is_linear else colors
    return np.rint(np.clip(levels, 0.0, 1.0) * 255.0).astype(np.uint8)


def pack_rgbx(rgb: Bytes, is_valid: Mask | None = None) -> Int32s:
    """Pack each colour (..., 3) into an int32 (...): R, G, B from the lowest byte up, then 1 where valid."""
    shape = rgb.shape[:-1]
    if 0 in shape:
        return np.empty(shape, np.int32)
    valid = np.ones(shape, np.uint8) if is_valid is None else is_valid.astype(np.uint8, copy=False)
    colors = np.ascontiguousarray(rgb, np.uint8).reshape(-1, 1, 3)
    rgbx = np.empty((len(colors), 1, 4), np.uint8)
    cv2.mixChannels([colors, valid.reshape(-1, 1)], [rgbx], [0, 0, 1, 1, 2, 2, 3, 3])
    return rgbx.view("<i4").reshape(shape).astype(np.int32, copy=False)


def unpack_rgb(rgbx: Int32s) -> Bytes:
    """Return the colours (N, 3) that `pack_rgbx` packed (N,)."""
    return np.ascontiguousarray(rgbx.astype("<i4")).view(np.uint8).reshape(-1, 4)[:, :3]


def colors_of_edges(strength: Floats, vertical: Floats, gray: Floats | float) -> Bytes:
    """Return the colours (..., 3) that stand for edges (...) in [0, 1], the vertical ones, and a grey.

    (2 G - R - B) / 4 is the strength, (R - B) / 2 that of vertical edges minus that of others, luminance the
    grey.
    """
    luminance = 0.25 + 0.5 * gray
    green = 0.2 * (strength - 0.5)
    difference = 0.15 * (2.0 * vertical - strength)
    rgb = np.empty((*np.shape(strength), 3), np.result_type(strength, np.float32))
    rgb[..., 0] = luminance - green + difference
    rgb[..., 1] = luminance + 2.0 * green
    rgb[..., 2] = luminance - green - difference
    return np.clip(np.rint(255.0 * rgb), 0.0, 255.0).astype(np.uint8)
