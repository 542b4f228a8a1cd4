"""Statistics of walks: frames right, sure and refused, and the errors of the path."""

import itertools
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from ...confidence.confidence import LOCALIZED
from ...geometry.pose import Array, Pose, angle_between, pose_errors
from ...walk.localize import Alone
from ..scene import Query, Scene
from .query_result import PAPER_THRESHOLDS, QueryResult, Thresholds
from .tables import ALL, Table


class Frame(NamedTuple):
    """A frame of a walk, and what was made of it."""

    query: Query
    pose: Pose | None  # the best
    is_localized: bool
    alone: Alone | None = None  # what was made of it without the others

    @property
    def sure_pose(self) -> Pose | None:
        """The pose of a frame that has one and is called localized."""
        return self.pose if self.is_localized and self.query.is_answerable else None


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
    first_sure: float | None  # [s] until the last of the walks has a sure frame; None if one has none

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
                result = row.result
                alone = result.walk.alone if result.walk else None
                frame = Frame(query, result.best_pose, result.status == LOCALIZED, alone)
                walks.setdefault((scene.name, query.walk), []).append(frame)
    return {name: sorted(frames, key=_time) for name, frames in sorted(walks.items())}


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
    good = [frame for frame in frames if frame.query.is_answerable]
    errors = [pose_errors(f.pose, f.query.pose) if f.pose else (np.inf, np.inf) for f in good]
    is_correct = [d < thresholds.max_distance and a < thresholds.max_angle for d, a in errors]
    is_sure = [frame.is_localized for frame in good]
    num_refused = sum(not frame.is_localized for frame in frames if not frame.query.is_answerable)
    num_bad = len(frames) - len(good)
    num_wrong = sum(a and not b for a, b in zip(is_sure, is_correct, strict=True)) + num_bad - num_refused
    steps = [
        step_errors((a.query.pose, b.query.pose), (a.sure_pose, b.sure_pose))
        for walk in walks
        for a, b in itertools.pairwise(walk)
        if a.sure_pose and b.sure_pose
    ]
    firsts = [next((_time(f) - _time(walk[0]) for f in walk if f.is_localized), np.inf) for walk in walks]
    first_sure = max(firsts, default=np.inf)
    return WalkSummary(
        len(frames),
        sum(is_correct),
        sum(is_sure),
        num_wrong,
        num_bad,
        num_refused,
        np.array([d**2 for (d, _), sure in zip(errors, is_sure, strict=True) if sure]),
        np.array(steps).reshape(-1, 2) ** 2,
        first_sure if np.isfinite(first_sure) else None,
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
        searched = [(frame, frame.alone) for frame in frames if frame.alone is not None]
        alone = [f._replace(pose=a.pose, is_localized=a.status == LOCALIZED) for f, a in searched]
        counts: list[str] = []
        for some in (alone, [frame for frame, _ in searched]):
            s = summarize_walks([some], thresholds)
            counts += [f"{n}" if some else "-" for n in (s.num_correct, s.num_localized, s.num_wrong)]
        rows.append((" ".join(name), f"{len(searched)}", *counts))
    return Table("frames that were searched in the whole scan", ("walk", "frames", *columns), tuple(rows))


def _cells(s: WalkSummary) -> list[str]:
    num_good = s.num_frames - s.num_bad
    fractions = [_fraction(s.num_correct, num_good), _fraction(s.num_localized, num_good)]
    refused = f"{s.num_refused} of {s.num_bad}" if s.num_bad else "-"
    step, turn = s.rpe
    found = [_number(s.ate, 4), _number(step, 4), _number(float(np.degrees(turn)), 3)]
    first = "-" if s.first_sure is None else f"{s.first_sure:.1f}"
    return [f"{s.num_frames}", *fractions, f"{s.num_wrong}", refused, *found, first]


def _fraction(count: int, total: int) -> str:
    return f"{count / total:.3f}" if total else "-"


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if np.isfinite(value) else "-"
