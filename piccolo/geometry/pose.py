"""SE(3) in NumPy, float64: `x_cam = R_cam_from_world @ (x_world - center_world)`.

Points are rotated term by term: BLAS sums in an order that depends on the number of points.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np

from ..system.arrays import Array
from ..system.errors import InputError

NEWTON_STEPS = 4  # from an error of 5 % to rounding
MAX_DISTANCE = 0.1  # [m] the paper's line between correct and wrong
MAX_ANGLE = math.radians(5.0)
MAX_SKEW = 1e-3  # of R R^T from the identity, in poses from outside: matrices are written with few digits
MAX_COORDINATE = 1e8  # [m], ten times the Earth: beyond it lie only broken numbers, and float32 gives way
TINY_SINE = 1e-150  # sine of an angle; of smaller ones the direction is lost to underflow
# of a query: known: the camera is upright, up to yaw; unknown: any rotation; auto: both are tried
Gravity = Literal["auto", "known", "unknown"]

# Psi, the real root of x^4 = x + 4 (Alexa, "Super-Fibonacci Spirals: Fast,
# Low-Discrepancy Sampling of SO(3)", CVPR 2022).
SUPER_FIBONACCI_PSI = 1.533751168755204288118041
OPTICAL_FROM_CAM = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # right, down, forward
OPENGL_FROM_CAM = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])  # right, up, back
CAMERA_AXES = {"optical": OPTICAL_FROM_CAM, "piccolo": np.eye(3)}  # by the name in the options
DECIMALS = 9  # of degrees


class ByValue:
    """A dataclass of arrays, compared and hashed by their values."""

    def _values(self) -> tuple[object, ...]:
        values = vars(self).values()
        return tuple((v.shape, *v.flat) if isinstance(v, np.ndarray) else v for v in values)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, type(self)) and self._values() == other._values()

    def __hash__(self) -> int:
        return hash(self._values())

    def freeze(self) -> None:
        """Make the arrays read-only."""
        for value in vars(self).values():
            if isinstance(value, np.ndarray):
                value.setflags(write=False)


@dataclass(frozen=True, eq=False)
class Pose(ByValue):
    """Position and rotation of a camera: `x_cam = R_cam_from_world @ (x_world - center_world)`.

    Parameters
    ----------
    R_cam_from_world
        Rotation (3, 3), float64. Camera axes are +x to the image centre, +y left, +z up.
    center_world
        Position of the camera (3,) [m], float64, in the scan's own coordinates.

    Examples
    --------
    >>> import numpy as np
    >>> from piccolo import Pose
    >>> pose = Pose(np.diag([-1.0, -1.0, 1.0]), np.array([1.0, 2.0, 3.0]))
    >>> pose.R_cam_from_world[0]  # viewing direction of the image centre
    array([-1.,  0.,  0.])
    >>> pose.T_world_from_cam @ [2.0, 0.0, 0.0, 1.0]  # the point 2 m ahead
    array([-1.,  2.,  3.,  1.])
    """

    R_cam_from_world: Array
    center_world: Array

    @property
    def key(self) -> bytes:
        """The bits of the pose."""
        return self.R_cam_from_world.tobytes() + self.center_world.tobytes()

    @property
    def T_world_from_cam(self) -> Array:
        """Homogeneous matrix (4, 4): `x_world = T_world_from_cam @ x_cam`."""
        T = np.eye(4)
        T[:3, :3] = self.R_cam_from_world.T
        T[:3, 3] = self.center_world
        return T

    @property
    def quaternion_wxyz(self) -> Array:
        """Unit quaternion (4,) of `R_cam_from_world`, scalar first and not negative."""
        return quaternion_wxyz(self.R_cam_from_world)

    def distance(self, other: "Pose") -> float:
        """Return the distance [m] to another camera."""
        return math.dist(self.center_world, other.center_world)

    def inverse(self) -> "Pose":
        """Return the inverse transform, which takes camera coordinates to the world's."""
        return Pose(self.R_cam_from_world.T, -rotate_vector(self.R_cam_from_world, self.center_world))

    def __matmul__(self, other: "Pose") -> "Pose":
        """Compose two transforms, of which `other` is applied first: `c_from_w = c_from_b @ b_from_w`."""
        center_world = other.center_world + rotate_vector(other.R_cam_from_world.T, self.center_world)
        return Pose(multiply(self.R_cam_from_world, other.R_cam_from_world), center_world)


