"""Perspective views of a sphere's picture: a set that covers the sphere, or one around a photo's content."""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple, TypeVar

import cv2
import numpy as np

from ..geometry.sphere import compute_pixels, pixel_rays
from ..system.arrays import Array, Array32, Bytes, Floats, Int64s, Mask

FIELD_DEG = 65.0  # [deg] width of a view in the set that covers the sphere
PICTURE_MARGIN = 8  # [px] that are added around the sphere's picture, so that views may cross the seam
# azimuth and elevation [deg] of the views' middles; none at the poles, which show floor, ceiling or nothing
VIEWS_DEG = [(45.0 * k, 0.0) for k in range(8)]
VIEWS_DEG += [(60.0 * k + 30.0, elevation) for elevation in (45.0, -45.0) for k in range(6)]
NUM_SIDES = 4  # views of a whole photo to its sides
Image = TypeVar("Image", Bytes, Mask)
# the same of the faces of a cube; the two at the poles are not used, but keypoints there belong to no side
FACES_DEG = [*((90.0 * k, 0.0) for k in range(NUM_SIDES)), (0.0, 90.0), (0.0, -90.0)]
STRETCH = 1.2  # largest tangent of the angle from the middle of a view around a photo to its edge
VIEW_MARGIN = 0.07  # margin of such a view around the photo, at a distance of 1: 4 degrees
MULTIPLE = 16  # [px] width and height of such a view are multiples of this


class PerspectiveView(NamedTuple):
    """A perspective view (h, w) of a sphere's picture."""

    R_sphere_from_view: Array  # (3, 3), +x the view's middle, +y left, +z up
    pixel: float  # width of a pixel, at a distance of 1
    columns: Array32  # (h, w) column of each pixel in the sphere's picture with its margin
    rows: Array32  # (h, w) and its row
    is_own: Bytes  # (h, w) 255 where no other view's middle is nearer, and a little beyond
    middles: Array  # (N, 3) unit directions of the middles of all views of the set
    place: int  # index of this view among them

    @property
    def focal(self) -> float:
        """Focal length [px]."""
        return 1.0 / self.pixel

    def cut(self, picture: Bytes) -> Bytes:
        """Cut the view (h, w) out of a sphere's picture with its margin."""
        return np.asarray(cv2.remap(picture, self.columns, self.rows, cv2.INTER_LINEAR), np.uint8)

    def cut_mask(self, is_valid: Mask) -> Bytes:
        """Cut the view (h, w) out of a sphere's mask with its margin: 255 where it is valid."""
        mask = is_valid.view(np.uint8) * np.uint8(255)
        return np.asarray(cv2.remap(mask, self.columns, self.rows, cv2.INTER_NEAREST), np.uint8)

    def find_own(self, rays: Floats) -> Int64s:
        """Return the indices of the directions (N, 3) whose nearest middle of the set is this view's."""
        return np.flatnonzero(np.argmax(rays @ self.middles.T, axis=1) == self.place)

    def project(self, rays: Floats) -> tuple[Int64s, Int64s]:
        """Return rows and columns (N,) of the pixels that contain directions (N, 3) of the sphere."""
        height, width = self.is_own.shape
        x, y, z = (rays @ self.R_sphere_from_view).T
        v = (0.5 * height - self.focal * z / x).astype(np.int64)
        u = (0.5 * width - self.focal * y / x).astype(np.int64)
        return np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)


@lru_cache(maxsize=4)
def cover_sphere(width: int) -> list[PerspectiveView]:
    """Return views that cover a sphere's picture `width` [px] wide, as fine as it in their middles."""
    reach = math.tan(math.radians(FIELD_DEG / 2.0))
    side = round(2.0 * reach * width / math.tau)
    return make_set(VIEWS_DEG, side, 2.0 * reach / side, width)


