"""Results as files of other tools: a writer for each format, and the same checks for all."""

from collections.abc import Sequence
from pathlib import Path

from ..errors import InputError
from ..files.atomic import check_output, check_output_folder
from ..result import Result
from .formats import COLMAP, CSV, GEOJSON, GPANO, GPX, KITTI, NERFSTUDIO, OPENSFM, POTREE, TUM
from .posed_images import Format, LeftOut, Options, Selection, select, select_images, true_results

__all__ = ["FORMATS", "Format", "Options", "Selection", "export", "select", "true_results"]

_ALL = COLMAP, NERFSTUDIO, OPENSFM, TUM, KITTI, CSV, GEOJSON, GPX, POTREE, GPANO
FORMATS: dict[str, Format] = {form.name: form for form in _ALL}


def export(results: Sequence[Result], name: str, out: Path, options: Options) -> LeftOut:
    """Write the poses of `results`, which all have one, to `out` in the format `name`, whole or not at all.

    Returns the pictures that are left out, by why: the format can't hold them, or they can't be read.
    Raises InputError if no pose is left, or `out` can't be written.
    """
    form = FORMATS[name]
    (check_output_folder if form.is_folder else check_output)(out)
    if not results:
        raise InputError(f"{out}: there is no pose to write; `all` also writes those that are not localized")
    images, left_out = select_images(results, form, options)
    form.write(images, out, options)
    return left_out
