"""A query: a panorama at several scales, and the map in which it is searched."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..geometry.pose import Array
from ..panorama import Panorama
from ..panorama.gpano import rotation_to_level
from ..panorama.local_normalization import image_pyramid
from ..panorama.texels import Texels
from ..runtime.threads import Workers
from .config import METHOD, MethodConfig
from .scan_map import ScanMap
from .settings import CoarseToFineSettings


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
    images = QueryImages(*image_pyramid(panorama, method.scales))
    return Query(scan_map, images, R_cam_from_level, settings, workers, method)
