"""Two runs over the same queries, side by side."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .query_result import QueryResult, Thresholds
from .statistics import Summary, summarize
from .tables import Table


@dataclass(frozen=True)
class Pair:
    """The same query in two runs."""

    first: QueryResult
    second: QueryResult

    def has_changed(self, thresholds: Thresholds) -> bool:
        """True if one run is correct where the other is wrong, or their statuses differ."""
        is_other_status = self.first.result.status != self.second.result.status
        return is_other_status or self.first.is_correct(thresholds) != self.second.is_correct(thresholds)


def pair_up(first: Sequence[QueryResult], second: Sequence[QueryResult]) -> list[Pair]:
    """The queries that both runs have, in the order of their names."""
    others = {row.key: row for row in second}
    pairs = [Pair(row, others[row.key]) for row in first if row.key in others]
    return sorted(pairs, key=lambda pair: pair.first.key)


def side_by_side(pairs: Sequence[Pair], names: tuple[str, str], thresholds: Thresholds) -> Table:
    """The statistics of two runs over the queries that both have."""
    runs = [summarize([p.first for p in pairs], thresholds), summarize([p.second for p in pairs], thresholds)]
    columns = "run", "queries", "correct", "accuracy", "localized", "wrong of these"
    rows = tuple((name, *_cells(run)) for name, run in zip(names, runs, strict=True))
    return Table("", (*columns, "t 50 % [m]", "R 50 % [deg]", "s"), rows)


def _cells(s: Summary) -> tuple[str, ...]:
    medians = f"{s.position_quartiles[1]:.4f}", f"{np.degrees(s.rotation_quartiles[1]):.3f}"
    counts = f"{s.num_queries}", f"{s.num_correct}", f"{s.accuracy:.3f}", f"{s.num_localized}"
    return (*counts, f"{s.num_wrong}", *medians, f"{s.seconds:.2f}")


def changes(pairs: Sequence[Pair], thresholds: Thresholds) -> Table:
    """The queries that one run alone gets right, or whose statuses differ."""
    rows = []
    for pair in pairs:
        if pair.has_changed(thresholds):
            was, is_now = pair.first.is_correct(thresholds), pair.second.is_correct(thresholds)
            kind = "same error" if was == is_now else "better" if is_now else "worse"
            cells = _outcome(pair.first), _outcome(pair.second)
            rows.append((pair.first.scene, pair.first.image, kind, *cells))
    columns = "scene", "panorama", "second is", "first", "second"
    return Table("queries that changed", columns, tuple(rows), 5)


def _outcome(row: QueryResult) -> str:
    error = f"{row.position_error:.3f} m, {np.degrees(row.rotation_error):.2f} deg"
    return f"{row.result.status} {row.result.confidence:.2f}: {error}"