def multiply(one: Array, other: Array) -> Array:
    """Return the product of matrices (..., 3, 3), to the same bits on all processors; BLAS sums otherwise."""
    return np.asarray(np.einsum("...ij,...jk->...ik", one, other))


def rotate_vector(R_target_from_source: Array, vector: Array) -> Array:
    """Return a vector (3,) rotated by a matrix (3, 3), to the same bits on all processors."""
    return np.asarray(np.einsum("ij,j->i", R_target_from_source, vector))


def skew(w: Array) -> Array:
    """Return the matrix (3, 3) of the cross product `w x .`."""
    return np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])


def exp_so3(w: Array) -> Array:
    """Return the rotation matrix (3, 3) of a rotation vector `w` (3,) [rad] (Rodrigues)."""
    angle = math.hypot(*w)
    K = skew(np.asarray(w, dtype=np.float64))
    # np.sinc(x) is sin(pi x) / (pi x): exact at angle 0
    a = np.sinc(angle / np.pi)
    b = 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2
    return np.asarray(np.eye(3) + a * K + b * multiply(K, K))


def log_so3(R: Array) -> Array:
    """Return the rotation vector (3,) [rad], of length [0, pi], of a rotation (3, 3): `exp_so3` inverted."""
    w, *v = quaternion_wxyz(R)
    sine = math.hypot(*v)
    scale = 2.0 * float(np.arctan2(sine, w)) / sine if sine > 0.0 else 2.0
    return scale * np.array(v)


def left_jacobian(w: Array) -> Array:
    """Return the J (3, 3) with exp([w + dw]x) = exp([J dw]x) exp([w]x) to first order in `dw`."""
    angle = math.hypot(*w)
    K = skew(np.asarray(w, dtype=np.float64))
    a = 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2
    b = 1.0 / 6.0 if angle < 1e-4 else (angle - np.sin(angle)) / angle**3
    return np.asarray(np.eye(3) + a * K + b * multiply(K, K))


def step(pose: Pose, delta: Array) -> Pose:
    """Move a pose by `delta` (6,), rotation [rad] then translation [m], both in the camera's frame.

    R <- exp([w]x) R, center <- center + R^T d, with R before the rotation.
    """
    center_world = pose.center_world + rotate_vector(pose.R_cam_from_world.T, delta[3:])
    return Pose(orthonormal(multiply(exp_so3(delta[:3]), pose.R_cam_from_world)), center_world)


def step_between(pose: Pose, other: Pose) -> Array:
    """Return the `delta` (6,) by which `step` moves a pose to another."""
    turn = log_so3(multiply(other.R_cam_from_world, pose.R_cam_from_world.T))
    offset = other.center_world - pose.center_world
    return np.concatenate([turn, rotate_vector(pose.R_cam_from_world, offset)])


def orthonormal(R: Array) -> Array:
    """Return the rotation (3, 3) nearest to `R` (3, 3), which differs from it by rounding or a few per cent.

    The polar factor by Newton and Schulz's iteration (Higham, "Functions of Matrices", 2008, eq. 8.20): each
    step squares the error.
    """
    for _ in range(NEWTON_STEPS):
        R = multiply(R, 1.5 * np.eye(3) - 0.5 * multiply(R.T, R))
    return R


def check_rotation(R: Array, tolerance: float, label: str) -> Array:
    """Return `R` (3, 3); InputError, naming it `label`, if R R^T is not the identity or if R mirrors."""
    # the bound on the entries keeps the product finite; NaN is not below it either
    is_tame = R.shape == (3, 3) and np.abs(R).max() < 2.0
    if not (is_tame and np.abs(R @ R.T - np.eye(3)).max() < tolerance and np.linalg.det(R) > 0.0):
        raise InputError(f"{label} is no rotation")
    return R


def check_pose(pose: object, label: str, tolerance: float = MAX_SKEW) -> Pose:
    """Return a copy of a pose from outside, in float64; InputError, naming it `label`, if it is none.

    A pose is a rotation (3, 3), R R^T within `tolerance` of the identity, and a finite position (3,) [m].
    """
    if not isinstance(pose, Pose):
        raise InputError(f"{label}: found {type(pose).__name__}, wanted a Pose")
    parts = pose.R_cam_from_world, pose.center_world
    is_numeric = all(isinstance(part, np.ndarray) and part.dtype.kind in "fiu" for part in parts)
    if not is_numeric or [part.shape for part in parts] != [(3, 3), (3,)]:
        kinds = [(getattr(part, "dtype", type(part).__name__), getattr(part, "shape", "")) for part in parts]
        found = " and ".join(f"{kind} {shape}".strip() for kind, shape in kinds)
        raise InputError(f"{label}: found {found}, wanted arrays of numbers, (3, 3) and (3,)")
    R, center = (np.array(part, np.float64, order="C") for part in parts)
    if not np.abs(center).max() <= MAX_COORDINATE:  # NaN is not either
        wanted = f"wanted finite numbers up to {MAX_COORDINATE:.0e} m"
        raise InputError(f"{label}: found a position {center.tolist()}, {wanted}")
    return Pose(check_rotation(R, tolerance, f"{label}: found a matrix that"), center)


