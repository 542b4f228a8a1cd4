"""Keypoints of a sphere, as rays and sizes: SIFT (Lowe, IJCV 2004) on overlapping perspective views."""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.sphere import compute_pixels
from ..jobs.threads import Workers

FIELD_DEG = 65.0  # of a view, across
CONTRAST = 0.006  # least of a keypoint, as OpenCV counts it: plain walls have faint ones, and they hold
MARGIN = 8  # [px] of the sphere's picture around it, so that views may cross the seam
DESCRIPTOR_SIZE = 128
ALONE = Workers()
# azimuth and elevation of the views' middles [deg]; at the poles pictures show floor and ceiling, or nothing
VIEWS_DEG = [(45.0 * k, 0.0) for k in range(8)]
VIEWS_DEG += [(60.0 * k + 30.0, elevation) for elevation in (45.0, -45.0) for k in range(6)]
ALL_VIEWS = tuple(range(len(VIEWS_DEG)))
HALVES = (0, 2, 4, 6, 8, 10, 12, 15, 17, 19), (1, 3, 5, 7, 9, 11, 13, 14, 16, 18)  # every other view


class Keypoints(NamedTuple):
    """Keypoints of one sphere, in the axes of its picture."""

    rays: NDArray[np.float32]  # (N, 3) unit directions
    tangents: NDArray[np.float32]  # (N, 3) unit directions across the ray in which the keypoint points
    sizes: NDArray[np.float32]  # (N,) diameter [rad]
    descriptors: NDArray[np.uint8]  # (N, 128) RootSIFT (Arandjelovic, Zisserman 2012), times 255

    def take(self, indices: NDArray[np.int64]) -> "Keypoints":
        """Return the keypoints at `indices`."""
        taken: list[Any] = [values[indices] for values in self]
        return Keypoints(*taken)

    def mirror(self) -> "Keypoints":
        """Return the keypoints of the picture mirrored left for right: rays, tangents and descriptors."""
        left_for_right = np.array([1.0, -1.0, 1.0], np.float32)
        histograms = self.descriptors.reshape(-1, 4, 4, 8)[:, ::-1, :, -np.arange(8) % 8]
        return Keypoints(
            self.rays * left_for_right,
            self.tangents * left_for_right,
            self.sizes,
            histograms.reshape(-1, DESCRIPTOR_SIZE),
        )


class PerspectiveView(NamedTuple):
    """A perspective view of a sphere's picture."""

    R_sphere_from_view: NDArray[np.float64]  # (3, 3), +x the view's middle, +y left, +z up
    columns: NDArray[np.float32]  # (s, s) of each pixel in the sphere's picture with its margin
    rows: NDArray[np.float32]
    is_own: NDArray[np.uint8]  # (s, s) 255 where no other view's middle is nearer, and a little beyond


@lru_cache(maxsize=4)
def perspective_views(width: int) -> list[PerspectiveView]:
    """Return the perspective views of a sphere's picture of `width`, with its resolution in their middles."""
    reach = math.tan(math.radians(FIELD_DEG / 2.0))
    side = round(2.0 * reach * width / (2.0 * math.pi))
    across = reach * (1.0 - (2.0 * np.arange(side) + 1.0) / side)
    left, up = np.meshgrid(across, across)
    rays = np.stack([np.ones_like(left), left, up], axis=-1)
    turns = []
    for angles in np.radians(VIEWS_DEG):
        (c, ce), (s, se) = np.cos(angles), np.sin(angles)
        turns.append(np.array([[c * ce, -s, -c * se], [s * ce, c, -s * se], [se, 0.0, ce]]))
    middles = np.stack(turns)[:, :, 0]
    views = []
    for k, R in enumerate(turns):
        columns, rows = (np.asarray(a - 0.5 + MARGIN, np.float32) for a in compute_pixels(rays @ R.T, width))
        is_nearest = np.argmax(rays @ R.T @ middles.T, axis=-1) == k
        own = cv2.dilate(is_nearest.astype(np.uint8) * np.uint8(255), np.ones((5, 5), np.uint8))
        views.append(PerspectiveView(R, columns, rows, np.asarray(own)))
    return views


