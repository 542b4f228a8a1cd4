"""Pictures of labels, one number a pixel."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...panorama.picture import read_picture
from ...runtime.atomic import write_atomically
from .model import Labels


def labels_by_index(path: Path, table: NDArray[np.uint16]) -> Labels:
    """The labels (H, W) of a picture whose colours are indices R 2^16 + G 2^8 + B into a table; 0 beyond."""
    rgb = read_picture(path).rgb.astype(np.uint32)
    index = rgb[..., 0] << 16 | rgb[..., 1] << 8 | rgb[..., 2]
    beyond = len(table)
    return np.asarray(np.append(table, np.uint16(0))[np.minimum(index, beyond)], dtype=np.uint16)


def write_labels(path: Path, labels: Labels) -> None:
    """Write labels (H, W) as a 16-bit PNG with one channel."""
    is_done, png = cv2.imencode(".png", labels)
    if not is_done:
        raise InputError(f"{path}: {labels.shape} labels could not be encoded as PNG")
    write_atomically(path, png.tobytes())