def check_transform(
    T: Array, label: str, other_from_cam: Array, is_from_world: bool = False, tolerance: float = MAX_SKEW
) -> Pose:
    """Return the pose of [R | t] (3 or 4, 4), from a tool's camera coordinates to the world's, or back.

    The rotation is without what was rounded. InputError, naming it `label`, if it is no pose.
    """
    given = check_pose(Pose(T[:3, :3], T[:3, 3]), label, tolerance)
    R = orthonormal(given.R_cam_from_world)
    if is_from_world:
        center = -rotate_vector(given.R_cam_from_world.T, given.center_world)
        return Pose(multiply(other_from_cam.T, R), center)
    return Pose(multiply(other_from_cam.T, R.T), given.center_world)


def angle_between(R_a: Array, R_b: Array) -> float:
    """Return the angle [rad] of the rotation between two orientations (3, 3); exact near 0 and pi."""
    relative = R_a @ R_b.T
    sine = 0.5 * np.linalg.norm(relative - relative.T) / np.sqrt(2.0)
    return float(np.arctan2(sine, 0.5 * (np.trace(relative) - 1.0)))


def yaw_rotation(yaw: float) -> Array:
    """Return R_cam_from_world (3, 3) of an upright camera whose image centre is at azimuth `yaw` [rad]."""
    c = np.cos(yaw)
    s = np.sin(yaw)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def rotation_to_z(direction: Array) -> Array:
    """Return the smallest rotation (3, 3) that takes a unit vector (3,) to +z; half a turn about x for -z."""
    x, y, z = direction
    sine = math.hypot(x, y)
    if sine < TINY_SINE:
        return np.diag([1.0, 1.0, 1.0] if z > 0.0 else [1.0, -1.0, -1.0])
    return exp_so3(math.atan2(sine, z) / sine * np.array([y, -x, 0.0]))


def quaternion_wxyz(R: Array) -> Array:
    """Return the unit quaternion (4,), scalar first and not negative, of a rotation (3, 3)."""
    # The eigenvector of Bar-Itzhack's symmetric matrix: no case distinction, accurate for every angle.
    K = np.array(
        [
            [R[0, 0] + R[1, 1] + R[2, 2], R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]],
            [R[2, 1] - R[1, 2], R[0, 0] - R[1, 1] - R[2, 2], R[0, 1] + R[1, 0], R[0, 2] + R[2, 0]],
            [R[0, 2] - R[2, 0], R[0, 1] + R[1, 0], R[1, 1] - R[0, 0] - R[2, 2], R[1, 2] + R[2, 1]],
            [R[1, 0] - R[0, 1], R[0, 2] + R[2, 0], R[1, 2] + R[2, 1], R[2, 2] - R[0, 0] - R[1, 1]],
        ]
    )
    q = np.linalg.eigh(K)[1][:, -1]
    return np.asarray(q if q[0] >= 0 else -q)


def rotation_from_quaternion_wxyz(q: Array) -> Array:
    """Return the rotation (3, 3) of a quaternion (4,), scalar first, of any length but zero."""
    w, x, y, z = np.asarray(q, dtype=np.float64) / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def pose_errors(pose: Pose, true_pose: Pose) -> tuple[float, float]:
    """Return the position error [m] and the rotation error [rad]."""
    distance = float(np.linalg.norm(pose.center_world - true_pose.center_world))
    return distance, angle_between(pose.R_cam_from_world, true_pose.R_cam_from_world)


def move(pose: Pose, T_target_from_source: Array, metres_per_unit: float) -> Pose:
    """Return a pose of the source in the target's coordinates; T (4, 4) is rigid, in `metres_per_unit`."""
    R = T_target_from_source[:3, :3]
    center = rotate_vector(R, pose.center_world) + T_target_from_source[:3, 3] * metres_per_unit
    return Pose(orthonormal(multiply(pose.R_cam_from_world, R.T)), center)


