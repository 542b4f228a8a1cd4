"""A query: a panorama at several scales, and the map in which it is searched."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.pose import Array, Pose, rotate_points
from ..geometry.sphere import indices_of, make_grid
from ..jobs.once import Once
from ..jobs.threads import Workers
from ..local_features.keypoints import HALVES, Keypoints, find_keypoints, joined_keypoints
from ..local_features.matching import Matches, joined_matches, match
from ..panorama import Panorama
from ..panorama.gpano import rotation_to_level
from ..panorama.local_normalization import normalize_panorama
from ..panorama.model import resize, shrink
from ..panorama.texels import Texels, pack_texels
from ..scan_map.scan_map import ScanMap
from ..views.recent_views import RecentViews
from .config import METHOD, ImageScales, MethodConfig
from .settings import CoarseToFineSettings

COMPARED_WIDTH = 256  # [px]
MAX_WIDTH = 4096  # [px] of the photo that the loss is taken from: more costs seconds and tells nothing
MOST_SHARE = 0.98  # of the sphere: of a photo that shows more, all cells are shown


@dataclass(frozen=True)
class QueryImages:
    """The panorama's locally normalised channels at several scales, each made when it is first asked for."""

    by_scale: tuple[Once[Texels], ...]  # widest first

    @property
    def full(self) -> Texels:
        """For the last millimetres."""
        return self.by_scale[0]()

    @property
    def fine(self) -> Texels:
        """For fine views."""
        return self.by_scale[1]()

    @property
    def middle(self) -> Texels:
        """For middle views."""
        return self.by_scale[2]()

    @property
    def search(self) -> Texels:
        """For prepared views."""
        return self.by_scale[3]()

    def mirrored(self) -> "QueryImages":
        """All images turned over, left for right."""
        return QueryImages(tuple(Once(partial(turned_over, image)) for image in self.by_scale))


def turned_over(image: Once[Texels]) -> Texels:
    """An image with left and right exchanged."""
    texels = image()
    across = texels.rgbx.reshape(-1, texels.width + 2)[:, ::-1]
    return Texels(np.ascontiguousarray(across).reshape(-1), texels.width)


def query_images(panorama: Panorama, pyramid: ImageScales) -> QueryImages:
    """The images of a panorama, each resized from the one before, widest first."""
    images = []
    for scale in pyramid:
        panorama = resize(panorama, scale.width)
        images.append(Once(partial(normalize_panorama, panorama, scale.cell_deg, scale.sigma_deg)))
    return QueryImages(tuple(images))


class Features(NamedTuple):
    """Keypoints of a photo, and the features of the map that look alike."""

    keypoints: Keypoints
    matches: Matches


@dataclass(frozen=True)
class Query:
    """A panorama and the map in which it is searched."""

    scan_map: ScanMap
    images: QueryImages
    R_cam_from_level: Array  # (3, 3) how the camera was tilted where gravity is known
    settings: CoarseToFineSettings
    workers: Workers
    method: MethodConfig
    panorama: Panorama  # at the width of its features
    pixel: float  # [rad] of the photo as it was given, but none finer than those that are compared
    views: RecentViews  # of the map
    colors: Once[Texels]  # of the photo at the size at which its loss is taken
    features: tuple[Once[Features], ...]  # of half of the photo's views each
    num_halves: int = len(HALVES)  # that are asked; none where whole views alone are
    comparisons: dict[bytes, Any] = field(default_factory=dict)  # worked out already, by comparison.py
    ends: set[bytes] = field(default_factory=set)  # poses which no perturbation improves any more

    @property
    def by_features(self) -> bool:
        """False where whole views alone are asked."""
        return self.num_halves > 0

    @cached_property
    def keypoints(self) -> Keypoints:
        """The photo's keypoints."""
        return joined_keypoints([half().keypoints for half in self.features[: self.num_halves]])

    @cached_property
    def matches(self) -> Matches:
        """The photo's keypoints and the features of the map that look alike."""
        halves = [half() for half in self.features[: self.num_halves]]
        return joined_matches([h.matches for h in halves], [len(h.keypoints.rays) for h in halves])

    @cached_property
    def photo(self) -> Texels:
        """The photo's colours at the size at which poses are compared."""
        small = resize(self.panorama, COMPARED_WIDTH)
        return pack_texels(small.rgb, small.is_valid)

    def make_images(self) -> None:
        """Make what descents and comparisons need, before they ask for it."""
        for image in self.images.by_scale:
            image()
        self.photo  # noqa: B018  # kept when it is first asked for

    def soon_needed(self) -> list[Once[Texels]]:
        """The images that descents will ask for, in that order."""
        return list(self.images.by_scale[2::-1])

    def shown_cells(self, num_rings: int, pose: Pose) -> NDArray[np.bool_]:
        """Which cells (N,) of a grid around a pose in the map the photo shows; all, if it shows a sphere."""
        grid = make_grid(num_rings)
        if self.photo.valid_share > MOST_SHARE:
            return np.ones(len(grid), np.bool_)
        rays_cam = rotate_points(grid.directions.astype(np.float64), pose.R_cam_from_world)
        return np.asarray(self.panorama.is_valid[indices_of(rays_cam, self.panorama.is_valid.shape[1])])

    def without(self, is_hidden: NDArray[np.bool_]) -> "Query":
        """The same of what is left of the photo without some pixels (h, 2 h), its contrast taken anew."""
        height, width = self.panorama.is_valid.shape
        enlarged = cv2.resize(is_hidden.view(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
        rest = replace(self.panorama, is_valid=self.panorama.is_valid & (enlarged == 0))
        return self.of_panorama(rest)

    def of_panorama(self, panorama: Panorama) -> "Query":
        """The same of another panorama of the same size."""
        images = query_images(panorama, self.method.scales)
        features = features_of(panorama, self.scan_map, self.workers)
        return replace(self, images=images, panorama=panorama, features=features, comparisons={}, ends=set())


def prepare_query(
    panorama: Panorama,
    scan_map: ScanMap,
    settings: CoarseToFineSettings,
    workers: Workers,
    method: MethodConfig = METHOD,
) -> Query:
    """The query of a panorama among a map's candidates; its metadata say how the camera was tilted."""
    R_level_from_cam = rotation_to_level(panorama.gpano) if panorama.gpano else None
    R_cam_from_level = np.eye(3) if R_level_from_cam is None else R_level_from_cam.T
    pixel = math.tau / min(panorama.rgb.shape[1], method.scales.full.width)
    colors = Once(partial(texels_of, panorama))
    panorama = resize(panorama, method.scales.full.width)
    images, views = query_images(panorama, method.scales), RecentViews(scan_map.octree)
    how, features = (settings, workers, method), features_of(panorama, scan_map, workers)
    return Query(scan_map, images, R_cam_from_level, *how, panorama, pixel, views, colors, features)


def features_of(panorama: Panorama, scan_map: ScanMap, workers: Workers) -> tuple[Once[Features], ...]:
    """The features of a panorama, half of its views each."""

    def found(views: Sequence[int]) -> Features:
        gray = np.asarray(cv2.cvtColor(panorama.rgb, cv2.COLOR_RGB2GRAY), np.uint8)
        keypoints = find_keypoints(gray, panorama.is_valid, workers, views)
        return Features(keypoints, match(keypoints, scan_map.features_now(workers), workers))

    return tuple(Once(partial(found, views)) for views in HALVES)


def texels_of(panorama: Panorama) -> Texels:
    """A panorama as texels, at most MAX_WIDTH wide."""
    panorama = shrink(panorama, MAX_WIDTH)
    return pack_texels(panorama.rgb, panorama.is_valid)
