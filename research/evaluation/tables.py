"""Statistics of an evaluation, as tables in Markdown and CSV, and plots: of one run, of two, of walks."""

import csv
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain, pairwise
from typing import Any, NamedTuple

import numpy as np

from piccolo.apps.export.formats import cell
from piccolo.judge.result import Result
from piccolo.system.arrays import Array
from piccolo.system.errors import import_optional, printable

from ..scene import Query, Scene
from .query_result import PAPER_THRESHOLDS, QueryResult, Thresholds, make_query_result

HUGE = 1e30  # stands for an error without a pose while quartiles are interpolated
ACCURACY_DISTANCES = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0)  # [m]
CONFIDENCES = (0.999, 0.99, 0.95, 0.9, 0.7, 0.5, 0.2, 0.0)
PERCENTS = (25, 50, 75)
ALL = "all"
Figure = Any  # of matplotlib, which is imported when one is drawn
POSITIONS = (1e-4, 30.0)  # of the axis [m]
ROTATIONS_DEG = (1e-3, 180.0)
SHOWN_ANGLES_DEG = (1.0, 5.0, 10.0)  # at which recall over distance is drawn


class Counts(NamedTuple):
    """Numbers of queries that are right, or called localized."""

    num_correct: int
    num_localized: int
    num_wrong: int  # of the localized


def quartiles(values: Sequence[float]) -> Array:
    """Return the PERCENTS (3,) of values, some of which may be infinite."""
    found = np.percentile(np.minimum(values, HUGE), PERCENTS)
    return np.where(found > 1e-6 * HUGE, np.inf, found)


def statistics(rows: Sequence[QueryResult], thresholds: Thresholds = PAPER_THRESHOLDS) -> dict[str, str]:
    """Return the statistics of one or more queries by the columns of tables.

    Quartiles of the errors are over all queries, infinite where there is no pose; `t of correct` and the
    seconds are medians.
    """
    counts = count_rows(rows, thresholds)
    distances = quartiles([row.position_error for row in rows])
    angles_deg = np.degrees(quartiles([row.rotation_error for row in rows]))
    of_correct = [row.position_error for row in rows if row.is_correct(thresholds)] or [np.nan]
    return {
        "number": f"{len(rows)}",
        "correct": f"{counts.num_correct}",
        "accuracy": f"{counts.num_correct / len(rows):.3f}",
        **{f"t {p} % [m]": f"{value:.4f}" for p, value in zip(PERCENTS, distances, strict=True)},
        **{f"R {p} % [deg]": f"{value:.3f}" for p, value in zip(PERCENTS, angles_deg, strict=True)},
        "t of correct [m]": f"{np.median(of_correct):.4f}",
        "localized": f"{counts.num_localized}",
        "wrong of these": f"{counts.num_wrong}",
        "s": f"{np.median([row.seconds for row in rows]):.2f}",
    }


def count_rows(rows: Sequence[QueryResult], thresholds: Thresholds = PAPER_THRESHOLDS) -> Counts:
    """Return how many queries are correct, localized, and localized but wrong."""
    is_correct = [row.is_correct(thresholds) for row in rows]
    num_wrong = sum(row.is_localized and not right for row, right in zip(rows, is_correct, strict=True))
    return Counts(sum(is_correct), sum(row.is_localized for row in rows), num_wrong)


class Point(NamedTuple):
    """One point of the curve of risk over coverage."""

    confidence: float  # results from here on are accepted
    coverage: float  # fraction that is accepted
    risk: float  # fraction of these that is wrong
    num_wrong: int


def risk_and_coverage(rows: Sequence[QueryResult], thresholds: Thresholds = PAPER_THRESHOLDS) -> list[Point]:
    """Return the curve of risk over coverage, a point for each distinct confidence, from the highest down."""
    points: dict[float, Point] = {}
    num_wrong = 0
    for k, row in enumerate(sorted(rows, key=lambda row: -row.result.confidence), 1):
        num_wrong += not row.is_correct(thresholds)
        confidence = row.result.confidence
        points[confidence] = Point(confidence, k / len(rows), num_wrong / k, num_wrong)
    return list(points.values())


Pair = tuple[QueryResult, QueryResult]  # the same query in two runs