def find_keypoints(
    gray: NDArray[np.uint8],
    is_valid: NDArray[np.bool_],
    workers: Workers = ALONE,
    chosen: Sequence[int] = ALL_VIEWS,
) -> Keypoints:
    """Find the keypoints of the valid part of an equirectangular picture (H, W), W = 2 H, in chosen views."""
    views = perspective_views(gray.shape[1])
    middles = np.stack([view.R_sphere_from_view[:, 0] for view in views])
    picture = _with_margin(gray)
    mask = _with_margin(is_valid.view(np.uint8) * np.uint8(255))

    def find(k: int) -> Keypoints:
        view = views[k]
        shown = cv2.remap(mask, view.columns, view.rows, cv2.INTER_NEAREST)
        shown = cv2.bitwise_and(cv2.erode(shown, np.ones((3, 3), np.uint8)), view.is_own)
        if not shown.any():
            return _nothing()
        image = cv2.remap(picture, view.columns, view.rows, cv2.INTER_LINEAR)
        sift = cv2.SIFT.create(contrastThreshold=CONTRAST, enable_precise_upscale=True)
        found, shares = sift.detectAndCompute(image, shown)
        keypoints = _on_sphere(found, np.asarray(shares, np.float32), view) if found else _nothing()
        is_own = np.argmax(keypoints.rays @ middles.T, axis=1) == k  # what views share counts once
        return keypoints.take(np.flatnonzero(is_own))

    return join_keypoints(list(workers.map(find, chosen, "find keypoints")))


def join_keypoints(parts: Sequence[Keypoints]) -> Keypoints:
    """Join the keypoints of several views, one after the other."""
    return Keypoints(*(np.concatenate(values) for values in zip(_nothing(), *parts, strict=True)))


def _with_margin(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Pad a picture by MARGIN: columns wrap at the seam, the first and the last row are repeated."""
    return np.pad(np.pad(image, ((0, 0), (MARGIN, MARGIN)), mode="wrap"), ((MARGIN, MARGIN), (0, 0)), "edge")


def _nothing() -> Keypoints:
    three = np.empty((0, 3), np.float32)
    return Keypoints(three, three, np.empty(0, np.float32), np.empty((0, DESCRIPTOR_SIZE), np.uint8))


def _on_sphere(
    found: Sequence[cv2.KeyPoint], shares: NDArray[np.float32], view: PerspectiveView
) -> Keypoints:
    """Convert a view's keypoints to rays, and their SIFT descriptors (N, 128) to RootSIFT."""
    side = len(view.rows)
    per_px = 2.0 * math.tan(math.radians(FIELD_DEG / 2.0)) / side
    points = np.array([(*k.pt, k.size, k.angle) for k in found])
    angle = np.radians(points[:, 3])
    left, up = (per_px * (0.5 * side - 0.5 - points[:, axis]) for axis in (0, 1))
    rays = np.stack([np.ones_like(left), left, up], axis=1)
    tangents = np.stack([np.zeros_like(left), -np.cos(angle), -np.sin(angle)], axis=1)
    length = np.linalg.norm(rays, axis=1, keepdims=True)
    rays /= length
    tangents -= rays * np.sum(rays * tangents, axis=1, keepdims=True)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    sizes = points[:, 2] * per_px / length[:, 0] ** 1.5  # of the area that it covers
    roots = np.sqrt(shares / np.maximum(shares.sum(axis=1, keepdims=True), 1.0))
    return Keypoints(
        np.asarray(rays @ view.R_sphere_from_view.T, np.float32),
        np.asarray(tangents @ view.R_sphere_from_view.T, np.float32),
        np.asarray(sizes, np.float32),
        np.rint(roots * 255.0).astype(np.uint8),
    )
