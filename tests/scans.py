"""A scan with all that a PLY may hold beside colours."""

import functools

import numpy as np
from plyfile import PlyData, PlyElement
from rooms import room

from piccolo.cloud.cloud_settings import BY_FILE
from piccolo.cloud.stream import open_cloud


def read_cloud(path, settings=BY_FILE):
    """The points of one file."""
    return open_cloud([path], settings).read()


@functools.lru_cache
def scan():
    """Points (N, 3) of a furnished room, its walls along x and y, and colours (N, 3)."""
    cloud = room(1)[1]
    return cloud.points.astype(np.float64)[::2], cloud.colors[::2]


def write_scan(path, points, dtype="<f4", **options):
    """A PLY with normals, intensity and labels as further properties, and a face if asked for."""
    colors = scan()[1]
    fields = [(n, dtype) for n in "xyz"] + [(n, "<f4") for n in ("nx", "ny", "nz")]
    fields += [("red", "u1"), ("green", "u1"), ("blue", "u1"), ("scalar_intensity", "<f4"), ("label", "<i4")]
    rows = np.zeros(len(points), dtype=fields)
    for k, name in enumerate("xyz"):
        rows[name] = points[:, k]
    for k, name in enumerate(("red", "green", "blue")):
        rows[name] = colors[:, k]
    rows["nz"] = 1.0
    rows["label"] = np.arange(len(points)) - 7
    rows["scalar_intensity"] = np.linspace(0.0, 1.0, len(points))
    options = {"text": False, "byte_order": "<", "comments": ["made by hand"], **options}
    PlyData([PlyElement.describe(rows, "vertex")], **options).write(path)


def write_scalars(path, points, name, values, kind="i4", text=False):
    rows = np.zeros(len(points), [(n, "f8") for n in "xyz"] + [(name, kind)])
    for k, n in enumerate("xyz"):
        rows[n] = points[:, k]
    rows[name] = values
    PlyData([PlyElement.describe(rows, "vertex")], text=text).write(path)
    return path


def points_of(path):
    vertex = PlyData.read(path)["vertex"]
    return np.stack([vertex["x"], vertex["y"], vertex["z"]], axis=1).astype(np.float64)


def bare_room():
    """Points (N, 3) of a closed box with nothing in it."""
    rng = np.random.default_rng(7)
    size = np.array([5.0, 4.0, 2.6])
    faces = []
    for axis, side in np.ndindex(3, 2):
        face = rng.uniform(0.0, 1.0, (3000, 3)) * size
        face[:, axis] = side * size[axis]
        faces.append(face)
    return np.concatenate(faces)
