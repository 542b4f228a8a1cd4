"""Tables of walks: frames right, sure and refused, alone and with the others."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import chain
from typing import NamedTuple

from piccolo.result import Result
from piccolo.scene import Query, Scene

from .query_result import QueryResult, Thresholds, make_query_result
from .tables import ALL, Table, count_rows


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
    rows = [(name, *_cells(frames, thresholds)) for name, frames in (walks | every).items()]
    return Table(f"walks; correct: {thresholds}", columns, tuple(rows))


def _cells(frames: Sequence[Frame], thresholds: Thresholds) -> list[str]:
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
