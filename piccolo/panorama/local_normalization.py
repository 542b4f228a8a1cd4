"""Local normalisation on the sphere: opponent channels less their local mean, by their local deviation."""

import math
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.sphere import pixel_rays, solid_angles
from ..runtime.jit import F0, F1, HALF, inline_kernel, kernel
from . import Panorama
from .projection import CHUNK, gather, make_projected, project
from .texels import Texels, bilinear_weights, blend, is_valid

CLIP = 2.0  # deviations; what differs more from its surroundings counts no more
MIN_DEVIATION = 0.03  # of a channel in [0, 1]: flatter surroundings are not amplified further
ZERO_LEVEL = 127.5  # the level of 0
LEVELS_PER_UNIT = 127.5 / CLIP
OPPONENT = np.array([[1 / 3, 1 / 3, 1 / 3], [1 / 2, 0, -1 / 2], [-1 / 4, 1 / 2, -1 / 4]], np.float32)

_CLIP = np.float32(CLIP)
_MIN_VARIANCE = np.float32(MIN_DEVIATION * MIN_DEVIATION)
STATS_WIDTH = 128  # [px] local means vary over 10 degrees and more
LEAST_WEIGHT = np.float32(1e-9)  # of neighbours that count, where hardly any does


@inline_kernel
def opponent(r, g, b):
    """Luminance, (R - B) / 2 and (2 G - R - B) / 4: OPPONENT times the colour."""
    return (r + g + b) / np.float32(3.0), HALF * (r - b), HALF * g - np.float32(0.25) * (r + b)


@inline_kernel
def zscore(value, mean, inverse_std):
    """(value - mean) / standard deviation, clipped."""
    return min(max((value - mean) * inverse_std, -_CLIP), _CLIP)


@inline_kernel
def inverse_std(mean, mean_square):
    """1 / standard deviation, bounded where nothing varies."""
    return F1 / math.sqrt(max(mean_square - mean * mean, F0) + _MIN_VARIANCE)


