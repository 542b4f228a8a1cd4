"""A query: a panorama at several scales, and the map in which it is searched."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.pose import Array, Pose, rotate_points
from ..geometry.sphere import indices_of, make_grid
from ..local_features.keypoints import find_keypoints
from ..local_features.matching import Matches, match
from ..panorama import Panorama
from ..panorama.gpano import rotation_to_level
from ..panorama.local_normalization import image_pyramid
from ..panorama.model import resize
from ..panorama.texels import Texels, pack_texels
from ..runtime.threads import Workers
from .config import METHOD, MethodConfig
from .scan_map import ScanMap
from .settings import CoarseToFineSettings

COMPARED_WIDTH = 256  # [px]
MOST_SHARE = 0.98  # of the sphere: of a photo that shows more, all cells are shown


class QueryImages(NamedTuple):
    """The panorama's locally normalised channels."""

    full: Texels  # for the last millimetres
    fine: Texels  # for fine views
    middle: Texels
    search: Texels


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

    @cached_property
    def matches(self) -> Matches:
        """The photo's keypoints and the features of the map that look alike."""
        gray = np.asarray(cv2.cvtColor(self.panorama.rgb, cv2.COLOR_RGB2GRAY), np.uint8)
        keypoints = find_keypoints(gray, self.panorama.is_valid, self.workers)
        return match(keypoints, self.scan_map.local_features, self.workers)

    @cached_property
    def photo(self) -> Texels:
        """The photo's colours at the size at which poses are compared."""
        small = resize(self.panorama, COMPARED_WIDTH)
        return pack_texels(small.rgb, small.is_valid)

    @cached_property
    def comparisons(self) -> dict[bytes, Any]:
        """What comparison.py has worked out already, by pose, and by the blocks that are left out."""
        return {}

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
        return replace(self, images=QueryImages(*image_pyramid(rest, self.method.scales)), panorama=rest)


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
    panorama = resize(panorama, method.scales.full.width)
    images = QueryImages(*image_pyramid(panorama, method.scales))
    return Query(scan_map, images, R_cam_from_level, settings, workers, method, panorama)
