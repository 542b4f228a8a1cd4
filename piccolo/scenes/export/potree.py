"""coordinates.txt of Potree's 360 images (src/modules/Images360/Images360.js), read from the images' folder.

Columns, by tabs: file, time, x, y, z in the cloud's coordinates, course, pitch, roll [deg]. Potree turns the
sphere by R_z(90 - course) R_y(-pitch) R_x(90 + roll); with the picture as three.js lays it on the sphere
these are heading, pitch and roll of Photo Sphere XMP.
"""

from collections.abc import Sequence
from pathlib import Path

from ...geometry.camera_axes import heading_pitch_roll_deg
from .model import Format, Options, Shot
from .text import numbers, write_lines, write_offset_beside


def write(shots: Sequence[Shot], out: Path, options: Options) -> None:
    """A row a picture below an empty line: by its version Potree skips the first line or reads it."""
    rows = [
        "\t".join(
            [
                shot.name,
                shot.time,
                numbers([*shot.pose.center_world, *heading_pitch_roll_deg(shot.pose)], "\t"),
            ]
        )
        for shot in shots
    ]
    write_offset_beside(out, options)
    write_lines(out, ["", *rows])


POTREE = Format(
    "potree",
    "coordinates.txt of Potree's 360 images, in the folder that --images names",
    write,
    frozenset({"offset", "timestamps"}),
    forbidden='"',
)