@lru_cache(maxsize=8)
def sphere_gaussian(width: int, sigma_deg: float) -> NDArray[np.float64]:
    """Spectra over the azimuth (W / 2 + 1, H, H) of the Gaussian weights between rows, times solid angle."""
    rays = pixel_rays(width)
    sigma = np.radians(sigma_deg)
    weight = np.empty((width // 2, width // 2, width))
    for i in range(width // 2):
        weight[i] = np.exp((rays @ rays[i, 0] - 1) / sigma**2) * solid_angles(width)[:, None]
    return np.ascontiguousarray(np.fft.rfft(weight, axis=2).real.transpose(2, 0, 1))


def blur_sphere(image: NDArray[np.float32], sigma_deg: float) -> NDArray[np.float32]:
    """Gaussian weighted sums (H, W, C) over the sphere of an equirectangular image (H, W, C).

    In float64: what BLAS rounds one way or the other is then rounded away.
    """
    spectrum = np.fft.rfft(image.astype(np.float64), axis=1).transpose(1, 0, 2)
    gains = sphere_gaussian(image.shape[1], sigma_deg)
    blurred = (gains @ spectrum.real) + 1j * (gains @ spectrum.imag)
    sums = np.fft.irfft(blurred.transpose(1, 0, 2), n=image.shape[1], axis=1)
    return np.ascontiguousarray(sums, np.float32)


@kernel
def block_moments(channels, weight, moments):
    """Write (h, w, 7): weighted sums of 1, the channels and their squares over equal blocks of the image."""
    step = channels.shape[0] // moments.shape[0]
    moments[:] = 0
    for i in range(channels.shape[0]):
        for j in range(channels.shape[1]):
            m, w = moments[i // step, j // step], weight[i, j]
            m[0] += w
            for c in range(3):
                m[1 + c] += w * channels[i, j, c]
                m[4 + c] += w * channels[i, j, c] * channels[i, j, c]


@kernel
def pack_normalized(channels, weight, stats, texels):
    """Write padded RGBX texels (H + 2, W + 2): (channel - mean) / deviation in levels, and validity.

    `stats` (h, w, 6) are means and 1 / standard deviations, read bilinearly; a column of texels is wrapped
    and a row clamped on each side.
    """
    height, width = weight.shape
    per = np.float32(stats.shape[1]) / np.float32(width)
    for i in range(height):
        v = min(max((np.float32(i) + HALF) * per - HALF, F0), np.float32(stats.shape[0] - 1))
        i0 = min(np.int32(v), stats.shape[0] - 2)
        fv = v - np.float32(i0)
        for j in range(width):
            u = (np.float32(j) + HALF) * per - HALF
            j0 = np.int32(math.floor(u))
            fu = u - np.float32(j0)
            j1 = (j0 + 1) % stats.shape[1]
            j0 = j0 % stats.shape[1]
            texel = np.int32(0)
            for c in range(3):
                mean = (F1 - fv) * ((F1 - fu) * stats[i0, j0, c] + fu * stats[i0, j1, c])
                mean += fv * ((F1 - fu) * stats[i0 + 1, j0, c] + fu * stats[i0 + 1, j1, c])
                gain = (F1 - fv) * ((F1 - fu) * stats[i0, j0, 3 + c] + fu * stats[i0, j1, 3 + c])
                gain += fv * ((F1 - fu) * stats[i0 + 1, j0, 3 + c] + fu * stats[i0 + 1, j1, 3 + c])
                value = zscore(channels[i, j, c], mean, gain)
                level = np.int32(value * np.float32(LEVELS_PER_UNIT) + np.float32(ZERO_LEVEL + 0.5))
                texel |= min(level, np.int32(255)) << np.int32(8 * c)
            if weight[i, j] > HALF:
                texel |= np.int32(1 << 24)
            texels[i + 1, j + 1] = texel
        texels[i + 1, 0], texels[i + 1, width + 1] = texels[i + 1, width], texels[i + 1, 1]
    texels[0], texels[height + 1] = texels[1], texels[height]


@kernel
def finish_statistics(sums):
    """Turn weighted sums (h, w, 7) of 1, channels, squares into means and 1 / deviations (h, w, 1:7)."""
    for i in range(sums.shape[0]):
        for j in range(sums.shape[1]):
            s = sums[i, j]
            per = F1 / max(s[0], LEAST_WEIGHT)
            for c in range(3):
                s[1 + c] *= per
                s[4 + c] = inverse_std(s[1 + c], s[4 + c] * per)


def opponent_channels(rgb: NDArray[np.float32]) -> NDArray[np.float32]:
    """Luminance and two opponent colours (H, W, 3) of an image (H, W, 3)."""
    return np.asarray(cv2.transform(rgb, OPPONENT))


def local_statistics(
    channels: NDArray[np.float32], weight: NDArray[np.float32], width: int, sigma_deg: float
) -> NDArray[np.float32]:
    """Local means and 1 / standard deviations (width / 2, width, 6) of channels (H, W, 3).

    Over a Gaussian on the sphere, weighted by (H, W) and the solid angle; W is a multiple of the width.
    """
    moments = np.empty((width // 2, width, 7), np.float32)
    block_moments(channels, weight, moments)
    sums = blur_sphere(moments, sigma_deg)
    finish_statistics(sums)
    return np.asarray(sums[..., 1:])


def normalize_locally(
    rgb: NDArray[np.float32], counts: NDArray[np.bool_], sigma_deg: float
) -> NDArray[np.float32]:
    """Opponent channels (H, W, 3) of an image, locally normalised over what `counts`; elsewhere 0."""
    channels, weight = opponent_channels(rgb), counts.astype(np.float32)
    statistics = local_statistics(channels, weight, rgb.shape[1], sigma_deg)
    normalized = (channels - statistics[..., :3]) * statistics[..., 3:]
    return np.asarray(np.clip(normalized, -CLIP, CLIP) * weight[..., None])


def normalize_panorama(panorama: Panorama, cell_deg: float, sigma_deg: float) -> Texels:
    """Opponent channels averaged over `cell_deg`, less the local mean, by the local deviation (`sigma_deg`).

    The width of the panorama is a multiple of STATS_WIDTH.
    """
    height, width = panorama.is_valid.shape
    weight = panorama.is_valid.astype(np.float32)
    channels = opponent_channels(panorama.rgb.astype(np.float32) / np.float32(255.0))
    if cell_deg * width / 360.0 > 1.5:  # cells wider than pixels: a Gaussian with a cell's second moment
        sums = blur_sphere(np.dstack([channels * weight[..., None], weight]), cell_deg / math.sqrt(12.0))
        channels = np.asarray(sums[..., :3] / np.maximum(sums[..., 3:], LEAST_WEIGHT), np.float32)
    statistics = local_statistics(channels, weight, STATS_WIDTH, sigma_deg)
    texels = np.empty((height + 2, width + 2), np.int32)
    pack_normalized(channels, weight, statistics, texels)
    return Texels(texels.reshape(-1), width)


@kernel
def sample_channels(texels, width, directions, rotations, samples, validity):
    """Write channels (rotations, 3, cells), less the zero level, and validity along each turned direction."""
    p, center, zero = make_projected(), np.zeros(3), np.float32(ZERO_LEVEL)
    axes = directions.T.copy()
    X, Y, Z = axes[0], axes[1], axes[2]
    for k in range(len(rotations)):
        for lo in range(0, len(X), CHUNK):
            hi = min(lo + CHUNK, len(X))
            project(X[lo:hi], Y[lo:hi], Z[lo:hi], rotations[k], center, width, p)
            gather(texels, width, p, hi - lo)
            s0, s1, s2 = samples[k, 0, lo:hi], samples[k, 1, lo:hi], samples[k, 2, lo:hi]
            valid = validity[k, lo:hi]
            for n in range(hi - lo):
                bilinear = bilinear_weights(p.fu[n], p.fv[n])
                t00, t10, t01, t11 = p.t00[n], p.t10[n], p.t01[n], p.t11[n]
                v = is_valid(t00, t10, t01, t11)
                s0[n] = v * (blend(t00, t10, t01, t11, bilinear, 0) - zero)
                s1[n] = v * (blend(t00, t10, t01, t11, bilinear, 8) - zero)
                s2[n] = v * (blend(t00, t10, t01, t11, bilinear, 16) - zero)
                valid[n] = v
