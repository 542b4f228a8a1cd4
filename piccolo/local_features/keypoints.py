"""Keypoints of a sphere, as rays and sizes: SIFT (Lowe, IJCV 2004) on overlapping perspective views."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np

from ..system.arrays import Array32, Bytes, Int64s, Mask
from ..system.jobs.threads import Workers
from .perspective_view import PerspectiveView, add_margin

CONTRAST = 0.006  # least of a keypoint, as OpenCV counts it: plain walls have faint ones, and they hold
DESCRIPTOR_SIZE = 128
ALONE = Workers()


class Keypoints(NamedTuple):
    """Keypoints of one sphere, in the axes of its picture."""

    rays: Array32  # (N, 3) unit directions
    tangents: Array32  # (N, 3) unit directions across the ray in which the keypoint points
    sizes: Array32  # (N,) diameter [rad]
    descriptors: Bytes  # (N, 128) RootSIFT (Arandjelovic, Zisserman 2012), times 255

    def take(self, indices: Int64s) -> "Keypoints":
        """Return the keypoints at `indices`."""
        taken: list[Any] = [values[indices] for values in self]
        return Keypoints(*taken)

    def mirror(self) -> "Keypoints":
        """Return the keypoints of the picture mirrored left for right: rays, tangents and descriptors."""
        left_for_right = np.array([1.0, -1.0, 1.0], np.float32)
        histograms = self.descriptors.reshape(-1, 4, 4, 8)[:, ::-1, :, -np.arange(8) % 8]
        descriptors = histograms.reshape(-1, DESCRIPTOR_SIZE)
        return Keypoints(self.rays * left_for_right, self.tangents * left_for_right, self.sizes, descriptors)


def find_keypoints(
    gray: Bytes, is_valid: Mask, views: Sequence[PerspectiveView], workers: Workers = ALONE
) -> Keypoints:
    """Find the keypoints of the valid part of an equirectangular picture (H, W), W = 2 H, in some views."""
    picture = add_margin(gray)
    mask = add_margin(is_valid)

    def find(view: PerspectiveView) -> Keypoints:
        shown = view.cut_mask(mask)
        return find_in_view(view.cut(picture), shown, view) if shown.any() else _nothing()

    return join_keypoints(list(workers.map(find, views, "find keypoints")))


def find_in_view(image: Bytes, shown: Bytes, view: PerspectiveView) -> Keypoints:
    """Find the keypoints in a picture (h, w) of a view where `shown` (h, w) is not 0."""
    inner = cv2.bitwise_and(cv2.erode(shown, np.ones((3, 3), np.uint8)), view.is_own)
    if not inner.any():
        return _nothing()
    sift = cv2.SIFT.create(contrastThreshold=CONTRAST, enable_precise_upscale=True)
    found, shares = sift.detectAndCompute(image, inner)
    keypoints = _on_sphere(found, np.asarray(shares, np.float32), view) if found else _nothing()
    return keypoints.take(view.find_own(keypoints.rays))  # what views share counts once


def join_keypoints(parts: Sequence[Keypoints]) -> Keypoints:
    """Join the keypoints of several views, one after the other."""
    return Keypoints(*(np.concatenate(values) for values in zip(_nothing(), *parts, strict=True)))


def _nothing() -> Keypoints:
    three = np.empty((0, 3), np.float32)
    return Keypoints(three, three, np.empty(0, np.float32), np.empty((0, DESCRIPTOR_SIZE), np.uint8))


def _on_sphere(found: Sequence[cv2.KeyPoint], shares: Array32, view: PerspectiveView) -> Keypoints:
    """Convert a view's keypoints to rays, and their SIFT descriptors (N, 128) to RootSIFT."""
    height, width = view.rows.shape
    per_px = view.pixel
    points = np.array([(*k.pt, k.size, k.angle) for k in found])
    angle = np.radians(points[:, 3])
    left, up = (per_px * (0.5 * size - 0.5 - points[:, k]) for k, size in enumerate((width, height)))
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
