"""The result of a photo, and its JSON."""

import json
from dataclasses import asdict, dataclass, field, fields, replace
from html import escape
from typing import Any

import numpy as np

from ..geometry.pose import Pose, check_pose, heading_pitch_roll_deg
from ..geometry.pose_gaussian import PoseGaussian
from ..geometry.sphere import CONVENTION
from ..photo.camera import Mount
from ..photo.camera.calibration import document_of as camera_document, read_mounts
from ..photo.photo import GpsPrior
from ..problem.accuracy import Accuracy, Demand
from ..system.arrays import Array
from ..system.errors import printable
from ..system.files.json_file import reading_document
from .accuracy_hint import explain_accuracy
from .belief import NOTHING, UNCONFIRMED, Belief, decide
from .pose_covariance import PoseCovariance
from .probability import AMBIGUOUS, LOCALIZED, NOT_LOCALIZED, Mirrored, Standing
from .result_parts import Alternative, Beside, Evidence, FocalLength, Source, SphereGeometry, WalkFrame

FORMAT = "piccolo-pose/13"
POSE_FIELDS = ("R_cam_from_world", "center_world", "quaternion_wxyz", "T_world_from_cam")
UNREADABLE = "unreadable"
FAILED = "failed"
STATUSES = (LOCALIZED, AMBIGUOUS, NOT_LOCALIZED, UNREADABLE, FAILED)
NOTHING_COUNTS = "no place for a camera, or nothing of the photo counts"
MAX_ROTATION_ERROR = 1e-6  # of R R^T from the identity, in a file
COVARIANCE_CONVENTION = (
    "of (w, d), rotation [rad] about the camera's axes, then translation [m] along the world's: "
    "R_true = exp([w]x) R_cam_from_world, center_true = center_world + d"
)


NO_SOURCE = Source()


