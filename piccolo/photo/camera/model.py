"""A camera: from pixels to rays and back, for all projections of pictures.

Models, their parameters and pixels are COLMAP's (sensor/models.h, https://colmap.github.io/cameras.html):
the centre of the upper left pixel is (0.5, 0.5), as everywhere here. In OpenCV it is (0, 0), so its principal
point is half a pixel less. Rays are in our camera axes, +x the image centre, +y left, +z up.

A ray at the angle theta from the axis meets the plane in front of the lens at the radius r:
    perspective r = tan theta;  equidistant r = theta (Kannala and Brandt, 2006);
    FOV r = atan(2 tan(omega / 2) tan theta) / omega (Devernay and Faugeras, 2001).
In a partial sphere x is the azimuth to the right and y the angle below the horizon [rad]. The point (x, y) is
distorted as in OpenCV (modules/calib3d, "Detailed description"), with r2 = x^2 + y^2:
    g  = (1 + k1 r2 + k2 r2^2 + k3 r2^3 + k4 r2^4) / (1 + d1 r2 + d2 r2^2 + d3 r2^3),
    x' = x g + 2 p1 x y + p2 (r2 + 2 x^2) + sx1 r2,
    y' = y g + p1 (r2 + 2 y^2) + 2 p2 x y + sy1 r2,
and u = fx x' + cx, v = fy y' + cy. d1..d3 are k4..k6 of OpenCV's rational model. For a fisheye lens the
length of (x, y) is the angle theta.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.polynomial import Polynomial

from ...geometry.sphere import compute_pixels, compute_rays
from ...system.arrays import Array, Mask
from ...system.errors import InputError

MAX_STEPS = 25  # of Newton's method; five are usual
LEAST = 1e-12  # a smaller denominator counts as this
NO_MORE = 1e-30  # a smaller coefficient changes nothing at any radius, but makes roots overflow
CONVERGED = 1e-12  # error of x' and y' at which Newton's method ends: 1e-9 of a pixel
PERSPECTIVE = "perspective"
EQUIDISTANT = "equidistant"
FOV = "fov"
SPHERE = "sphere"
PARTIAL_SPHERE = "partial sphere"
CUT_SPHERE = "PARTIAL_EQUIRECTANGULAR"  # the only model that is not COLMAP's
# lens, and the names of the parameters in the formulas above
MODELS: dict[str, tuple[str, tuple[str, ...]]] = {
    model: (lens, tuple(names.split()))
    for model, lens, names in (
        ("SIMPLE_PINHOLE", PERSPECTIVE, "f cx cy"),
        ("PINHOLE", PERSPECTIVE, "fx fy cx cy"),
        ("SIMPLE_RADIAL", PERSPECTIVE, "f cx cy k1"),
        ("RADIAL", PERSPECTIVE, "f cx cy k1 k2"),
        ("OPENCV", PERSPECTIVE, "fx fy cx cy k1 k2 p1 p2"),
        ("FULL_OPENCV", PERSPECTIVE, "fx fy cx cy k1 k2 p1 p2 k3 d1 d2 d3"),
        ("FOV", FOV, "fx fy cx cy omega"),
        ("SIMPLE_FISHEYE", EQUIDISTANT, "f cx cy"),
        ("FISHEYE", EQUIDISTANT, "fx fy cx cy"),
        ("SIMPLE_RADIAL_FISHEYE", EQUIDISTANT, "f cx cy k1"),
        ("RADIAL_FISHEYE", EQUIDISTANT, "f cx cy k1 k2"),
        ("OPENCV_FISHEYE", EQUIDISTANT, "fx fy cx cy k1 k2 k3 k4"),
        ("THIN_PRISM_FISHEYE", EQUIDISTANT, "fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1"),
        ("EQUIRECTANGULAR", SPHERE, "w h"),
        (CUT_SPHERE, PARTIAL_SPHERE, "fx fy cx cy"),
    )
}
FOCALS = "f", "fx", "fy"
RADIAL = "k1"
MAX_PERSPECTIVE = math.radians(89.9)  # half angle that a plane can show
MAX_ASPECT_ERROR = 0.01  # relative, between a picture and its calibration at another size
MAX_CAMERA_NUMBER = 1e6
MOST_OFF_AXIS = 1e3  # of a coefficient whose effect is not radial; beyond, pixels are not exact
OFF_AXIS = "p1", "p2", "sx1", "sy1"
MIN_FOCAL = 1.0  # [px]
TABLE_SIZE = 4096  # angles at which the radial part is tabulated, for the start of Newton's method
SMALL = 1e-4  # [rad] from the axis, over which the resolution is measured


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
        """Numerator of g as a polynomial in r2."""
        return Polynomial([1.0, self.k1, self.k2, self.k3, self.k4]).trim()

    @property
    def denominator(self) -> Polynomial:
        """Denominator of g as a polynomial in r2."""
        return Polynomial([1.0, self.d1, self.d2, self.d3]).trim()

    def radial(self, r2: Array) -> tuple[Array, Array]:
        """Return g and dg/dr2 at r2, an array of any shape."""
        n = self.numerator
        d = self.denominator
        above = n(r2)
        slope = n.deriv()(r2)
        if d.degree() == 0:
            return above, slope
        below = d(r2)
        below = np.where(np.abs(below) < LEAST, LEAST, below)  # 0 at the limit itself
        value = above / below
        return value, (slope - value * d.deriv()(r2)) / below

    def max_radius(self) -> float:
        """Return the radius up to which r g(r^2) grows, or infinity: beyond, two rays have the same pixel."""
        if self == Distortion():
            return math.inf
        n = self.numerator
        d = self.denominator
        r2 = Polynomial([0.0, 1.0])
        slope = n * d + 2.0 * r2 * (n.deriv() * d - n * d.deriv())
        roots = np.concatenate([slope.trim(NO_MORE).roots(), d.trim(NO_MORE).roots()])
        real = roots[np.abs(roots.imag) < 1e-9 * (1.0 + np.abs(roots))].real
        return math.sqrt(min(real[real > 0.0], default=math.inf))

    def apply(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Return the distorted (x', y') of (x, y), arrays of the same shape."""
        r2 = x * x + y * y
        xy = 2.0 * x * y
        g, _ = self.radial(r2)
        return (
            x * g + self.p1 * xy + self.p2 * (r2 + 2.0 * x * x) + self.sx1 * r2,
            y * g + self.p1 * (r2 + 2.0 * y * y) + self.p2 * xy + self.sy1 * r2,
        )

    def jacobian(self, x: Array, y: Array) -> tuple[Array, Array, Array, Array]:
        """Return the derivatives dx'/dx, dx'/dy, dy'/dx, dy'/dy at (x, y), arrays of the same shape."""
        g, by_r2 = self.radial(x * x + y * y)
        both = 2.0 * x * y * by_r2 + 2.0 * (self.p1 * x + self.p2 * y)
        return (
            g + 2.0 * x * x * by_r2 + 2.0 * self.p1 * y + (6.0 * self.p2 + 2.0 * self.sx1) * x,
            both + 2.0 * self.sx1 * y,
            both + 2.0 * self.sy1 * x,
            g + 2.0 * y * y * by_r2 + 2.0 * self.p2 * x + (6.0 * self.p1 + 2.0 * self.sy1) * y,
        )

    def keeps_sides(self, x: Array, y: Array) -> Mask:
        """Return True where the distortion does not mirror the picture: its Jacobian is positive."""
        a, b, c, d = self.jacobian(x, y)
        return np.asarray(a * d - b * c > 0.0)

    def invert(self, x_distorted: Array, y_distorted: Array, radii: Array) -> tuple[Array, Array, Mask]:
        """Return the (x, y) whose distortion is (x', y'), and a mask of those found, all of the same shape.

        Newton's method starts from the inverse of the radial part, which is tabulated at `radii` (N,): it
        grows over these, and the last is its limit.
        """
        length = np.hypot(x_distorted, y_distorted)
        begin = np.interp(length, radii * self.radial(radii**2)[0], radii) / np.maximum(length, 1e-300)
        x = x_distorted * begin
        y = y_distorted * begin
        for _ in range(MAX_STEPS):
            found_x, found_y = self.apply(x, y)
            off_x, off_y = found_x - x_distorted, found_y - y_distorted
            if max(np.abs(off_x).max(initial=0.0), np.abs(off_y).max(initial=0.0)) < CONVERGED:
                break
            a, b, c, d = self.jacobian(x, y)
            determinant = a * d - b * c
            per = 1.0 / np.where(np.abs(determinant) < 1e-9, 1e-9, determinant)
            x = x - (d * off_x - b * off_y) * per
            y = y - (a * off_y - c * off_x) * per
            shrink = np.minimum(1.0, radii[-1] / np.maximum(np.hypot(x, y), 1e-300))
            x = x * shrink
            y = y * shrink
        found_x, found_y = self.apply(x, y)
        is_found = np.hypot(found_x - x_distorted, found_y - y_distorted) < 1e3 * CONVERGED
        return x, y, is_found & self.keeps_sides(x, y)


