"""Semantic labels as colours far apart in RGB, equal in clouds and panoramas."""

import functools
from pathlib import Path

import cv2
import numpy as np
from plyfile import PlyData

from piccolo import InputError
from piccolo.system.arrays import Array, Bytes, Integers

NUM_LEVELS = 16  # of a channel that colours are made of
NUM_COLORS = 4093  # a prime: labels that count in steps of 256 or 65,536 do not fall together


@functools.cache
def palette() -> Bytes:
    """Return RGB (NUM_COLORS, 3), each the colour of a grid farthest from all before it; none is black.

    The loss is a norm in RGB: a label mistaken for another costs their distance.
    """
    levels = np.round(np.linspace(0.0, 255.0, NUM_LEVELS)).astype(np.int64)
    grid = np.stack(np.meshgrid(levels, levels, levels, indexing="ij"), axis=-1).reshape(-1, 3)[1:]
    colors = np.empty((NUM_COLORS, 3), dtype=np.uint8)
    distance = np.full(len(grid), np.iinfo(np.int64).max)
    farthest = len(grid) - 1  # white
    for k in range(NUM_COLORS):
        colors[k] = grid[farthest]
        distance = np.minimum(distance, ((grid - grid[farthest]) ** 2).sum(axis=1))
        farthest = int(distance.argmax())
    return colors


def label_colors(labels: Integers) -> Bytes:
    """Return the colour (..., 3) of each label (...); labels equal modulo NUM_COLORS have the same colour."""
    return np.asarray(palette()[labels % NUM_COLORS])


def read_labelled_points(path: Path) -> tuple[Array, Integers]:
    """Return points (N, 3) [m] and labels (N,) of a scene's PLY; InputError if it has none."""
    vertices = PlyData.read(str(path))["vertex"]
    if "label" not in vertices.data.dtype.names:
        raise InputError(f"{path}: found points without labels, wanted a property `label`")
    points = np.stack([np.asarray(vertices[axis], np.float64) for axis in "xyz"], axis=1)
    return points, np.asarray(vertices["label"], np.int64)


def read_labels(path: Path) -> Integers:
    """Return the labels (H, W) in a PNG of one channel, as scenes have them."""
    labels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if labels is None or labels.ndim != 2 or labels.shape[1] != 2 * len(labels):
        raise InputError(f"{path}: found no labels, wanted a PNG of one channel, W = 2 H")
    return labels.astype(np.int64)