@dataclass(frozen=True)
class Result:
    """Result of localizing one photo.

    Attributes
    ----------
    status
        "localized", "ambiguous" or "not_localized"; "unreadable" or "failed" if the photo was not read.
    pose
        `Pose` of a localized photo in the scan's own coordinates, else None.
    best_guess
        The best `Pose` found for a photo that is not localized; None if there is none.
    best_pose
        `pose` or `best_guess`, whichever there is.
    confidence
        Probability that `best_pose` is as exact as `settings` say, by default within 0.1 m and 5 degrees.
    place_probability
        Probability that its place is right, however exact it is.
    hint
        Which accuracy would accept a pose whose place is certain, one line; else None.
    probability_none
        Probability that neither `best_pose` nor an alternative is right; None if the photo was not read.
    belief
        `Belief`, from which the probabilities follow; `NOTHING` if the photo was not read.
    alternatives
        Other poses that explain the photo, best first, at most 5.
    evidence
        The measurements from which the confidence is computed.
    covariance
        `PoseCovariance` of `best_pose`; None if the points do not determine it, or with the preset paper.
    loss
        Sampling loss over the points that are visible from `best_pose`, 0 to sqrt(3).
    storey, height_above_floor
        Storey of `best_pose`, 1 for the lowest, and its height [m] above the floor there; None if no floor
        was found.
    scan
        Name of the scan in which `best_pose` lies, if the map has named scans.
    cloud, pano
        Paths of scan and photo as given; `cloud` is a tuple if several files are one scan.
    source
        Digests of scan and photo, the photo's size and capture time.
    cameras, focal_length
        Cameras of a photo that is no sphere; the estimate of its focal length if the given one is not exact.
    sphere
        The part of the sphere that a panorama shows, if the scan contradicts the part that it claims.
    gps_prior
        Where the photo's GPS position lies in the scan, if both are known.
    walk
        For a frame of a walk, how its pose was found. Status, pose and covariance are then those of the walk.
    beside
        For a photo that was not sure alone, the photos of the batch beside which it was localized again; for
        a photo of a group, the photos with which it was localized together.
    seconds
        Time [s] spent on this photo, by stage.
    settings, warnings
        The settings as they took effect; warnings about scan and photo, one line each.
    error
        The reason why a photo is "unreadable" or has "failed".
    """

    status: str = NOT_LOCALIZED
    confidence: float = 0.0
    cloud: str | tuple[str, ...] = ""
    pano: str = ""
    best_pose: Pose | None = None
    loss: float | None = None
    evidence: Evidence | None = None
    alternatives: tuple[Alternative, ...] = ()
    covariance: PoseCovariance | None = None
    seconds: dict[str, float] = field(default_factory=dict, hash=False)
    settings: dict[str, Any] = field(default_factory=dict, hash=False)
    warnings: tuple[str, ...] = ()
    source: Source = NO_SOURCE
    error: str | None = None
    gps_prior: GpsPrior | None = None
    cameras: tuple[Mount, ...] = ()
    focal_length: FocalLength | None = None
    sphere: SphereGeometry | None = None
    scan: str | None = None
    probability_none: float | None = None
    storey: int | None = None
    height_above_floor: float | None = None
    walk: WalkFrame | None = None
    beside: Beside | None = None
    belief: Belief = NOTHING
    # values that the method hands on until the result is complete; they are not written to files
    gaussian: PoseGaussian | None = field(default=None, compare=False, repr=False)  # of the pose, in the map
    # [rad] largest deviation of the position if focal length and stitching were exact
    std_of_fit: float | None = field(default=None, compare=False, repr=False)
    # evidence for the pose and each alternative
    standings: tuple[Standing, ...] = field(default=(), compare=False, repr=False)
    # None if the mirrored photo was not searched
    mirrored: Mirrored | None = field(default=None, compare=False, repr=False)

    def __post_init__(self) -> None:
        """Make the arrays read-only, as the JSON and the hash depend on them."""
        for part in (*self.poses, *filter(None, [self.covariance])):
            part.freeze()

    @property
    def poses(self) -> list[Pose]:
        """All poses: the best, the alternatives, and that of a walk's frame alone."""
        alone = self.walk.alone.pose if self.walk and self.walk.alone else None
        found = [self.best_pose, *(a.pose for a in self.alternatives), alone]
        return [pose for pose in found if pose is not None]

    @property
    def is_believed(self) -> bool:
        """Return True if there is a belief, even if it is that no pose was found."""
        return self.probability_none is not None or self.belief != NOTHING

    @property
    def is_calibrated(self) -> bool:
        """Return True if the probabilities are calibrated: not with the preset paper."""
        return self.probability_none is not None and self.settings.get("preset") != "paper"

    @property
    def pose(self) -> Pose | None:
        """Pose of a localized photo, else None."""
        return self.best_pose if self.status == LOCALIZED else None

    @property
    def best_guess(self) -> Pose | None:
        """The best pose found for a photo that is not localized; None if there is none."""
        return None if self.status == LOCALIZED else self.best_pose

    @property
    def pose_errors(self) -> Array:
        """Covariance (6, 6) of `best_pose`, as `covariance` has it; zeros if that is None."""
        return np.zeros((6, 6)) if self.covariance is None else self.covariance.matrix

    @property
    def place_probability(self) -> float:
        """Probability that the place of `best_pose` is right, however exact it is; 0 without a pose."""
        return self.belief.best_place

    @property
    def hint(self) -> str | None:
        """A line with the accuracy that would accept a pose whose place is certain; None if there is none."""
        asked = self.settings.get("accuracy")
        if self.status == LOCALIZED or self.covariance is None or not asked:
            return None
        doubt = self.belief.doubt
        if self.focal_length is not None:  # a focal length that need not be so exact is confirmed more easily
            doubt = max(1.0 - (1.0 - doubt) / (1.0 - UNCONFIRMED), 0.0)
        demand = Demand(Accuracy(**asked), self.settings["min_confidence"])
        return explain_accuracy(self.place_probability * (1.0 - doubt), self.covariance, demand)

    @property
    def cloud_name(self) -> str:
        """Path of the scan, or paths of its files, separated by commas."""
        return self.cloud if isinstance(self.cloud, str) else ", ".join(self.cloud)

    def take_belief(self, belief: Belief, min_confidence: float) -> "Result":
        """Return the result with a belief in its pose and alternatives, and the status that follows."""
        status, probabilities = decide(belief, min_confidence)
        *of_poses, none = probabilities.tolist()
        pairs = zip(self.alternatives, of_poses[1:], strict=True)
        return replace(
            self,
            status=status,
            confidence=of_poses[0] if of_poses else 0.0,
            probability_none=none,
            alternatives=tuple(replace(alternative, probability=p) for alternative, p in pairs),
            belief=belief,
        )

    def complete(self, blank: "Result") -> "Result":
        """Return the result with the names of files, settings and digests that a blank result has."""
        return replace(
            self,
            cloud=blank.cloud,
            pano=blank.pano,
            seconds=blank.seconds,
            settings=blank.settings,
            warnings=blank.warnings + self.warnings,
            source=blank.source,
            cameras=self.cameras or blank.cameras,
            walk=blank.walk,
            gaussian=None,
            std_of_fit=None,
            standings=(),
            mirrored=None,
        )

    def summary(self) -> str:
        """Return the result as a few lines of text."""
        if self.best_pose is None:
            lines = [f"{printable(self.pano)}: {self.status}"]
            if self.error or not self.warnings:
                lines.append(f"  {printable(self.error or NOTHING_COUNTS)}")
            return "\n".join(lines)
        x, y, z = self.best_pose.center_world
        total = sum(self.seconds.values())
        where = "at" if self.pose else "with the best guess"
        place = f"({x:.3f}, {y:.3f}, {z:.3f}) m{_in(self.scan)}"
        lines = [f"{printable(self.pano)}: {self.status} {where} {place} in {total:.1f} s"]
        if self.evidence is not None:
            e = self.evidence
            lines.append(
                f"  confidence {self.confidence:.3f}, score {e.score:.2f}, margin {e.margin:.2f}, "
                f"{100.0 * e.explained_fraction:.0f} % of the photo explained, "
                f"{100.0 * e.contradicted_fraction:.0f} % contradicted"
            )
        if self.covariance is not None:
            mm = 1000.0 * self.covariance.largest_std
            deg = self.covariance.std_deg.max()
            direction = self.covariance.least_constrained_direction
            lines.append(f"  one sigma {mm:.1f} mm {direction}, rotation {deg:.2f} deg")
        if self.status == AMBIGUOUS:
            shown = (h for h in self.alternatives if round(h.probability, 2) > 0.0)
            lines += [f"  or {_place(h)}" for h in shown]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        """Return the result as a table, which notebooks show."""
        rows = {"photo": self.pano, "status": self.status, "confidence": f"{self.confidence:.3f}"}
        if self.best_pose is not None:
            x, y, z = self.best_pose.center_world
            heading, pitch, roll = heading_pitch_roll_deg(self.best_pose)
            turned = f"heading {heading:.1f}, pitch {pitch:.1f}, roll {roll:.1f} deg"
            rows["pose" if self.pose else "best guess"] = f"({x:.3f}, {y:.3f}, {z:.3f}) m, {turned}"
        if self.covariance is not None:
            rows["one sigma"] = f"{1000.0 * self.covariance.largest_std:.1f} mm"
        rows |= {"hint": self.hint} if self.hint else {}
        rows |= {"warnings": "; ".join(self.warnings)} if self.warnings else {}
        rows |= {"error": self.error} if self.error else {}
        cells = (f"<tr><th>{name}</th><td>{escape(printable(text))}</td></tr>" for name, text in rows.items())
        return f"<table>{''.join(cells)}</table>"

    def to_json(self) -> str:
        """Return the result as JSON on one line (docs/RESULT.md). NaN and infinity raise ValueError."""
        from .. import __version__  # noqa: PLC0415  above this, the stub would be read before all others

        document = {
            "format": FORMAT,
            "status": self.status,
            "confidence": self.confidence,
            "place_probability": self.place_probability,
            "hint": self.hint,
            "probability_none": self.probability_none,
            "calibrated": self.is_calibrated,
            "belief": _belief_json(self.belief) if self.is_believed else None,
            "error": self.error,
            "cloud": self.cloud,
            "pano": self.pano,
            "camera": camera_document(self.cameras) if self.cameras else None,
            "focal_length": self.focal_length and asdict(self.focal_length),
            "sphere": self.sphere and asdict(self.sphere),
            **asdict(self.source),
            **(_pose_json(self.pose) or dict.fromkeys(POSE_FIELDS)),
            "best_guess": _pose_json(self.best_guess),
            "scan": self.scan,
            "storey": self.storey,
            "height_above_floor_m": self.height_above_floor,
            "loss": self.loss,
            "evidence": self.evidence and asdict(self.evidence),
            "alternatives": [_alternative_json(alternative) for alternative in self.alternatives],
            "covariance": self.covariance and self.covariance.matrix.tolist(),
            "covariance_convention": COVARIANCE_CONVENTION,
            "std_mm": self.covariance and self.covariance.std_mm.tolist(),
            "std_deg": self.covariance and self.covariance.std_deg.tolist(),
            "least_constrained_direction": self.covariance and self.covariance.least_constrained_direction,
            "convention": CONVENTION,
            "seconds": {stage: round(seconds, 4) for stage, seconds in self.seconds.items()},
            "gps_prior": self.gps_prior and asdict(self.gps_prior),
            "walk": self.walk and _walk_json(self.walk),
            "beside": self.beside and asdict(self.beside),
            "settings": self.settings,
            "warnings": list(self.warnings),
            "version": __version__,
        }
        return json.dumps(document, allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> "Result":
        """Return the result that `to_json` wrote. Raises InputError for any other text."""
        from msgspec import convert  # noqa: PLC0415  only reading results needs it

        with reading_document(text, FORMAT, "result") as document:
            walk = document["walk"]
            alone = walk and walk["alone"]
            if alone:
                walk = {**walk, "alone": {**alone, "pose": alone if alone["center_world"] else None}}
            matrix = document["covariance"]
            about = document["least_constrained_direction"]
            made = {
                "best_pose": document if document["status"] == LOCALIZED else document["best_guess"],
                "source": {f.name: document[f.name] for f in fields(Source)},
                "cameras": (),
                "belief": document["belief"] or asdict(NOTHING),
                "alternatives": [{**one, "pose": one} for one in document["alternatives"]],
                "covariance": matrix and {"matrix": matrix, "least_constrained_direction": about},
                "height_above_floor": document["height_above_floor_m"],
                "walk": walk,
            }
            plain = {f.name: document[f.name] for f in fields(cls) if f.compare and f.name not in made}
            result = convert(plain | made, cls, dec_hook=lambda _, rows: np.array(rows, np.float64))
            for pose in result.poses:
                check_pose(pose, "result", MAX_ROTATION_ERROR)
            camera = document["camera"]
            return replace(result, cameras=read_mounts(camera) if camera else ())


def nothing_found(*warnings: str, belief: Belief = NOTHING) -> Result:
    """Return the result of a photo for which no pose was found, with warnings that say why."""
    return Result(probability_none=1.0, warnings=warnings, belief=belief)


def _belief_json(belief: Belief) -> dict[str, object]:
    return {**asdict(belief), "ruled_out": sorted(belief.ruled_out)}


def _pose_json(pose: Pose | None) -> dict[str, object] | None:
    """Return a pose in all its forms, POSE_FIELDS."""
    return None if pose is None else {name: getattr(pose, name).tolist() for name in POSE_FIELDS}


def _alternative_json(alternative: Alternative) -> dict[str, object]:
    pose = {name: getattr(alternative.pose, name).tolist() for name in POSE_FIELDS[:2]}
    return pose | {f.name: getattr(alternative, f.name) for f in fields(alternative) if f.name != "pose"}


def _walk_json(walk: WalkFrame) -> dict[str, object]:
    alone: dict[str, object] | None = None
    if walk.alone is not None:
        about = {"status": walk.alone.status, "confidence": walk.alone.confidence}
        alone = {**about, **(_pose_json(walk.alone.pose) or dict.fromkeys(POSE_FIELDS))}
    plain = {"frame": walk.frame, "time": walk.time, "how": walk.how}
    return {**plain, "alone": alone, "gap": walk.gap and asdict(walk.gap)}


def _place(alternative: Alternative) -> str:
    x, y, z = alternative.pose.center_world
    return f"({x:.3f}, {y:.3f}, {z:.3f}) m{_in(alternative.scan)}, probability {alternative.probability:.2f}"


def _in(scan: str | None) -> str:
    return f" ({scan})" if scan else ""