@lru_cache(maxsize=4)
def list_sides(width: int) -> list[PerspectiveView]:
    """Return four views to the sides of a sphere's picture `width` [px] wide: cube faces with a margin."""
    pixel = math.tau / width
    side = math.ceil(2.0 * (1.0 + VIEW_MARGIN) / pixel / MULTIPLE) * MULTIPLE
    return make_set(FACES_DEG, side, pixel, width)[:NUM_SIDES]


def make_set(
    middles_deg: Sequence[tuple[float, float]], side: int, pixel: float, width: int
) -> list[PerspectiveView]:
    """Make square views (side, side) around middles given by azimuth and elevation [deg].

    `pixel` is that of `PerspectiveView`, `width` [px] that of the sphere's picture.
    """
    turns = []
    for angles in np.radians(middles_deg):
        (c, ce), (s, se) = np.cos(angles), np.sin(angles)
        turns.append(np.array([[c * ce, -s, -c * se], [s * ce, c, -s * se], [se, 0.0, ce]]))
    middles = np.stack(turns)[:, :, 0]
    return [make_view(R, pixel, (side, side), width, middles, k) for k, R in enumerate(turns)]


def view_around(is_valid: Mask, focal: float, width: int) -> PerspectiveView | None:
    """Return a view of all valid pixels of a mask (H, W) of the sphere; None if they are too far apart.

    `focal` [px] is the view's focal length, `width` [px] that of the sphere's picture from which it is cut.
    """
    if not is_valid.any():
        return None
    rays = pixel_rays(is_valid.shape[1])[is_valid]
    middle = rays.sum(axis=0) + np.array([1e-9, 0.0, 0.0])  # the mean of the whole sphere has no direction
    middle /= np.linalg.norm(middle)
    up = np.array([0.0, 0.0, 1.0]) if abs(middle[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    left = np.cross(up, middle)
    left /= np.linalg.norm(left)
    R_sphere_from_view = np.stack([middle, left, np.cross(middle, left)], axis=1)
    local = rays @ R_sphere_from_view
    if local[:, 0].min() <= 1.0 / math.hypot(1.0, STRETCH):
        return None
    half_width, half_height = (np.abs(local[:, k] / local[:, 0]).max() + VIEW_MARGIN for k in (1, 2))
    shape = tuple(math.ceil(2.0 * focal * half / MULTIPLE) * MULTIPLE for half in (half_height, half_width))
    return make_view(R_sphere_from_view, 1.0 / focal, (shape[0], shape[1]), width, middle[None], 0)


def make_view(
    R_sphere_from_view: Array, pixel: float, shape: tuple[int, int], width: int, middles: Array, place: int
) -> PerspectiveView:
    """Make a view of `shape` (h, w) of a sphere's picture `width` [px] wide.

    `pixel`, `middles` (N, 3) and `place` are those of `PerspectiveView`.
    """
    # positions of the pixels' centres on the plane at a distance of 1
    centers = (0.5 * pixel * n * (1.0 - (2.0 * np.arange(n) + 1.0) / n) for n in reversed(shape))
    left, up = np.meshgrid(*centers)
    rays = np.stack([np.ones_like(left), left, up], axis=-1) @ R_sphere_from_view.T
    columns, rows = (np.asarray(a - 0.5 + PICTURE_MARGIN, np.float32) for a in compute_pixels(rays, width))
    is_nearest = np.argmax(rays @ middles.T, axis=-1) == place
    grown = cv2.dilate(is_nearest.astype(np.uint8) * np.uint8(255), np.ones((5, 5), np.uint8))
    own = np.asarray(grown, np.uint8)
    return PerspectiveView(R_sphere_from_view, pixel, columns, rows, own, middles, place)


def add_margin(image: Image) -> Image:
    """Pad a picture or mask: columns wrap at the seam, the first and the last row are repeated."""
    return np.pad(
        np.pad(image, ((0, 0), (PICTURE_MARGIN, PICTURE_MARGIN)), mode="wrap"),
        ((PICTURE_MARGIN, PICTURE_MARGIN), (0, 0)),
        "edge",
    )