class Table(NamedTuple):
    """A table of text; the first `num_left` columns are words."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    num_left: int = 1

    def markdown(self) -> str:
        """Title and table."""
        marks = ["---"] * self.num_left + ["---:"] * (len(self.columns) - self.num_left)
        lines = [" | ".join(cells) for cells in (self.columns, *self.rows)]
        lines = [f"| {line} |" for line in lines]
        head = [self.title, ""] if self.title else []
        return "\n".join([*head, lines[0], f"|{'|'.join(marks)}|", *lines[1:], ""])


def table_of(lines: Sequence[Mapping[str, str]], title: str = "", num_left: int = 1) -> Table:
    """Return a table of lines whose cells are named by their columns."""
    return Table(title, tuple(lines[0]), tuple(tuple(line.values()) for line in lines), num_left)


def per_query(rows: Sequence[QueryResult]) -> Table:
    """One line a query."""
    columns = "scene", "panorama", "status", "error [m]", "error [deg]", "confidence", "score", "margin"
    cells = []
    for row in rows:
        result = row.result
        evidence = result.evidence
        score = (f"{evidence.score:.2f}", f"{evidence.margin:.2f}") if evidence else ("-", "-")
        errors = f"{row.position_error:.4f}", f"{np.degrees(row.rotation_error):.3f}"
        loss = "-" if result.loss is None else f"{result.loss:.3f}"
        words = row.scene, printable(row.image), result.status
        cells.append((*words, *errors, f"{result.confidence:.3f}", *score, loss, f"{row.seconds:.2f}"))
    return Table("", (*columns, "loss", "seconds"), tuple(cells), 3)


def groups(rows: Sequence[QueryResult]) -> Iterator[tuple[str, list[QueryResult]]]:
    """Yield the queries of each variant, of each scene, and all; a grouping of one group is left out."""
    for kind in ("variant", "scene"):
        names = sorted({getattr(row, kind) for row in rows})
        if len(names) > 1:
            yield from ((name, [row for row in rows if getattr(row, kind) == name]) for name in names)
    yield ALL, list(rows)


def summary_table(rows: Sequence[QueryResult], thresholds: Thresholds, title: str) -> Table:
    """Quartiles of the errors, accuracy and statuses of every group."""
    lines = [{"queries": name, **statistics(some, thresholds)} for name, some in groups(rows)]
    return table_of(lines, f"{title}; correct: {thresholds}")


def threshold_table(rows: Sequence[QueryResult], thresholds: Thresholds) -> Table:
    """Accuracy at several distances."""
    title = f"accuracy: fraction under the distance and {np.degrees(thresholds.max_angle):g} deg"
    cells = []
    for name, some in groups(rows):
        levels = [Thresholds(distance, thresholds.max_angle) for distance in ACCURACY_DISTANCES]
        fractions = [sum(row.is_correct(level) for row in some) / len(some) for level in levels]
        cells.append((name, *(f"{fraction:.3f}" for fraction in fractions)))
    return Table(title, ("queries", *(f"{line:g} m" for line in ACCURACY_DISTANCES)), tuple(cells))


def risk_table(points: Sequence[Point]) -> Table:
    """Return the fraction accepted, and wrong of these, at a few minimum confidences."""
    cells = []
    for line in CONFIDENCES:
        if inside := [point for point in points if point.confidence >= line]:
            p = inside[-1]
            cells.append((f"{line}", f"{100 * p.coverage:.1f} %", f"{p.num_wrong}", f"{100 * p.risk:.2f} %"))
    columns = "min confidence", "accepted", "wrong of these", "wrong fraction"
    return Table("", columns, tuple(cells), 0)


def reliability_table(
    title: str, stated: Sequence[float], are_right: Sequence[bool], ends: Sequence[float]
) -> Table:
    """Return how many answers were right, by the probability that was stated, between consecutive `ends`."""
    rows = []
    for low, high in pairwise(ends):
        own = [k for k, p in enumerate(stated) if low <= p < high or p == high == ends[-1]]
        if own:
            means = [f"{np.mean([values[k] for k in own]):.3f}" for values in (stated, are_right)]
            rows.append((f"{low:g} to {high:g}", str(len(own)), *means))
    return Table("", (title, "answers", "mean stated", "fraction right"), tuple(rows))


def csv_text(rows: Sequence[QueryResult]) -> str:
    """One line a query, in base units, every digit; empty where there is no pose."""
    file = io.StringIO()
    columns = ("scene", "image", "variant", "is_in_box", "status", "confidence", "position_error_m")
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow((*columns, "rotation_error_deg", "loss", "seconds"))
    for row in rows:
        errors = (row.position_error, float(np.degrees(row.rotation_error))) if row.has_errors else ("", "")
        box = "" if row.is_in_box is None else str(row.is_in_box).lower()
        status = row.result.status, row.result.confidence
        words = cell(row.scene), cell(printable(row.image)), cell(row.variant), box
        writer.writerow((*words, *status, *errors, row.result.loss, round(row.seconds, 4)))
    return file.getvalue()


def pair_up(first: Sequence[QueryResult], second: Sequence[QueryResult]) -> list[Pair]:
    """Return the queries that both runs have, in the order of their names."""
    others = {row.key: row for row in second}
    pairs = [(row, others[row.key]) for row in first if row.key in others]
    return sorted(pairs, key=lambda pair: pair[0].key)


def side_by_side(pairs: Sequence[Pair], names: tuple[str, str], thresholds: Thresholds) -> Table:
    """Return the statistics of two runs over the queries that both have."""
    lines = []
    for k, name in enumerate(names):
        lines.append({"run": name, **statistics([pair[k] for pair in pairs], thresholds)})
    return table_of(lines)


def changes(pairs: Sequence[Pair], thresholds: Thresholds) -> Table:
    """Return the queries that one run alone gets right, or whose statuses differ."""
    rows = []
    for first, second in pairs:
        was = first.is_correct(thresholds)
        is_now = second.is_correct(thresholds)
        if was != is_now or first.result.status != second.result.status:
            kind = "same error" if was == is_now else "better" if is_now else "worse"
            rows.append((first.scene, printable(first.image), kind, _outcome(first), _outcome(second)))
    columns = "scene", "panorama", "second is", "first", "second"
    return Table("queries that changed", columns, tuple(rows), 5)


def _outcome(row: QueryResult) -> str:
    error = f"{row.position_error:.3f} m, {np.degrees(row.rotation_error):.2f} deg"
    return f"{row.result.status} {row.result.confidence:.2f}: {error}"


class Frame(NamedTuple):
    """A frame of a walk, and what was made of it."""

    query: Query
    row: QueryResult
    alone: QueryResult | None = None  # what was made of it without the others


def group_walks(scenes: Iterable[Scene], rows: Iterable[QueryResult]) -> dict[str, list[Frame]]:
    """Return the frames that have a result, by the names of scene and walk."""
    by_key = {row.key: row for row in rows}
    walks: dict[str, list[Frame]] = {}
    for scene in scenes:
        for query in scene.queries:
            row = by_key.get((scene.name, scene.name_of(query)))
            if query.walk is not None and row is not None:
                frame = Frame(query, row, make_row_alone(scene, query, row.result))
                walks.setdefault(f"{scene.name} {query.walk}", []).append(frame)
    return dict(sorted(walks.items()))


def make_row_alone(scene: Scene, query: Query, result: Result) -> QueryResult | None:
    """Return what was made of a frame without the others; None if it was not searched so."""
    alone = None if result.walk is None else result.walk.alone
    if alone is None:
        return None
    return make_query_result(scene, query, replace(result, status=alone.status, best_pose=alone.pose), None)


def walk_table(walks: dict[str, list[Frame]], thresholds: Thresholds) -> Table:
    """Return a line a walk, and one of all."""
    columns = "walk", "frames", "correct", "localized", "wrong of all", "bad refused"
    every = {ALL: list(chain.from_iterable(walks.values()))} if len(walks) > 1 else {}
    rows = [(name, *_cells_of_walk(frames, thresholds)) for name, frames in (walks | every).items()]
    return Table(f"walks; correct: {thresholds}", columns, tuple(rows))


def _cells_of_walk(frames: Sequence[Frame], thresholds: Thresholds) -> list[str]:
    every = count_rows([frame.row for frame in frames], thresholds)
    bad = [frame.row for frame in frames if not frame.query.is_answerable]
    sure_bad = count_rows(bad, thresholds).num_localized
    num_good = len(frames) - len(bad)
    of_good = every.num_correct, every.num_localized - sure_bad
    fractions = [f"{count / num_good:.3f}" if num_good else "-" for count in of_good]
    refused = f"{len(bad) - sure_bad} of {len(bad)}" if bad else "-"
    return [f"{len(frames)}", *fractions, f"{every.num_wrong}", refused]


def alone_table(walks: dict[str, list[Frame]], thresholds: Thresholds) -> Table:
    """Return a line a walk: its frames that were searched alone, by themselves and with the others."""
    columns = [f"{what} {how}" for how in ("alone", "together") for what in ("correct", "localized", "wrong")]
    rows = []
    for name, frames in walks.items():
        searched = [(frame.alone, frame.row) for frame in frames if frame.alone is not None]
        counts = [count_rows(some, thresholds) for some in zip(*searched, strict=True)]
        cells = [f"{n}" for c in counts for n in c] or ["-"] * len(columns)
        rows.append((name, f"{len(searched)}", *cells))
    return Table("frames that were searched in the whole scan", ("walk", "frames", *columns), tuple(rows))


def new_figure(**options: Any) -> Figure:
    """Return an empty figure that belongs to no window, by matplotlib, whose import takes half a second."""
    return import_optional("a plot", "matplotlib.figure", "plans").Figure(**options)


def figure_png(figure: Figure) -> bytes:
    """Return a figure as a PNG file."""
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=120)
    return file.getvalue()


def _fraction_below(axes: Any, errors: Sequence[float], label: str) -> None:
    """Draw the fraction of the errors below each value; queries without a pose never count."""
    finite = np.sort([error for error in errors if np.isfinite(error)])
    fractions = 100.0 * np.arange(1, len(finite) + 1) / max(len(errors), 1)
    last = fractions[-1] if len(fractions) else 0.0
    axes.step([1e-9, *finite, 1e9], [0.0, *fractions, last], where="post", label=label)


def errors_figure(runs: Mapping[str, Sequence[QueryResult]], thresholds: Thresholds) -> Figure:
    """Position and rotation error over the fraction of queries, and recall over thresholds, a line a run."""
    figure = new_figure(figsize=(14, 4.2), layout="constrained")
    position, rotation, recall = figure.subplots(1, 3)
    for name, rows in runs.items():
        _fraction_below(position, [row.position_error for row in rows], name)
        _fraction_below(rotation, [float(np.degrees(row.rotation_error)) for row in rows], name)
        for angle_deg in SHOWN_ANGLES_DEG:
            pairs = [(row.position_error, np.degrees(row.rotation_error)) for row in rows]
            inside = [distance if angle < angle_deg else np.inf for distance, angle in pairs]
            _fraction_below(recall, inside, f"{name}, under {angle_deg:g} deg")
    position.axvline(thresholds.max_distance, color="gray", linestyle=":")
    rotation.axvline(float(np.degrees(thresholds.max_angle)), color="gray", linestyle=":")
    recall.axvline(thresholds.max_distance, color="gray", linestyle=":")
    position.set(xlabel="position error [m]", xlim=POSITIONS)
    rotation.set(xlabel="rotation error [deg]", xlim=ROTATIONS_DEG)
    recall.set(xlabel="distance [m]", xlim=POSITIONS, title="recall")
    for axes in (position, rotation, recall):
        axes.set(xscale="log", ylim=(0, 101), ylabel="queries [%]")
        axes.grid(alpha=0.3)
        axes.legend(loc="lower right", fontsize="small")
    return figure


def risk_figure(points: Sequence[Point]) -> Figure:
    """Return the fraction that is wrong over the fraction that is accepted."""
    figure = new_figure(figsize=(6, 4), layout="constrained")
    axes = figure.add_subplot()
    coverage = [100 * p.coverage for p in points]
    risk = [100 * p.risk for p in points]
    axes.step([0.0, *coverage], [risk[0], *risk], where="pre")
    for line in (0.99, 0.9, 0.5):
        inside = [p for p in points if p.confidence >= line]
        if inside:
            axes.plot(100 * inside[-1].coverage, 100 * inside[-1].risk, "o", label=f"confidence {line}")
    axes.set(xlabel="accepted [%]", ylabel="wrong of the accepted [%]")
    axes.set(xlim=(0, 100), ylim=(0, max(5.0, 1.1 * max(risk))))
    axes.grid(alpha=0.3)
    if axes.get_legend_handles_labels()[0]:
        axes.legend()
    return figure
