"""Results as files of the tools that come next: one writer a format, then the same checks for all."""

from collections.abc import Sequence
from pathlib import Path

from ...errors import InputError
from ...result import Result
from ...runtime.atomic import check_output, check_output_folder
from .colmap import COLMAP
from .geojson import GEOJSON
from .gpano import GPANO
from .model import Format, Options
from .nerfstudio import NERFSTUDIO
from .opensfm import OPENSFM
from .potree import POTREE
from .shots import Selection, select, shots_of, true_results
from .table import CSV
from .trajectory import KITTI, TUM

__all__ = ["FORMATS", "Format", "Options", "Selection", "export", "select", "true_results"]

FORMATS: dict[str, Format] = {
    f.name: f for f in (COLMAP, NERFSTUDIO, OPENSFM, TUM, KITTI, CSV, GEOJSON, POTREE, GPANO)
}


def export(results: Sequence[Result], name: str, out: Path, options: Options) -> None:
    """Write the poses of `results`, which all have one, to `out` in the format `name`, whole or not at all.

    Raises
    ------
    InputError
        There is no pose, the format can't say what a result says, a picture can't be read, or `out` can't
        be written.
    """
    form = FORMATS[name]
    if form.is_folder:
        check_output_folder(out)
    else:
        check_output(out, [Path(result.pano) for result in results])
    if not results:
        raise InputError(f"{out}: found no pose to write, wanted one or more")
    form.write(shots_of(results, form, options), out, options)
