"""Made-up results with tilted poses at UTM-size coordinates, and where their pixels are in the world."""

import json

import cv2
import numpy as np

from piccolo.geometry.pose import Pose, exp_so3
from piccolo.geometry.sphere import pixel_rays
from piccolo.judge.result import Result
from piccolo.judge.result_parts import Evidence

WIDTH = 512
SIZE = (WIDTH, WIDTH // 2)
CENTER = np.array([500_123.456789, 5_400_987.654321, 312.25])
EVIDENCE = Evidence(0.7, 0.5, 0.8, 0.9, 0.95)
WORDS = {"confidence": 0.9, "loss": 0.05, "evidence": EVIDENCE, "alternatives": (), "covariance": None}
WORDS |= {"seconds": {}, "settings": {}}


def tilted_poses(num_poses, center=CENTER):
    """Any rotation, centres some metres apart."""
    rng = np.random.default_rng(3)
    return [Pose(exp_so3(2.0 * rng.normal(size=3)), center + rng.normal(size=3)) for _ in range(num_poses)]


def result(pano, pose, status="localized", cloud="a.ply", **changes):
    return Result(status=status, cloud=cloud, pano=str(pano), best_pose=pose, **(WORDS | changes))


def judged(status, belief, pose, **more):
    """The result of a photo alone, its probabilities as they are believed."""
    probabilities = belief.probabilities.tolist()
    best = probabilities[0]
    none = probabilities[-1]
    return Result(status, best, best_pose=pose, belief=belief, probability_none=none, **more)


def write_results(path, results):
    path.write_text("".join(r.to_json() + "\n" for r in results))
    return path


def jpeg(path, size=SIZE, seed=0):
    """A small picture; returns its bytes."""
    pixels = np.random.default_rng(seed).integers(0, 255, (size[1] // 8, size[0] // 8, 3), np.uint8)
    path.write_bytes(cv2.imencode(".jpg", cv2.resize(pixels, size))[1].tobytes())
    return path.read_bytes()


def pixels_and_points(pose, seed=0, num_points=200):
    """Pixels (N, 2) and world points (N, 3) seen there, by geometry/sphere.py, up to 80 degrees of elevation.

    Nearer to a pole the rounding of UTM-size coordinates alone moves u by more than the tests allow.
    """
    rng = np.random.default_rng(seed)
    margin = WIDTH // 36
    rows = rng.integers(margin, WIDTH // 2 - margin, num_points)
    columns = np.concatenate([[0, WIDTH - 1], rng.integers(0, WIDTH, num_points - 2)])  # the seam too
    rays = pixel_rays(WIDTH)[rows, columns] * rng.uniform(3.0, 30.0, (num_points, 1))
    return np.stack([columns + 0.5, rows + 0.5], axis=1), pose.center_world + rays @ pose.R_cam_from_world


def lines_of(path):
    return path.read_text(encoding="utf-8").splitlines()


def json_of(path):
    return json.loads(path.read_text(encoding="utf-8"))


def covariance(rng, std=0.01):
    """A covariance (6, 6) without symmetries."""
    A = std * rng.normal(size=(6, 6))
    return A @ A.T + std**2 * np.eye(6)


def rotation(heading, pitch, roll):
    """R_world_from_cam of angles in degrees: R_z(90 - heading) R_y(-pitch) R_x(roll)."""
    z, y, x = np.radians([90.0 - heading, -pitch, roll])
    return exp_so3(z * np.eye(3)[2]) @ exp_so3(y * np.eye(3)[1]) @ exp_so3(x * np.eye(3)[0])


def assert_same_poses(found, expected):
    assert len(found) == len(expected)
    for pose, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(pose.R_cam_from_world, other.R_cam_from_world, atol=1e-12)
        np.testing.assert_allclose(pose.center_world, other.center_world, atol=1e-12)
