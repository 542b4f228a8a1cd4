"""Distortion in the plane before the lens, its derivative, its inverse, and the radius up to which it holds.

With r2 = x^2 + y^2, as OpenCV (modules/calib3d, "Detailed description") and COLMAP (sensor/models.h) have it:
    g  = (1 + k1 r2 + k2 r2^2 + k3 r2^3 + k4 r2^4) / (1 + d1 r2 + d2 r2^2 + d3 r2^3),
    x' = x g + 2 p1 x y + p2 (r2 + 2 x^2) + sx1 r2,
    y' = y g + p1 (r2 + 2 y^2) + 2 p2 x y + sy1 r2.
d1..d3 are OpenCV's k4..k6 of the rational model. Of a fisheye lens (x, y) has the length of the angle.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from ..geometry.pose import Array

MAX_STEPS = 25  # of Newton; five are usual
LEAST = 1e-12  # of the denominator
NO_MORE = 1e-30  # of a coefficient: less does nothing at any radius, but overflows
CONVERGED = 1e-12  # of x' and y': a thousandth of a millionth of a pixel


class Distortion(NamedTuple):
    """The coefficients of the formula above."""

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    d1: float = 0.0
    d2: float = 0.0
    d3: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    sx1: float = 0.0
    sy1: float = 0.0

    @property
    def numerator(self) -> Polynomial:
        """Of g, in r2."""
        return Polynomial([1.0, self.k1, self.k2, self.k3, self.k4]).trim()

    @property
    def denominator(self) -> Polynomial:
        """Of g, in r2."""
        return Polynomial([1.0, self.d1, self.d2, self.d3]).trim()

    def radial(self, r2: Array) -> tuple[Array, Array]:
        """Values g and dg/dr2 at r2, of any shape."""
        n, d = self.numerator, self.denominator
        below = d(r2)
        below = np.where(np.abs(below) < LEAST, LEAST, below)  # 0 at the limit itself
        value = n(r2) / below
        return value, (n.deriv()(r2) - value * d.deriv()(r2)) / below

    def max_radius(self) -> float:
        """Radius up to which r g(r^2) grows, infinite if it always does: beyond, a pixel is two rays."""
        n, d, r2 = self.numerator, self.denominator, Polynomial([0.0, 1.0])
        slope = n * d + 2.0 * r2 * (n.deriv() * d - n * d.deriv())
        roots = np.concatenate([slope.trim(NO_MORE).roots(), d.trim(NO_MORE).roots()])
        real = roots[np.abs(roots.imag) < 1e-9 * (1.0 + np.abs(roots))].real
        return math.sqrt(min(real[real > 0.0], default=math.inf))

    def apply(self, x: Array, y: Array) -> tuple[Array, Array]:
        """The distorted (x', y') of (x, y), arrays of one shape."""
        r2, xy = x * x + y * y, 2.0 * x * y
        g, _ = self.radial(r2)
        return (
            x * g + self.p1 * xy + self.p2 * (r2 + 2.0 * x * x) + self.sx1 * r2,
            y * g + self.p1 * (r2 + 2.0 * y * y) + self.p2 * xy + self.sy1 * r2,
        )

    def jacobian(self, x: Array, y: Array) -> tuple[Array, Array, Array, Array]:
        """Derivatives dx'/dx, dx'/dy, dy'/dx, dy'/dy at (x, y), arrays of one shape."""
        g, by_r2 = self.radial(x * x + y * y)
        both = 2.0 * x * y * by_r2 + 2.0 * (self.p1 * x + self.p2 * y)
        return (
            g + 2.0 * x * x * by_r2 + 2.0 * self.p1 * y + (6.0 * self.p2 + 2.0 * self.sx1) * x,
            both + 2.0 * self.sx1 * y,
            both + 2.0 * self.sy1 * x,
            g + 2.0 * y * y * by_r2 + 2.0 * self.p2 * x + (6.0 * self.p1 + 2.0 * self.sy1) * y,
        )

    def keeps_sides(self, x: Array, y: Array) -> NDArray[np.bool_]:
        """True where the distortion does not turn the picture inside out."""
        a, b, c, d = self.jacobian(x, y)
        return np.asarray(a * d - b * c > 0.0)

    def invert(
        self, x_distorted: Array, y_distorted: Array, radii: Array
    ) -> tuple[Array, Array, NDArray[np.bool_]]:
        """The (x, y) whose distortion is (x', y'), and where it was found, arrays of one shape.

        By Newton, from the inverse of the radial part, which grows over `radii` (N,), the last its limit.
        """
        length = np.hypot(x_distorted, y_distorted)
        begin = np.interp(length, radii * self.radial(radii**2)[0], radii) / np.maximum(length, 1e-300)
        x, y = x_distorted * begin, y_distorted * begin
        for _ in range(MAX_STEPS):
            found_x, found_y = self.apply(x, y)
            off_x, off_y = found_x - x_distorted, found_y - y_distorted
            if max(np.abs(off_x).max(initial=0.0), np.abs(off_y).max(initial=0.0)) < CONVERGED:
                break
            a, b, c, d = self.jacobian(x, y)
            determinant = a * d - b * c
            per = 1.0 / np.where(np.abs(determinant) < 1e-9, 1e-9, determinant)
            x, y = x - (d * off_x - b * off_y) * per, y - (a * off_y - c * off_x) * per
            shrink = np.minimum(1.0, radii[-1] / np.maximum(np.hypot(x, y), 1e-300))
            x, y = x * shrink, y * shrink
        found_x, found_y = self.apply(x, y)
        is_found = np.hypot(found_x - x_distorted, found_y - y_distorted) < 1e3 * CONVERGED
        return x, y, is_found & self.keeps_sides(x, y)
