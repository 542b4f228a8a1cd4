"""Colours of any type to 8 bits. The range follows from the declared type and is never guessed."""

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from .reader import RawCloud

# The value that means full brightness, by the type of a field without its byte order.
BRIGHTEST = {"u1": 255.0, "u2": 65535.0, "f4": 1.0, "f8": 1.0}
TYPES_WANTED = "uint8 0-255, uint16 0-65535 or float 0-1, one for all three"
COLOR_NAMES = (
    ("red", "green", "blue"),
    ("r", "g", "b"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
)


def color_names(names: Collection[str]) -> tuple[str, ...]:
    """Which of a file's names are the three colours'; empty if none are."""
    return next((three for three in COLOR_NAMES if all(name in names for name in three)), ())


def brightest_of(path: Path, types: Sequence[str]) -> float:
    """The value of full brightness in colours of these types, as "u1"."""
    if len(set(types)) > 1 or types[0] not in BRIGHTEST:
        raise InputError(f"{path}: the colours are of type {' '.join(types)}, wanted {TYPES_WANTED}")
    return BRIGHTEST[types[0]]


def colored_chunks(
    chunks: Iterable[tuple[NDArray[np.generic], NDArray[np.generic]]],
    brightest: float,
    locate: Callable[[int], str],
) -> Iterator[RawCloud]:
    """Yield chunks of positions and colours (N, 3), each of any type, colours from 0 to `brightest`.

    Raises
    ------
    InputError
        A colour is out of range: `locate` turns the index of its point into the file and a place in it.
    """
    num_before = 0
    for points, values in chunks:
        with np.errstate(invalid="ignore"):  # a NaN of the kind that signals
            points_world = points.astype(np.float64)
        colors, wrong = _to_uint8(values, points_world, brightest)
        if wrong >= 0:
            color = " ".join(f"{value:g}" for value in values[wrong].tolist())
            place = locate(num_before + wrong)
            raise InputError(f"{place} has the colour {color}, wanted 0 to {brightest:g}")
        num_before += len(colors)
        yield RawCloud(points_world, colors)


def _to_uint8(
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
