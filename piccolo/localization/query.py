"""A query: a photo at several scales, the map in which it is searched, and cached results."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ..cloud.soa import PackedPoints
from ..geometry.pose import Array, Pose, rotate_points
from ..geometry.sphere import compute_indices, make_grid
from ..jobs.threads import Once, Workers
from ..local_features.keypoints import Keypoints, find_keypoints, join_keypoints
from ..local_features.matching import Matches, join_matches, match
from ..local_features.perspective_view import HALVES, PerspectiveView, cover_sphere, view_around
from ..panorama import Panorama
from ..panorama.edges import draw_edges, soften
from ..panorama.gpano import rotation_to_level
from ..panorama.local_normalization import normalize_panorama
from ..panorama.model import resize, shrink
from ..panorama.texels import Texels, find_valid, pack_texels
from ..scan_map.scan_map import ScanMap
from ..views.points_around import RecentViews, round_position
from ..views.view import Cells, ViewConfig, normalize_view
from .settings import METHOD, SHAPE_SCALES, CoarseToFineSettings, ImageScale, ImageScales, MethodConfig

MAX_WIDTH = 4096  # [px] of the photo for the loss: more costs seconds and gains nothing
WHOLE = 0.9  # least fraction of the sphere that a whole photo shows
MOST_SHARE = 0.98  # of the sphere: a photo that shows more counts as showing all cells
NUM_POINTS = 30_000  # of the last descent, among those that the photo shows
VOXEL_PER_RANGE = 1 / 150  # of points around a pose, with which the photo is compared
COARSE_VOXEL_PER_RANGE = 1 / 40  # of coarser ones


class Images(NamedTuple):
    """A photo's locally normalised channels at several scales, each made when it is first asked for."""

    full: Once[Texels]  # for the last millimetres
    fine: Once[Texels]  # for fine views
    middle: Once[Texels]  # for middle views
    search: Once[Texels]  # for prepared views


def make_images(panorama: Panorama, scales: ImageScales) -> Images:
    """Make the images of a panorama, each resized from the one before."""
    images = {}
    for name, scale in scales._asdict().items():
        panorama = reduce(panorama, scale)
        images[name] = Once(partial(normalize_panorama, panorama, scale.cell_deg, scale.sigma_deg))
    return Images(**images)


def reduce(panorama: Panorama, scale: ImageScale) -> Panorama:
    """Return a panorama at the size of one of its images, made of one that is wider or of the same size."""
    return resize(soften(panorama, scale.blur_px) if scale.blur_px else panorama, scale.width)


@dataclass(frozen=True)
class Photo:
    """A photo at the sizes at which it is compared; immutable, as threads share it."""

    given: Panorama
    panorama: Panorama  # at the width of its features
    images: Images
    small: Texels  # colours at the size of fine images, at which poses are compared
    colors: Once[Texels]  # at the size at which the loss is taken
    R_cam_from_level: Array  # (3, 3) how the camera was tilted where gravity is known
    has_tilt: bool  # R_cam_from_level is known, from metadata or a gravity vector
    pixel: float  # [rad] of the photo as it was given, but none finer than those that are compared

    @property
    def is_partial(self) -> bool:
        """True if the photo shows a part of the sphere."""
        return self.small.valid_share < WHOLE

    def find_shown_cells(self, num_rings: int, pose: Pose) -> NDArray[np.bool_]:
        """Return a mask (N,) of the grid cells around a pose that the photo shows."""
        grid = make_grid(num_rings)
        if self.small.valid_share > MOST_SHARE:
            return np.ones(len(grid), np.bool_)
        rays_cam = rotate_points(grid.directions.astype(np.float64), pose.R_cam_from_world)
        return np.asarray(self.panorama.is_valid[compute_indices(rays_cam, self.panorama.is_valid.shape[1])])


class Seen(NamedTuple):
    """Views that show all of a photo, and the keypoints in them."""

    views: list[PerspectiveView]
    keypoints: Keypoints


class Features(NamedTuple):
    """Keypoints of a photo, and the similar features of the map."""

    keypoints: Keypoints
    matches: Matches


@dataclass(frozen=True)
class Cache:
    """Results computed once for one photo in one map, shared by threads and copies of a query."""

    views: RecentViews  # of the map
    comparisons: dict[bytes, Any] = field(default_factory=dict)  # `comparison.compare`, by the pose's key
    unoccluded: dict[bytes, "Query"] = field(
        default_factory=dict
    )  # `comparison.mask_occluders`, by the blocks masked
    matches: dict[bytes, Any] = field(default_factory=dict)  # `verification.matches_near`, by its grid
    ends: set[bytes] = field(default_factory=set)  # keys of poses that no perturbation improves


