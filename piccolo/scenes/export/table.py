"""A table for spreadsheets: CSV with a header, our own axes."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path

from ...geometry.camera_axes import heading_pitch_roll_deg
from ...geometry.pose import quaternion_wxyz
from ...runtime.atomic import write_atomically
from .model import Format, Options, Shot
from .text import write_offset_beside

COLUMNS = (
    *("image", "cloud", "status", "confidence", "score", "x", "y", "z"),
    *("quaternion_w", "quaternion_x", "quaternion_y", "quaternion_z"),  # of R_cam_from_world
    *("heading_deg", "pitch_deg", "roll_deg"),
)


def write(shots: Sequence[Shot], out: Path, options: Options) -> None:
    """A row a result; what is not known is empty."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(COLUMNS)
    table.writerows(_row(shot) for shot in shots)
    write_offset_beside(out, options)
    write_atomically(out, text.getvalue().encode())


def _row(shot: Shot) -> list[object]:
    result, pose = shot.result, shot.pose
    score = result.evidence.score if result.evidence else None
    return [
        *(shot.name, result.cloud_name, result.status, result.confidence, score),
        *pose.center_world.tolist(),
        *quaternion_wxyz(pose.R_cam_from_world).tolist(),
        *heading_pitch_roll_deg(pose),
    ]


CSV = Format("csv", "table with a header", write, frozenset({"offset"}), has_unique_names=False)
