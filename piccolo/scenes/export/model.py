"""What a format's writer is given, and what describes the format."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from ...errors import InputError
from ...geometry.pose import Pose
from ...panorama.crop import ASPECT_TOLERANCE
from ...result import Result


@dataclass(frozen=True)
class PosedImage:
    """One picture with its pose, as it is to be written."""

    name: str  # of the picture, relative to the folder of images
    path: Path  # where the picture is
    time: str  # timestamp, a number as text
    pose: Pose  # less the offset
    size: tuple[int, int]  # W, H [px]; (0, 0) for a format that takes none
    result: Result


@dataclass(frozen=True)
class Options:
    """What the user chooses; a format takes some of these."""

    images: Path | None = None  # folder to which names are relative; None: as the result has them
    size: tuple[int, int] | None = None  # W, H [px] of all pictures; None: read from each
    offset: tuple[float, float, float] | None = None  # subtracted from positions [m]
    axes: str = "optical"  # of the camera in a trajectory: "optical" or "piccolo"
    timestamps: str = "index"  # "index", or "name": the number that is the picture's name
    crs: str | None = None  # of the cloud's coordinates, such as EPSG:25832

    def __post_init__(self) -> None:
        """Refuse values that mean nothing, naming the option."""
        if self.size is not None:
            check_size("--size", self.size)
        if self.offset is not None and not all(math.isfinite(value) for value in self.offset):
            raise InputError(f"--offset: found {self.offset}, wanted three finite numbers")


@dataclass(frozen=True)
class Format:
    """How the poses are written in one format."""

    name: str
    description: str  # what reads it, and what `out` is
    write: Callable[[Sequence[PosedImage], Path, Options], None]
    options: frozenset[str] = frozenset()  # names of the Options that it takes beside `images`
    is_folder: bool = False
    has_unique_names: bool = True  # the picture's name is the key
    forbidden: str = ""  # regular expression of what a name can't have in it


def check_size(label: str, size: tuple[int, int]) -> None:
    """Refuse the size of a picture that is no full sphere."""
    width, height = size
    if min(size) < 1 or abs(width - 2 * height) > ASPECT_TOLERANCE * 2 * height:
        raise InputError(f"{label}: found {width} x {height}, wanted width = 2 x height (a full sphere)")
