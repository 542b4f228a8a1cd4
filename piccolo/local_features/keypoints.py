"""Keypoints of a sphere, as rays and sizes: SIFT on overlapping perspective views."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np

from ..system.arrays import Array32, Bytes, Int64s, Mask
from ..system.jobs.threads import Workers
from .perspective_view import PerspectiveView, add_margin
from .sift import DESCRIPTOR_SIZE, find_sift

ALONE = Workers()  # the calling thread only


class Keypoints(NamedTuple):
    """Keypoints of one sphere, in the axes of its picture."""

    rays: Array32  # (N, 3) unit directions
    tangents: Array32  # (N, 3) unit vectors at right angles to the ray: the keypoint's orientation
    sizes: Array32  # (N,) diameter [rad]
    descriptors: Bytes  # (N, 128) RootSIFT (Arandjelovic, Zisserman 2012), times 255

    def take(self, indices: Int64s) -> "Keypoints":
        """Return the keypoints at `indices`."""
        taken: list[Any] = [values[indices] for values in self]
        return Keypoints(*taken)

    def mirror(self) -> "Keypoints":
        """Return the keypoints as they are in the picture mirrored left to right."""
        left_for_right = np.array([1.0, -1.0, 1.0], np.float32)
        histograms = self.descriptors.reshape(-1, 4, 4, 8)[:, ::-1, :, -np.arange(8) % 8]
        descriptors = histograms.reshape(-1, DESCRIPTOR_SIZE)
        return Keypoints(self.rays * left_for_right, self.tangents * left_for_right, self.sizes, descriptors)


def find_keypoints(
    gray: Bytes, is_valid: Mask, views: Sequence[PerspectiveView], workers: Workers = ALONE
) -> Keypoints:
    """Find keypoints in some views of an equirectangular picture (H, W), W = 2 H, where it is valid."""
    picture = add_margin(gray)
    mask = add_margin(is_valid)

    def find(view: PerspectiveView) -> Keypoints:
        shown = view.cut_mask(mask)
        return find_in_view(view.cut(picture), shown, view) if shown.any() else _nothing()

    return join_keypoints(list(workers.map(find, views, "find keypoints")))


def find_in_view(image: Bytes, shown: Bytes, view: PerspectiveView) -> Keypoints:
    """Find the keypoints in the picture (h, w) of a view where `shown` (h, w) is 255; elsewhere it is 0."""
    inner = np.asarray(cv2.bitwise_and(cv2.erode(shown, np.ones((3, 3), np.uint8)), view.is_own), np.uint8)
    if not inner.any():
        return _nothing()
    found = _on_sphere(*find_sift(image, inner), view)
    return found.take(view.find_own(found.rays))  # a keypoint in the overlap of two views counts once


def join_keypoints(parts: Sequence[Keypoints]) -> Keypoints:
    """Join the keypoints of several views, one after the other."""
    return Keypoints(*(np.concatenate(values) for values in zip(_nothing(), *parts, strict=True)))


def _nothing() -> Keypoints:
    three = np.empty((0, 3), np.float32)
    return Keypoints(three, three, np.empty(0, np.float32), np.empty((0, DESCRIPTOR_SIZE), np.uint8))


def _on_sphere(places: Array32, descriptors: Bytes, view: PerspectiveView) -> Keypoints:
    """Convert the keypoints of a view, as `find_sift` returns them, to rays of the sphere."""
    height, width = view.rows.shape
    per_px = view.pixel
    columns, rows, diameters, angles = np.asarray(places, np.float64).T
    left = per_px * (0.5 * width - 0.5 - columns)
    up = per_px * (0.5 * height - 0.5 - rows)
    rays = np.stack([np.ones_like(left), left, up], axis=1)
    tangents = np.stack([np.zeros_like(left), -np.cos(angles), -np.sin(angles)], axis=1)
    length = np.linalg.norm(rays, axis=1, keepdims=True)
    rays /= length
    tangents -= rays * np.sum(rays * tangents, axis=1, keepdims=True)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    sizes = diameters * per_px / length[:, 0] ** 1.5  # by the solid angle that it covers
    return Keypoints(
        np.asarray(rays @ view.R_sphere_from_view.T, np.float32),
        np.asarray(tangents @ view.R_sphere_from_view.T, np.float32),
        np.asarray(sizes, np.float32),
        descriptors,
    )
