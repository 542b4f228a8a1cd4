"""A problem: where in a map was a photo taken? It holds the question only; each step hands its results on."""

import math
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ..geometry.points import PackedPoints
from ..geometry.pose import Gravity, Pose
from ..local_features.matching import Matches
from ..photo.panorama import Panorama
from ..photo.panorama.edges import draw_edges
from ..photo.panorama.gpano import rotation_to_level
from ..photo.panorama.panorama import shrink
from ..photo.panorama.texels import Texels, pack_texels
from ..photo.photo import NOTHING_KNOWN, Prior
from ..scan_map.scan_map import ScanMap
from ..system.arrays import Array, Array32
from ..system.jobs.threads import Once
from ..views.points_around import Place, RecentViews, round_position
from ..views.view import Cells, ViewConfig, normalize_view
from .method import METHOD, Method
from .photo_images import MIRROR, PhotoImages, make_photo
from .profile import VIEWS, Profile, choose_profile, choose_scales
from .stages import ViewName

MAX_LOSS_WIDTH = 2048  # [px] of the photo for the loss: more costs time and gains nothing
NUM_POINTS = 30_000  # points of the scan in the last descent, all where the photo shows them
AROUND_VOXEL_PER_RANGE = 1 / 150  # largest voxel, divided by its distance, of the points around a pose
COARSE_VOXEL_PER_RANGE = 1 / 40  # the same of the coarser points


@dataclass(frozen=True)
class Problem:
    """A photo, the map in which it is searched, and what is known about its pose."""

    source: Panorama  # the photo as it was read
    given: Panorama  # the picture that is compared: the photo, or its edges if the scan has no colours
    photo: PhotoImages
    colors: Once[Texels]  # of `given`, at the size at which the paper's loss is computed
    scan_map: ScanMap  # searched only where the prior allows
    views: RecentViews  # of the scan, each rendered when it is needed
    profile: Profile
    prior: Prior
    gravity: Gravity
    rotations: Array | None = None  # (N, 3, 3) camera from map: only these are searched; None: all
    beside: tuple[Matches, ...] = ()  # one for each photo of known pose that shows the same
    is_mirrored: bool = False  # the images are those of the photo mirrored left for right

    @property
    def method(self) -> Method:
        """The numbers by which the method decides."""
        return self.profile.method

    @property
    def pixel(self) -> float:
        """Angle [rad] of a pixel of the photo, or of its largest image if that is coarser."""
        width: int = min(self.given.rgb.shape[1], self.photo.panorama.rgb.shape[1])
        return math.tau / width

    def by_views(self) -> "Problem":
        """Return the problem with poses compared by whole views alone, without local features."""
        return replace(self, profile=self.profile.by_views())

    def show(self, photo: PhotoImages) -> "Problem":
        """Return the problem with other images of the photo, such as with occluders masked."""
        return replace(self, photo=photo)

    def forget(self) -> "Problem":
        """Return the problem without the images and views made so far, which frees about 100 MB."""
        colors = Once(make_texels, self.given)
        return replace(self, photo=self.photo.forget(), colors=colors, views=make_views(self.scan_map))

    def retake(self, panorama: Panorama) -> "Problem":
        """Return the problem of the photo resampled by another calibration, which moves its content."""
        fresh = prepare_problem(panorama, self.scan_map, self.prior, self.gravity, self.method)
        return fresh if self.profile.uses_matches else fresh.by_views()

    def mirror(self) -> "Problem":
        """Return the problem of the mirrored photo, without the prior's heading."""
        rotations = None if self.rotations is None else MIRROR @ self.rotations @ MIRROR
        return replace(
            self,
            photo=self.photo.mirror(),
            prior=self.prior.without_heading(),
            rotations=rotations,
            beside=(),
            is_mirrored=not self.is_mirrored,
        )

    def view_at(self, pose: Pose, name: ViewName) -> Cells:
        """Return the scan's cells or points that the photo, taken at a pose, shows.

        They are rendered from a place that is at most half a grid spacing away (`round_position`).
        """
        config = VIEWS[name]
        place = round_position(pose)
        shown = self.photo.find_shown_cells(config.num_rings, pose)
        cone = self.photo.find_cone(config.num_rings, pose)
        if name == "points":
            return self.views.points(place, config, shown.tobytes(), cone, NUM_POINTS)
        return normalize_view(self.views.averages(place, config, cone), place, config, shown)

    def averages_at(self, pose: Pose, place: Place, config: ViewConfig) -> Array32:
        """Return the sums (cells, 8) of the view from a place near a pose, as of `average_nodes`.

        Only the cells that the photo, taken at the pose, shows are complete.
        """
        return self.views.averages(place, config, self.photo.find_cone(config.num_rings, pose))

    def surroundings_at(self, pose: Pose) -> tuple[PackedPoints, PackedPoints]:
        """Return the scan's points in all directions around a pose, and coarser ones."""
        around = partial(self.views.surroundings, round_position(pose))
        return around(AROUND_VOXEL_PER_RANGE), around(COARSE_VOXEL_PER_RANGE)


def prepare_problem(
    panorama: Panorama,
    scan_map: ScanMap,
    prior: Prior = NOTHING_KNOWN,
    gravity: Gravity = "auto",
    method: Method = METHOD,
) -> Problem:
    """Prepare a panorama for its search in a map; its metadata may give the camera's tilt."""
    source = panorama
    R_level_from_cam = rotation_to_level(panorama.gpano) if panorama.gpano else None
    has_tilt = R_level_from_cam is not None
    R_cam_from_level = np.eye(3) if R_level_from_cam is None else R_level_from_cam.T
    if scan_map.has_shape:
        panorama = draw_edges(panorama, R_cam_from_level, scan_map.has_intensity)
    photo = make_photo(panorama, choose_scales(scan_map.has_shape), R_cam_from_level, has_tilt)
    return Problem(
        source=source,
        given=panorama,
        photo=photo,
        colors=Once(make_texels, panorama),
        scan_map=scan_map,
        views=make_views(scan_map),
        profile=choose_profile(photo.small.valid_share, photo.is_partial, scan_map.has_shape, method),
        prior=prior,
        gravity=gravity,
    )


def make_views(scan_map: ScanMap) -> RecentViews:
    """Return the views of a map, none rendered yet."""
    # the octree's leaves have narrow edges: only the last descent begins near enough to use them
    averaged = scan_map.octree.without_leaves() if scan_map.has_shape else None
    return RecentViews(scan_map.octree, averaged)


def make_texels(panorama: Panorama) -> Texels:
    """Pack a panorama into texels, at most MAX_LOSS_WIDTH wide."""
    panorama = shrink(panorama, MAX_LOSS_WIDTH)
    return pack_texels(panorama.rgb, panorama.is_valid)
