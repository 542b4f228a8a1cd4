"""Local normalisation on the sphere: opponent channels minus local mean, divided by local deviation."""

import math
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from ...geometry.sphere import pixel_rays, solid_angles
from ...geometry.vectors import row
from ...system.arrays import Array, Array32, Int32s, Mask
from ...system.kernels.jit import F0, F1, HALF, Scalar, copy_to, inline_kernel, kernel
from . import Panorama
from .texels import TEXEL_CHUNK, Texels, make_chunk, project, sample

CLIP = 2.0  # [standard deviations] larger differences from the surroundings count as this
MIN_DEVIATION = 0.03  # of a channel in [0, 1]: in flatter surroundings contrast is not amplified further
ZERO_LEVEL = 127.5  # the level of a normalised channel of 0
LEVELS_PER_UNIT = 127.5 / CLIP  # per standard deviation
OPPONENT = np.array([[1 / 3, 1 / 3, 1 / 3], [1 / 2, 0, -1 / 2], [-1 / 4, 1 / 2, -1 / 4]], np.float32)

_CLIP = np.float32(CLIP)
_MIN_VARIANCE = np.float32(MIN_DEVIATION * MIN_DEVIATION)
STATS_WIDTH = 128  # [px] of the sphere for statistics, enough as these vary over 10 degrees and more
LEAST_NEIGHBOR_WEIGHT = np.float32(1e-9)  # sum of the weights of valid neighbours, at least


@inline_kernel
def opponent(r: Scalar, g: Scalar, b: Scalar) -> tuple[Scalar, Scalar, Scalar]:
    """Return luminance, (R - B) / 2 and (2 G - R - B) / 4: OPPONENT times the colour."""
    return (r + g + b) / np.float32(3.0), HALF * (r - b), HALF * g - np.float32(0.25) * (r + b)


@inline_kernel
def zscore(value: Scalar, mean: Scalar, inverse_std: Scalar) -> Scalar:
    """Return (value - mean) / standard deviation, clipped."""
    return min(max((value - mean) * inverse_std, -_CLIP), _CLIP)


@inline_kernel
def mean_and_inverse_std(total: Scalar, squares: Scalar, per: Scalar) -> tuple[Scalar, Scalar]:
    """Return mean and 1 / deviation, bounded, from weighted sums; `per` is 1 / sum of the weights."""
    mean = total * per
    return mean, F1 / math.sqrt(max(squares * per - mean * mean, F0) + _MIN_VARIANCE)


