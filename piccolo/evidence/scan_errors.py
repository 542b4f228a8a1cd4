"""Errors of a pose that come from the scan, which all photos taken there have in common."""

import numpy as np

from ..geometry.pose import Pose
from ..scan_map.scan_map import ScanMap
from ..system.arrays import Array

SHAPE_TURN = 0.003  # [rad] by which edges of a photo are displaced from the scan's, alike in all blocks
SHAPE_MOVE = 0.01  # [m]


def scan_covariance(scan_map: ScanMap) -> Array:
    """Return the covariance (6, 6) [rad, m], in the map's axes, of errors of the scan.

    They are correlated over many blocks: errors of noise and doubled surfaces (`surface_variance`), and in a
    scan without colours those of its edges. Noise and doubled surfaces move a camera, but do not turn it: in
    scans with noise of 1 to 5 cm, and doubled by as much, rotations were as exact as the photo alone says.
    """
    covariance = np.zeros((6, 6))
    covariance[3:, 3:] = scan_map.surface_variance
    if scan_map.has_shape:
        covariance += np.diag(np.repeat([SHAPE_TURN**2, SHAPE_MOVE**2], 3))
    return covariance


def layer_covariance(scan_map: ScanMap, pose: Pose, acting_range: float) -> Array:
    """Return the covariance (6, 6) [rad, m] of a pose in the map by two layers of the scan's surfaces.

    It is not part of `scan_covariance`, as it is no evidence that a photo was taken elsewhere.
    """
    if not scan_map.layers.any():
        return np.zeros((6, 6))
    variance = gap_variance(scan_map.layers, pose.center_world, acting_range)
    return np.diag(np.repeat([variance / acting_range**2, variance], 3))


def displacement_variance(scan_map: ScanMap, pose: Pose, acting_range: float) -> Array:
    """Return the covariance (3, 3) [m^2], in the map's axes, of the scan's surfaces about the true ones."""
    common = scan_covariance(scan_map) + layer_covariance(scan_map, pose, acting_range)
    return common[3:, 3:] + scan_map.displacement**2 * np.eye(3)


def gap_variance(motion: Array, place: Array, reach: float) -> float:
    """Return the variance [m^2] of a position at a place (3,) along any axis by layers with a motion (3, 3).

    It is a twelfth of the mean square distance of the layers within `reach` [m], which is the variance of a
    uniform density between both: a pose may follow one layer in some directions and the other in others.
    """
    middle, turn, move = motion
    gap = move + np.cross(turn, place - middle)
    return float(gap @ gap + reach**2 * (turn @ turn)) / 12.0
