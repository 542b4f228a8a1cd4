"""The tilt of a photo in a scan without colours: its lines against the vertical of the scan."""

from dataclasses import replace

from ..jobs.threads import Workers
from ..panorama import Panorama
from ..panorama.manhattan import find_axes
from ..scan_map.scan_map import ScanMap
from .attempts import brief_query, score_starts
from .query import prepare_query
from .search import search_poses
from .settings import CoarseToFineSettings, MethodConfig

CLEAR_SHAPE = 0.1  # least score with which a level camera is taken for the right one
NUM_TILTS = 3  # that are searched in full, at most


def is_tilt_known(panorama: Panorama, settings: CoarseToFineSettings) -> bool:
    """Return True if the settings, or the photo's metadata, say how the camera was tilted."""
    has_attitude = settings.prior.gravity_vector is not None or panorama.gpano is not None
    return settings.gravity == "known" or (has_attitude and settings.gravity != "unknown")


def find_tilts(
    scan_map: ScanMap,
    panorama: Panorama,
    settings: CoarseToFineSettings,
    workers: Workers,
    method: MethodConfig,
) -> list[CoarseToFineSettings]:
    """Return settings with the axes of the photo's lines as its vertical, those that fit best.

    In a building the vertical is one of six directions of lines. Each is searched briefly.
    """
    tried = [
        replace(
            settings,
            gravity="known",
            prior=replace(settings.prior, gravity_vector=tuple((-axis).tolist())),
        )
        for axis in find_axes(panorama)
    ]
    scores = []
    for one in tried:
        query = brief_query(prepare_query(panorama, scan_map, one, workers, method))
        scores.append(score_starts(query, search_poses(query, "known")))
    ranked = sorted(range(len(tried)), key=lambda k: -scores[k])
    return [tried[k] for k in ranked[:NUM_TILTS]]
