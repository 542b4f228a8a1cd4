"""A query: a photo, the map in which it is searched, and cached results."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import cv2
import numpy as np

from ..arrays import Array, Array32, Mask
from ..cloud.soa import PackedPoints
from ..confidence.confidence import EvidenceKind
from ..geometry.pose import Pose
from ..jobs.threads import Once, Workers
from ..local_features.keypoints import Keypoints, find_keypoints, join_keypoints
from ..local_features.matching import Matches, join_matches, match
from ..local_features.perspective_view import HALVES, PerspectiveView, cover_sphere
from ..panorama import Panorama
from ..panorama.edges import draw_edges
from ..panorama.gpano import rotation_to_level
from ..panorama.model import shrink
from ..panorama.texels import Texels, pack_texels
from ..scan_map.scan_map import ScanMap
from ..views.points_around import Place, RecentViews, round_position
from ..views.view import Cells, ViewConfig, normalize_view
from .photo import ACROSS, Photo, make_photo
from .settings import (
    PARTIAL_BEAM,
    SHAPE_SCALES,
    VIEWS,
    WHOLE_BEAM,
    Beam,
    CoarseToFineSettings,
    ImageScales,
    ViewName,
)

MAX_WIDTH = 2048  # [px] of the photo for the loss: more costs time and gains nothing
NUM_POINTS = 30_000  # of the last descent, among those that the photo shows
VOXEL_PER_RANGE = 1 / 150  # of points around a pose, with which the photo is compared
COARSE_VOXEL_PER_RANGE = 1 / 40  # of coarser ones


class Features(NamedTuple):
    """Keypoints of a photo, and the similar features of the map."""

    keypoints: Keypoints
    matches: Matches


@dataclass(frozen=True)
class Cache:
    """Results computed once for one photo in one map, shared by threads and copies of a query."""

    views: RecentViews  # of the map
    comparisons: dict[Any, Any] = field(default_factory=dict)  # of `comparison.compare`
    masked: dict[bytes, "Query"] = field(default_factory=dict)  # `comparison.mask_occluders`, by its blocks
    matches: dict[bytes, Any] = field(default_factory=dict)  # `verification.matches_near`, by its grid
    fits: dict[Any, Any] = field(default_factory=dict)  # `lens_matches.fit_matches`
    ends: set[bytes] = field(default_factory=set)  # keys of poses that no perturbation improves


@dataclass(frozen=True)
class Query:
    """A photo, the map that it is searched in, and the settings of the search."""

    source: Panorama  # the photo as it was read
    given: Panorama  # which is compared: the photo, or its edges if the scan has no colours
    photo: Photo
    colors: Once[Texels]  # of what is given, at the size at which the loss is taken
    scan_map: ScanMap
    settings: CoarseToFineSettings
    workers: Workers
    features: tuple[Once[Features], ...]  # of a part of the photo's views each; none by whole views alone
    evidence: EvidenceKind  # with what poses are compared
    cache: Cache
    rotations: Array | None = None  # (N, 3, 3) camera from map, searched in place of those of the settings
    beside: tuple[Matches, ...] = ()  # with each of the photos beside this one whose poses are known

    @property
    def uses_matches(self) -> bool:
        """True if local features speak for poses, not whole views alone."""
        return self.evidence == "drawn scan"

    @property
    def is_narrow(self) -> bool:
        """True for a photo of a part of the sphere that is compared with the drawn scan."""
        return self.uses_matches and self.photo.is_partial

    @property
    def beam(self) -> Beam:
        """The number of poses that go on to each stage of a search."""
        return PARTIAL_BEAM if self.photo.is_partial else WHOLE_BEAM

    @property
    def pixel(self) -> float:
        """Pixel [rad] of the photo as it was given, but none finer than those that are compared."""
        width: int = min(self.given.rgb.shape[1], self.photo.panorama.rgb.shape[1])
        return math.tau / width

    @cached_property
    def keypoints(self) -> Keypoints:
        """Keypoints of the photo."""
        return join_keypoints([part().keypoints for part in self.features])

    @cached_property
    def matches(self) -> Matches:
        """Keypoints of the photo matched with features of the map."""
        parts = [part() for part in self.features]
        return join_matches([p.matches for p in parts], [len(p.keypoints.rays) for p in parts])

    def without_features(self) -> "Query":
        """Return the query that asks no features of the map for poses."""
        return replace(self, features=())

    def by_views(self) -> "Query":
        """Return the query by whole views alone."""
        return replace(self.without_features(), evidence="views" if self.uses_matches else self.evidence)

    def with_rotations(self, rotations: Array | None) -> "Query":
        """Return the query that searches only rotations (N, 3, 3), camera from map, with only views kept."""
        return replace(self, rotations=rotations, cache=Cache(self.cache.views))

    def forget(self) -> "Query":
        """Return the query without what was computed for it, but with its features: 100 MB less."""
        colors = Once(make_texels, self.given)
        return replace(self, photo=self.photo.forget(), colors=colors, cache=Cache(make_views(self.scan_map)))

    def mask(self, is_hidden: Mask) -> "Query":
        """Return the query of the photo without pixels (h, 2 h)."""
        return replace(self, photo=self.photo.mask(is_hidden), cache=Cache(self.cache.views))

    def mirror(self) -> "Query":
        """Return the query of the mirrored photo, without features of the map and the prior's heading."""
        prior = self.settings.prior.without_heading()
        return replace(
            self.without_features(),
            photo=self.photo.mirror(),
            settings=replace(self.settings, prior=prior),
            beside=(),
        ).with_rotations(None if self.rotations is None else ACROSS @ self.rotations @ ACROSS)

    def view_at(self, pose: Pose, name: ViewName) -> Cells:
        """Return the cells or points seen from a position near a pose, those that the photo shows."""
        config = VIEWS[name]
        place = round_position(pose)
        shown = self.photo.find_shown_cells(config.num_rings, pose)
        if name == "points":
            cone = self.photo.find_cone(config.num_rings, pose)
            return self.cache.views.points(place, config, shown.tobytes(), cone, NUM_POINTS)
        return normalize_view(self.averages_at(pose, place, config), place, config, shown)

    def averages_at(self, pose: Pose, place: Place, config: ViewConfig) -> Array32:
        """Return the sums (cells, 8) of a view from a place near a pose, of what the photo shows."""
        return self.cache.views.averages(place, config, self.photo.find_cone(config.num_rings, pose))

    def surroundings_at(self, pose: Pose) -> tuple[PackedPoints, PackedPoints]:
        """Return the points around a pose with which the photo is compared, and coarser ones."""
        around = partial(self.cache.views.surroundings, round_position(pose))
        return around(VOXEL_PER_RANGE), around(COARSE_VOXEL_PER_RANGE)


