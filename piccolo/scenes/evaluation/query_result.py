"""The errors of one result against the true pose."""

import json
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...errors import InputError, printable
from ...files.json_file import document_of
from ...geometry.pose import MAX_ANGLE, MAX_DISTANCE, Array, Pose, pose_errors
from ...result import Result
from ...scan import Scan
from ..scene import Query, Scene

FORMAT = "piccolo-evaluation/1"
VIDEO_FRAME = re.compile(r"(.+)#t=(\d+\.\d+)")
MAX_TIME_DIFFERENCE = 2e-3  # [s] of a video's frame from a walk's


class Thresholds(NamedTuple):
    """Errors below which a pose is correct."""

    max_distance: float = MAX_DISTANCE  # [m]
    max_angle: float = MAX_ANGLE  # [rad]

    def __str__(self) -> str:
        """In words."""
        return f"under {self.max_distance:g} m and {np.degrees(self.max_angle):g} deg"


PAPER_THRESHOLDS = Thresholds()


@dataclass(frozen=True)
class QueryResult:
    """The result of one query of one scene, and its errors."""

    scene: str
    image: str  # as the scene's queries.json names it
    variant: str
    is_in_box: bool | None  # the true position lies in the box of the cloud's points; None if not known
    position_error: float  # [m], inf without a pose, or of a photo that has no answer
    rotation_error: float  # [rad], likewise
    result: Result

    @property
    def key(self) -> tuple[str, str]:
        """The query, unique in a run."""
        return self.scene, self.image

    @property
    def has_errors(self) -> bool:
        """True if there is a pose, and a true one."""
        return bool(np.isfinite(self.position_error))

    @property
    def seconds(self) -> float:
        """All stages but reading the photo."""
        return sum(seconds for stage, seconds in self.result.seconds.items() if stage != "read")

    def is_correct(self, thresholds: Thresholds = PAPER_THRESHOLDS) -> bool:
        """True if both errors are below the thresholds."""
        return self.position_error < thresholds.max_distance and self.rotation_error < thresholds.max_angle

    def to_json(self) -> str:
        """One line."""
        names = "scene", "image", "variant", "is_in_box"
        line: dict[str, object] = {"format": FORMAT, **{name: getattr(self, name) for name in names}}
        line["position_error"] = self.position_error if self.has_errors else None
        line["rotation_error_deg"] = float(np.degrees(self.rotation_error)) if self.has_errors else None
        line["result"] = json.loads(self.result.to_json())
        return json.dumps(line, allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> "QueryResult":
        """Read back what `to_json` wrote; any other text is an InputError."""
        with document_of(text, FORMAT, "evaluation") as row:
            distance = row["position_error"]
            angle_deg = row["rotation_error_deg"]
            words = str(row["scene"]), str(row["image"]), str(row["variant"])
            position_error = np.inf if distance is None else float(distance)
            rotation_error = np.inf if angle_deg is None else float(np.radians(angle_deg))
            result = Result.from_json(json.dumps(row["result"]))
            return cls(*words, row["is_in_box"], position_error, rotation_error, result)


def query_result_of(scene: Scene, query: Query, result: Result, is_in_box: bool | None) -> QueryResult:
    """A query's result with its errors."""
    pose = result.best_pose if query.is_answerable else None
    errors = (np.inf, np.inf) if pose is None else pose_errors(pose, query.pose)
    return QueryResult(scene.name, scene.name_of(query), query.variant, is_in_box, *errors, result)


def is_in_box(scan: Scan, pose: Pose) -> bool:
    """True if a pose's position lies in the bounding box of a localizer's cloud (the paper's protocol)."""
    points = scan.points
    center: Array = scan.from_world(pose).center_world
    axes = zip(center, (points.x, points.y, points.z), strict=True)
    return all(bool(axis.min() <= value <= axis.max()) for value, axis in axes)


def frames_of_video(pairs: Sequence[tuple[Scene, Query]], pano: str) -> list[tuple[Scene, Query]]:
    """The queries that a frame of a video may be: of the walk of its name, at its time."""
    found = VIDEO_FRAME.fullmatch(pano)
    if found is None:
        return []
    walk = Path(found[1]).stem
    time = float(found[2])
    of_walk = [pair for pair in pairs if pair[1].walk == walk]
    return [pair for pair in of_walk if abs((pair[1].time or 0.0) - time) < MAX_TIME_DIFFERENCE]


def match_results(
    scenes: Sequence[Scene], results: Sequence[Result], tell: Callable[[str], object]
) -> Iterator[QueryResult]:
    """Results of localize.py with their errors; each belongs to the query whose image it names.

    The image is found by its path, or else by its file name if only one query has that. A frame of a video,
    FOLDER/WALK.mp4#t=SECONDS, is the query of the walk of that name and time.

    A result of no query, or of a name that several have, goes to `tell` and is left out. Raises
    InputError for a second result of a query.
    """
    pairs = [(scene, query) for scene in scenes for query in scene.queries]
    queries = [(*pair, path) for pair in pairs for path in (pair[1].image, pair[1].labels) if path]
    by_path = {path.resolve(): (scene, query) for scene, query, path in queries}
    done: set[tuple[str, str]] = set()
    for result in results:
        found = by_path.get(Path(printable(result.pano)).resolve())  # queries have printable names
        named = [(scene, query) for scene, query, path in queries if path.name == Path(result.pano).name]
        named += frames_of_video(pairs, result.pano)
        if found is None and len(named) != 1:
            names = sorted(path.name for _, _, path in queries)[:3]
            text = f"{len(named)} queries of this name" if named else "a result without a true pose"
            tell(f"{result.pano}: found {text}, wanted one of {names} ...")
            continue
        row = query_result_of(*(found or named[0]), result, None)
        if row.key in done:
            raise InputError(f"{result.pano}: found a second result of this panorama, wanted one")
        done.add(row.key)
        yield row
