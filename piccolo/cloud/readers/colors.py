"""Colours of any type to 8 bits. The range follows from the declared type and is never guessed."""

import numpy as np
from numpy.typing import NDArray

# The value that means full brightness, by the type of a field without its byte order.
BRIGHTEST = {"u1": 255.0, "u2": 65535.0, "f4": 1.0, "f8": 1.0}
TYPES_WANTED = "uint8 0-255, uint16 0-65535 or float 0-1"


def to_bytes(
    colors: NDArray[np.generic], points_world: NDArray[np.float64], brightest: float
) -> tuple[NDArray[np.uint8], int]:
    """Colours (N, 3) uint8 of values 0 to `brightest`, and the first row that is out of range, or -1.

    A point without a finite position needs no colour: it becomes black.
    """
    if colors.dtype == np.uint8 and brightest == BRIGHTEST["u1"]:
        return np.array(colors, dtype=np.uint8), -1
    is_finite: NDArray[np.bool_] = np.all(np.isfinite(points_world), axis=1)
    values = np.where(is_finite[:, None], colors, 0).astype(np.float64)
    is_wrong = ~np.all((values >= 0.0) & (values <= brightest), axis=1)
    if is_wrong.any():
        return np.zeros((len(values), 3), np.uint8), int(np.argmax(is_wrong))
    return np.rint(values * (255.0 / brightest)).astype(np.uint8), -1


def in_words(color: NDArray[np.generic]) -> str:
    """The numbers of a colour (3,), for a message."""
    return " ".join(f"{value:g}" for value in color.tolist())
