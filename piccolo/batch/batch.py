"""Many panoramas one after another: those that are finished are passed over, each result counts."""

import json
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from .. import __version__
from ..camera import Calibration
from ..cloud.settings import CloudSettings
from ..coarse_to_fine.settings import CoarseToFineSettings
from ..errors import InputError
from ..panorama import ReadOptions
from ..panorama.photo import photo_of
from ..query_options import Settings
from ..scan import settings_json
from .priors import PriorTable
from .results_file import WAYS, check_finished, finished_lines


@dataclass(frozen=True)
class Batch:
    """How the panoramas of a batch are localized."""

    settings: Settings
    cloud_settings: CloudSettings
    read_options: ReadOptions
    priors: PriorTable | None = None

    def settings_of(self, pano: Path) -> Settings:
        """The settings of one panorama: its own prior, if it has one."""
        if self.priors is None or not isinstance(self.settings, CoarseToFineSettings):
            return self.settings
        return replace(self.settings, prior=self.priors.prior_of(pano, self.settings.prior))

    def expected(self, pano: Path, cloud: str | tuple[str, ...], cloud_sha256: str) -> Mapping[str, Any]:
        """What the line of a panorama says of how it was made, as JSON gives it back."""
        repeated = settings_json(self.settings_of(pano), self.cloud_settings, self.read_options)
        expected = {
            "pano": str(pano),
            "pano_sha256": pano_sha256(pano, self.read_options.rig),
            "cloud": cloud,
            "cloud_sha256": cloud_sha256,
            "settings": repeated,
            "version": __version__,
        }
        return dict(json.loads(json.dumps(expected)))

    def pass_finished(
        self, path: Path, panoramas: Iterator[Path], cloud: str | tuple[str, ...], cloud_sha256: str
    ) -> tuple[Counter[str], int]:
        """Take from `panoramas` what an earlier run has finished: counts by status, size of their lines.

        Raises
        ------
        InputError
            The file is of another run: other panoramas, settings, scan, or photos that have changed.
        """
        counts = Counter[str]()
        lines, size = finished_lines(path)
        for fields in lines:
            pano = next(panoramas, None)
            if pano is None:
                raise InputError(f"{fields['line']}: more results than this command has panoramas; {WAYS}")
            check_finished(fields, self.expected(pano, cloud, cloud_sha256))
            counts[str(fields["status"])] += 1
        return counts, size


def pano_sha256(pano: Path, rig: Calibration | None) -> str | None:
    """Digest of a panorama's file; None for one that is missing or no picture."""
    try:
        return photo_of(pano, rig).sha256
    except (OSError, InputError):
        return None