@dataclass(frozen=True)
class Camera:
    """A calibrated camera; two cameras with equal fields are equal."""

    model: str  # one of MODELS
    width: int  # [px]
    height: int  # [px]
    params: tuple[float, ...]  # in COLMAP's order
    max_angle_deg: float | None = None  # from the axis, beyond which nothing is shown (a fisheye's circle)

    def __post_init__(self) -> None:
        if self.model not in MODELS:
            raise InputError(f"found the camera model {self.model!r}, wanted one of {', '.join(MODELS)}")
        names = MODELS[self.model][1]
        if len(self.params) != len(names) or not all(abs(p) <= MAX_CAMERA_NUMBER for p in self.params):
            wanted = f"wanted {len(names)} finite numbers ({' '.join(names)})"
            raise InputError(f"found {list(self.params)} as parameters of {self.model}, {wanted}")
        if not (0 < self.width <= MAX_CAMERA_NUMBER and 0 < self.height <= MAX_CAMERA_NUMBER):
            raise InputError(f"found a camera of {self.width} x {self.height}, wanted its size in pixels")
        if min(self.focal) < MIN_FOCAL:
            raise InputError(f"found a focal length of {min(self.focal):g} px, wanted at least {MIN_FOCAL:g}")
        if not 1e-4 <= self._named.get("omega", 1.0) < math.pi:
            raise InputError(f"found omega {self._named['omega']:g} of the model FOV, wanted 0.0001 to 3.14")
        self._check_off_axis()
        if self.max_angle_deg is not None and not 0.0 < self.max_angle_deg <= 180.0:
            raise InputError(f"found max_angle_deg {self.max_angle_deg:g}, wanted above 0 and at most 180")

    def _check_off_axis(self) -> None:
        """Raise InputError for a coefficient with which pixels would not be exact."""
        for name in OFF_AXIS:
            if abs(value := self._named.get(name, 0.0)) > MOST_OFF_AXIS:
                wanted = f"wanted {-MOST_OFF_AXIS:g} to {MOST_OFF_AXIS:g}"
                raise InputError(f"found {name} {value:g} of the model {self.model}, {wanted}")

    @property
    def lens(self) -> str:
        """The projection, which turns the angle from the optical axis into a radius."""
        return MODELS[self.model][0]

    def change(self, log_focal: float, k1: float = 0.0) -> "Camera":
        """Return the camera with changes of its focal length's logarithm and, if it has one, its k1."""
        factors = dict.fromkeys(FOCALS, math.exp(log_focal))
        steps = {RADIAL: k1}
        params = (value * factors.get(n, 1.0) + steps.get(n, 0.0) for n, value in self._named.items())
        return replace(self, params=tuple(float(value) for value in params))

    @cached_property
    def _named(self) -> dict[str, float]:
        return dict(zip(MODELS[self.model][1], self.params, strict=True))

    @property
    def focal(self) -> tuple[float, float]:
        """Pixels per unit of the plane, across and down; for a sphere, pixels per radian."""
        if self.lens == SPHERE:
            return self.width / (2.0 * math.pi), self.height / math.pi
        f = self._named.get("f", 0.0)
        return self._named.get("fx", f), self._named.get("fy", f)

    @property
    def center(self) -> tuple[float, float]:
        """Pixel (cx, cy) of the optical axis; only for models that have one, not EQUIRECTANGULAR."""
        return self._named["cx"], self._named["cy"]

    @cached_property
    def distortion(self) -> Distortion:
        """The distortion; coefficients that the model does not have are 0."""
        return Distortion(**{k: v for k, v in self._named.items() if k in Distortion._fields})

    @cached_property
    def max_angle(self) -> float:
        """Angle [rad] from the axis up to which each ray has a pixel of its own."""
        limits = {PERSPECTIVE: MAX_PERSPECTIVE, FOV: MAX_PERSPECTIVE}.get(self.lens, math.pi)
        radius = self.distortion.max_radius()
        if math.isfinite(radius):
            limits = min(limits, math.atan(radius) if self.lens == PERSPECTIVE else radius)
        return limits if self.max_angle_deg is None else min(limits, math.radians(self.max_angle_deg))

    @property
    def resolution(self) -> float:
        """Pixels per radian at the axis, at least MIN_FOCAL."""
        off = np.array([[math.cos(SMALL), -math.sin(SMALL), 0.0], [math.cos(SMALL), 0.0, -math.sin(SMALL)]])
        pixels, _ = self.pixels(np.array([[1.0, 0.0, 0.0], *off]))
        steps = np.linalg.norm(pixels[1:] - pixels[0], axis=1) / SMALL
        return max(float(np.sqrt(steps[0] * steps[1])), MIN_FOCAL)

    def scale_to_size(self, width: int, height: int) -> "Camera":
        """Return the same camera with its picture at another size. InputError if that has another shape."""
        if (width, height) == (self.width, self.height):
            return self
        across = width / self.width
        down = height / self.height
        if abs(across / down - 1.0) > max(MAX_ASPECT_ERROR, 1.5 / min(width, height)):
            found = f"found a picture of {width} x {height}"
            raise InputError(f"{found} and a calibration for {self.width} x {self.height}, wanted one shape")
        factors = {"f": math.sqrt(across * down), "fx": across, "cx": across, "fy": down, "cy": down}
        factors |= {"w": across, "h": down}
        params = tuple(value * factors.get(name, 1.0) for name, value in self._named.items())
        return replace(self, width=width, height=height, params=params)

    def scale_to_width(self, width: int) -> "Camera":
        """Return the same camera with its picture at another width [px]."""
        return self.scale_to_size(width, max(1, round(width * self.height / self.width)))

    def pixels(self, rays: Array) -> tuple[Array, Mask]:
        """Return pixels (..., 2) of rays (..., 3) of any length, and a mask (...) of those in the picture."""
        if self.lens == SPHERE:
            u, v = compute_pixels(rays, self.width)
            return np.stack([u, v * (2.0 * self.height / self.width)], axis=-1), np.ones(u.shape, np.bool_)
        forward = rays[..., 0]
        right = -rays[..., 1]
        down = -rays[..., 2]
        across = np.sqrt(right * right + down * down)
        if self.lens == PARTIAL_SPHERE:
            below = np.arctan2(down, np.hypot(forward, right))
            return self._place(np.arctan2(right, forward), below, np.ones(forward.shape, np.bool_))
        if self.lens == PERSPECTIVE:
            is_in = (forward > 0.0) & (across <= math.tan(self.max_angle) * forward)
            per = 1.0 / np.where(is_in, forward, np.inf)
        else:
            angle = np.arctan2(across, forward)
            is_in = angle <= self.max_angle
            per = np.where(is_in, self._radius(np.where(is_in, angle, 0.0)), 0.0) / np.maximum(across, 1e-300)
        x = right * per
        y = down * per
        if self.distortion != Distortion():
            is_in = is_in & self.distortion.keeps_sides(x, y)
            x, y = self.distortion.apply(x, y)
        return self._place(x, y, is_in)

    def _place(self, x: Array, y: Array, is_in: Mask) -> tuple[Array, Mask]:
        """Return pixels (..., 2) of points (x, y) of the plane, and a mask (...) of those in the picture."""
        u = self.focal[0] * x + self._named["cx"]
        v = self.focal[1] * y + self._named["cy"]
        is_in = is_in & (u >= 0.0) & (u <= self.width) & (v >= 0.0) & (v <= self.height)
        return np.stack([u, v], axis=-1), is_in

    def rays(self, pixels: Array) -> tuple[Array, Mask]:
        """Return the unit rays (..., 3) of pixels (..., 2), and a mask (...) of the pixels that have one."""
        u, v = np.moveaxis(np.asarray(pixels, np.float64), -1, 0)
        if self.lens == SPHERE:
            ray = compute_rays(u, v * (0.5 * self.width / self.height), self.width)
            return ray, np.ones(u.shape, np.bool_)
        x = (u - self._named["cx"]) / self.focal[0]
        y = (v - self._named["cy"]) / self.focal[1]
        is_found = np.ones(x.shape, np.bool_)
        if self.lens == PARTIAL_SPHERE:
            is_found = (u >= 0.0) & (u <= self.width) & (v >= 0.0) & (v <= self.height)
            is_found &= (np.abs(x) <= math.pi) & (np.abs(y) <= 0.5 * math.pi)
            flat = np.cos(y)
            return np.stack([flat * np.cos(x), -flat * np.sin(x), -np.sin(y)], axis=-1), is_found
        if self.distortion != Distortion():
            x, y, is_found = self.distortion.invert(x, y, self._radii)
        radius = np.hypot(x, y)
        angle = self._angle(radius)
        per = np.sin(angle) / np.maximum(radius, 1e-300)
        is_found &= (angle <= self.max_angle) & (u >= 0.0) & (u <= self.width)
        is_found &= (v >= 0.0) & (v <= self.height)
        return np.stack([np.cos(angle), -x * per, -y * per], axis=-1), is_found

    @cached_property
    def _radii(self) -> Array:
        return self._radius(np.linspace(0.0, self.max_angle, TABLE_SIZE))

    def _radius(self, angle: Array) -> Array:
        """Return the radius, before distortion, of an angle [rad] from the axis."""
        if self.lens == EQUIDISTANT:
            return angle
        if self.lens == PERSPECTIVE:
            return np.tan(angle)
        omega = self._named["omega"]
        return np.asarray(np.arctan(2.0 * math.tan(omega / 2.0) * np.tan(angle)) / omega)

    def _angle(self, radius: Array) -> Array:
        """Return the angle [rad] from the axis of a radius before distortion."""
        if self.lens == EQUIDISTANT:
            return radius
        if self.lens == PERSPECTIVE:
            return np.arctan(radius)
        omega = self._named["omega"]
        inner = np.minimum(radius * omega, 0.5 * math.pi)
        return np.arctan2(np.sin(inner), 2.0 * math.tan(omega / 2.0) * np.cos(inner))


