"""Up of a cloud by a photo that was taken in it, localized under exactly one of the hypotheses."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..cloud import CloudStream
from ..cloud.settings import CloudSettings
from ..cloud.voxels import Voxels
from ..coarse_to_fine.scan_map import prepare_map
from ..coarse_to_fine.settings import CoarseToFineSettings
from ..confidence.confidence import LOCALIZED
from ..geometry.pose import Array
from ..gravity import rotation_to_z_up
from ..gravity.up import Hypothesis, Up
from ..runtime.threads import Workers
from ..scan import Scan

MAX_HYPOTHESES = 4  # tried, each of which takes a map
MIN_PROBABILITY = 1e-4  # of one that is tried
AS_MAPPED = CloudSettings(up="z")


@dataclass(frozen=True)
class TurnedCloud:
    """A cloud in other axes: x_turned = R_turned_from_scan @ x_scan."""

    cloud: CloudStream
    R_turned_from_scan: Array  # (3, 3)

    def voxels(self, R_map_from_world: Array) -> Voxels:
        """Its points averaged voxel by voxel, in axes turned again by a rotation (3, 3)."""
        return self.cloud.voxels(R_map_from_world @ self.R_turned_from_scan)


def settle_by_photo(found: Up, cloud: CloudStream, pano: Path, workers: Workers) -> Up:
    """Up as the hypothesis under which an upright photo is localized; as found if that are none or several.

    The confidence is then the photo's.
    """
    tried = [h for h in found.hypotheses if h.probability > MIN_PROBABILITY][:MAX_HYPOTHESES]
    outcomes = [_localized(hypothesis, cloud, pano, workers) for hypothesis in tried]
    statuses = ", ".join(status for status, _ in outcomes)
    localized = [k for k, (status, _) in enumerate(outcomes) if status == LOCALIZED]
    if len(localized) != 1:
        return found._replace(reason=f"{found.reason}; {pano} settles nothing: {statuses}")
    (k,) = localized
    reason = f"{pano} is localized under this of {len(tried)} hypotheses only: {statuses}"
    return found._replace(direction_world=tried[k].direction_world, confidence=outcomes[k][1], reason=reason)


def _localized(hypothesis: Hypothesis, cloud: CloudStream, pano: Path, workers: Workers) -> tuple[str, float]:
    """Status and confidence of an upright photo in the cloud with this direction up."""
    settings = CoarseToFineSettings(gravity="known")
    turned = TurnedCloud(cloud, np.asarray(rotation_to_z_up(hypothesis.direction_world)))
    scan_map = prepare_map(turned, workers, "z")
    result = Scan(scan_map, cloud.label, AS_MAPPED, settings, workers, {}).localize(pano)
    return result.status, result.confidence