@lru_cache(maxsize=8)
def sphere_gaussian(width: int, sigma_deg: float) -> Array:
    """Return spectra over azimuth (W / 2 + 1, H, H) of Gaussian weights between rows, times solid angles."""
    rays = pixel_rays(width)
    sigma = np.radians(sigma_deg)
    weight = np.empty((width // 2, width // 2, width))
    for i in range(width // 2):
        weight[i] = np.exp((rays @ rays[i, 0] - 1) / sigma**2) * solid_angles(width)[:, None]
    return np.ascontiguousarray(np.fft.rfft(weight, axis=2).real.transpose(2, 0, 1))


def blur_sphere(image: Array32, sigma_deg: float) -> Array32:
    """Return the Gaussian weighted sums (H, W, C) over the sphere of an equirectangular image (H, W, C).

    They are computed in float64: rounding to float32 then removes the differences between BLAS libraries.
    """
    spectrum = np.fft.rfft(image.astype(np.float64), axis=1).transpose(1, 0, 2)
    gains = sphere_gaussian(image.shape[1], sigma_deg)
    blurred = (gains @ spectrum.real) + 1j * (gains @ spectrum.imag)
    sums = np.fft.irfft(blurred.transpose(1, 0, 2), n=image.shape[1], axis=1)
    return np.ascontiguousarray(sums, np.float32)


@kernel
def block_moments(channels: Array32, weight: Array32, moments: Array32) -> None:
    """Write the weighted sums (h, w, 7) of 1, channels and their squares over equal blocks of the image."""
    step = channels.shape[0] // moments.shape[0]
    for i in range(moments.shape[0]):
        for j in range(moments.shape[1]):
            m0 = m1 = m2 = m3 = m4 = m5 = m6 = F0
            for k in range(i * step, (i + 1) * step):
                for n in range(j * step, (j + 1) * step):
                    w = weight[k, n]
                    a, b, c = row(channels[k], n)
                    m0 += w
                    m1 += w * a
                    m2 += w * b
                    m3 += w * c
                    m4 += w * a * a
                    m5 += w * b * b
                    m6 += w * c * c
            m = moments[i, j]
            for k, total in enumerate((m0, m1, m2, m3, m4, m5, m6)):
                m[k] = total


@inline_kernel
def interpolation_along(num: int, num_wider: int) -> tuple[NDArray[np.uintp], NDArray[np.uintp], Array32]:
    """Locate `num` pixels of a row between wider ones: left and right neighbour, and fraction (num,)."""
    left = np.empty(num, np.uintp)
    right = np.empty(num, np.uintp)
    fraction = np.empty(num, np.float32)
    per = np.float32(num_wider) / np.float32(num)
    for j in range(num):
        u = (np.float32(j) + HALF) * per - HALF
        whole = math.floor(u)
        fraction[j] = u - np.float32(whole)
        left[j] = np.uintp(np.int64(whole) % num_wider)
        right[j] = np.uintp((np.int64(whole) + 1) % num_wider)
    return left, right, fraction


@inline_kernel
def as_texel_channel(value: Scalar, mean: Scalar, gain: Scalar, shift: int) -> np.int32:
    """Return a channel, normalised and in levels, as bits of a texel shifted by `shift`."""
    level = np.int32(zscore(value, mean, gain) * np.float32(LEVELS_PER_UNIT) + np.float32(ZERO_LEVEL + 0.5))
    return np.int32(min(level, np.int32(255)) << np.int32(shift))


@kernel
def pack_normalized(
    channels: Array32, weight: Array32, stats: Array32, corner: tuple[int, int], texels: Int32s
) -> None:
    """Write padded RGBX texels (H + 2, W + 2): (channel - mean) / deviation in levels, and validity.

    Channels and weights are those of a box of the image, whose first row and column are `corner`. Means and
    1 / standard deviations are interpolated bilinearly in `stats` (h, w, 6). The padding is a column on each
    side, which wraps, and a row above and below, which repeats.
    """
    top, begin = corner
    height = texels.shape[0] - 2
    width = texels.shape[1] - 2
    num_rows, num_columns, _ = stats.shape
    of_all = interpolation_along(width, num_columns)
    num = weight.shape[1]
    left = of_all[0][begin : begin + num]
    right = of_all[1][begin : begin + num]
    fraction = of_all[2][begin : begin + num]
    wide = np.empty((6, num_columns), np.float32)
    along = np.empty((6, num), np.float32)
    per = np.float32(num_columns) / np.float32(width)
    for i in range(len(weight)):
        v = min(max((np.float32(i + top) + HALF) * per - HALF, F0), np.float32(num_rows - 1))
        i0 = min(np.int32(v), num_rows - 2)
        fv = v - np.float32(i0)
        for j in range(num_columns):
            for c in range(6):
                wide[c, j] = stats[i0, j, c] + fv * (stats[i0 + 1, j, c] - stats[i0, j, c])
        for c in range(6):
            for j in range(num):
                at = wide[c, left[j]]
                along[c, j] = at + fraction[j] * (wide[c, right[j]] - at)
        planes = channels[i].T.copy()  # (3, num), so that the loop below is vectorised
        row = texels[top + i + 1, begin + 1 : begin + num + 1]
        for j in range(num):
            texel = as_texel_channel(planes[0, j], along[0, j], along[3, j], 0)
            texel |= as_texel_channel(planes[1, j], along[1, j], along[4, j], 8)
            texel |= as_texel_channel(planes[2, j], along[2, j], along[5, j], 16)
            row[j] = texel | (np.int32(1 << 24) if weight[i, j] > HALF else np.int32(0))
    for i in range(height):
        texels[i + 1, 0] = texels[i + 1, width]
        texels[i + 1, width + 1] = texels[i + 1, 1]
    copy_to(texels[0], texels[1])
    copy_to(texels[height + 1], texels[height])


@kernel
def finish_statistics(sums: Array32) -> None:
    """Replace weighted sums (h, w, 7) of 1, channels, squares by means and 1 / deviations in columns 1:7."""
    for i in range(sums.shape[0]):
        for j in range(sums.shape[1]):
            s = sums[i, j]
            per = F1 / max(s[0], LEAST_NEIGHBOR_WEIGHT)
            for c in range(3):
                s[1 + c], s[4 + c] = mean_and_inverse_std(s[1 + c], s[4 + c], per)


def opponent_channels(rgb: Array32) -> Array32:
    """Convert an image (H, W, 3) to luminance and two opponent colours (H, W, 3)."""
    return np.asarray(cv2.transform(rgb, OPPONENT))


def local_statistics(channels: Array32, weight: Array32, width: int, sigma_deg: float) -> Array32:
    """Compute local means and 1 / standard deviations (width / 2, width, 6) of channels (H, W, 3).

    The weights are a Gaussian on the sphere times `weight` (H, W) times the solid angle. W must be a multiple
    of `width`.
    """
    moments = np.empty((width // 2, width, 7), np.float32)
    block_moments(channels, weight, moments)
    return smooth_statistics(moments, sigma_deg)


def smooth_statistics(moments: Array32, sigma_deg: float) -> Array32:
    """Compute local means and 1 / standard deviations (h, w, 6) from the moments (h, w, 7) of blocks."""
    sums = blur_sphere(moments, sigma_deg)
    finish_statistics(sums)
    return np.asarray(sums[..., 1:])


def normalize_locally(rgb: Array32, is_valid: Mask, sigma_deg: float) -> Array32:
    """Return opponent channels (H, W, 3), locally normalised over the valid pixels; 0 in others."""
    channels = opponent_channels(rgb)
    weight = is_valid.astype(np.float32)
    statistics = local_statistics(channels, weight, rgb.shape[1], sigma_deg)
    normalized = (channels - statistics[..., :3]) * statistics[..., 3:]
    return np.asarray(np.clip(normalized, -CLIP, CLIP) * weight[..., None])


def normalize_panorama(panorama: Panorama, cell_deg: float, sigma_deg: float) -> Texels:
    """Return a panorama's opponent channels, averaged over `cell_deg` and normalised over `sigma_deg`.

    W must be a multiple of STATS_WIDTH. Texels outside of a box around the valid pixels are 0.
    """
    height, width = panorama.is_valid.shape
    is_averaged = cell_deg * width / 360.0 > 1.5  # then the box is the whole sphere
    step = width // STATS_WIDTH
    rows = find_span(np.asarray(panorama.is_valid.any(axis=1) | is_averaged), step)
    columns = find_span(np.asarray(panorama.is_valid.any(axis=0) | is_averaged), step)
    weight = panorama.is_valid[rows, columns].astype(np.float32)
    channels = opponent_channels(panorama.rgb[rows, columns].astype(np.float32) / np.float32(255.0))
    if is_averaged:  # by a Gaussian with the second moment of a cell
        sums = blur_sphere(np.dstack([channels * weight[..., None], weight]), cell_deg / math.sqrt(12.0))
        channels = np.asarray(sums[..., :3] / np.maximum(sums[..., 3:], LEAST_NEIGHBOR_WEIGHT), np.float32)
    inner = np.empty((len(weight) // step, weight.shape[1] // step, 7), np.float32)
    block_moments(channels, weight, inner)
    corner = rows.start, columns.start
    moments = np.zeros((STATS_WIDTH // 2, STATS_WIDTH, 7), np.float32)
    top = rows.start // step
    left = columns.start // step
    moments[top : top + len(inner), left : left + inner.shape[1]] = inner
    texels = np.zeros((height + 2, width + 2), np.int32)
    pack_normalized(channels, weight, smooth_statistics(moments, sigma_deg), corner, texels)
    return Texels(texels.reshape(-1), width)


def find_span(is_used: Mask, step: int) -> slice:
    """Return the span of the True elements (N,), widened to whole steps; the first step if there are none."""
    used = np.flatnonzero(is_used)
    if len(used) == 0:
        return slice(0, step)
    return slice(int(used[0]) // step * step, -(-(int(used[-1]) + 1) // step) * step)


@kernel
def sample_channels(
    texels: Int32s, width: int, directions: Array32, rotations: Array32, samples: Array32, validity: Array32
) -> None:
    """Write the channels (rotations, 3, cells), minus the zero level, and their validity (rotations, cells).

    They are sampled in the `directions` (cells, 3), turned by each of the rotations (rotations, 3, 3).
    """
    p = make_chunk()
    center = np.zeros(3)
    zero = np.float32(ZERO_LEVEL)
    axes = directions.T.copy()
    for k in range(len(rotations)):
        for lo in range(0, len(directions), TEXEL_CHUNK):
            hi = min(lo + TEXEL_CHUNK, len(directions))
            x = axes[0, lo:hi]
            y = axes[1, lo:hi]
            z = axes[2, lo:hi]
            project(x, y, z, rotations[k], center, texels, width, p)
            s0 = samples[k, 0, lo:hi]
            s1 = samples[k, 1, lo:hi]
            s2 = samples[k, 2, lo:hi]
            valid = validity[k, lo:hi]
            for n in range(hi - lo):
                a, b, c, v = sample(p, n)
                s0[n] = v * (a - zero)
                s1[n] = v * (b - zero)
                s2[n] = v * (c - zero)
                valid[n] = v


def to_levels(channels: Array32) -> Array32:
    """Convert channels in standard deviations to 8-bit levels, not rounded."""
    return np.asarray(channels * np.float32(LEVELS_PER_UNIT) + np.float32(ZERO_LEVEL))