@dataclass(frozen=True)
class Query:
    """A photo, the map that it is searched in, and the settings of the search."""

    photo: Photo
    scan_map: ScanMap
    settings: CoarseToFineSettings
    workers: Workers
    method: MethodConfig
    features: tuple[Once[Features], ...]  # of a part of the photo's views each
    seen: Once[Seen]  # what verification compares with the scan drawn at a pose
    cache: Cache
    num_parts: int  # of the features that are matched; 0 with whole views alone
    rotations: Array  # (N, 3, 3) camera from map, that are searched in place of those of the settings; N >= 0
    beside: tuple[Matches, ...] = ()  # with each of the photos beside this one whose poses are known

    @cached_property
    def keypoints(self) -> Keypoints:
        """Keypoints of the photo."""
        return join_keypoints([part().keypoints for part in self.features[: self.num_parts]])

    @cached_property
    def matches(self) -> Matches:
        """Keypoints of the photo matched with features of the map."""
        parts = [part() for part in self.features[: self.num_parts]]
        return join_matches([p.matches for p in parts], [len(p.keypoints.rays) for p in parts])

    def mask_pixels(self, is_hidden: NDArray[np.bool_]) -> "Query":
        """Mask pixels (h, 2 h) of the photo, and normalise the rest again."""
        panorama = self.photo.panorama
        height, width = panorama.is_valid.shape
        enlarged = cv2.resize(is_hidden.view(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
        rest = replace(panorama, is_valid=panorama.is_valid & (enlarged == 0))
        scales = self.method.scales
        small = make_texels(reduce(rest, scales.fine))
        photo = replace(self.photo, panorama=rest, images=make_images(rest, scales), small=small)
        return replace(self, photo=photo, cache=Cache(self.cache.views))

    def forget(self) -> "Query":
        """Return the query without what was computed for it but its features: that takes 100 MB."""
        given = self.photo.given
        images = make_images(self.photo.panorama, self.method.scales)
        photo = replace(self.photo, images=images, colors=Once(partial(make_texels, given)))
        seen = Once(partial(find_seen, photo, self.workers))
        return replace(self, photo=photo, seen=seen, cache=Cache(make_views(self.scan_map)))

    def view_at(self, pose: Pose, config: ViewConfig) -> Cells:
        """Return the cells seen from a position near a pose, without those that the photo does not show."""
        place = round_position(pose)
        shown = self.photo.find_shown_cells(config.num_rings, pose)
        return normalize_view(self.cache.views.averages(place, config), place, config, shown)

    def points_at(self, pose: Pose) -> Cells:
        """Return the points of the last descent: seen from near a pose, and shown by the photo."""
        config = self.method.full_view
        shown = self.photo.find_shown_cells(config.num_rings, pose)
        return self.cache.views.points(round_position(pose), config, shown.tobytes(), NUM_POINTS)

    def surroundings_at(self, pose: Pose) -> tuple[PackedPoints, PackedPoints]:
        """Return the points around a pose with which the photo is compared, and coarser ones."""
        around = partial(self.cache.views.surroundings, round_position(pose))
        return around(VOXEL_PER_RANGE), around(COARSE_VOXEL_PER_RANGE)


def prepare_query(
    panorama: Panorama,
    scan_map: ScanMap,
    settings: CoarseToFineSettings,
    workers: Workers,
    method: MethodConfig = METHOD,
    rotations: Array | None = None,
) -> Query:
    """Prepare a panorama for the search in a map; the photo may give the camera's tilt.

    Of rotations (N, 3, 3), camera from map, with N > 0, only these are searched.
    """
    R_cam_from_level, has_tilt = find_tilt(panorama)
    rotations = np.empty((0, 3, 3)) if rotations is None else rotations
    if scan_map.has_shape:
        panorama = draw_edges(panorama, R_cam_from_level, scan_map.has_intensity)
        method = method._replace(uses_features=False, scales=SHAPE_SCALES)
    width = method.scales.full.width
    resized = resize(panorama, width)
    photo = Photo(
        panorama,
        resized,
        make_images(resized, method.scales),
        make_texels(reduce(resized, method.scales.fine)),
        Once(partial(make_texels, panorama)),
        R_cam_from_level,
        has_tilt,
        math.tau / min(panorama.rgb.shape[1], width),
    )
    photo.images.search()  # each search begins with it
    every = cover_sphere(width)
    halves = () if scan_map.has_shape else HALVES
    features = tuple(
        Once(partial(find_features, resized, scan_map, workers, [every[k] for k in half])) for half in halves
    )
    cache = Cache(make_views(scan_map))
    seen = Once(partial(find_seen, photo, workers))
    return Query(photo, scan_map, settings, workers, method, features, seen, cache, len(features), rotations)


def make_views(scan_map: ScanMap) -> RecentViews:
    """Return the views of a map, none rendered yet."""
    # leaves have narrow edges, which only the last descent is near enough to
    averaged = scan_map.octree.without_leaves() if scan_map.has_shape else None
    return RecentViews(scan_map.octree, averaged)


def find_tilt(panorama: Panorama) -> tuple[Array, bool]:
    """Return R_cam_from_level (3, 3) of a camera, and True if the photo gives its tilt."""
    R_level_from_cam = rotation_to_level(panorama.gpano) if panorama.gpano else None
    return (np.eye(3), False) if R_level_from_cam is None else (R_level_from_cam.T, True)


def find_seen(photo: Photo, workers: Workers) -> Seen:
    """Find keypoints in one view around what a photo shows, or in those of many that show a part of it."""
    panorama = photo.panorama
    width = panorama.rgb.shape[1]
    around = view_around(find_valid(photo.small), width / math.tau, width)
    views = [around] if around else cover_sphere(width)
    views = [view for view in views if view.cut_mask(panorama.is_valid).any()]
    gray = np.asarray(cv2.cvtColor(panorama.rgb, cv2.COLOR_RGB2GRAY), np.uint8)
    return Seen(views, find_keypoints(gray, panorama.is_valid, views, workers))


def find_features(
    panorama: Panorama, scan_map: ScanMap, workers: Workers, views: Sequence[PerspectiveView]
) -> Features:
    """Find the features in several views of a panorama, and match them to the map."""
    gray = np.asarray(cv2.cvtColor(panorama.rgb, cv2.COLOR_RGB2GRAY), np.uint8)
    keypoints = find_keypoints(gray, panorama.is_valid, views, workers)
    return Features(keypoints, match(keypoints, scan_map.features_now(workers), workers))


def make_texels(panorama: Panorama) -> Texels:
    """Pack a panorama into texels, at most MAX_WIDTH wide."""
    panorama = shrink(panorama, MAX_WIDTH)
    return pack_texels(panorama.rgb, panorama.is_valid)
