"""The result of one localization, and its JSON."""

import json
from dataclasses import dataclass, field

import numpy as np

from . import __version__
from .errors import InputError
from .pose import Pose, T_world_from_cam, quaternion_wxyz
from .verify import Evidence

FORMAT = "piccolo-pose/1"
LOCALIZED = "localized"
NOT_LOCALIZED = "not_localized"
CONVENTION = (
    "x_cam = R_cam_from_world @ (x_world - center_world) in metres; +x_cam points to the image centre, "
    "+y_cam left, +z_cam up; u = (1/2 - atan2(y, x) / 2 pi) W, v = (1/2 - atan2(z, hypot(x, y)) / pi) H, "
    "pixel centres at half-integers"
)


@dataclass(frozen=True)
class Localization:
    """The best pose for one panorama, in world coordinates, and what speaks for it."""

    status: str
    pose: Pose | None
    loss: float | None
    evidence: Evidence | None
    margin: float | None  # of the score, to the best distinct rival


@dataclass(frozen=True)
class Result:
    """Where one panorama was taken, and what speaks for it."""

    status: str  # "localized" or "not_localized"
    cloud: str | tuple[str, ...]  # path as given, or the paths of several files that are one cloud
    pano: str  # path as given
    pose: Pose | None  # the best pose found, in the file's own coordinates; None if there was no start
    loss: float | None  # sampling loss [0, sqrt(3)] over the points seen from the pose
    score: float | None  # locally normalised correlation, [-1, 1]
    margin: float | None  # score minus that of the best distinct rival; None if there is none
    inlier_share: float | None  # share of the seen solid angle with a residual below `inlier_residual`
    inlier_residual: float  # RGB norm
    seconds: dict[str, float]  # read, prepare, search, refine
    settings: dict[str, object]  # effective settings, seed included
    warnings: tuple[str, ...] = field(default=())

    def summary(self) -> str:
        """Two lines for a person."""
        if self.pose is None:
            return f"{self.pano}: {self.status}\n  no place for a camera, or nothing of the panorama counts"
        x, y, z = self.pose.center_world
        total = sum(self.seconds.values())
        return (
            f"{self.pano}: {self.status} at ({x:.3f}, {y:.3f}, {z:.3f}) m in {total:.1f} s\n"
            f"  score {self.score:.2f}, margin {self.margin:.2f}, loss {self.loss:.3f}, "
            f"{100.0 * (self.inlier_share or 0.0):.0f} % of the seen directions agree"
        )

    def to_json(self) -> str:
        """One JSON object on one line. Numbers only: NaN and infinity raise ValueError."""
        pose = self.pose
        document = {
            "format": FORMAT,
            "status": self.status,
            "cloud": self.cloud,
            "pano": self.pano,
            "R_cam_from_world": pose and pose.R_cam_from_world.tolist(),
            "center_world": pose and pose.center_world.tolist(),
            "quaternion_wxyz": pose and quaternion_wxyz(pose.R_cam_from_world).tolist(),
            "T_world_from_cam": pose and T_world_from_cam(pose).tolist(),
            "loss": self.loss,
            "score": self.score,
            "margin": self.margin,
            "inlier_share": self.inlier_share,
            "inlier_residual": self.inlier_residual,
            "convention": CONVENTION,
            "seconds": {stage: round(seconds, 4) for stage, seconds in self.seconds.items()},
            "settings": self.settings,
            "warnings": list(self.warnings),
            "version": __version__,
        }
        return json.dumps(document, allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> "Result":
        """Read back what `to_json` wrote; any other text is an InputError."""
        try:
            document = json.loads(text)
            if document["format"] != FORMAT:
                raise InputError(f"result: found format {document['format']!r}, wanted {FORMAT!r}")
            R, center = document["R_cam_from_world"], document["center_world"]
            cloud = document.pop("cloud")
            return cls(
                cloud=cloud if isinstance(cloud, str) else _paths(cloud),
                pose=None if R is None else Pose(np.array(R), np.array(center)),
                warnings=tuple(document["warnings"]),
                **{name: document[name] for name in _PLAIN_FIELDS},
            )
        except (json.JSONDecodeError, KeyError, TypeError) as error:
            raise InputError(
                f"result: found {error!r}, wanted one JSON object of format {FORMAT!r}"
            ) from error


def _paths(value: object) -> tuple[str, ...]:
    """A list of paths; TypeError for anything else."""
    if not isinstance(value, list) or not all(isinstance(path, str) for path in value):
        raise TypeError("a cloud that is neither a path nor a list of paths")
    return tuple(value)


_PLAIN_FIELDS = (
    *("status", "pano", "loss", "score", "margin"),
    *("inlier_share", "inlier_residual", "seconds", "settings"),
)
