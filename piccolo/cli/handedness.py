"""After a batch in which no photo was localized: whether the scan is left-handed."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..batch.localizer import Localizer
from ..confidence.confidence import LOCALIZED
from ..files.atomic import temporary_folder
from ..panorama import read_panorama
from ..views.pictures import encode_image
from .executing import Executor

NUM_TRIED = 3  # photos that were not localized
LEFT_HANDED = (
    "the photos fit the scan mirrored, left for right: its axes are left-handed, which `up` can't mend; "
    "negate one of its coordinates, or export it with right-handed axes"
)


def is_left_handed(localizer: Localizer, photos: Sequence[str], executor: Executor) -> bool:
    """Return True if most of the first photos are localized when they are mirrored; they are spheres."""
    if len(photos) < NUM_TRIED:
        return False
    with temporary_folder() as folder:
        paths = [folder / f"{k}.png" for k in range(NUM_TRIED)]
        for path, photo in zip(paths, photos, strict=False):
            photo_asked, _ = localizer.ask(Path(photo))
            panorama = read_panorama(photo_asked, localizer.cloud_settings.labels)
            shown = np.dstack([panorama.rgb, np.uint8(255) * panorama.is_valid])
            path.write_bytes(encode_image(shown[:, ::-1], ".png"))
        pairs = executor.values(map(localizer.task, paths))
        found = [localizer.wait_for(*pair, None).result.status for pair in pairs]
    return 2 * found.count(LOCALIZED) > NUM_TRIED
