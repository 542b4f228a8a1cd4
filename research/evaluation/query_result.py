"""Results of queries with their errors against the true poses, and runs: files with one on each line."""

import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from piccolo.api.scan import Scan
from piccolo.batch.results_file import check_as_expected
from piccolo.geometry.pose import MAX_ANGLE, MAX_DISTANCE, Pose, pose_errors
from piccolo.judge.probability import LOCALIZED
from piccolo.judge.result import Result
from piccolo.system.arrays import Array
from piccolo.system.errors import InputError, printable
from piccolo.system.files.json_file import parse_lines, read_bytes, reading_document
from piccolo.system.files.line_file import whole_size

from ..scene import Query, Scene, document_of_pose, pose_of

FORMAT = "piccolo-evaluation/2"
WANTED = "wanted a run of tools/evaluate.py"
LINE_BEGINS = f'{{"format": "{FORMAT}"'.encode()
MAX_DIFFERENCE = 1e-6  # [m], [rad] between the same poses
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
    true_pose: Pose | None  # None of a photo that has no answer
    result: Result

    @property
    def key(self) -> tuple[str, str]:
        """The query, unique in a run."""
        return self.scene, self.image

    @property
    def has_errors(self) -> bool:
        """True if there is a pose, and a true one."""
        return self.result.best_pose is not None and self.true_pose is not None

    @cached_property
    def errors(self) -> tuple[float, float]:
        """Errors of the best pose [m], [rad]; infinite without one, or without a true one."""
        if self.result.best_pose is None or self.true_pose is None:
            return np.inf, np.inf
        return pose_errors(self.result.best_pose, self.true_pose)

    @property
    def position_error(self) -> float:
        """Of the best pose [m]."""
        return self.errors[0]

    @property
    def rotation_error(self) -> float:
        """Of the best pose [rad]."""
        return self.errors[1]

    @property
    def is_localized(self) -> bool:
        """True if the method is sure."""
        return self.result.status == LOCALIZED

    @property
    def seconds(self) -> float:
        """All stages but reading the photo."""
        return sum(seconds for stage, seconds in self.result.seconds.items() if stage != "read")

    def is_correct(self, thresholds: Thresholds = PAPER_THRESHOLDS) -> bool:
        """Return True if both errors are below the thresholds."""
        return self.position_error < thresholds.max_distance and self.rotation_error < thresholds.max_angle

    def to_json(self) -> str:
        """One line."""
        names = "scene", "image", "variant", "is_in_box"
        line: dict[str, object] = {"format": FORMAT, **{name: getattr(self, name) for name in names}}
        line["position_error"] = self.position_error if self.has_errors else None
        line["rotation_error_deg"] = float(np.degrees(self.rotation_error)) if self.has_errors else None
        line["true_pose"] = self.true_pose and document_of_pose(self.true_pose)
        line["result"] = json.loads(self.result.to_json())
        return json.dumps(line, allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> "QueryResult":
        """Read back what `to_json` wrote; any other text is an InputError."""
        with reading_document(text, FORMAT, "evaluation") as row:
            true_pose = None if row["true_pose"] is None else pose_of(row["true_pose"])
            scene = str(row["scene"])
            image = str(row["image"])
            variant = str(row["variant"])
            result = Result.from_json(json.dumps(row["result"]))
            return cls(scene, image, variant, row["is_in_box"], true_pose, result)


def make_query_result(scene: Scene, query: Query, result: Result, is_in_box: bool | None) -> QueryResult:
    """Return a query's result, with its true pose if it has one."""
    true_pose = query.pose if query.is_answerable else None
    return QueryResult(scene.name, scene.name_of(query), query.variant, is_in_box, true_pose, result)


def is_in_box(scan: Scan, pose: Pose) -> bool:
    """Return True if a pose lies in the bounding box of the scan's points (the paper's protocol)."""
    points = scan.prepared.points
    center: Array = scan.prepared.from_world(pose).center_world
    axes = zip(center, (points.x, points.y, points.z), strict=True)
    return all(bool(axis.min() <= value <= axis.max()) for value, axis in axes)


def frames_of_video(pairs: Sequence[tuple[Scene, Query]], pano: str) -> list[tuple[Scene, Query]]:
    """Return the queries that a frame of a video may be: of the walk of its name, at its time."""
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
    by_path = {query.image.resolve(): (scene, query) for scene, query in pairs}
    done: set[tuple[str, str]] = set()
    for result in results:
        found = by_path.get(Path(printable(result.pano)).resolve())  # queries have printable names
        named = [pair for pair in pairs if pair[1].image.name == Path(result.pano).name]
        named += frames_of_video(pairs, result.pano)
        if found is None and len(named) != 1:
            names = sorted(query.image.name for _, query in pairs)[:3]
            text = f"{len(named)} queries of this name" if named else "a result without a true pose"
            tell(f"{result.pano}: found {text}, wanted one of {names} ...")
            continue
        row = make_query_result(*(found or named[0]), result, None)
        if row.key in done:
            raise InputError(f"{result.pano}: found a second result of this panorama, wanted one")
        done.add(row.key)
        yield row


def read_run(path: Path) -> tuple[list[QueryResult], int]:
    """Return the queries of a run, and the size [byte] of the file up to its last whole line.

    Raises InputError if a line is none of a run; an unfinished last line was being written, and is left out.
    """
    content = read_bytes(path, WANTED)
    size = whole_size(path, LINE_BEGINS, "a run of tools/evaluate.py")
    rows = parse_lines(path, content[:size], QueryResult.from_json)
    return list({row.key: row for row in rows}.values()), size


def check_run(
    path: Path, rows: Sequence[QueryResult], scenes: Sequence[Scene], expected: Mapping[str, Any]
) -> None:
    """Refuse rows that were made with other settings than the expected, other true poses or other scenes."""
    queries = {(s.name, s.name_of(query)): query for s in scenes for query in s.queries}
    for row in rows:
        found = {"line": path, "settings": row.result.settings}
        check_as_expected(found, expected, "choose another file")
        if row.key in queries and not _is_of(row, queries[row.key]):
            text = "made with another true pose or another scene of this name; choose another file"
            raise InputError(f"{path}: found a result of {row.scene}, {row.image} {text}")


def _is_of(row: QueryResult, query: Query) -> bool:
    """Return True if a result's true pose is that of this query."""
    expected = query.pose if query.is_answerable else None
    if row.true_pose is None or expected is None:
        return row.true_pose is expected
    return max(pose_errors(row.true_pose, expected)) < MAX_DIFFERENCE


def check_variants(scenes: Sequence[Scene], variants: Sequence[str]) -> None:
    """Refuse variants that no query of the scenes has."""
    known = {query.variant for scene in scenes for query in scene.queries}
    if missing := [variant for variant in variants if variant not in known]:
        raise InputError(f"`variants`: found no {missing[0]}, wanted some of {', '.join(sorted(known))}")
