"""Text, PTS and PTX files of points."""

import math

import numpy as np
from clouds import seeded_cloud


def lines_of(raw, separator=" ", color_format="d"):
    return [
        separator.join([*map("{:.6f}".format, point), *(f"{value:{color_format}}" for value in color)])
        for point, color in zip(raw.points_world, raw.colors, strict=True)
    ]


def write_lines(path, lines, end="\n"):
    path.write_bytes((end.join(lines) + end).encode())
    return path


RAW = seeded_cloud(1, num_points=1200)


def placed(yaw, pitch, translation):
    """A PTX matrix: for row vectors, the rotation transposed above the translation."""
    c = math.cos(yaw)
    s = math.sin(yaw)
    about_z = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    c = math.cos(pitch)
    s = math.sin(pitch)
    matrix = np.eye(4)
    matrix[:3, :3] = (about_z @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])).T
    matrix[3, :3] = translation
    return matrix


HERE = placed(0.7, 0.3, [12.5, -3.0, 1.75])
THERE = placed(-2.1, -0.8, [637_012.25, 5_849_028.5, 431.125])


def points_of(points_world, colors, intensity="0.5 "):
    rows = zip(points_world.tolist(), colors.tolist(), strict=True)
    return [f"{x!r} {y!r} {z!r} {intensity}{r} {g} {b}" for (x, y, z), (r, g, b) in rows]


def in_scanner(points_world, matrix):
    return (points_world - matrix[3, :3]) @ np.linalg.inv(matrix[:3, :3])


def scan(points_world, colors, matrix=HERE, count=None):
    header = [*np.vstack([matrix[3, :3], matrix[:3, :3]]), *matrix]
    return [
        f"{len(colors) if count is None else count}",
        "1",
        *(" ".join(map(repr, line.tolist())) for line in header),
        *points_of(in_scanner(points_world, matrix), colors),
    ]


TWO_SCANS = [
    *scan(RAW.points_world[:500], RAW.colors[:500], HERE),
    *scan(RAW.points_world[500:], RAW.colors[500:], THERE),
]


def pts(intensity="-1613 ", raw_cloud=RAW):
    return points_of(raw_cloud.points_world, raw_cloud.colors, intensity)