def rotate_points(points: Array, R_target_from_source: Array) -> Array:
    """Rotate points (N, 3) by a rotation (3, 3); under the identity the array itself is returned."""
    if np.array_equal(R_target_from_source, np.eye(3)):
        return points
    x, y, z = points.T
    return np.stack([a * x + b * y + c * z for a, b, c in R_target_from_source], axis=1)


def transform_points(points: Array, T_target_from_source: Array) -> Array:
    """Transform points (N, 3) by an affine transform (4, 4) for column vectors."""
    x, y, z = points.T
    return np.stack([a * x + b * y + c * z + d for a, b, c, d in T_target_from_source[:3]], axis=1)


def carry(pose: Pose, beside: Pose, to: Pose) -> Pose:
    """Apply the relative motion from `beside` to `pose` to the pose `to`.

    Poses are in any one frame each: pose and beside in that of an odometry, say, and to in the map.
    """
    return pose @ beside.inverse() @ to


def uniform_yaws(num_rotations: int) -> Array:
    """Return R_cam_from_world (num_rotations, 3, 3) of an upright camera at evenly spaced yaws."""
    return np.stack([yaw_rotation(2.0 * math.pi * k / num_rotations) for k in range(num_rotations)])


@lru_cache(maxsize=4)
def uniform_rotations(num_rotations: int) -> Array:
    """Return rotations (num_rotations, 3, 3) spread evenly over SO(3) by the super-Fibonacci spiral."""
    s = np.arange(num_rotations) + 0.5
    r = np.sqrt(s / num_rotations)
    R = np.sqrt(1.0 - s / num_rotations)
    alpha = 2.0 * np.pi * s / math.sqrt(2.0)
    beta = 2.0 * np.pi * s / SUPER_FIBONACCI_PSI
    quaternions = np.stack([r * np.sin(alpha), r * np.cos(alpha), R * np.sin(beta), R * np.cos(beta)], axis=1)
    rotations = np.stack([rotation_from_quaternion_wxyz(q) for q in quaternions])
    rotations.flags.writeable = False  # it is kept for the next query
    return rotations


def turn_axes(pose: Pose, other_from_cam: Array) -> Pose:
    """Return the pose with its rotation to another tool's camera axes, by `other_from_cam` (3, 3)."""
    return Pose(multiply(other_from_cam, pose.R_cam_from_world), pose.center_world)


def translation(pose: Pose) -> Array:
    """Return the t (3,) of x_cam = R x_world + t."""
    return -rotate_vector(pose.R_cam_from_world, pose.center_world)


def R_cam_from_angles(heading_deg: float, pitch_deg: float, roll_deg: float) -> Array:
    """Return R_cam_from_world (3, 3) of the angles [deg] that `heading_pitch_roll_deg` returns."""
    yaw = exp_so3(np.radians([0.0, 0.0, 90.0 - heading_deg]))
    pitch = exp_so3(np.radians([0.0, -pitch_deg, 0.0]))
    roll = exp_so3(np.radians([roll_deg, 0.0, 0.0]))
    return multiply(multiply(yaw, pitch), roll).T


def heading_pitch_roll_deg(pose: Pose) -> tuple[float, float, float]:
    """Return heading in [0, 360), pitch in [-90, 90], roll in (-180, 180] [deg], as Photo Sphere XMP does.

    Heading is that of the image centre, clockwise from the world's +y; pitch is its elevation above the
    horizon; as roll grows the camera's right side goes down: the horizon turns counterclockwise in the image:
    R_world_from_cam = R_z(90 deg - heading) R_y(-pitch) R_x(roll).
    https://developers.google.com/streetview/spherical-metadata
    """
    forward, left, up = pose.R_cam_from_world  # the camera's axes in the world
    heading = np.arctan2(forward[0], forward[1])
    pitch = np.arctan2(forward[2], np.hypot(forward[0], forward[1]))
    # Against the level left of this very heading: right at the zenith too, where any heading would do.
    level_left = np.array([-np.cos(heading), np.sin(heading), 0.0])
    roll = np.arctan2(-up @ level_left, left @ level_left)
    rounded = [round(float(np.degrees(angle)), DECIMALS) for angle in (heading, pitch, roll)]
    return rounded[0] % 360.0, rounded[1], 180.0 if rounded[2] == -180.0 else rounded[2]
