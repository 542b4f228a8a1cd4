"""The result of one localization, and its JSON."""

import json
import math
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from . import __version__
from .confidence.alternatives import Hypothesis
from .confidence.confidence import AMBIGUOUS
from .confidence.covariance import PoseCovariance
from .confidence.localization import Localization
from .confidence.score import Evidence
from .errors import InputError
from .geometry.pose import Pose, T_world_from_cam, checked_rotation, quaternion_wxyz
from .geometry.sphere import CONVENTION
from .runtime.json_file import parse_lines, read_bytes

FORMAT = "piccolo-pose/3"
MAX_ROTATION_ERROR = 1e-6  # of R R^T from the identity, in a file
# control characters, line ends, halves of characters
UNWRITABLE = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")
WANTED = "wanted JSON lines of localize.py"
COVARIANCE_CONVENTION = (
    "of (w, d), rotation [rad] about the camera's axes, then translation [m] along the world's: "
    "R_true = exp([w]x) R_cam_from_world, center_true = center_world + d"
)


@dataclass(frozen=True)
class Result:
    """Where one panorama was taken, and what speaks for it."""

    status: str  # "localized", "ambiguous" or "not_localized"
    confidence: float  # [0, 1] how likely the pose is right, see piccolo.confidence
    cloud: str | tuple[str, ...]  # path as given, or the paths of several files that are one cloud
    pano: str  # path as given
    pose: Pose | None  # the best pose found, in the file's own coordinates; None if there was no start
    loss: float | None  # sampling loss [0, sqrt(3)] over the points seen from the pose
    evidence: Evidence | None
    alternatives: tuple[Hypothesis, ...]  # poses elsewhere, best first, at most 5
    covariance: PoseCovariance | None  # None with the preset paper, and where the points do not fix the pose
    seconds: dict[str, float]  # read, prepare, search, refine
    settings: dict[str, object]  # effective settings, seed included
    warnings: tuple[str, ...] = field(default=())

    @property
    def cloud_name(self) -> str:
        """The cloud's path, or those of its files, separated by commas."""
        return self.cloud if isinstance(self.cloud, str) else ", ".join(self.cloud)

    def summary(self) -> str:
        """Two lines for a person."""
        if self.pose is None:
            return f"{self.pano}: {self.status}\n  no place for a camera, or nothing of the panorama counts"
        x, y, z = self.pose.center_world
        total = sum(self.seconds.values())
        lines = [f"{self.pano}: {self.status} at ({x:.3f}, {y:.3f}, {z:.3f}) m in {total:.1f} s"]
        if self.evidence is not None:
            e = self.evidence
            lines.append(
                f"  confidence {self.confidence:.3f}, score {e.score:.2f}, margin {e.margin:.2f}, "
                f"{100.0 * e.explained_fraction:.0f} % of the panorama explained"
            )
        if self.covariance is not None:
            mm, deg = 1000.0 * self.covariance.largest_std, self.covariance.std_deg.max()
            lines.append(
                f"  one sigma {mm:.1f} mm ({self.covariance.least_constrained_direction}), {deg:.2f} deg"
            )
        if self.status == AMBIGUOUS:
            lines += [f"  or {_place(h)}" for h in self.alternatives]
        return "\n".join(lines)

    def to_json(self) -> str:
        """One JSON object on one line. Numbers only: NaN and infinity raise ValueError."""
        pose = self.pose
        document = {
            "format": FORMAT,
            "status": self.status,
            "confidence": self.confidence,
            "cloud": self.cloud,
            "pano": self.pano,
            **_pose_json(pose),
            "quaternion_wxyz": pose and quaternion_wxyz(pose.R_cam_from_world).tolist(),
            "T_world_from_cam": pose and T_world_from_cam(pose).tolist(),
            "loss": self.loss,
            "evidence": self.evidence and asdict(self.evidence),
            "alternatives": [_pose_json(h.pose) | {"score": h.score} for h in self.alternatives],
            "covariance": self.covariance and self.covariance.matrix.tolist(),
            "covariance_convention": COVARIANCE_CONVENTION,
            "std_mm": self.covariance and self.covariance.std_mm.tolist(),
            "std_deg": self.covariance and self.covariance.std_deg.tolist(),
            "least_constrained_direction": self.covariance and self.covariance.least_constrained_direction,
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
            cloud = document.pop("cloud")
            return cls(
                cloud=cloud if isinstance(cloud, str) else _paths(cloud),
                pose=_pose_from_json(document),
                evidence=document["evidence"] and Evidence(**document["evidence"]),
                alternatives=tuple(map(_alternative_from_json, document["alternatives"])),
                covariance=_covariance_from_json(document),
                warnings=tuple(document["warnings"]),
                **{name: document[name] for name in _PLAIN_FIELDS},
            )
        except (json.JSONDecodeError, KeyError, RecursionError, TypeError) as error:
            raise InputError(
                f"result: found {error!r}, wanted one JSON object of format {FORMAT!r}"
            ) from error


def result_of(
    found: Localization,
    cloud: str | tuple[str, ...],
    pano: str,
    seconds: dict[str, float],
    settings: dict[str, object],
    warnings: tuple[str, ...] = (),
) -> Result:
    """The result of a localization, with the names of the files and what it took."""
    values = {f.name: getattr(found, f.name) for f in fields(found)}
    values["warnings"] = warnings + found.warnings
    return Result(cloud=cloud, pano=pano, seconds=seconds, settings=settings, **values)


_PLAIN_FIELDS = ("status", "confidence", "pano", "loss", "seconds", "settings")


def _pose_json(pose: Pose | None) -> dict[str, object]:
    return {
        "R_cam_from_world": pose and pose.R_cam_from_world.tolist(),
        "center_world": pose and pose.center_world.tolist(),
    }


def _pose_from_json(document: dict[str, Any]) -> Pose | None:
    R, center = document["R_cam_from_world"], document["center_world"]
    return None if R is None else Pose(np.array(R), np.array(center))


def _covariance_from_json(document: dict[str, Any]) -> PoseCovariance | None:
    matrix = document["covariance"]
    return (
        None if matrix is None else PoseCovariance(np.array(matrix), document["least_constrained_direction"])
    )


def _alternative_from_json(document: dict[str, Any]) -> Hypothesis:
    pose = Pose(np.array(document["R_cam_from_world"]), np.array(document["center_world"]))
    return Hypothesis(pose, document["score"])


def _place(h: Hypothesis) -> str:
    x, y, z = h.pose.center_world
    return f"({x:.3f}, {y:.3f}, {z:.3f}) m, score {h.score:.2f}"


def _paths(value: object) -> tuple[str, ...]:
    """A list of paths; TypeError for anything else."""
    if not isinstance(value, list) or not all(isinstance(path, str) for path in value):
        raise TypeError("a cloud that is neither a path nor a list of paths")
    return tuple(value)


def read_results(paths: Sequence[Path]) -> list[Result]:
    """The results in files of JSON lines, their poses checked.

    Raises
    ------
    InputError
        A line is no result, or a file has none.
    """
    results = []
    for path in paths:
        found = parse_lines(path, read_bytes(path, WANTED), _checked_result)
        if not found:
            raise InputError(f"{path}: found no result, {WANTED}")
        results += found
    return results


def _checked_result(text: str) -> Result:
    """A result of one line; refused are names and numbers that can't be written, and a pose that is none."""
    result = Result.from_json(text)
    for label, value in (("status", result.status), ("cloud", result.cloud_name), ("pano", result.pano)):
        if not isinstance(value, str) or UNWRITABLE.search(value):
            raise InputError(f"result: found {label} {value!r}, wanted text on one line")
    values = [result.confidence, *([result.evidence.score] if result.evidence else [])]
    if not all(isinstance(value, int | float) and math.isfinite(value) for value in values):
        raise InputError(f"result: found confidence and score {values}, wanted finite numbers")
    if result.pose is not None:
        R, center = result.pose.R_cam_from_world, result.pose.center_world
        is_number = R.dtype.kind in "fiu" and center.dtype.kind in "fiu"
        if not (is_number and center.shape == (3,) and np.isfinite(center).all()):
            raise InputError("result: found no numbers of a pose, wanted R_cam_from_world and center_world")
        checked_rotation(R, MAX_ROTATION_ERROR, "result: R_cam_from_world")
    return result
