"""A photo at the sizes at which it is compared with the scan; each image is made once, at its first use."""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np

from ..geometry.cone import EVERYWHERE, Cone
from ..geometry.pose import Pose, rotate_points
from ..geometry.sphere import compute_indices, make_grid
from ..local_features.keypoints import Keypoints, find_keypoints
from ..local_features.perspective_view import (
    PerspectiveView,
    add_margin,
    cover_sphere,
    list_sides,
    view_around,
)
from ..photo.panorama import Panorama
from ..photo.panorama.edges import soften
from ..photo.panorama.local_normalization import normalize_panorama
from ..photo.panorama.panorama import resize
from ..photo.panorama.texels import Texels, find_valid, pack_texels
from ..system.arrays import Array, Mask
from ..system.jobs.threads import Once, Workers
from .photo_cone import find_cone
from .profile import ImageScale, ImageScales
from .stages import ImageName

LEAST_WHOLE = 0.9  # least fraction of the sphere that a whole photo shows
ALL_SHOWN = 0.98  # fraction of the sphere: a photo that shows more counts as showing all cells
SEEN_SHIFT = math.radians(5.0)  # by which the direction of a point changes between nearby poses, at most
MIRROR = np.diag([1.0, -1.0, 1.0])  # mirrors a camera's axes left for right


class Images(NamedTuple):
    """A photo's locally normalised channels at several sizes; `ImageScales` has the sizes."""

    full: Once[Texels]  # for the last descent, on points
    fine: Once[Texels]  # for fine views
    middle: Once[Texels]  # for middle views
    search: Once[Texels]  # for prepared views


class PhotoFeatures(NamedTuple):
    """Perspective views that together show all of a photo, and the keypoints found in them."""

    views: list[PerspectiveView]
    keypoints: Keypoints


@dataclass(frozen=True)
class PhotoImages:
    """The images of a photo at the sizes at which it is compared; immutable, as threads share them."""

    panorama: Panorama  # at the width at which keypoints are found
    images: Images
    small: Texels  # colours, not normalised, at the size of the fine image; poses are scored by it
    features: Once[PhotoFeatures]  # compared with the scan drawn at a pose; called with the workers
    cone: Once[Cone]  # around what the photo shows, in the camera's axes
    R_cam_from_level: Array  # (3, 3) tilt of the camera; the identity if it is not known
    has_tilt: bool  # True if R_cam_from_level is known, from metadata or a gravity vector
    scales: ImageScales

    @property
    def is_partial(self) -> bool:
        """True if the photo shows a part of the sphere."""
        return self.small.valid_share < LEAST_WHOLE

    def image(self, name: ImageName) -> Texels:
        """Return the image of this name."""
        image: Texels = getattr(self.images, name)()
        return image

    def find_shown_cells(self, num_rings: int, pose: Pose) -> Mask:
        """Return the mask (N,) of the cells of a grid around a pose that the photo, taken there, shows."""
        grid = make_grid(num_rings)
        if self.small.valid_share > ALL_SHOWN:
            return np.ones(len(grid), np.bool_)
        shown = self.find_cone(num_rings, pose).contains(grid.directions)
        rays_cam = rotate_points(grid.directions[shown].astype(np.float64), pose.R_cam_from_world)
        is_valid = self.panorama.is_valid
        shown[shown] = is_valid[compute_indices(rays_cam, is_valid.shape[1])]
        return shown

    def find_cone(self, num_rings: int, pose: Pose) -> Cone:
        """Return the cone, in the map's axes, around the grid cells that the photo at a pose shows."""
        if not self.is_partial:
            return EVERYWHERE
        return self.cone().widen(SEEN_SHIFT + 1.5 * math.pi / num_rings).turn(pose.R_cam_from_world.T)

    def mask(self, is_hidden: Mask) -> "PhotoImages":
        """Return the photo without the pixels that a mask (h, 2 h) hides; the rest is normalised again."""
        height, width = self.panorama.is_valid.shape
        enlarged = cv2.resize(is_hidden.view(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
        rest = replace(self.panorama, is_valid=self.panorama.is_valid & (enlarged == 0))
        return self.take(rest)

    def mirror(self) -> "PhotoImages":
        """Return the photo mirrored left to right."""
        rgb = self.panorama.rgb[:, ::-1]
        panorama = replace(self.panorama, rgb=rgb, is_valid=self.panorama.is_valid[:, ::-1])
        small = self.small.mirror()
        return replace(
            self,
            panorama=panorama,
            images=Images(*(Once(Texels.mirror, image) for image in self.images)),
            small=small,
            features=Once(find_features, panorama, small),
            cone=Once(find_cone, small, 0.0),
            R_cam_from_level=MIRROR @ self.R_cam_from_level @ MIRROR,
        )

    def forget(self) -> "PhotoImages":
        """Return the photo without the images made so far, which are made again when they are needed."""
        return self.take(self.panorama)

    def take(self, panorama: Panorama) -> "PhotoImages":
        """Return another panorama as a photo at the same sizes, taken with the same tilt."""
        return make_photo(panorama, self.scales, self.R_cam_from_level, self.has_tilt)


def make_photo(
    panorama: Panorama, scales: ImageScales, R_cam_from_level: Array, has_tilt: bool
) -> PhotoImages:
    """Make the photo of a panorama."""
    panorama = resize(panorama, scales.full.width)
    fine = reduce(panorama, scales.fine)
    small = pack_texels(fine.rgb, fine.is_valid)
    features = Once(find_features, panorama, small)
    images = make_images(panorama, scales)
    cone = Once(find_cone, small, 0.0)
    return PhotoImages(panorama, images, small, features, cone, R_cam_from_level, has_tilt, scales)


def make_images(panorama: Panorama, scales: ImageScales) -> Images:
    """Make the images of a panorama, each from the next larger one."""
    images = {}
    larger = Once(lambda: panorama)
    for name, scale in scales._asdict().items():
        larger = Once(reduce, larger, scale)
        images[name] = Once(normalize_panorama, larger, scale.cell_deg, scale.sigma_deg)
    return Images(**images)


def reduce(panorama: Panorama, scale: ImageScale) -> Panorama:
    """Blur a panorama as the scale says, and shrink it to the scale's width if it is wider."""
    return resize(soften(panorama, scale.blur_px) if scale.blur_px else panorama, scale.width)


def find_features(panorama: Panorama, small: Texels, workers: Workers) -> PhotoFeatures:
    """Find the keypoints of a photo, in one view around what it shows or, if that is too wide, in several.

    The views of a whole photo are those to its sides, without above and below.
    """
    width = panorama.rgb.shape[1]
    around = view_around(find_valid(small), width / math.tau, width)
    several = list_sides(width) if small.valid_share >= LEAST_WHOLE else cover_sphere(width)
    views = [around] if around else several
    mask = add_margin(panorama.is_valid)
    views = [view for view in views if view.cut_mask(mask).any()]
    gray = np.asarray(cv2.cvtColor(panorama.rgb, cv2.COLOR_RGB2GRAY), np.uint8)
    return PhotoFeatures(views, find_keypoints(gray, panorama.is_valid, views, workers))


def find_all_around(photo: PhotoImages, workers: Workers) -> Keypoints:
    """Find a photo's keypoints in all directions, for a whole photo also above and below."""
    if photo.is_partial:
        return photo.features(workers).keypoints
    panorama = photo.panorama
    gray = np.asarray(cv2.cvtColor(panorama.rgb, cv2.COLOR_RGB2GRAY), np.uint8)
    return find_keypoints(gray, panorama.is_valid, cover_sphere(panorama.rgb.shape[1]), workers)