def pinhole(width: int, height: int, focal: float) -> Camera:
    """Return an ideal pinhole camera of this size and focal length [px], with its axis in the middle."""
    return Camera("SIMPLE_PINHOLE", width, height, (focal, width / 2.0, height / 2.0))


def whole_sphere(width: int, height: int) -> Camera:
    """Return the camera of a picture that shows the whole sphere, with the horizon in the middle."""
    params = width / (2.0 * math.pi), height / math.pi, width / 2.0, height / 2.0
    return Camera(CUT_SPHERE, width, height, params)


def camera_of_fov(lens: str, fov_deg: float, width: int, height: int) -> Camera:
    """Return an ideal fisheye (`lens` "fisheye") or else a pinhole, whose width shows `fov_deg`.

    Raise InputError if a pinhole can't show so much.
    """
    if lens == "fisheye":
        focal = width / math.radians(fov_deg)
        return Camera("SIMPLE_FISHEYE", width, height, (focal, width / 2.0, height / 2.0))
    if fov_deg >= 2.0 * math.degrees(MAX_PERSPECTIVE) - 1.0:
        raise InputError(f"`fov_deg`: found {fov_deg:g} of a pinhole, wanted less than 178")
    return pinhole(width, height, width / 2.0 / math.tan(math.radians(fov_deg) / 2.0))
