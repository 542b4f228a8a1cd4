"""A scan in the colours of photos: the work of `Scan.color`."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..cloud.cloud_settings import CloudSettings
from ..judge.result import Result
from ..scan_map.scan_map import ScanMap
from ..system.errors import InputError
from ..system.files.atomic import check_output
from ..system.files.line_file import Journal
from ..system.jobs.threads import Workers
from ..together.coloring.painting import (
    LEAST_COLORING_PHOTOS,
    OF_RESULTS,
    PAINTED,
    Coloring,
    check_colored_suffix,
    check_point_files,
    color_if_enough,
    localize_for_colors,
    write_colored_scan,
)
from .scan_photo import Asked

__all__ = [
    "LEAST_COLORING_PHOTOS",
    "PAINTED",
    "check_colored_suffix",
    "color_by",
    "color_if_enough",
    "write_colored_scan",
]


def color_by(
    name: str | tuple[str, ...],
    scan_map: ScanMap,
    cloud_settings: CloudSettings,
    asked: Sequence[Asked],
    localize: Callable[[ScanMap, Asked], Result],
    out: Path,
    workers: Workers,
) -> Coloring:
    """Localize photos, then again in the scan with the other photos' colours; write the coloured scan.

    `name` is the path, or the paths, of the scan's files, which are written to `out` in these colours.
    `localize` returns the result of a photo in a map, which may have the other photos' colours.
    """
    files = [Path(path) for path in ([name] if isinstance(name, str) else name)]
    check_point_files(files)
    check_colored_suffix(out)
    check_output(out)
    if any(isinstance(one.photo.picture, np.ndarray) for one in asked):
        raise InputError("`photos`: found an array, wanted files, which are read again for their colours")

    def localize_one(colored: ScanMap, k: int) -> Result:
        result = localize(colored, asked[k])
        return replace(result, settings={**result.settings, **OF_RESULTS})

    steps = [one.photo.name for one in asked]
    results = localize_for_colors(scan_map, steps, localize_one, len(asked), workers, Journal())
    return color_if_enough(files, scan_map, cloud_settings, results, out, workers)
