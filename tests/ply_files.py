"""PLY files of seeded points, written by plyfile."""

import numpy as np
from clouds import seeded_cloud
from plyfile import PlyData, PlyElement

RAW = seeded_cloud(1, num_points=1200)
RGB = ("red", "green", "blue")


def vertices(raw=RAW, coordinate="f4", color="u1", names=RGB, brightest=255, extra=()):
    """The vertex element of a cloud; `extra` names float properties put first."""
    fields = [*((n, "f4") for n in extra), *((n, coordinate) for n in "xyz"), *((n, color) for n in names)]
    table = np.zeros(len(raw.colors), dtype=fields)
    for k in range(3):
        table["xyz"[k]] = raw.points_world[:, k]
        table[names[k]] = raw.colors[:, k] * (brightest / 255)
    return PlyElement.describe(table, "vertex")


def write(path, *elements, text=False, byte_order="<", comments=()):
    PlyData(list(elements), text=text, byte_order=byte_order, comments=list(comments)).write(str(path))
    return path