def prepare_query(
    panorama: Panorama, scan_map: ScanMap, settings: CoarseToFineSettings, workers: Workers
) -> Query:
    """Prepare a panorama for the search in a map; the photo may give the camera's tilt."""
    source = panorama
    R_level_from_cam = rotation_to_level(panorama.gpano) if panorama.gpano else None
    has_tilt = R_level_from_cam is not None
    R_cam_from_level = np.eye(3) if R_level_from_cam is None else R_level_from_cam.T
    if scan_map.has_shape:
        panorama = draw_edges(panorama, R_cam_from_level, scan_map.has_intensity)
    scales = SHAPE_SCALES if scan_map.has_shape else ImageScales()
    photo = make_photo(panorama, scales, R_cam_from_level, has_tilt, workers)
    every = cover_sphere(scales.full.width)
    features = tuple(
        Once(find_features, photo.panorama, scan_map, workers, [every[k] for k in half])
        for half in (() if scan_map.has_shape else HALVES)
    )
    return Query(
        source,
        panorama,
        photo,
        Once(make_texels, panorama),
        scan_map,
        settings,
        workers,
        features,
        "shape" if scan_map.has_shape else "drawn scan",
        Cache(make_views(scan_map)),
    )


def make_views(scan_map: ScanMap) -> RecentViews:
    """Return the views of a map, none rendered yet."""
    # leaves have narrow edges, which only the last descent is near enough to
    averaged = scan_map.octree.without_leaves() if scan_map.has_shape else None
    return RecentViews(scan_map.octree, averaged)


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
