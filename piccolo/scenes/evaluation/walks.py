"""Statistics of walks: frames right, sure and refused, and the errors of the path."""

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ...geometry.pose import Array, Pose, angle_between
from ...result import Result
from ..scene import Query, Scene
from .query_result import PAPER_THRESHOLDS, QueryResult, Thresholds, make_query_result
from .tables import ALL, Table, count_rows


class Frame(NamedTuple):
    """A frame of a walk, and what was made of it."""

    query: Query
    row: QueryResult
    alone: QueryResult | None = None  # what was made of it without the others

    @property
    def sure_pose(self) -> Pose | None:
        """The pose of a frame that has one and is called localized."""
        return self.row.result.pose if self.query.is_answerable else None


class WalkSummary(NamedTuple):
    """Statistics of walks."""

    num_frames: int
    num_correct: int  # of the frames that have an answer
    num_localized: int  # of these
    num_wrong: int  # of all frames: localized and not correct
    num_bad: int  # frames without an answer
    num_refused: int  # of these: not localized
    squared_errors: Array  # (N,) of the positions of localized frames [m2]
    squared_steps: Array  # (M, 2) of the motion between neighbours both localized: [m2], [rad2]
    first_sure: float  # [s] until the last of the walks has a sure frame; inf if one has none

    @property
    def ate(self) -> float:
        """The absolute trajectory error of evo: root mean square of the positions', nothing aligned [m]."""
        return root_mean(self.squared_errors)

    @property
    def rpe(self) -> tuple[float, float]:
        """The relative pose error of evo for a step of one frame, root mean square: [m], [rad].

        Unlike evo's, steps over frames that are not localized are left out, not taken for one step.
        """
        return root_mean(self.squared_steps[:, 0]), root_mean(self.squared_steps[:, 1])


def root_mean(squares: Array) -> float:
    """Return the root of the mean (N,); NaN of nothing."""
    return float(np.sqrt(squares.mean())) if len(squares) else np.nan


def group_walks(scenes: Iterable[Scene], rows: Iterable[QueryResult]) -> dict[tuple[str, str], list[Frame]]:
    """Return the frames that have a result, by scene and walk, each walk's in the order of time."""
    by_key = {row.key: row for row in rows}
    walks: dict[tuple[str, str], list[Frame]] = {}
    for scene in scenes:
        for query in scene.queries:
            row = by_key.get((scene.name, scene.name_of(query)))
            if query.walk is not None and row is not None:
                frame = Frame(query, row, make_row_alone(scene, query, row.result))
                walks.setdefault((scene.name, query.walk), []).append(frame)
    return {name: sorted(frames, key=_time) for name, frames in sorted(walks.items())}


def make_row_alone(scene: Scene, query: Query, result: Result) -> QueryResult | None:
    """Return what was made of a frame without the others; None if it was not searched so."""
    alone = None if result.walk is None else result.walk.alone
    if alone is None:
        return None
    return make_query_result(scene, query, replace(result, status=alone.status, best_pose=alone.pose), None)


def _time(frame: Frame) -> float:
    return frame.query.time or 0.0


def step_errors(true: tuple[Pose, Pose], found: tuple[Pose, Pose]) -> tuple[float, float]:
    """Return the error [m], [rad] of a motion, evo's: inv(inv(Q_0) Q_1) inv(P_0) P_1 of T_world_from_cam."""
    true_motion, motion = (np.linalg.solve(a.T_world_from_cam, b.T_world_from_cam) for a, b in (true, found))
    error = np.linalg.solve(true_motion, motion)
    return float(np.linalg.norm(error[:3, 3])), angle_between(error[:3, :3], np.eye(3))


def summarize_walks(
    walks: Sequence[Sequence[Frame]], thresholds: Thresholds = PAPER_THRESHOLDS
) -> WalkSummary:
    """Return the statistics of walks, the frames of each in the order of time."""
    frames = [frame for walk in walks for frame in walk]
    counts = count_rows([frame.row for frame in frames], thresholds)
    bad = [frame.row for frame in frames if not frame.query.is_answerable]
    sure_bad = count_rows(bad, thresholds).num_localized
    steps = [
        step_errors((a.query.pose, b.query.pose), (a.sure_pose, b.sure_pose))
        for walk in walks
        for a, b in itertools.pairwise(walk)
        if a.sure_pose and b.sure_pose
    ]
    firsts = [next((_time(f) - _time(walk[0]) for f in walk if f.row.result.pose), np.inf) for walk in walks]
    return WalkSummary(
        len(frames),
        counts.num_correct,
        counts.num_localized - sure_bad,
        counts.num_wrong,
        len(bad),
        len(bad) - sure_bad,
        np.array([frame.row.position_error**2 for frame in frames if frame.sure_pose]),
        np.array(steps).reshape(-1, 2) ** 2,
        max(firsts, default=np.inf),
    )


def walk_table(walks: dict[tuple[str, str], list[Frame]], thresholds: Thresholds) -> Table:
    """Return a line a walk, and one of all."""
    summaries = {" ".join(name): summarize_walks([frames], thresholds) for name, frames in walks.items()}
    if len(summaries) > 1:
        summaries[ALL] = summarize_walks(list(walks.values()), thresholds)
    title = f"walks; correct: {thresholds}; ATE, RPE: RMSE of localized frames"
    columns = "walk", "frames", "correct", "localized", "wrong of all", "bad refused"
    errors = "ATE [m]", "RPE [m a frame]", "RPE [deg]", "first localized [s]"
    return Table(title, (*columns, *errors), tuple((name, *_cells(s)) for name, s in summaries.items()))


def alone_table(walks: dict[tuple[str, str], list[Frame]], thresholds: Thresholds) -> Table:
    """Return a line a walk: its frames that were searched alone, by themselves and with the others."""
    columns = [f"{what} {how}" for how in ("alone", "together") for what in ("correct", "localized", "wrong")]
    rows = []
    for name, frames in walks.items():
        searched = [(frame.alone, frame.row) for frame in frames if frame.alone is not None]
        counts = [count_rows(some, thresholds) for some in zip(*searched, strict=True)]
        cells = [f"{n}" for c in counts for n in c] or ["-"] * len(columns)
        rows.append((" ".join(name), f"{len(searched)}", *cells))
    return Table("frames that were searched in the whole scan", ("walk", "frames", *columns), tuple(rows))


def _cells(s: WalkSummary) -> list[str]:
    num_good = s.num_frames - s.num_bad
    fractions = [_fraction(s.num_correct, num_good), _fraction(s.num_localized, num_good)]
    refused = f"{s.num_refused} of {s.num_bad}" if s.num_bad else "-"
    step, turn = s.rpe
    path = _number(s.ate, 4), _number(step, 4), _number(float(np.degrees(turn)), 3), _number(s.first_sure, 1)
    return [f"{s.num_frames}", *fractions, f"{s.num_wrong}", refused, *path]


def _fraction(count: int, total: int) -> str:
    return f"{count / total:.3f}" if total else "-"


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if np.isfinite(value) else "-"
