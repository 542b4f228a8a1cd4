"""The checks of a file's points, chunk by chunk, and their conversion to metres."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..geometry.pose import MAX_COORDINATE
from ..system.arrays import Array, Bytes, Mask
from ..system.errors import InputError
from .readers import reader

MIN_POINTS = 1000  # of a file
MIN_BRIGHTEST = 2  # of 255, of the brightest colour: 8-bit values in 16-bit fields are read as 1 at most
COARSE_STEP = 0.01  # [m] larger steps between float32 numbers are warned of: from 131 km on
Chunk = tuple[Array, Bytes]  # finite points (N, 3) [m], colours (N, 3)


def find_box(points: Array) -> Array:
    """Return the least and the greatest coordinates (2, 3) of points (N, 3); NaN where any is NaN."""
    columns = points.T  # column by column, which is faster
    return np.array([[a.min(initial=np.inf) for a in columns], [a.max(initial=-np.inf) for a in columns]])


@dataclass
class PointValidator:
    """The checks of a file's points, and what has been counted so far."""

    path: Path
    units: Array  # (3,) [m] units of the file's x, y, z
    is_colored: bool = True  # the file has colours
    num_finite: int = 0
    num_dropped: int = 0  # points with NaN or infinite coordinates
    brightest: int = 0  # largest value of any colour
    color: Bytes | None = None  # (3,) colour of the first point
    is_varied: bool = False  # not all points have this colour
    step: float = 0.0  # [m] largest step between neighbouring float32 numbers, at the farthest point
    # (2, 3) least and greatest coordinates so far [m]
    box: Array = field(default_factory=lambda: find_box(np.empty((0, 3))))

    def filter(self, raw: reader.RawCloud) -> Chunk:
        """Count the points of a chunk; return the finite ones in metres."""
        colors = raw.colors
        with np.errstate(invalid="ignore"):  # a signalling NaN
            points: Array = raw.points_world.astype(np.float64, copy=False)
        box = find_box(points)
        if not np.isfinite(box).all():
            is_finite: Mask = np.all(np.isfinite(points), axis=1)
            points = points[is_finite]
            colors = colors[is_finite]
            box = find_box(points)
        self.num_finite += len(points)
        self.num_dropped += len(raw.colors) - len(points)
        if len(points):
            points = points if (self.units == 1.0).all() else points * self.units
            farthest_read = np.abs(box).max(axis=0)
            box *= self.units
            self.box[0] = np.minimum(self.box[0], box[0])
            self.box[1] = np.maximum(self.box[1], box[1])
            self.brightest = max(self.brightest, int(colors.max()))
            self.color = colors[0] if self.color is None else self.color
            self.is_varied = self.is_varied or bool((colors != self.color).any())
            farthest = float(np.abs(box).max())
            if farthest > MAX_COORDINATE:
                found = f"a coordinate of {farthest:.3g} m, wanted all within {MAX_COORDINATE:.0e} m"
                raise InputError(f"{self.path}: {found}; remove broken points or set `units`")
            if raw.points_world.dtype == np.float32:
                steps = np.spacing(farthest_read.astype(np.float32)) * self.units
                self.step = max(self.step, float(steps.max()))
        return points, colors

    def check(self) -> None:
        """After the last chunk, refuse a file that has too few finite points, or only black ones."""
        if self.num_finite < MIN_POINTS:
            found = f"found {self.num_finite} finite points ({self.num_dropped} with NaN or infinity)"
            raise InputError(f"{self.path}: {found}, wanted at least {MIN_POINTS}")
        if self.is_colored and self.brightest < MIN_BRIGHTEST:
            found = f"all points are black (brightest value {self.brightest} of 255)"
            raise InputError(f"{self.path}: {found}, wanted their colours; `color_range` sets their range")

    def warnings(self) -> tuple[str, ...]:
        """Return warnings: points left out, all of one colour, or stored with too few digits."""
        texts = []
        if self.num_dropped:
            texts.append(f"{self.num_dropped} points with NaN or infinite coordinates left out")
        if self.is_colored and not self.is_varied and self.color is not None:
            color = " ".join(map(str, self.color.tolist()))
            texts.append(f"all points have one colour ({color}), which shows nothing: wanted their colours")
        if self.step >= COARSE_STEP:
            what = f"its float32 coordinates, far from the origin, are rounded to {self.step:.2g} m"
            texts.append(f"{what}: export it in float64, or nearer to its origin")
        return tuple(f"{self.path}: {text}" for text in texts)
